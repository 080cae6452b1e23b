"""Pictures of boxes over time: filled bands, measurements, gaps and alarms, labelled without being asked.

matplotlib is imported when a picture is drawn, never before.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ._extras import need
from ._record import Record, Series, read_record

BAND, EDGE, MEASURED, TRUTH, ALARM, GAP = "#88aadd", "#3366aa", "#bb5500", "#111111", "#cc2233", "#dddddd"
MAXIMUM_POINTS = 3000


def framers(
    dataset_or_estimate: Any,
    signals: Sequence[str] | None = None,
    truth: Mapping[str, Any] | None = None,
    ax: Any = None,
) -> Any:
    """Draw the box of every signal over time.

    A band is the box; where it fills the panel from edge to edge the signal is not bounded there. Dots are
    measurements, found by name and unit: the outputs ``position``, ``position_sensor`` and ``reported_position`` belong
    to the signal ``position`` if their units agree. Grey stretches are rows without any measurement, red lines are
    certified alarms. An axis shows the ordinary boxes; a few much wider ones (the initial box, say) run out of the
    panel.

    Args:
        dataset_or_estimate: result of `dataset.to_dataset`, or of `estimate` on one record.
        signals: names to draw, in order; all states and inputs where left out (``x1``, ``d1``, ... of an estimate).
        truth: true values by signal name, shape (T,) each, (T - 1,) for inputs.
        ax: one matplotlib axes per signal; a new figure where left out.

    Returns:
        Array of axes, one per signal; the axes itself where `ax` is one axes.

    Raises:
        ValueError: a name that is not there, the wrong number of axes, a truth of the wrong length.
        MissingExtra: matplotlib is not installed.
    """
    need("matplotlib", extra="plot", purpose="drawing a picture")
    record = read_record(dataset_or_estimate)
    names = list(record.series) if signals is None else list(signals)
    for name in [*names, *(truth or {})]:
        if name not in record.series:
            raise ValueError(f"framers: there is no signal '{name}'; the signals are: {', '.join(record.series)}")
    if ax is None:
        from matplotlib import pyplot

        axes = _layout(pyplot.figure(layout="constrained"), len(names))
    else:
        axes = np.atleast_1d(np.asarray(ax, dtype=object)).ravel()
    if len(axes) != len(names):
        raise ValueError(f"framers: `ax` has {len(axes)} axes for {len(names)} signals; give one per signal")
    for axis, name in zip(axes, names, strict=True):
        _panel(axis, record, record.series[name], None if truth is None else truth.get(name))
    for axis in axes:
        if _in_last_row(axis, axes):
            axis.set_xlabel(record.time_label)
    if ax is None and len(axes):
        figure = axes[0].figure
        if record.title:
            figure.suptitle(record.title)
        _legend(figure, axes)
    return ax if ax is not None and not np.iterable(ax) else axes


def save(dataset_or_estimate: Any, path: str | Path, signals: Sequence[str] | None = None) -> None:
    """Draw `framers` into a file, without touching any open figure.

    Args:
        dataset_or_estimate: as for `framers`.
        path: file to write; its ending names the format.
        signals: as for `framers`.

    Raises:
        MissingExtra: matplotlib is not installed.
    """
    module = need("matplotlib.figure", extra="plot", purpose="drawing a picture")
    record = read_record(dataset_or_estimate)
    names = list(record.series) if signals is None else list(signals)
    figure = module.Figure(layout="constrained")
    axes = _layout(figure, len(names))
    framers(dataset_or_estimate, names, ax=axes)
    if record.title:
        figure.suptitle(record.title)
    _legend(figure, axes)
    figure.savefig(path, dpi=130)


def _layout(figure: Any, count: int) -> np.ndarray:
    """One column of panels, two from six on, sharing the time axis."""
    columns = 1 if count < 6 else 2
    rows = max(-(-count // columns), 1)
    figure.set_size_inches(10 if columns == 1 else 15, 1.2 + max(1.9 * rows, 3.0))
    axes = figure.subplots(rows, columns, sharex=True, squeeze=False).ravel()
    for spare in axes[count:]:
        spare.remove()
    for above in axes[max(count - columns, 0) : count]:
        above.tick_params(labelbottom=True)
    return axes[:count]


def _in_last_row(axis: Any, axes: Any) -> bool:
    """Is nothing of this figure below the axes?"""
    mine = axis.get_subplotspec()
    others = [spec for spec in (other.get_subplotspec() for other in axes) if spec is not None]
    return mine is None or not any(
        spec.get_gridspec() is mine.get_gridspec()
        and spec.colspan.start == mine.colspan.start
        and spec.rowspan.start > mine.rowspan.start
        for spec in others
    )


def _legend(figure: Any, axes: Any) -> None:
    entries = {}
    for axis in axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    if any(label.startswith("guaranteed box (") for label in entries):
        entries.pop("guaranteed box", None)
    if entries:
        figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=len(entries), frameon=False)


def _panel(axis: Any, record: Record, series: Series, truth: Any) -> None:
    time, lower, upper = record.time, series.lower, series.upper
    low, high = _limits(series, truth)
    axis.set_ylim(low, high)
    axis.set_ylabel(_label(series.name, series.unit))
    axis.margins(x=0.01)
    axis.grid(alpha=0.25)
    if record.missing.any():
        across = axis.get_xaxis_transform()
        shaded = _runs(time, record.missing)
        axis.fill_between(*shaded, transform=across, color=GAP, linewidth=0, label="no measurement", zorder=0)
    # Infinite sides are drawn just outside the panel, so that the band fills it.
    beyond = high - low
    outside = (low - beyond, high + beyond)
    at, bottom, top = _thinned(time, np.clip(lower, *outside), np.clip(upper, *outside))
    step = "mid" if len(at) <= 400 else None
    unbounded = bool((np.isinf(lower) | np.isinf(upper)).any())
    label = "guaranteed box (full height: not bounded)" if unbounded else "guaranteed box"
    axis.fill_between(at, bottom, top, step=step, color=BAND, alpha=0.55, linewidth=0, label=label, zorder=2)
    drawstyle = "steps-mid" if step else "default"
    for side in (bottom, top):
        axis.plot(at, side, color=EDGE, linewidth=0.8, drawstyle=drawstyle, zorder=2.5)
    if series.measured is not None:
        # Many dots would hide the band that they lie in.
        size, level = (4, 3) if len(time) <= 400 else (1.5, 1)
        dots = {"linestyle": "", "marker": ".", "color": MEASURED}
        axis.plot(time, series.measured, markersize=size, zorder=level, **dots)
        axis.plot([], [], markersize=6, label="measured", **dots)
    if truth is not None:
        truth = np.asarray(truth, dtype=np.float64)
        if truth.ndim != 1 or len(truth) not in (len(time), len(time) - 1):
            raise ValueError(f"framers: the truth of '{series.name}' must have shape ({len(time)},), got {truth.shape}")
        axis.plot(time[: len(truth)], truth, color=TRUTH, linewidth=1.0, label="truth", zorder=4)
    for index, when in enumerate(record.alarms):
        label = "certified alarm" if index == 0 else None
        axis.axvline(when, color=ALARM, linewidth=1.2, label=label, zorder=3.5)
    axis.set_title(_widths(series), loc="right", fontsize="small", color="#444444")


def _widths(series: Series) -> str:
    width = series.upper - series.lower
    width = width[~np.isnan(width)]
    finite = width[np.isfinite(width)]
    if len(finite) == 0:
        return "never bounded"
    last = _short(width[-1]) if np.isfinite(width[-1]) else "not bounded"
    return f"width: mean {_short(finite.mean())}, median {_short(np.median(finite))}, last {last}"


def _short(value: float) -> str:
    return f"{value:.0f}" if 1e3 <= value < 1e8 else f"{value:.3g}"


def _limits(series: Series, truth: Any) -> tuple[float, float]:
    """Axis limits from the ordinary boxes, the measurements and the truth; a few huge boxes do not set the scale."""
    finite = np.isfinite(series.lower) & np.isfinite(series.upper)
    lower, upper = series.lower[finite], series.upper[finite]
    values = [np.zeros(0)]
    if len(lower):
        width = upper - lower
        ordinary = width <= 10 * np.quantile(width, 0.75)
        values += [lower[ordinary], upper[ordinary]]
    values += [np.asarray(extra, dtype=np.float64).ravel() for extra in (series.measured, truth) if extra is not None]
    every = np.concatenate(values)
    every = every[np.isfinite(every)]
    if len(every) == 0:
        return -1.0, 1.0
    low, high = float(every.min()), float(every.max())
    # Wide boxes that at most double the scale are shown whole all the same.
    room = (high - low) / 2
    shown = (lower >= low - room) & (upper <= high + room)
    low, high = min(low, lower[shown].min(initial=low)), max(high, upper[shown].max(initial=high))
    spare = 0.06 * (high - low) or max(abs(high), 1.0) * 0.1
    return low - spare, high + spare


def _thinned(time: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """At most `MAXIMUM_POINTS` boxes: neighbours are joined to their hull, so that no box is drawn too small."""
    count = len(time)
    if count <= MAXIMUM_POINTS:
        return time, lower, upper
    starts = np.unique(np.linspace(0, count, MAXIMUM_POINTS, endpoint=False).astype(int))
    return time[starts], np.fmin.reduceat(lower, starts), np.fmax.reduceat(upper, starts)


def _runs(time: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Outline of the stretches where `mask` holds, half a step to both sides, as one `fill_between`."""
    half = 0.5 * float(np.median(np.diff(time))) if len(time) > 1 else 0.5
    change = np.diff(np.concatenate([[0], mask.astype(int), [0]]))
    first, last = np.flatnonzero(change == 1), np.flatnonzero(change == -1) - 1
    left, right = time[first] - half, time[last] + half
    at = np.stack([left, left, right, right], axis=1).ravel()
    return at, np.zeros(len(at)), np.tile([0.0, 1.0, 1.0, 0.0], len(left))


def _label(name: str, unit: str) -> str:
    spoken = name.replace("_", " ")
    # Long names would run into the panel above.
    if len(spoken) > 18 and " " in spoken:
        half = spoken.rfind(" ", 0, len(spoken) // 2 + 4)
        spoken = spoken[:half] + "\n" + spoken[half + 1 :] if half > 0 else spoken
    return f"{spoken}\n[{unit}]" if unit else spoken
