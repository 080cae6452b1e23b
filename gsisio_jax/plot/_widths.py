"""`widths`: how wide the boxes are over time, beside what the certificate promises."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gsisio_jax._calls import named_arguments
from gsisio_jax.plot import style
from gsisio_jax.plot.dates import show_dates
from gsisio_jax.plot.scales import quantiles
from gsisio_jax.plot.tubes import Group, Tube, Tubes, read_tubes

SHARES = (0.05, 0.5, 0.95, 1.0)
LEVELS = 3


@named_arguments
def widths(
    dataset_or_estimate: Any, signals: str | Sequence[str] | None = None, certificate: Any = None, ax: Any = None
) -> Any:
    """Draw the width of the box of every signal over time.

    Of many cases the median, the band from 5 to 95 % of them, and the largest. Where the noise varies along an axis,
    the lowest, the middle and the highest level are drawn, each in its colour. The dashed line is the steady width that
    the certificate promises. Triangles at the upper edge are steps with an infinite width, red crosses steps whose data
    contradict the stated bounds (conflicts), and a curve with some is dash-dotted. Scales are logarithmic where
    the widths span more than a factor of 30.

    Args:
        dataset_or_estimate: of `estimate` (also of a batch), of `to_dataset`, or of a study with reduce=None.
        signals: names to draw, in order; all states and inputs where left out (``x1``, ``d1``, ... of an estimate).
        certificate: ``observer.certificate``; left out where the dataset holds the promised widths of each case.
        ax: one matplotlib axes per signal; a new figure where left out.

    Returns:
        Array of axes, one per signal; the axes itself where `ax` is one axes.

    Raises:
        ValueError: there are no boxes over time, a name is not there, the number of axes is wrong, or the certificate
            is of another system.
        MissingExtra: matplotlib is not installed.

    Source: theory 11.
    """
    style.require()
    tubes = read_tubes("widths", dataset_or_estimate, certificate)
    chosen = tubes.chosen("widths", signals)
    axes, figure = style.panels("widths", len(chosen), ax, style.stacked)
    for axis, tube in zip(axes, chosen, strict=True):
        _panel(axis, tubes, tube)
        show_dates(axis, tubes.time_label)
        if style.in_last_row(axis, axes):
            axis.set_xlabel(tubes.time_label)
    if figure is not None:
        style.complete(figure, axes, tubes.title)
    return style.handed_back(ax, axes)


def _panel(axis: Any, tubes: Tubes, tube: Tube) -> None:
    groups = tubes.groups(tube, LEVELS)
    axis.set_ylabel(style.label(f"width of {tube.name}", tube.unit))
    axis.margins(x=0.01)
    axis.grid(alpha=0.25)
    drawn = []
    for group, color in zip(groups, style.CYCLE, strict=False):
        alone = len(groups) == 1
        drawn += _curve(axis, tubes.time, group, color, alone)
        if group.predicted is not None and np.isfinite(group.predicted):
            dashed = style.CERTIFICATE if alone else color
            axis.axhline(group.predicted, color=dashed, linestyle="--", linewidth=1.3, zorder=3.5)
            drawn.append(group.predicted)
    # In grey where every group has its own colour.
    if any(group.predicted is not None and np.isfinite(group.predicted) for group in groups):
        color = style.CERTIFICATE if len(groups) == 1 else style.GREY
        axis.plot([], [], "--", color=color, linewidth=1.3, label="certificate: steady width")
    if len(groups) > 1 and len(groups[0].lower) > 1:
        axis.fill_between([], [], [], color=style.GREY, alpha=0.25, linewidth=0, label="5 to 95 % of them")
        axis.plot([], [], ":", color=style.GREY, linewidth=1.0, label="largest of them")
    style.fit(axis, drawn)
    if len(groups) == 1:
        axis.set_title(_words(groups[0]), loc="right", fontsize="small", color="#444444")


def _curve(axis: Any, time: np.ndarray, group: Group, color: str, alone: bool) -> list[Any]:
    """One group of cases; returns what it shows, for the choice of the scale."""
    width = group.upper - group.lower
    bad = np.zeros(len(time), bool) if group.conflicts is None else group.conflicts.any(0)
    starts = style.joined(len(time), style.MAXIMUM_POINTS)
    if len(starts) < len(time):
        # The largest of the neighbours: no width is drawn too small.
        time, width = time[starts], np.fmax.reduceat(width, starts, axis=1)
        bad = np.logical_or.reduceat(bad, starts)
    count = len(width)
    low, middle, high, most = (np.where(np.isinf(line), np.nan, line) for line in quantiles(width, SHARES))
    unbounded = np.isinf(width).any(axis=0)
    dashes = "-." if bad.any() else "-"
    if count == 1:
        text = group.label or "width of the guaranteed box"
        axis.plot(time, middle, dashes, color=color, linewidth=1.5, label=text, zorder=4)
    else:
        text = f"median of {count} cases" + (f", {group.label}" if group.label else "")
        axis.plot(time, middle, dashes, color=color, linewidth=1.6, label=text, zorder=4)
        band = "5 to 95 % of them" if alone else None
        top = style.beyond(low, high, [middle, most])
        axis.fill_between(time, low, top, color=color, alpha=0.22, linewidth=0, label=band, zorder=2)
        axis.plot(time, most, ":", color=color, linewidth=1.0, label="largest of them" if alone else None, zorder=3)
    style.mark_conflicts(axis, time, middle, bad, "conflict" if count == 1 else "conflict in some cases")
    text = "not bounded" if count == 1 else "some not bounded"
    style.mark_unbounded(axis, time, unbounded, text, color if alone else style.GREY)
    return [low, middle, most]


def _words(group: Group) -> str:
    """The last widths and the promise in numbers."""
    width = group.upper - group.lower
    known = np.flatnonzero(~np.isnan(width).any(axis=0))
    if len(known) == 0:
        return ""
    last = float(width[:, known[-1]].max())
    end = style.short(last) if np.isfinite(last) else "not bounded"
    said = f"{'last' if len(width) == 1 else 'largest last'} {end}"
    if group.predicted is None:
        return said
    return f"{said}, " + (
        f"certificate {style.short(group.predicted)}" if np.isfinite(group.predicted) else "no width certified"
    )
