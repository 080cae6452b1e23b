"""What all pictures share: colours, panels, legends and the words at their axes."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsisio_jax._extras import need

BAND, EDGE, MEASURED, TRUTH, ALARM, GAP = "#88aadd", "#3366aa", "#bb5500", "#111111", "#cc2233", "#dddddd"
CERTIFICATE, GREY = "#b34700", "#777777"
# Told apart with any colour vision (Okabe and Ito), and by their lightness in print.
CYCLE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00")
MAXIMUM_POINTS = 3000
LOG_SPAN = 30.0  # values that span more than this factor get a logarithmic scale


def require(module: str = "matplotlib") -> Any:
    """matplotlib, before any work is done for a picture.

    Raises:
        MissingExtra: it is not installed.
    """
    return need(module, extra="plot", purpose="drawing a picture")


def check_picture(call: str, path: str | Path) -> None:
    """A file that matplotlib can write, in a folder that is there: before anything is drawn.

    Raises:
        ValueError: the path has an ending that names no format, or the folder is missing.
    """
    from matplotlib.backend_bases import FigureCanvasBase

    path, known = Path(path), FigureCanvasBase.get_supported_filetypes()
    if path.suffix[1:].lower() not in known:
        raise ValueError(
            f"{call} must end in the format of a picture (.{', .'.join(known)}), got '{path}'; "
            f"say '{path.with_suffix('.png') if path.name else 'boxes.png'}'"
        )
    if not path.parent.is_dir():
        raise ValueError(f"{call} must be in a folder that is there, got '{path}'; make '{path.parent}' first")


def panels(call: str, count: int, ax: Any, arrange: Any) -> tuple[np.ndarray, Any]:
    """Axes for `count` panels: those given, or those of a new figure.

    Args:
        call: what messages name.
        ax: None, one axes, or several.
        arrange: `stacked` or `tiled`.

    Returns:
        Array of axes, and the new figure (None where `ax` was given).

    Raises:
        ValueError: the wrong number of axes.
    """
    if ax is None:
        from matplotlib import pyplot

        figure = pyplot.figure(layout="constrained")
        return arrange(figure, count), figure
    axes = np.atleast_1d(np.asarray(ax, dtype=object)).ravel()
    if len(axes) != count:
        raise ValueError(f"{call}: `ax` has {len(axes)} axes for {count} signals; give one per signal")
    return axes, None


def handed_back(ax: Any, axes: np.ndarray) -> Any:
    """The axes itself where one axes was given."""
    return ax if ax is not None and not np.iterable(ax) else axes


def stacked(figure: Any, count: int) -> np.ndarray:
    """One column of panels, two from six on, sharing the time axis."""
    columns = 1 if count < 6 else 2
    rows = max(-(-count // columns), 1)
    figure.set_size_inches(10 if columns == 1 else 15, 1.2 + max(1.9 * rows, 3.0))
    return _grid(figure, count, rows, columns, sharex=True)


def tiled(figure: Any, count: int) -> np.ndarray:
    """Panels side by side, four at most."""
    columns = {1: 1, 2: 2, 3: 3, 4: 2, 5: 3, 6: 3}.get(count, 4)
    rows = max(-(-count // columns), 1)
    figure.set_size_inches(1.2 + 4.4 * columns, 0.9 + 3.4 * rows)
    return _grid(figure, count, rows, columns)


def _grid(figure: Any, count: int, rows: int, columns: int, **options: Any) -> np.ndarray:
    axes = figure.subplots(rows, columns, squeeze=False, **options).ravel()
    for spare in axes[count:]:
        spare.remove()
    for above in axes[max(count - columns, 0) : count]:
        above.tick_params(labelbottom=True)
    return axes[:count]


def in_last_row(axis: Any, axes: Any) -> bool:
    """Is nothing of this figure below the axes?"""
    mine = axis.get_subplotspec()
    others = [spec for spec in (other.get_subplotspec() for other in axes) if spec is not None]
    return mine is None or not any(
        spec.get_gridspec() is mine.get_gridspec()
        and spec.colspan.start == mine.colspan.start
        and spec.rowspan.start > mine.rowspan.start
        for spec in others
    )


def in_first_column(axis: Any) -> bool:
    """Is nothing of this figure to the left of the axes?"""
    mine = axis.get_subplotspec()
    return mine is None or mine.colspan.start == 0


def complete(figure: Any, axes: Any, title: str) -> None:
    """Title and one legend for all panels of a figure of our own."""
    if title:
        figure.suptitle(title)
    entries = {}
    for axis in axes:
        for handle, text in zip(*axis.get_legend_handles_labels(), strict=True):
            entries.setdefault(text, handle)
    if any(text.startswith("guaranteed box (") for text in entries):
        entries.pop("guaranteed box", None)
    if entries:
        # Rows of a legend that is wider than its figure would be cut off.
        room = max(int(11 * figure.get_size_inches()[0] / (max(map(len, entries)) + 6)), 1)
        rows = -(-len(entries) // room)
        columns = -(-len(entries) // rows)
        figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=columns, frameon=False)


def label(name: str, unit: str) -> str:
    """Name and unit below each other, long names on two lines."""
    spoken = name.replace("_", " ")
    # Long names would run into the panel above.
    if len(spoken) > 18 and " " in spoken:
        half = spoken.rfind(" ", 0, len(spoken) // 2 + 4)
        spoken = spoken[:half] + "\n" + spoken[half + 1 :] if half > 0 else spoken
    return f"{spoken}\n[{unit}]" if unit else spoken


def caption(text: str) -> str:
    """Words for a title or a colour bar, broken into lines."""
    return textwrap.fill(text.replace("_", " "), 34)


def with_unit(text: str, unit: str) -> str:
    """Text and unit in one line."""
    return f"{text} [{unit}]" if unit else text


def short(value: float) -> str:
    """Three digits, more only where they are before the point."""
    return f"{value:.0f}" if 1e3 <= abs(value) < 1e8 else f"{value:.3g}"


def spans(values: Sequence[Any], factor: float = LOG_SPAN) -> bool:
    """Do these numbers, all of them positive, span more than a factor, so that they call for a logarithmic scale?"""
    every = _finite(values)
    return len(every) > 1 and bool(every.min() > 0) and every.max() > factor * every.min()


def fit(axis: Any, drawn: Sequence[Any], factor: float = LOG_SPAN, zero: bool = True) -> None:
    """Scale and limits upward, from the numbers that are drawn; a linear scale shows zero, unless `zero` is False."""
    every = _finite(drawn)
    if len(every) == 0:
        return
    low, high = float(every.min()), float(every.max())
    if spans([every], factor):
        axis.set_yscale("log")
        log_ticks(axis.yaxis, low, high)
        room = (high / low) ** 0.05
        axis.set_ylim(low / room, high * room)
    elif zero and low >= 0:
        axis.set_ylim(0, 1.06 * high or 1.0)
    else:
        axis.set_ylim(low - 0.06 * (high - low or 1), high + 0.06 * (high - low or 1))


def log_ticks(side: Any, low: float, high: float) -> None:
    """Plain numbers, few enough not to touch, at a logarithmic axis from `low` to `high`."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    side.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 200 * low else (1.0,)))
    side.set_major_formatter(FuncFormatter(lambda value, _: _power(value)))
    side.set_minor_formatter(NullFormatter())


