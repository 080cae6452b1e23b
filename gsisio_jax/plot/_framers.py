"""`framers`: boxes over time with measurements, gaps and alarms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsisio_jax._calls import named_arguments
from gsisio_jax.interval.reading import read_array
from gsisio_jax.plot import style
from gsisio_jax.plot.dates import show_dates
from gsisio_jax.plot.record import Record, Series, read_record
from gsisio_jax.plot.study import check_signals

MANY = 50  # alarms


@named_arguments
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
        dataset_or_estimate: result of `dataset.to_dataset`, of `sweep` with reduce=None, reduced to one case by
            ``.isel(...)``, or of `estimate` on one record.
        signals: names to draw, in order; all states and inputs where left out (``x1``, ``d1``, ... of an estimate).
            Measurements that belong to no signal have panels of their own where they are named: ``measured_<output>``.
        truth: true values by signal name, shape (T,) or (T + 1,) each, (T - 1,) or (T,) for inputs.
        ax: one matplotlib axes per signal; a new figure where left out.

    Returns:
        Array of axes, one per signal; the axes itself where `ax` is one axes.

    Raises:
        ValueError: a name that is not there, the wrong number of axes, a truth of the wrong length, many cases.
        MissingExtra: matplotlib is not installed.
    """
    style.require()
    record = read_record(dataset_or_estimate)
    names = list(record.series) if signals is None else list(signals)
    every = record.series | record.outputs
    if truth is not None and not isinstance(truth, Mapping):
        raise ValueError(
            f'framers: `truth` must have true values by signal name, as {{"x1": x[:, 0]}}, got {type(truth).__name__}'
        )
    check_signals("framers", [*names, *(truth or {})], list(every))
    axes, figure = style.panels("framers", len(names), ax, style.stacked)
    for axis, name in zip(axes, names, strict=True):
        _panel(axis, record, every[name], None if truth is None else truth.get(name))
    for axis in axes:
        show_dates(axis, record.time_label)
        if style.in_last_row(axis, axes):
            axis.set_xlabel(record.time_label)
    if figure is not None:
        style.complete(figure, axes, record.title)
    return style.handed_back(ax, axes)


@named_arguments
def save(
    dataset_or_estimate: Any,
    path: str | Path,
    signals: Sequence[str] | None = None,
    truth: Mapping[str, Any] | None = None,
) -> None:
    """Draw `framers` into a file, without touching any open figure.

    Args:
        dataset_or_estimate: as for `framers`.
        path: file to write; its ending names the format.
        signals: as for `framers`.
        truth: as for `framers`.

    Raises:
        MissingExtra: matplotlib is not installed.
        ValueError: the ending is no format of matplotlib, or the folder is not there.
    """
    module = style.require("matplotlib.figure")
    record = read_record(dataset_or_estimate)
    if not isinstance(path, str | Path):
        raise ValueError(f"plot.save: `path` must be the name of a file, got {type(path).__name__}; say 'boxes.png'")
    style.check_picture("plot.save: `path`", path)
    names = list(record.series) if signals is None else list(signals)
    figure = module.Figure(layout="constrained")
    axes = style.stacked(figure, len(names))
    framers(dataset_or_estimate, names, {name: rows for name, rows in (truth or {}).items() if name in names}, axes)
    style.complete(figure, axes, record.title)
    figure.savefig(path, dpi=130)


