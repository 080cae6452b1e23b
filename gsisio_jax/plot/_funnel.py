"""`funnel`: the boxes of many cases closing in over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gsisio_jax._calls import named_arguments
from gsisio_jax.plot import style
from gsisio_jax.plot._framers import true_rows
from gsisio_jax.plot.dates import show_dates
from gsisio_jax.plot.scales import quantiles
from gsisio_jax.plot.tubes import Group, Tube, Tubes, read_tubes

LINES = 20  # cases drawn one by one


@named_arguments
def funnel(
    dataset: Any, signal: str | Sequence[str] | None = None, ax: Any = None, truth: Mapping[str, Any] | None = None
) -> Any:
    """Draw the boxes of many initial boxes or runs over time, closing in like a funnel.

    The light band is the hull of all boxes, the middle one goes from the 5 % quantile of the lower to the 95 % quantile
    of the upper bounds, the dark one from median to median; thin lines are single cases, 20 at most. Cases with
    conflicts (data that contradict the stated bounds) are red and dash-dotted, crosses are the steps. The bar behind
    the last step is as long as the steady width that the certificate promises. Where the noise varies along an axis,
    its middle level is drawn and named in the title; another one is had by ``.isel``.

    Boxes are drawn relative to the truth if it is given. If it is not, and at some step they have no point in common,
    they cannot be about one truth: then each is drawn around its own middle.

    Args:
        dataset: of a study with reduce=None, or an estimate of a batch.
        signal: one name or several; all states where left out.
        ax: one matplotlib axes per signal; a new figure where left out.
        truth: true values by signal name: (T,), or (S, T) with the axes of the cases in front; one row more or less
            than T is legal, as in `framers`.

    Returns:
        Array of axes, one per signal; the axes itself where `ax` is one axes.

    Raises:
        ValueError: there are no boxes over time, a name is not there, or a shape does not agree.
        MissingExtra: matplotlib is not installed.

    Source: theory 11.
    """
    style.require()
    tubes = read_tubes("funnel", dataset)
    if signal is None:
        signal = [one.name for one in tubes.series.values() if one.kind == "state"] or None
    chosen = tubes.chosen("funnel", signal)
    tubes.chosen("funnel", list(truth or {}))
    axes, figure = style.panels("funnel", len(chosen), ax, style.stacked)
    title = tubes.title
    for axis, tube in zip(axes, chosen, strict=True):
        rows = None
        if truth is not None and tube.name in truth:
            rows = true_rows("funnel", tube.name, truth[tube.name], len(tubes.time), tube.lower.shape[:-1])
        (group,) = tubes.groups(tube, 1, rows)
        _panel(axis, tubes, tube, group)
        show_dates(axis, tubes.time_label)
        if style.in_last_row(axis, axes):
            axis.set_xlabel(tubes.time_label)
        if group.label and group.label not in title:
            title = ", ".join(part for part in (title, group.label) if part)
    if figure is not None:
        style.complete(figure, axes, title)
    return style.handed_back(ax, axes)


def _panel(axis: Any, tubes: Tubes, tube: Tube, group: Group) -> None:
    time = tubes.time
    lower, upper, about = _centred(group)
    axis.set_ylabel(style.label(tube.name + about, tube.unit))
    axis.margins(x=0.01)
    axis.grid(alpha=0.25)
    # An infinite side is left out of the hull and marked.
    unbounded = (np.isinf(lower) | np.isinf(upper)).any(axis=0)
    low, high = (np.where(np.isinf(side), np.nan, side) for side in (lower, upper))
    count = len(lower)
    text = f"hull of {count} boxes" if count > 1 else "guaranteed box"
    with np.errstate(invalid="ignore"):
        hull = np.fmin.reduce(low, axis=0), np.fmax.reduce(high, axis=0)
    axis.fill_between(time, *hull, color=style.BAND, alpha=0.3, linewidth=0, label=text, zorder=2)
    for side in hull:
        axis.plot(time, side, color=style.EDGE, linewidth=1.1, zorder=4)
    if count > 1:
        for share, alpha, text in ((0.05, 0.45, "5 % lower to 95 % upper"), (0.5, 0.75, "median box")):
            # NaN counts as largest: turned around, the lower side is treated as the upper one is.
            inner = -quantiles(-low, (1 - share,))[0], quantiles(high, (1 - share,))[0]
            axis.fill_between(time, *inner, color=style.BAND, alpha=alpha, linewidth=0, label=text, zorder=2.2)
        for case in np.unique(np.linspace(0, count - 1, min(count, LINES)).astype(int)):
            for side in (low[case], high[case]):
                axis.plot(time, side, color=style.EDGE, linewidth=0.4, alpha=0.35, zorder=3)
    _conflicts(axis, time, low, high, group.conflicts)
    style.mark_unbounded(axis, time, unbounded, "some not bounded" if count > 1 else "not bounded", style.EDGE)
    if about:
        axis.axhline(0.0, color=style.TRUTH, linewidth=1.0, label="truth" if "truth" in about else None, zorder=5)
    _bar(axis, time, lower, upper, group.predicted)


def _conflicts(axis: Any, time: np.ndarray, low: np.ndarray, high: np.ndarray, bad: np.ndarray | None) -> None:
    """Cases whose data contradict the stated bounds at some step: dash-dotted in red, with crosses at these steps."""
    if bad is None:
        return
    broken = np.flatnonzero(bad.any(1))
    for place, case in enumerate(broken[:LINES]):
        for text, side in (("conflict" if place == 0 else "_", low[case]), ("_", high[case])):
            axis.plot(time, side, "-.", color=style.ALARM, linewidth=0.8, zorder=4.5)
            style.mark_conflicts(axis, time, side, bad[case], text)


def _centred(group: Group) -> tuple[np.ndarray, np.ndarray, str]:
    """The sides (N, T) as they are drawn, and what they are relative to."""
    if group.truth is not None:
        known = group.truth.shape[-1]
        rest = np.full((len(group.truth), group.lower.shape[-1] - known), np.nan)
        truth = np.concatenate([group.truth, rest], axis=1)
        return group.lower - truth, group.upper - truth, " minus truth"
    with np.errstate(invalid="ignore"):
        apart = np.fmax.reduce(group.lower, axis=0) > np.fmin.reduce(group.upper, axis=0)
    if not apart.any():
        return group.lower, group.upper, ""
    half = 0.5 * (group.upper - group.lower)
    return -half, half, " minus middle of box"


def _bar(axis: Any, time: np.ndarray, lower: np.ndarray, upper: np.ndarray, width: float | None) -> None:
    """A bar as long as the promised width behind the last step, around the middle of the last boxes."""
    known = np.flatnonzero((np.isfinite(lower) & np.isfinite(upper)).any(axis=0))
    if width is None or not np.isfinite(width) or len(known) == 0:
        return
    last = known[-1]
    middles = 0.5 * (lower[:, last] + upper[:, last])
    middle = float(np.median(middles[np.isfinite(middles)]))
    step = (time[-1] - time[0]) / max(len(time) - 1, 1) or 1.0
    at = time[-1] + max(0.02 * (time[-1] - time[0]), step)
    axis.errorbar(
        [at], [middle], yerr=0.5 * width, fmt="none", ecolor=style.CERTIFICATE, elinewidth=2.0, capsize=4, capthick=2.0,
        label="certificate: steady width", zorder=6,
    )  # fmt: skip