def _power(value: float) -> str:
    if 1e-3 <= value < 1e5:
        return f"{value:g}"
    digits, _, exponent = f"{value:.0e}".partition("e")
    factor = "" if digits == "1" else rf"{digits} \times "
    return f"${factor}10^{{{int(exponent)}}}$"


def beyond(low: np.ndarray, high: np.ndarray, drawn: Sequence[Any]) -> np.ndarray:
    """The upper side of a band for `fit`: an infinite one (NaN here) lies above all that the panel shows."""
    return np.where(np.isnan(high) & ~np.isnan(low), 1e3 * _finite(drawn).max(initial=1.0), high)


def _finite(values: Sequence[Any]) -> np.ndarray:
    every = np.concatenate([np.ravel(np.asarray(part, dtype=np.float64)) for part in values] or [np.zeros(0)])
    return every[np.isfinite(every)]


def joined(count: int, most: int) -> np.ndarray:
    """First indices of the groups of neighbours, `most` groups at most, that a long row is drawn in."""
    if count <= most:
        return np.arange(count)
    return np.unique(np.linspace(0, count, most, endpoint=False).astype(int))


def mark_unbounded(axis: Any, at: np.ndarray, bad: Any, text: str, color: str) -> None:
    """Triangles at the upper edge where a value is infinite and so has no place in the panel."""
    if bad.any():
        axis.plot(
            at[bad], np.ones(int(bad.sum())), "^", transform=axis.get_xaxis_transform(), clip_on=False, markersize=5,
            color=color, markeredgecolor="white", markeredgewidth=0.4, label=text, zorder=6,
        )  # fmt: skip


def mark_conflicts(axis: Any, at: np.ndarray, line: np.ndarray, bad: Any, text: str) -> None:
    """Red crosses on a line where data contradict the stated bounds; at the lower edge where the line has no place."""
    bad = np.asarray(bad)
    for where, mine, heights in (
        (None, bad & np.isfinite(line), line),
        (axis.get_xaxis_transform(), bad & ~np.isfinite(line), np.zeros(len(at))),
    ):
        if mine.any():
            place = {} if where is None else {"transform": where, "clip_on": False}
            axis.plot(at[mine], heights[mine], "X", color=ALARM, markersize=6, markeredgecolor="white",
                      markeredgewidth=0.5, label=text, zorder=6, **place)  # fmt: skip
            text = "_"