def _panel(axis: Any, record: Record, series: Series, truth: Any) -> None:
    time, lower, upper = record.time, series.lower, series.upper
    if truth is not None:
        truth = true_rows("framers", series.name, truth, len(time))
    low, high = _limits(series, truth)
    axis.set_ylim(low, high)
    axis.set_ylabel(style.label(series.name, series.unit))
    axis.margins(x=0.01)
    axis.grid(alpha=0.25)
    if record.missing.any():
        across = axis.get_xaxis_transform()
        shaded = _runs(time, record.missing)
        axis.fill_between(*shaded, transform=across, color=style.GAP, linewidth=0, label="no measurement", zorder=0)
    # Infinite sides are drawn just outside the panel, so that the band fills it.
    beyond = high - low
    outside = (low - beyond, high + beyond)
    # Without a last box, that of an input, edges would go on for half a step behind the end of the band.
    known = np.flatnonzero(~(np.isnan(lower) | np.isnan(upper)))
    end = int(known[-1]) + 1 if len(known) else len(time)
    at, bottom, top = thinned(time[:end], np.clip(lower, *outside)[:end], np.clip(upper, *outside)[:end])
    step = "mid" if len(at) <= 400 else None
    unbounded = bool((np.isinf(lower) | np.isinf(upper)).any())
    text = "guaranteed box (full height: not bounded)" if unbounded else "guaranteed box"
    axis.fill_between(at, bottom, top, step=step, color=style.BAND, alpha=0.55, linewidth=0, label=text, zorder=2)
    drawstyle = "steps-mid" if step else "default"
    for side in (bottom, top):
        axis.plot(at, side, color=style.EDGE, linewidth=0.8, drawstyle=drawstyle, zorder=2.5)
    if series.measured is not None:
        # Many dots would hide the band that they lie in.
        size, level = (4, 3) if len(time) <= 400 else (1.5, 1)
        dots = {"linestyle": "", "marker": ".", "color": style.MEASURED}
        axis.plot(time, series.measured, markersize=size, zorder=level, **dots)
        axis.plot([], [], markersize=6, label="measured", **dots)
    if truth is not None:
        axis.plot(time[: len(truth)], truth, color=style.TRUTH, linewidth=1.0, label="truth", zorder=4)
    shown = {"color": style.ALARM, "linewidth": 1.2, "zorder": 3.5}
    if len(record.alarms) > MANY:
        # As one object: thousands of lines of their own take minutes.
        axis.vlines(record.alarms, 0, 1, transform=axis.get_xaxis_transform(), label="certified alarm", **shown)
    else:
        for index, when in enumerate(record.alarms):
            axis.axvline(when, label="certified alarm" if index == 0 else None, **shown)
    if series.kind != "output":
        axis.set_title(series.widths or _widths(series), loc="right", fontsize="small", color="#444444")


def true_rows(call: str, name: str, truth: Any, steps: int, lead: tuple[int, ...] = ()) -> np.ndarray:
    """The true values of a signal, (T,) or (T - 1,), or with the leading axes `lead`.

    Raises:
        ValueError: the truth has another shape.
    """
    truth = np.asarray(read_array(call, f"truth of '{name}'", truth, missing=True), dtype=np.float64)
    if truth.shape[:-1] not in ((), lead) or truth.ndim == 0 or truth.shape[-1] - steps not in (-1, 0, 1):
        legal = " or ".join(str((*front, steps)) for front in dict.fromkeys([(), lead]))
        raise ValueError(f"{call}: the truth of '{name}' must have shape {legal}, got {truth.shape}")
    return truth[..., :steps]


def _widths(series: Series) -> str:
    width = series.upper - series.lower
    width = width[~np.isnan(width)]
    finite = width[np.isfinite(width)]
    if len(finite) == 0:
        return "never bounded"
    last = style.short(width[-1]) if np.isfinite(width[-1]) else "not bounded"
    return f"width: mean {style.short(finite.mean())}, median {style.short(np.median(finite))}, last {last}"


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


def thinned(time: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """At most `MAXIMUM_POINTS` boxes: neighbours are joined to their hull, so that no box is drawn too small."""
    if len(time) <= style.MAXIMUM_POINTS:
        return time, lower, upper
    starts = style.joined(len(time), style.MAXIMUM_POINTS)
    return time[starts], np.fmin.reduceat(lower, starts), np.fmax.reduceat(upper, starts)


def _runs(time: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Outline of the stretches where `mask` holds, half a step to both sides, as one `fill_between`."""
    half = 0.5 * float(np.median(np.diff(time))) if len(time) > 1 else 0.5
    change = np.diff(np.concatenate([[0], mask.astype(int), [0]]))
    first, last = np.flatnonzero(change == 1), np.flatnonzero(change == -1) - 1
    left, right = time[first] - half, time[last] + half
    at = np.stack([left, left, right, right], axis=1).ravel()
    return at, np.zeros(len(at)), np.tile([0.0, 1.0, 1.0, 0.0], len(left))
