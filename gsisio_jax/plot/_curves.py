"""`curves`: what a study kept, against one of its axes, beside what the certificate promises."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gsisio_jax._calls import named_arguments
from gsisio_jax.plot import style
from gsisio_jax.plot.scales import Merge, Scale, merge_of, quantiles
from gsisio_jax.plot.study import BESIDE, Quantity, axes_of, conflicts_of, prepared, quantities, title_of, with_entry

SINGLE = 5  # most cases that are drawn one by one


@named_arguments
def curves(
    dataset: Any,
    variable: str | None = None,
    x: str | None = None,
    signal: str | Sequence[str] | None = None,
    ax: Any = None,
) -> Any:
    """Draw what a study kept, against one of its axes: widths against the noise, say.

    Up to five cases of the other axes are drawn one by one; of more, the median, the band from 5 to 95 % of them, and
    the worst one. Of the summary of a Monte Carlo study, the mean with its confidence interval, and the largest. Dashed
    is the steady width that the certificate promises; where it differs between the cases, its smallest and largest.
    Triangles at the upper edge are elements with an infinite value. Red crosses are cases with conflicts (data that
    contradict the stated bounds), and a case with some is drawn dash-dotted. Scales are logarithmic where the numbers
    call for it.

    Args:
        dataset: of `sweep` or `monte_carlo`.
        variable: its name; where the boxes were kept also ``state_width`` and ``input_width``, at the last step. Left
            out: the last widths, or else the mean ones, ....
        x: axis to the right. Left out: that of the noise, or else the last but "run".
        signal: one name or several; where left out, all states.
        ax: one matplotlib axes per signal; a new figure where left out.

    Returns:
        Array of axes, one per signal; the axes itself where `ax` is one axes.

    Raises:
        ValueError: nothing was swept, or a name is not there.
        MissingExtra: matplotlib is not installed.

    Source: theory 11.
    """
    style.require()
    dataset = prepared("curves", dataset)
    found = quantities("curves", dataset, variable, signal, 1, (x,))
    directions = [_direction(dataset, one, x) for one in found]
    axes, figure = style.panels("curves", len(found), ax, style.tiled)
    for axis, one, to_the_right in zip(axes, found, directions, strict=True):
        scale = Scale.of(dataset, to_the_right)
        _panel(axis, dataset, one, scale)
        scale.decorate(axis, "x", figure is None or style.in_last_row(axis, axes))
    if figure is not None:
        style.complete(figure, axes, title_of(dataset))
    return style.handed_back(ax, axes)


def _direction(dataset: Any, one: Quantity, x: str | None) -> str:
    dims = [str(dim) for dim in one.values.dims if dim != "statistic"]
    if x is not None:
        if x not in dims:
            raise ValueError(f"curves: {one.variable!r} has no axis {x!r}; its axes are: {', '.join(dims)}")
        return x
    noise = [str(d) for name in BESIDE if name in dataset.data_vars for d in dataset[name].dims if d in dims]
    return (noise or sorted(dims, key=lambda dim: dim != "run"))[0 if noise else -1]


def _panel(axis: Any, dataset: Any, one: Quantity, scale: Scale) -> None:
    rest = [dim for dim in axes_of(dataset) if dim in one.values.dims and dim != scale.name]
    count = int(np.prod([one.values.sizes[dim] for dim in rest], dtype=int))
    if count > SINGLE:
        one = one.mean()
    axis.set_title(style.caption(one.signal), fontsize="medium")
    axis.set_ylabel(style.caption(style.with_unit(one.text, one.unit)))
    axis.grid(alpha=0.25)
    axis.margins(x=0.02 if scale.words is None else 0.1)
    found = None if one.variable == "conflicts" else conflicts_of(dataset, one.values)
    bad = None if found is None else _table(found, rest, scale) > 0
    if count > SINGLE:
        drawn = _many(axis, scale, _table(one.values, rest, scale), merge_of(one.variable, one.flags), bad)
    else:
        drawn = _few(axis, dataset, scale, one, rest, bad)
    if one.predicted is not None:
        drawn += _certificate(axis, scale, one, rest, count)
    style.fit(axis, drawn, 5.0 if scale.log else style.LOG_SPAN, zero="coverage" not in one.variable)


def _table(values: Any, rest: list[str], scale: Scale) -> np.ndarray:
    """(cases, S), or (cases, S, statistics)."""
    last = [dim for dim in ("statistic",) if dim in values.dims]
    table = values.transpose(*rest, scale.name, *last).values.astype(np.float64)
    return table.reshape(-1, *table.shape[len(rest) :])[:, scale.order]


def _finite(line: np.ndarray) -> np.ndarray:
    return np.where(np.isinf(line), np.nan, line)


def _many(axis: Any, scale: Scale, values: np.ndarray, merge: Merge, bad: np.ndarray | None) -> list[np.ndarray]:
    """Median, band and worst case of many cases; returns what is shown."""
    low, middle, high, worst = (_finite(line) for line in quantiles(values, (0.05, 0.5, 0.95, merge.worst)))
    color, drawn = style.CYCLE[0], [low, middle, worst]
    names = f"median of {len(values)} cases", "5 to 95 % of them", f"{'largest' if merge.worst else 'smallest'} of them"
    top = style.beyond(low, high, drawn)
    if scale.words is None:
        axis.plot(scale.at, middle, ".-", color=color, linewidth=1.6, label=names[0], zorder=4)
        axis.fill_between(scale.at, low, top, color=color, alpha=0.22, linewidth=0, label=names[1], zorder=2)
        axis.plot(scale.at, worst, ":", color=color, linewidth=1.2, label=names[2], zorder=3)
    else:
        axis.plot(scale.at, middle, "o", color=color, label=names[0], zorder=4)
        axis.vlines(scale.at, low, top, color=color, alpha=0.3, linewidth=7, label=names[1], zorder=2)
        axis.plot(scale.at, worst, "v", color=color, markersize=5, fillstyle="none", label=names[2], zorder=3)
    style.mark_unbounded(axis, scale.at, np.isinf(values).any(axis=0), "some infinite", style.GREY)
    if bad is not None:
        style.mark_conflicts(axis, scale.at, middle, bad.any(0) & ~bad.all(0), "conflicts in some cases")
        style.mark_conflicts(axis, scale.at, middle, bad.all(0), "conflicts in all cases")
    return drawn


def _few(
    axis: Any, dataset: Any, scale: Scale, one: Quantity, rest: list[str], bad: np.ndarray | None
) -> list[np.ndarray]:
    """Every case by itself, with its statistics if it has some; returns what is shown."""
    values = _table(one.values, rest, scale)
    labels = _entries(dataset, rest)
    statistics = [str(name) for name in one.values["statistic"].values] if "statistic" in one.values.dims else []
    share = dataset.attrs.get("confidence")
    interval = f"{100 * share:g} % confidence of the mean" if share is not None else "confidence of the mean"
    marks, drawn = (".-" if scale.words is None else "o"), []
    for case, color in enumerate(style.CYCLE[: len(values)]):
        alone, label = len(values) == 1, labels[case]
        named = dict(zip(statistics, np.moveaxis(values[case], -1, 0), strict=True)) if statistics else {}
        line = values[case] if not statistics else named.get("mean", values[case][..., 0])
        text = f"{'mean' if named else ''}{', ' if named and label else ''}{label}" or "measured"
        (drawn_line,) = axis.plot(scale.at, _finite(line), marks, color=color, linewidth=1.6, label=text, zorder=4)
        if bad is not None and bad[case].any():
            if scale.words is None:
                drawn_line.set_linestyle("-.")
            said = "with conflicts" if case == np.flatnonzero(bad.any(1))[0] else "_"
            style.mark_conflicts(axis, scale.at, _finite(line), bad[case], said)
        drawn.append(_finite(line))
        if {"mean_lower", "mean_upper"} <= named.keys():
            ends = [_finite(named[name]) for name in ("mean_lower", "mean_upper")]
            shown = interval if alone else None
            if scale.words is None:
                axis.fill_between(scale.at, *ends, color=color, alpha=0.3, linewidth=0, label=shown, zorder=2)
            else:
                axis.vlines(scale.at, *ends, color=color, alpha=0.4, linewidth=7, label=shown, zorder=2)
            drawn += ends
        if "max" in named:
            most = _finite(named["max"])
            dots = ":" if scale.words is None else "v"
            axis.plot(scale.at, most, dots, color=color, linewidth=1.2, markersize=5, fillstyle="none",
                      label="largest" if alone else None, zorder=3)  # fmt: skip
            drawn.append(most)
        style.mark_unbounded(axis, scale.at, np.isinf(line), "infinite", color if alone else style.GREY)
    if len(values) > 1 and statistics:
        axis.fill_between([], [], [], color=style.GREY, alpha=0.3, linewidth=0, label=interval)
        axis.plot([], [], ":", color=style.GREY, linewidth=1.2, label="largest")
    return drawn


def _entries(dataset: Any, rest: list[str]) -> list[str]:
    """What tells the cases apart, in C order of the axes."""
    words = [""]
    for dim in rest:
        mine = [with_entry(dataset, dim, value) for value in dataset[dim].values]
        words = [", ".join(filter(None, (before, now))) for before in words for now in mine]
    return words


def _certificate(axis: Any, scale: Scale, one: Quantity, rest: list[str], count: int) -> list[np.ndarray]:
    """The promised widths as dashed lines; returns what is shown."""
    values = one.values.isel(statistic=0) if "statistic" in one.values.dims else one.values
    promise = one.predicted.max([dim for dim in one.predicted.dims if dim not in values.dims])
    promise = _table(promise.broadcast_like(values), rest, scale)
    text, color = "certificate: steady width", style.CERTIFICATE
    if (promise == promise[:1]).all():
        lines = promise[:1]
    elif count <= SINGLE:
        lines, text = promise, "certificate, by color"
    else:
        lines, text = np.stack([promise.min(0), promise.max(0)]), "certificate: smallest and largest steady width"
    drawn = []
    for case, line in enumerate(lines):
        if not np.isfinite(line).any():
            continue
        if count <= SINGLE and len(lines) > 1:
            color = style.CYCLE[case]
        dashes = {"linestyle": "--"} if scale.words is None else {"linestyle": "", "marker": "_", "markersize": 18}
        label = text if not drawn else None
        axis.plot(scale.at, _finite(line), color=color, linewidth=1.4, markeredgewidth=1.8, label=label, zorder=3.5,
                  **dashes)  # fmt: skip
        drawn.append(_finite(line))
    return drawn
