"""What `framers` shows: one record, taken out of a labelled dataset, of one case of a sweep, or of an estimate."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gsisio_jax.observer.status import Status
from gsisio_jax.plot.dates import days, zone_of
from gsisio_jax.plot.study import KINDS, axes_of, fixed, kept_kinds, prepared, time_of, variable_signals


@dataclass(frozen=True)
class Series:
    """One panel: a box over time; `widths` says how wide it is where the boxes themselves do not tell."""

    name: str
    unit: str
    lower: np.ndarray
    upper: np.ndarray
    measured: np.ndarray | None
    kind: str = "state"
    widths: str | None = None


@dataclass(frozen=True)
class Record:
    """All that is drawn, whatever it came from; `outputs` where somebody asks for them by name."""

    title: str
    time: np.ndarray
    time_label: str
    series: dict[str, Series]
    missing: Any
    alarms: np.ndarray
    outputs: dict[str, Series] = field(default_factory=dict)  # measurements that are of no signal: they have no box


def read_record(source: Any, call: str = "framers") -> Record:
    """Take one record out of a Dataset made by `to_dataset`, of one case of a `sweep`, or of an estimate of one record.

    Raises:
        ValueError: there are no boxes over time, or those of more than one case.
    """
    if not hasattr(source, "data_vars"):
        return _read_estimate(source, call)
    return _read_case(source, call) if kept_kinds(source) else _read_dataset(source, call)


def _read_dataset(dataset: Any, call: str) -> Record:
    variables = dataset.data_vars
    outputs = {name: variables[name].values for name in variables if variables[name].attrs.get("role") == "output"}
    series, measured = {}, _measurements(variables)
    for name in variables:
        signal = variables[name].attrs.get("signal")
        if signal is None or not str(name).endswith("_lower"):
            continue
        about = variables[name].attrs
        upper = variables[f"{signal}_upper"].values
        kind = "input" if about.get("role") == "unknown input" else "state"
        unit, lower = about.get("units", ""), variables[name].values
        series[signal] = Series(signal, unit, lower, upper, measured.get(signal), kind, about.get("widths"))
    if not series:
        raise ValueError(
            f"{call}: the dataset has no boxes over time: no variable `<signal>_lower` made by `to_dataset`, no "
            "`state_lower` made by `sweep` with reduce=None"
        )
    missing = (
        np.isnan(np.stack(list(outputs.values()))).all(axis=0) if outputs else _missing(variables["status"].values)
    )
    alarms = np.array([alarm["time"] for alarm in json.loads(dataset.attrs.get("alarms", "[]"))])
    if zone_of(dataset) is not None:
        alarms = days(alarms if alarms.dtype.kind == "f" else alarms.astype("M8[ns]"))
    time, label = time_of(dataset)
    nothing = np.full(len(time), np.nan)
    of_signals = list(measured.values())
    apart = {
        str(name): Series(str(name), variables[name].attrs.get("units", ""), nothing, nothing, values, "output")
        for name, values in outputs.items()
        if not any(values is one for one in of_signals)
    }
    title = ", ".join(part for part in (dataset.attrs.get("title", ""), told_delay(dataset)) if part)
    return Record(title, time, label, series, missing, alarms, apart)


def _measurements(variables: Any) -> dict[str, np.ndarray]:
    """Measurements by the signal they are of: the one that the attribute ``measures`` names, else of all names that an
    output begins or ends with, the longest."""
    units = {
        variable.attrs["signal"]: variable.attrs.get("units", "")
        for variable in variables.values()
        if "signal" in variable.attrs
    }
    found = {}
    for name, variable in variables.items():
        if variable.attrs.get("role") == "output":
            if "measures" in variable.attrs:
                found.setdefault(variable.attrs["measures"], variable.values)
                continue
            words = f"_{str(name).removeprefix('measured_')}_"
            inside = [s for s in units if words.startswith(f"_{s}_") or words.endswith(f"_{s}_")]
            signal = max(inside, key=len, default=None)
            if signal is not None and units[signal] == variable.attrs.get("units", ""):
                found.setdefault(signal, variable.values)
    return found


def _read_case(dataset: Any, call: str) -> Record:
    """One case of a sweep that kept its boxes."""
    dataset = prepared(call, dataset)
    axes = {axis: dataset.sizes[axis] for axis in axes_of(dataset)}
    if axes:
        sizes = ", ".join(f"{axis}: {size}" for axis, size in axes.items())
        first = ", ".join(f"{axis}=0" for axis in axes)
        raise ValueError(
            f"{call}: one case is needed, the dataset has many ({sizes}); take one by .isel({first}), or draw all by "
            "gx.plot.widths or gx.plot.funnel"
        )
    time, time_label = time_of(dataset)
    series = {}
    for kind in kept_kinds(dataset):
        sides = (variable_signals(dataset, f"{kind}_{side}") for side in ("lower", "upper"))
        for low, high in zip(*sides, strict=True):
            lower, upper = (np.asarray(one.values.values, dtype=np.float64) for one in (low, high))
            series[low.signal] = Series(low.signal, low.unit, lower, upper, None, kind)
    # Rows of an unfinished study are not a number.
    status = np.nan_to_num(dataset["status"].values).astype(int) if "status" in dataset else np.zeros(len(time), int)
    said = dataset.attrs.get("title", ""), fixed(dataset), told_delay(dataset)
    title = ", ".join(part for part in said if part)
    return Record(title, time, time_label, series, _missing(status), time[(status & int(Status.CONFLICT)) != 0])


def _read_estimate(est: Any, call: str) -> Record:
    if not hasattr(est, "state"):
        raise ValueError(
            f"{call}: expected an estimate, or a dataset of `to_dataset` or of a study with reduce=None; got "
            f"{type(est).__name__}"
        )
    if np.ndim(est.state.lower) != 2:
        raise ValueError(f"{call}: one record is needed, est.state of shape (T, n), got {np.shape(est.state.lower)}")
    series = {}
    for kind, letter in KINDS.items():
        lower, upper = sides_over_time(est, kind)
        for index in range(lower.shape[-1]):
            name = f"{letter}{index + 1}"
            series[name] = Series(name, "", lower[:, index], upper[:, index], None, kind)
    alarms = np.array([float(alarm.step) for alarm in est.alarms()])
    time = np.arange(np.shape(est.state.lower)[0], dtype=np.float64)
    return Record(told_delay(est), time, "step", series, _missing(np.asarray(est.status)), alarms)


def told_delay(est: Any) -> str:
    """A title that says from when boxes with a delay are; none for others. Takes an estimate or a dataset of one."""
    delay = getattr(est, "delay", 0)
    return f"boxes from measurements up to {delay} step{'s' if delay > 1 else ''} later" if delay else ""


def sides_over_time(est: Any, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Bounds (..., T, n) of the states or inputs of an estimate; inputs end with a row that is not known yet."""
    steps, box = np.shape(est.state.lower)[-2], getattr(est, kind)
    sides = []
    for side in (box.lower, box.upper):
        side = np.asarray(side, dtype=np.float64)
        rest = np.full((*side.shape[:-2], steps - side.shape[-2], side.shape[-1]), np.nan)
        sides.append(np.concatenate([side, rest], axis=-2))
    return sides[0], sides[1]


def _missing(status: np.ndarray) -> np.ndarray:
    return (status & int(Status.MISSING)) != 0
