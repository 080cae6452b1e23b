"""What a summary counts, gathered part by part."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np

from .._moments import moment
from ..dataset import alarm_records
from ..observer.alarms import read_alarms
from ..observer.status import Status
from ..observer.summary import beyond, unpromised, unread
from .problem import Names, Problem

MOST_ALARMS = 10_000  # with their words; status and margin of the files have all


def seconds(time: float) -> str:
    """A time with the digits that tell steps apart, also where it counts from 1970, and without those of its rounding.

    >>> seconds(0.1 + 0.2), seconds(1714557600.6)
    ('0.3', '1714557600.6')
    """
    return f"{time:.10g}" if abs(time) < 1e6 else f"{time:.15g}"


@dataclass
class Signal:
    """Widths of one state or input; `mean` is over the bounded steps, None where there is none."""

    name: str
    unit: str
    kind: str
    total: float = 0.0
    bounded: int = 0
    unbounded: int = 0
    last: float | None = None

    @property
    def steps(self) -> int:
        return self.bounded + self.unbounded

    @property
    def mean(self) -> float | None:
        return self.total / self.bounded if self.bounded else None

    def add(self, width: np.ndarray) -> None:
        width = width[~np.isnan(width)]
        finite = width[np.isfinite(width)]
        self.total += float(finite.sum())
        self.bounded += len(finite)
        self.unbounded += len(width) - len(finite)
        if len(width):
            self.last = float(width[-1]) if np.isfinite(width[-1]) else None


@dataclass
class Totals:
    """Counts over all steps of a run.

    Attributes:
        absent, partly: rows without any measurement, and with some entries missing.
        statuses: steps by the bit of their status.
        beyond: steps whose state box is not inside the region.
        unread: steps of which an output, or one of the step before, is missing, ambiguous or contradicted.
        outside: these, and those with the status OUTSIDE_REGION.
        zone: of the dates that the clock shows, "" where they have none; None where it counts from a beginning of its
            own.
        alarms: the first `MOST_ALARMS` as plain data; `alarm_times` has the times of all, `alarm_count` of them.
    """

    signals: list[Signal]
    steps: int = 0
    first: float = np.nan
    last: float = np.nan
    absent: int = 0
    partly: int = 0
    statuses: dict[str, int] = field(default_factory=dict)
    beyond: int = 0
    unread: int = 0
    outside: int = 0
    zone: str | None = None
    alarms: list[dict[str, Any]] = field(default_factory=list)
    alarm_times: np.ndarray = field(default_factory=lambda: np.empty(0))

    def when(self, time: float, unit: str = " s") -> str:
        """A time of the run for a reader: date and time of day where the clock shows dates, else seconds."""
        return f"{seconds(time)}{unit}" if self.zone is None else moment(time, self.zone)

    @property
    def alarm_count(self) -> int:
        return len(self.alarm_times)


def gather(parts: Iterable[np.ndarray], problem: Problem, observer: Any) -> Totals:
    """Count over the parts of `Boxes`.

    Args:
        parts: rows in order.
        problem: names and units.
        observer: of the run.
    """
    region, output_rows = observer.certificate.region, observer.output_rows
    totals = Totals([*_signals(problem.state, "state"), *_signals(problem.input, "input")])
    members = [member for member in Status if member.value]
    totals.statuses = {str(member.name): 0 for member in members}
    times, before = [], False
    for rows in parts:
        if totals.steps == 0:
            totals.first = float(rows["time"][0])
        totals.last = float(rows["time"][-1])
        missing = np.isnan(rows["y"])
        whole = missing.all(axis=1)
        totals.absent += int(whole.sum())
        totals.partly += int((missing.any(axis=1) & ~whole).sum())
        for member in members:
            totals.statuses[str(member.name)] += int(np.count_nonzero(rows["status"] & int(member)))
        totals.beyond += int(np.count_nonzero(beyond(rows["state_lower"], rows["state_upper"], region)))
        lacking, before = unread(rows["status"], before), unread(rows["status"][-1:])[-1]
        totals.unread += int(lacking.sum())
        totals.outside += unpromised(rows["status"], lacking)
        width = np.concatenate([rows[f"{kind}_upper"] - rows[f"{kind}_lower"] for kind in ("state", "input")], axis=1)
        for index, signal in enumerate(totals.signals):
            signal.add(width[:, index])
        times.append(rows["time"][(rows["status"] & int(Status.CONFLICT)) != 0])
        totals.alarms += alarms_of(rows, problem, output_rows, totals.steps, MOST_ALARMS - len(totals.alarms))
        totals.steps += len(rows)
    totals.alarm_times = np.concatenate(times)
    return totals


def alarms_of(
    rows: np.ndarray, problem: Problem, output_rows: Sequence[tuple[int, ...]], begin: int, most: int | None = None
) -> list[dict[str, Any]]:
    """The alarms of some rows as plain data; `begin` is the step of the first row, `most` their largest number."""
    conflicts = np.flatnonzero(rows["status"] & int(Status.CONFLICT))[:most]
    some = rows[conflicts]
    found = SimpleNamespace(alarms=lambda: read_alarms(some["status"], some["margin"], some["source"], output_rows))
    labels = {
        f"{group}_{what}": getattr(getattr(problem, group), what)
        for group in ("state", "input", "output")
        for what in ("names", "units")
    }
    records = alarm_records(found, some["time"], **labels)
    return [record | {"step": int(begin + place)} for record, place in zip(records, conflicts, strict=True)]


def _signals(group: Names, kind: str) -> list[Signal]:
    return [Signal(name, unit, kind) for name, unit in zip(group.names, group.units, strict=True)]
