"""`heatmap`: what a study kept, over two of its axes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsisio_jax._calls import named_arguments
from gsisio_jax.plot import style
from gsisio_jax.plot.scales import Scale, merge_of
from gsisio_jax.plot.study import Quantity, axes_of, conflicts_of, prepared, quantities, title_of

CELLS = 1000  # most cells along an axis
ROUNDING = 1e-9  # relative
COLORS = "viridis"  # even in lightness, for any colour vision and in print
INFINITE, UNKNOWN, NEVER = ("////", "infinite: not bounded"), ("....", "no value"), ("....", "never")
CONFLICTS = ("xx", "with conflicts: data contradict the bounds")
BORDER = "#d55e00"


@dataclass(frozen=True)
class Mesh:
    """Cells of one panel: values (Sy, Sx), their edges, and what was done to get them."""

    x: Scale
    y: Scale
    x_edges: np.ndarray
    y_edges: np.ndarray
    values: np.ndarray
    above: np.ndarray  # 1 where wider than certified, 0 where not, NaN where unknown
    conflicts: np.ndarray  # True where some case has steps whose data contradict the bounds
    remark: str


@named_arguments
def heatmap(
    dataset: Any,
    variable: str | None = None,
    x: str | None = None,
    y: str | None = None,
    signal: str | Sequence[str] | None = None,
    ax: Any = None,
    log: bool | None = None,
) -> Any:
    """Draw what a study kept, over two of its axes, as colours.

    Cells with conflicts (data that contradict the stated bounds) are crossed in red. Axes with numbers are drawn to
    scale, also where they are uneven, and logarithmic where they lie more evenly by their factors; others are
    categories. Cells without a finite value are hatched. A line separates widths above the steady width of the
    certificate from those below, unless it would wind through all of the panel. Cases of further axes are drawn by
    their median, or, for coverage, misses, conflicts and largest values, by the worst of them; the title says so. More
    than 1000 elements of an axis are joined in groups of neighbours, each drawn by its worst case.

    Args:
        dataset: of `sweep` or `monte_carlo`.
        variable: its name; where the boxes were kept also ``state_width`` and ``input_width``. Left out: the last
            widths, or else the mean ones, ....
        x: axis to the right, "time" included where the variable has it. Left out: the last but "run", or time where
            there is one axis only.
        y: axis upward.
        signal: one name or several; where left out, all states.
        ax: one matplotlib axes per signal; a new figure where left out. Colour bars take their room from it.
        log: colours by the logarithm; where left out, if the values span more than a factor of 30.

    Returns:
        Array of axes, one per signal; the axes itself where `ax` is one axes.

    Raises:
        ValueError: the study has less than two axes, a name is not there, or `log` is asked of values that are not
            positive.
        MissingExtra: matplotlib is not installed.

    Source: theory 11.
    """
    style.require()
    dataset = prepared("heatmap", dataset)
    found = [one.mean() for one in quantities("heatmap", dataset, variable, signal, 2, _wanted(dataset, x, y))]
    meshes = [_mesh(dataset, one, *_directions(dataset, one, x, y)) for one in found]
    axes, figure = style.panels("heatmap", len(found), ax, style.tiled)
    for axis, one, mesh in zip(axes, found, meshes, strict=True):
        _panel(axis, one, mesh, log)
        mesh.x.decorate(axis, "x", figure is None or style.in_last_row(axis, axes))
        first = figure is None or style.in_first_column(axis)
        mesh.y.decorate(axis, "y", first)
        axis.tick_params(labelleft=first or mesh.y.name != meshes[0].y.name)
        if figure is None and mesh.remark:
            # Without a figure of our own there is no other place to say it.
            axis.set_title(f"{axis.get_title()}\n{mesh.remark}".strip(), fontsize="medium")
    if figure is not None:
        remarks = list(dict.fromkeys(mesh.remark for mesh in meshes if mesh.remark))
        style.complete(figure, axes, "\n".join(part for part in (title_of(dataset), *remarks) if part))
    return style.handed_back(ax, axes)


def _wanted(dataset: Any, x: str | None, y: str | None) -> tuple[str | None, ...]:
    """The axes asked for; time as well where the study has but one axis."""
    return (x, y, "time") if len(axes_of(dataset)) < 2 else (x, y)


def _directions(dataset: Any, one: Quantity, x: str | None, y: str | None) -> tuple[str, str]:
    dims = [dim for dim in map(str, one.values.dims)]
    for name in (x, y):
        if name is not None and name not in dims:
            raise ValueError(f"heatmap: {one.variable!r} has no axis {name!r}; its axes are: {', '.join(dims)}")
    if x is not None and x == y:
        raise ValueError(f"heatmap: x and y are both {x!r}; give two of: {', '.join(dims)}")
    # Runs are many and have no order: they are drawn only where nothing else is left.
    free = [dim for dim in sorted(dims, key=lambda dim: dim != "run") if dim not in (x, y)]
    x = x or free.pop()
    return x, y or free.pop()


def _mesh(dataset: Any, one: Quantity, x: str, y: str) -> Mesh:
    rest = [str(dim) for dim in one.values.dims if dim not in (x, y)]
    values = one.values.transpose(*rest, y, x).values.astype(np.float64)
    merge = merge_of(one.variable, one.flags)
    remarks = []
    if rest:
        count = int(np.prod(values.shape[:-2]))
        values = np.asarray(merge.of(values.reshape(-1, *values.shape[-2:])), dtype=np.float64)
        remarks.append(f"{merge.word} over {count} cases ({', '.join(rest)})")
    scales = Scale.of(dataset, x), Scale.of(dataset, y)
    places = np.ix_(scales[1].order, scales[0].order)
    values = values[places]
    above = np.full(values.shape, np.nan)
    if one.predicted is not None and set(one.predicted.dims) <= {x, y}:
        every = one.predicted.broadcast_like(one.values.isel(dict.fromkeys(rest, 0)))
        # Where the promise is met exactly, rounding must not draw a line.
        limit = (1 + ROUNDING) * every.transpose(y, x).values[places]
        above = np.where(np.isnan(values), np.nan, values > limit)
    found = None if one.variable == "conflicts" or one.flags else conflicts_of(dataset, one.values)
    bad = np.zeros(values.shape, bool)
    if found is not None:
        bad = found.any(rest).transpose(y, x).values[places]
    edges = []
    for dim, scale in zip((1, 0), scales, strict=True):
        starts = style.joined(len(scale.at), CELLS)
        if len(starts) < len(scale.at):
            numbers = np.nan_to_num(values).astype(np.int64) if one.flags else values
            values = merge.pair.reduceat(numbers, starts, axis=dim).astype(np.float64)
            above = np.maximum.reduceat(above, starts, axis=dim)
            bad = np.logical_or.reduceat(bad, starts, axis=dim)
            remarks.append(f"{scale.name}: {len(scale.at)} in {len(starts)} groups, the worst of each")
        edges.append(scale.edges()[[*starts, len(scale.at)]])
    return Mesh(*scales, edges[0], edges[1], values, above, bad, ", ".join(remarks))


def _panel(axis: Any, one: Quantity, mesh: Mesh, log: bool | None) -> None:
    from matplotlib import colors

    axis.set_title(style.caption(one.signal), fontsize="medium")
    values = np.where(np.isfinite(mesh.values), mesh.values, np.nan)
    finite = values[~np.isnan(values)]
    caption = style.caption(style.with_unit(one.text, one.unit))
    draw = {"cmap": COLORS, "rasterized": True, "zorder": 1}
    if len(finite) == 0:
        axis.set_xlim(mesh.x_edges[[0, -1]])
        axis.set_ylim(mesh.y_edges[[0, -1]])
        # There is no color bar to say what is drawn.
        axis.set_title(style.caption(" ".join(filter(None, (one.signal, one.text)))), fontsize="medium")
    elif one.flags is not None:
        _flags(axis, one, mesh, values, caption, draw)
    else:
        if log and not (finite > 0).any():
            raise ValueError(f"heatmap: {one.variable!r} has no positive values, so log=True cannot be drawn")
        logarithmic = style.spans([finite]) if log is None else log
        least = float(finite[finite > 0].min()) if logarithmic else float(finite.min())
        most = float(finite.max())
        same = most <= least
        if same:
            # One color for all needs a scale that is not empty; its one number is labelled.
            room = 1.05 if logarithmic else (abs(most) or 1.0) * 0.05
            least, most = (least / room, most * room) if logarithmic else (least - room, most + room)
        norm = colors.LogNorm(least, most) if logarithmic else colors.Normalize(least, most)
        shown = axis.pcolormesh(mesh.x_edges, mesh.y_edges, np.ma.masked_invalid(values), norm=norm, **draw)
        below = "min" if logarithmic and (finite <= 0).any() else "neither"
        bar = axis.figure.colorbar(shown, ax=axis, label=caption, extend=below, pad=0.02)
        if same:
            bar.set_ticks([float(finite.max())])
            bar.ax.minorticks_off()
        elif logarithmic:
            style.log_ticks(bar.ax.yaxis, least, most)
    _hatched(axis, mesh, np.isinf(mesh.values), *INFINITE)
    happens = one.variable in ("settled_at", "first_conflict", "first_miss", "broken_at")
    _hatched(axis, mesh, np.isnan(mesh.values), *(NEVER if happens else UNKNOWN))
    _hatched(axis, mesh, mesh.conflicts, *CONFLICTS, face="none", edge=style.ALARM)
    _border(axis, mesh)


def _border(axis: Any, mesh: Mesh) -> None:
    """A line along the cells whose width exceeds the steady one that the certificate promises."""
    across, along = (np.abs(np.diff(mesh.above, axis=dim)) == 1 for dim in (1, 0))
    count, most = int(across.sum() + along.sum()), 2 * sum(mesh.above.shape)
    # A longer border than that is no border but noise.
    if not 0 < count <= most:
        return
    from matplotlib.collections import LineCollection

    x, y = mesh.x_edges, mesh.y_edges
    segments = [((x[j + 1], y[i]), (x[j + 1], y[i + 1])) for i, j in np.argwhere(across)]
    segments += [((x[j], y[i + 1]), (x[j + 1], y[i + 1])) for i, j in np.argwhere(along)]
    lines = LineCollection(segments, colors=BORDER, linewidths=1.8, capstyle="projecting", zorder=3,
                           label="border to widths above the certificate")  # fmt: skip
    axis.add_collection(lines, autolim=False)


def _flags(axis: Any, one: Quantity, mesh: Mesh, values: np.ndarray, caption: str, draw: dict[str, Any]) -> None:
    """A bit mask: one colour for each combination that occurs."""
    from matplotlib import colors

    there = np.unique(values[~np.isnan(values)]).astype(int)
    codes = np.where(np.isnan(values), np.nan, np.searchsorted(there, np.nan_to_num(values)))
    flags, words = one.flags or {}, lambda name: name.lower().replace("_", " ")
    names = ["\n".join(words(name) for bit, name in flags.items() if code & bit) or "OK" for code in there]
    norm = colors.BoundaryNorm(np.arange(len(there) + 1) - 0.5, max(len(there), 2), clip=True)
    from matplotlib import colormaps

    draw = draw | {"cmap": colormaps[COLORS].resampled(max(len(there), 2)), "norm": norm}
    shown = axis.pcolormesh(mesh.x_edges, mesh.y_edges, np.ma.masked_invalid(codes), **draw)
    bar = axis.figure.colorbar(shown, ax=axis, label=caption, pad=0.02)
    bar.set_ticks(np.arange(len(there)), labels=names)


def _hatched(
    axis: Any, mesh: Mesh, mask: np.ndarray, hatch: str, text: str, face: str = "#eeeeee", edge: str = "#666666"
) -> None:
    """Runs of cells to the right as one rectangle each: a hatch of single cells would cost seconds."""
    if not mask.any():
        return
    from matplotlib.collections import PolyCollection

    padded = np.pad(mask.astype(np.int8), ((0, 0), (1, 1)))
    change = np.diff(padded, axis=1)
    row, first = np.nonzero(change == 1)
    _, end = np.nonzero(change == -1)
    left, right = mesh.x_edges[first], mesh.x_edges[end]
    bottom, top = mesh.y_edges[row], mesh.y_edges[row + 1]
    corners = np.stack(
        [np.stack([left, left, right, right], axis=1), np.stack([bottom, top, top, bottom], axis=1)], axis=2
    )
    axis.add_collection(
        PolyCollection(list(corners), facecolor=face, edgecolor=edge, hatch=hatch, linewidth=0, label=text, zorder=1.5),
        autolim=False,
    )
