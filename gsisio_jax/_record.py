"""What a picture shows, taken out of a labelled Dataset or straight out of an estimate."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np

from .status import Status


@dataclass(frozen=True)
class Series:
    """One panel: a box over time."""

    name: str
    unit: str
    lower: np.ndarray
    upper: np.ndarray
    measured: np.ndarray | None


@dataclass(frozen=True)
class Record:
    """All that is drawn, whatever it came from."""

    title: str
    time: np.ndarray
    time_label: str
    series: dict[str, Series]
    missing: Any
    alarms: np.ndarray


def read_record(source: Any) -> Record:
    """Take what `plot` draws out of a Dataset made by `to_dataset`, or out of an estimate of one record."""
    return _read_dataset(source) if hasattr(source, "data_vars") else _read_estimate(source)


def _read_dataset(dataset: Any) -> Record:
    variables = dataset.data_vars
    outputs = {name: variables[name].values for name in variables if variables[name].attrs.get("role") == "output"}
    series, measured = {}, _measurements(variables)
    for name in variables:
        signal = variables[name].attrs.get("signal")
        if signal is None or not str(name).endswith("_lower"):
            continue
        unit = variables[name].attrs.get("units", "")
        upper = variables[f"{signal}_upper"].values
        series[signal] = Series(signal, unit, variables[name].values, upper, measured.get(signal))
    if not series:
        raise ValueError("framers: the dataset has no variable `<signal>_lower` made by `to_dataset`")
    missing = (
        np.isnan(np.stack(list(outputs.values()))).all(axis=0) if outputs else _missing(variables["status"].values)
    )
    alarms = np.array([alarm["time"] for alarm in json.loads(dataset.attrs.get("alarms", "[]"))])
    unit = dataset["time"].attrs.get("units")
    label = f"time [{unit}]" if unit else "step"
    return Record(dataset.attrs.get("title", ""), dataset["time"].values, label, series, missing, alarms)


def _measurements(variables: Any) -> dict[str, np.ndarray]:
    """Measurements by the signal they are of: of all names that an output begins or ends with, the longest."""
    units = {
        variable.attrs["signal"]: variable.attrs.get("units", "")
        for variable in variables.values()
        if "signal" in variable.attrs
    }
    found = {}
    for name, variable in variables.items():
        if variable.attrs.get("role") == "output":
            words = f"_{str(name).removeprefix('measured_')}_"
            inside = [s for s in units if words.startswith(f"_{s}_") or words.endswith(f"_{s}_")]
            signal = max(inside, key=len, default=None)
            if signal is not None and units[signal] == variable.attrs.get("units", ""):
                found.setdefault(signal, variable.values)
    return found


def _read_estimate(est: Any) -> Record:
    steps = np.shape(est.state.lower)[0]
    if np.ndim(est.state.lower) != 2:
        raise ValueError(f"framers: one record is needed, est.state of shape (T, n), got {np.shape(est.state.lower)}")
    series = {}
    for letter, box in (("x", est.state), ("d", est.input)):
        lower, upper = (np.asarray(side, dtype=np.float64) for side in (box.lower, box.upper))
        rest = np.full((steps - len(lower), lower.shape[1]), np.nan)
        lower, upper = np.concatenate([lower, rest]), np.concatenate([upper, rest])
        for index in range(lower.shape[1]):
            name = f"{letter}{index + 1}"
            series[name] = Series(name, "", lower[:, index], upper[:, index], None)
    alarms = np.array([float(alarm.step) for alarm in est.alarms()])
    return Record("", np.arange(steps, dtype=np.float64), "step", series, _missing(np.asarray(est.status)), alarms)


def _missing(status: np.ndarray) -> np.ndarray:
    return (status & int(Status.MISSING)) != 0
