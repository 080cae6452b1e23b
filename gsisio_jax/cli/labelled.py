"""The rows of a run with the user's names and units: whole, part by part, or joined for a picture."""

from __future__ import annotations

import json
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np

from .._moments import EPOCH
from ..dataset import to_dataset
from ..plot.style import MAXIMUM_POINTS, joined
from ..plot.style import short as short_width
from .boxes import Boxes
from .problem import Problem
from .totals import Totals


class Labelled:
    """Datasets of a run, all with the same variables and attributes.

    Args:
        problem: names and units.
        boxes: the rows.
        totals: of those rows.
        title, certificate: attributes.
    """

    def __init__(self, problem: Problem, boxes: Boxes, totals: Totals, title: str, certificate: Any):
        self._problem, self._boxes, self._totals = problem, boxes, totals
        self._title, self._certificate = title, certificate
        self._measured = measured_states(problem.system)

    def parts(self) -> Iterator[Any]:
        """Some rows at a time; one dataset of all of them where they are in memory."""
        for rows in self._boxes.parts():
            yield self._dataset(rows)

    def whole(self) -> Any:
        """All rows, in memory."""
        parts = list(self._boxes.parts())
        return self._dataset(parts[0] if len(parts) == 1 else np.concatenate(parts))

    def picture(self) -> Any:
        """What a picture shows: all rows, or neighbours joined to their hull where there are more than a picture has
        room for. Every group of neighbours is two rows, its first and last time, with the least and the largest
        measurement; a group is a gap where all its rows are.
        """
        if not self._boxes.on_disk:
            return self.whole()
        dataset = self._dataset(_hulls(self._boxes))
        for signal in self._totals.signals:
            mean = "never bounded" if signal.mean is None else f"width: mean {short_width(signal.mean)}"
            last = "not bounded" if signal.last is None else short_width(signal.last)
            dataset[f"{signal.name}_lower"].attrs["widths"] = f"{mean}, last {last}"
        times = dataset["time"].values
        places = np.clip(np.searchsorted(times, self._totals.alarm_times, side="right") - 1, 0, len(times) - 1)
        dataset.attrs["alarms"] = json.dumps([{"time": float(times[place])} for place in np.unique(places)])
        return dataset

    def _dataset(self, rows: np.ndarray) -> Any:
        problem = self._problem
        estimate = SimpleNamespace(
            state=SimpleNamespace(lower=rows["state_lower"], upper=rows["state_upper"]),
            input=SimpleNamespace(lower=rows["input_lower"], upper=rows["input_upper"]),
            status=rows["status"],
            margin=rows["margin"],
            alarms=lambda: [],
            delay=self._boxes.delay,
        )
        dataset = to_dataset(
            estimate,
            time=rows["time"],
            state_names=problem.state.names,
            state_units=problem.state.units,
            input_names=problem.input.names,
            input_units=problem.input.units,
            output_names=problem.output.names,
            output_units=problem.output.units,
            y=rows["y"],
            title=self._title,
            certificate=self._certificate,
        )
        for output, state in self._measured.items():
            dataset[f"measured_{problem.output.names[output]}"].attrs["measures"] = problem.state.names[state]
        if self._totals.zone is not None:
            # The numbers stay seconds; pictures show what they stand for.
            dataset["time"].attrs |= date_attributes(self._totals.zone)
        dataset.attrs["alarms"] = json.dumps(self._totals.alarms, ensure_ascii=False)
        if self._totals.alarm_count > len(self._totals.alarms):
            dataset.attrs["alarm_count"] = self._totals.alarm_count
        return dataset


def date_attributes(zone: str) -> dict[str, str]:
    """Of a time in seconds since 1970 that stands for dates of a zone, "" where they have none."""
    return {"long_name": "time since 1970-01-01 00:00 UTC", "epoch": EPOCH} | ({"zone": zone} if zone else {})


def measured_states(system: Any) -> dict[int, int]:
    """Outputs that are a state and noise, and which state: g returns it as it is at some points, and no input enters.

    Of a signal that has a name of its own, `framers` would not know.
    """
    import jax

    rng = np.random.default_rng(0)
    found: list[np.ndarray] = []
    with jax.enable_x64(True):
        for _ in range(4):
            x, u = rng.uniform(0.1, 0.9, system.n), rng.uniform(0.1, 0.9, system.m)
            found.append(np.asarray(system.measurement(jax.numpy.asarray(x), jax.numpy.asarray(u)))[:, None] == x)
    same = np.logical_and.reduce(found)
    free = ~(np.any(system.H, 1) | np.any(system.D, 1))
    return {int(j): int(np.argmax(same[j])) for j in np.flatnonzero(same.any(1) & free)}


def _hulls(boxes: Boxes) -> np.ndarray:
    """Groups of neighbours, two rows each."""
    starts = joined(boxes.steps, MAXIMUM_POINTS)
    found = np.zeros(2 * len(starts), boxes.kind)
    first, second = found[::2], found[1::2]
    for side in (first, second):
        for name in ("y", "state_lower", "state_upper", "input_lower", "input_upper"):
            side[name] = np.nan
    begin = 0
    for rows in boxes.parts():
        group = np.searchsorted(starts, begin + np.arange(len(rows)), side="right") - 1
        places = np.flatnonzero(np.diff(group, prepend=group[0] - 1))
        mine, ends = group[places], np.append(places[1:], len(rows)) - 1
        new = starts[mine] >= begin
        first["time"][mine[new]] = rows["time"][places[new]]
        second["time"][mine] = rows["time"][ends]
        for name in ("state_lower", "input_lower", "y"):
            first[name][mine] = np.fmin(first[name][mine], np.fmin.reduceat(rows[name], places))
        for name in ("state_upper", "input_upper", "y"):
            second[name][mine] = np.fmax(second[name][mine], np.fmax.reduceat(rows[name], places))
        first["status"][mine] |= np.bitwise_or.reduceat(rows["status"], places)
        begin += len(rows)
    for name in ("state_lower", "input_lower"):
        second[name] = first[name]
    for name in ("state_upper", "input_upper"):
        first[name] = second[name]
    second["status"] = first["status"]
    return found
