"""Labelled results: an estimate as an xarray Dataset with the user's own names and units.

The command line writes this Dataset as NetCDF; anyone else can build it from any estimate with `to_dataset`.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from numbers import Real
from typing import Any

import numpy as np

from gsisio_jax._calls import named_arguments
from gsisio_jax._extras import need
from gsisio_jax._moments import zone_name
from gsisio_jax._version import __version__
from gsisio_jax.interval.reading import read_array
from gsisio_jax.observer.status import flag_attributes


@named_arguments
def to_dataset(
    est: Any,
    *,
    time: Any = None,
    dt: float | None = None,
    state_names: Sequence[str] | None = None,
    input_names: Sequence[str] | None = None,
    output_names: Sequence[str] | None = None,
    state_units: Sequence[str] | None = None,
    input_units: Sequence[str] | None = None,
    output_units: Sequence[str] | None = None,
    y: Any = None,
    title: str = "",
    certificate: Any = None,
) -> Any:
    """Label an estimate.

    Args:
        est: result of `estimate` on one record (no batch axis): T steps, n states, p unknown inputs.
        time: shape (T,), seconds; or dates, as a ``pandas.DatetimeIndex`` or ``datetime64`` of NumPy (of a zone: those
            of UTC, as xarray knows none).
        dt: seconds between two steps, in the place of `time`: the first step is at 0 s. With neither, the time is the
            number of the step.
        state_names: n names; ``x1, x2, ...`` where left out. Likewise `input_names` (``d1, ...``) and `output_names`
            (``y1, ...``).
        state_units: n units; no unit where left out. Likewise `input_units` and `output_units`.
        y: shape (T, l), the measurements, NaN where missing; left out of the Dataset where left out here.
        title: attribute ``title``.
        certificate: the observer's certificate; its text becomes the attribute ``certificate``.

    Returns:
        xarray.Dataset: with the dimension ``time``, ``<signal>_lower`` and ``<signal>_upper`` of every state and input,
        ``measured_<output>``, ``status`` (a bit mask with CF flag attributes) and ``margin``. The input box at
        step k is that of d_k, which needs y_{k+1}: its last entry is NaN. The attribute ``alarms`` is a JSON list of
        ``{time, kind, index, gap, text}``; of an estimate with a delay, `delay` is its number of steps.

    Raises:
        ValueError: a batch of estimates, or a list of the wrong length.
        MissingExtra: xarray is not installed.
    """
    xarray = need("xarray", extra="cli", purpose="a labelled dataset")
    if not hasattr(est, "state"):
        raise ValueError(f"to_dataset: `est` must be what gx.estimate returns, got {type(est).__name__}")
    state_shape = np.shape(est.state.lower)
    if len(state_shape) != 2:
        raise ValueError(
            f"to_dataset: `est` must hold one record, est.state of shape (T, n), got {state_shape}; take one element "
            "of the batch first"
        )
    steps, n = state_shape
    p = np.shape(est.input.lower)[-1]
    time, time_attributes = _time(time, dt, steps)
    state_names, state_units = _labels("state", state_names, state_units, n, "x")
    input_names, input_units = _labels("input", input_names, input_units, p, "d")
    _check_different([*state_names, *input_names])
    variables: dict[str, Any] = {}
    for index, (name, unit) in enumerate(zip(state_names, state_units, strict=True)):
        _add_bounds(variables, name, unit, "state", np.asarray(est.state.lower), np.asarray(est.state.upper), index)
    # Part of a longer record knows its last input too.
    last = np.full((steps - len(est.input.lower), p), np.nan)
    lower, upper = (np.concatenate([np.asarray(side), last]) for side in (est.input.lower, est.input.upper))
    for index, (name, unit) in enumerate(zip(input_names, input_units, strict=True)):
        _add_bounds(variables, name, unit, "unknown input", lower, upper, index)
    if y is not None:
        y = np.asarray(read_array("to_dataset", "y", y, missing=True))
        if y.ndim != 2 or len(y) != steps:
            raise ValueError(f"to_dataset: `y` must have shape ({steps}, l), got {y.shape}")
        output_names, output_units = _labels("output", output_names, output_units, y.shape[1], "y")
        for index, (name, unit) in enumerate(zip(output_names, output_units, strict=True)):
            attributes = {"units": unit, "long_name": f"measured {_spoken(name)}", "role": "output"}
            variables[f"measured_{name}"] = ("time", y[:, index], attributes)
    flags = {"long_name": "status of the step (0 = OK)", **flag_attributes()}
    variables["status"] = ("time", np.asarray(est.status).astype(np.int32), flags)
    margin = {"long_name": "signed slack of the tightest intersection, in the unit of its component"}
    variables["margin"] = ("time", np.asarray(est.margin), margin)
    alarms = alarm_records(
        est,
        time,
        state_names=state_names,
        input_names=input_names,
        output_names=output_names,
        state_units=state_units,
        input_units=input_units,
        output_units=output_units,
    )
    attributes: dict[str, Any] = {
        "title": title,
        "alarms": json.dumps(alarms, ensure_ascii=False),
        "certificate": "" if certificate is None else str(certificate),
        "library": f"gsisio_jax {__version__}",
    }
    if delay := getattr(est, "delay", 0):
        attributes["delay"] = delay
        attributes["comment"] = f"the boxes of step k are from measurements up to step k + {delay}"
    return xarray.Dataset(variables, coords={"time": ("time", time, time_attributes)}, attrs=attributes)


def alarm_records(est: Any, time: Any, **labels: Any) -> list[dict[str, Any]]:
    """Alarms of an estimate as plain data.

    Args:
        est: an estimate of one record.
        time: shape (T,), time of every step.
        labels: ``state_names``, ``input_names``, ``output_names`` and the units likewise, passed to
            `Alarm.describe`.

    Returns:
        list[dict]: one for each alarm, with ``time`` (a date as text of ISO 8601), ``step``, ``kind``, ``index``,
            ``gap`` (unit of the component) and ``text``, a sentence.
    """
    return [
        {
            "time": _plain(time[alarm.step]),
            "step": int(alarm.step),
            "kind": str(alarm.kind),
            "index": int(alarm.index),
            "gap": float(alarm.gap),
            "text": alarm.describe(**labels),
        }
        for alarm in est.alarms()
    ]


def _time(time: Any, dt: float | None, steps: int) -> tuple[np.ndarray, dict[str, str]]:
    if dt is not None:
        if time is not None:
            raise ValueError("to_dataset: give either `time` or `dt`, got both; `dt` is for steps of one length")
        if not (isinstance(dt, Real) and 0 < dt < np.inf):
            raise ValueError(f"to_dataset: `dt` must be a number of seconds above 0, got {dt!r}")
        time = float(dt) * np.arange(steps)
    if time is None:
        return np.arange(steps, dtype=np.float64), {"long_name": "step"}
    dates = getattr(getattr(time, "dtype", None), "kind", "") == "M"
    if dates:
        zone = zone_of_dates(time)
        attributes = {"long_name": "time"} | ({} if zone is None else {"zone": zone_name(zone)})
        time = np.asarray(time, dtype="datetime64[ns]")  # of a zone: in UTC
    else:
        attributes = {"units": "s", "long_name": "time"}
        time = np.asarray(read_array("to_dataset", "time", time), dtype=np.float64)
    if time.shape != (steps,):
        raise ValueError(f"to_dataset: `time` must have shape ({steps},), got {time.shape}")
    if dates and np.isnat(time).any():
        raise ValueError(f"to_dataset: `time` has no date in row {int(np.argmax(np.isnat(time)))}")
    return time, attributes


def zone_of_dates(time: Any) -> Any:
    """The zone of dates of pandas, an index or a column; None where they have none."""
    return getattr(getattr(time, "dt", time), "tz", None)


def _plain(time: Any) -> float | str:
    return str(np.datetime_as_string(time, unit="auto")) if isinstance(time, np.datetime64) else float(time)


def _labels(
    kind: str, names: Sequence[str] | None, units: Sequence[str] | None, count: int, letter: str
) -> tuple[list[str], list[str]]:
    for what, values in (("names", names), ("units", units)):
        if isinstance(values, str):
            raise ValueError(f"to_dataset: `{kind}_{what}` must be a list of {count} words, got the word {values!r}")
    names = [f"{letter}{index + 1}" for index in range(count)] if names is None else list(names)
    units = [""] * count if units is None else list(units)
    for what, values in (("names", names), ("units", units)):
        if len(values) != count:
            raise ValueError(f"to_dataset: `{kind}_{what}` has {len(values)} entries, the estimate has {count}")
        other = next((value for value in values if not isinstance(value, str)), None)
        if other is not None:
            raise ValueError(f"to_dataset: `{kind}_{what}` must be a list of {count} words, got {other!r} in it")
    return names, units


def _check_different(names: list[str]) -> None:
    """One column would take the place of another, without a word."""
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ValueError(f"to_dataset: two signals are called {twice!r}; give every state and input a name of its own")


def _spoken(name: str) -> str:
    return name.replace("_", " ")


def _add_bounds(
    variables: dict[str, Any], name: str, unit: str, role: str, lower: np.ndarray, upper: np.ndarray, index: int
) -> None:
    for side, values in (("lower", lower), ("upper", upper)):
        attributes = {"units": unit, "long_name": f"{side} bound of {_spoken(name)}", "role": role, "signal": name}
        variables[f"{name}_{side}"] = ("time", values[:, index], attributes)
