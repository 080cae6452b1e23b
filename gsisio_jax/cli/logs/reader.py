"""Blocks of cells to rows on the grid: clock, units, duplicates, known inputs."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..errors import UserError
from .cells import Block
from .clock import TOLERANCE, Clock, check_order, find_sample_time
from .config import TablePart
from .dialect import Dialect
from .stamps import StampReader, Stamps

KNOWN = (
    'every step needs one: set on_gap_u = "hold" where it kept its last value, fill it in with a table.transform, or '
    "make it an unknown input, a column of G"
)


@dataclass(frozen=True)
class Rows:
    """Rows in order, one a point of the grid; points without a row are left out.

    Attributes:
        index: (R,) points of the grid, rising.
        time: (R,) seconds.
        y: (R, l).
        u: (R, m), or a row for every point of the grid since the last row before; None where there are no inputs.
        rows: (R,) numbers of the rows in the file.
    """

    index: np.ndarray
    time: np.ndarray
    y: np.ndarray
    u: np.ndarray | None
    rows: np.ndarray


class TableReader:
    """Blocks of cells to rows on the grid, block by block; memory is that of a block.

    Rows that a later block can still change are held back until then: the last point of the grid where
    ``on_duplicate`` is "last" or "mean", the last row where ``dt = "as_input"``, whose time step is not known before.
    With ``on_unsorted = "sort"`` the rows of one block are sorted, so whoever wants the whole file sorted hands it over
    as one block (`joined`). With ``sample_time = "auto"`` the first block tells.

    Args:
        name: of the file, for messages.
        part: the table ``[table]`` of the configuration.
    """

    def __init__(self, name: str, part: TablePart):
        self.name, self.part = name, part
        self.stamps = None if part.time is None else StampReader(part.time, tuple(part.missing))
        self.clock: Clock | None = None
        self.dropped = self.merged = self.filled = 0
        self.sorted = False
        self._held: dict[str, np.ndarray] = {}
        self._last_u = np.full(len(part.u), np.nan)
        self._last, self._since, self._shown, self._step = -1, 0.0, "", 0.0
        self._holds = part.dt is not None or part.on_duplicate in ("last", "mean")

    def feed(self, block: Block) -> Rows:
        """Rows that are finished with this block.

        Raises:
            UserError: a time, or a known input, that cannot be used; one line with row and column.
        """
        found = self._placed(block)
        if self._held:
            found = {key: np.concatenate([self._held[key], values]) for key, values in found.items()}
        if self._holds:
            cut = int(np.searchsorted(found["index"], found["index"][-1])) if len(found["index"]) else 0
            self._held = {key: values[cut:] for key, values in found.items()}
            found = {key: values[:cut] for key, values in found.items()}
        return self._emit(found, self._held["since"][0] if self._holds and len(self._held["since"]) else None)

    def feed_up_to_fault(self, block: Block) -> Iterator[Rows]:
        """`feed`; where a row is at fault, first the rows before it, found by halving, and then the error.

        Fewer rows at a time must tell the same: not so of a sample time that the first block tells.
        """
        if len(block) < 2 or (self.part.sample_time == "auto" and self.clock is None):
            yield self.feed(block)
            return
        before = {name: copy.deepcopy(value) for name, value in vars(self).items() if name != "part"}
        try:
            rows = self.feed(block)
        except UserError:
            vars(self).update(before)
            middle = len(block) // 2
            yield from self.feed_up_to_fault(block.cut(0, middle))
            yield from self.feed_up_to_fault(block.cut(middle, len(block)))
            return
        yield rows

    def finish(self) -> Rows:
        """Rows that were held back, once there is no more block.

        Raises:
            UserError: there was no row; or most of the grid would be empty.
        """
        rows = self._emit(self._held or self._empty(), None)
        self._held = {}
        if self._last < 0:
            what = "no row has a time" if self.dropped else "the file has a header but no rows"
            raise UserError(f"{self.name}: {what}")
        if self.clock is not None:
            self.clock.finish(self.name)
        return rows

    def notes(self, dialect: Dialect | None) -> tuple[tuple[str, str], ...]:
        """What is not plain, as (label, text): the dialect; the clock where it was found, jitters or was mended."""
        clock = self.clock
        mended = [
            f"{self.dropped:,} rows without a time dropped" if self.dropped else "",
            f"{self.merged:,} rows of the same step merged ({self.part.on_duplicate})" if self.merged else "",
            "rows sorted" if self.sorted else "",
            f"known inputs held at {self.filled:,} steps without a value" if self.filled else "",
        ]
        notes = [("table", dialect.found)] if dialect is not None and dialect.found else []
        uneven = clock is not None and clock.jitter > 0.01 * clock.sample_time
        if clock is not None and (clock.found or uneven or any(mended)):
            mended = [clock.describe(), *mended]
        if any(mended):
            notes.append(("clock", ", ".join(filter(None, mended))))
        return tuple(notes)

    def _placed(self, block: Block) -> dict[str, np.ndarray]:
        """Columns of a block in the order of time, with their points."""
        found = {"rows": block.rows, "y": self._columns(block, self.part.y), "u": self._columns(block, self.part.u)}
        if self.stamps is None:
            index = self._last + 1 + np.arange(len(block))
            return found | {
                "index": index,
                "since": index * self.part.sample_time,
                "time": index * self.part.sample_time,
            }
        stamps = self.stamps.read(block)
        order = self._order(stamps, block.units)
        if order is not None:
            stamps = stamps.take(order)
            found = {key: values[order] for key, values in found.items()}
        return found | {"index": self._points(stamps), "since": stamps.since, "time": stamps.time}

    def _order(self, stamps: Stamps, units: str) -> np.ndarray | None:
        """Rows that have a time, sorted on request; None where that is all of them as they are."""
        empty = np.isnan(stamps.since)
        order = None
        if empty.any():
            if self.part.on_blank_time == "error":
                bad = int(np.argmax(empty))
                raise UserError(
                    f"{stamps.place(bad)}: the time is missing; every row needs one, or set "
                    f'on_blank_time = "drop"{"" if bad else units}'
                )
            self.dropped += int(empty.sum())
            order = np.flatnonzero(~empty)
        if self.part.on_unsorted == "sort":
            since = stamps.since if order is None else stamps.since[order]
            if (np.diff(since) < 0).any():
                by_time = np.argsort(since, kind="stable")
                order = by_time if order is None else order[by_time]
                self.sorted = True
        return order

    def _points(self, stamps: Stamps) -> np.ndarray:
        if not len(stamps):
            return np.empty(0, np.int64)
        duplicates = self.part.on_duplicate != "error"
        if self.part.dt is None:
            if self.clock is None:
                self.clock = self._new_clock(stamps)
            return self.clock.place(stamps, duplicates)
        first = self._shown == ""
        step = np.diff(stamps.since, prepend=stamps.since[0] if first else self._since)
        check_order(stamps, step, self._shown, duplicates, not first)
        start = self._held["index"][-1] if self._held and len(self._held["index"]) else -1
        self._since, self._shown = float(stamps.since[-1]), stamps.show(len(stamps) - 1)
        return start + first + np.cumsum(step > 0)

    def _new_clock(self, stamps: Stamps) -> Clock:
        part, reader = self.part.time, self.stamps
        assert part is not None
        assert reader is not None
        found = self.part.sample_time == "auto"
        sample_time = find_sample_time(stamps, part.tolerance) if found else self.part.sample_time
        tolerance = TOLERANCE * sample_time if part.tolerance is None else part.tolerance
        if tolerance > sample_time / 4:
            raise UserError(
                f"table.time.tolerance = {tolerance:g} s must not exceed a quarter of the sample time that was found, "
                f"{sample_time:g} s"
            )
        return Clock(sample_time, tolerance, "" if reader.dates else reader.unit, found, self.part.sparse)

    def _columns(self, block: Block, names: list[str]) -> np.ndarray:
        """(R, len(names)) numbers in the units of the plant."""
        values = [block.columns[name] for name in names]
        parts = self.part.columns
        values = [
            parts[name].apply(column) if name in parts else column for name, column in zip(names, values, strict=True)
        ]
        return np.stack(values, axis=1) if values else np.empty((len(block), 0))

    def _empty(self) -> dict[str, np.ndarray]:
        return {
            "index": np.empty(0, np.int64), "rows": np.empty(0, np.int64), "since": np.empty(0), "time": np.empty(0),
            "y": np.empty((0, len(self.part.y))), "u": np.empty((0, len(self.part.u))),
        }  # fmt: skip

    def _emit(self, found: dict[str, np.ndarray], following: float | None) -> Rows:
        """One row a point, with its time step; `following` is the time of the next point, where it is known."""
        rows = len(found["index"])
        found = merged(found, self.part.on_duplicate)
        if len(found["index"]) and found["index"][0] == self._last:
            found = {key: values[1:] for key, values in found.items()}
        self.merged += rows - len(found["index"])
        index, u = found["index"], found["u"]
        if not len(index):
            return Rows(index, found["time"], found["y"], u if self.part.u or self.part.dt else None, found["rows"])
        if self.part.u:
            u = self._held_inputs(found) if self.part.on_gap_u == "hold" else u
            self._check_inputs(found, u)
        if self.part.dt is not None:
            u = np.column_stack([u, self._time_steps(found["since"], following)])
        self._last = int(index[-1])
        return Rows(index, found["time"], found["y"], u if u.shape[1] else None, found["rows"])

    def _time_steps(self, since: np.ndarray, following: float | None) -> np.ndarray:
        step = np.diff(since, append=since[-1] if following is None else following)
        if following is None:
            # Nothing follows the last row; its own step only matters to a g that takes it.
            step[-1] = step[-2] if len(step) > 1 else self._step
            if step[-1] == 0:
                raise UserError(f'{self.name}: dt = "as_input" needs at least two rows with different times')
        self._step = float(step[-1])
        return step

    def _held_inputs(self, found: dict[str, np.ndarray]) -> np.ndarray:
        """Known inputs at every point of the grid since the last row before: where there is none, the last one."""
        begin = self._last + 1
        u = np.full((int(found["index"][-1]) - self._last, len(self.part.u)), np.nan)
        u[found["index"] - begin] = found["u"]
        self.filled += int(np.isnan(u).any(axis=1).sum())
        u = np.vstack([self._last_u, u])
        source = np.where(np.isnan(u), 0, np.arange(len(u))[:, None])
        u = np.take_along_axis(u, np.maximum.accumulate(source), axis=0)
        self._last_u = u[-1]
        return u[1:]

    def _check_inputs(self, found: dict[str, np.ndarray], u: np.ndarray) -> None:
        """Known inputs must be there at every step."""
        held = self.part.on_gap_u == "hold"
        blank = np.isnan(u[found["index"] - self._last - 1] if held else u)
        if blank.any():
            row, column = np.unravel_index(int(np.argmax(blank)), blank.shape)
            raise UserError(
                f"{self.name}: row {found['rows'][row]}, column '{self.part.u[column]}': a known input is missing"
                + (", and there is none before it to be held" if held else f"; {KNOWN}")
            )
        absent = np.diff(found["index"], prepend=self._last) - 1
        if (absent > 0).any() and not held:
            bad = int(np.argmax(absent > 0))
            raise UserError(
                f"{self.name}: row {found['rows'][bad]}: {absent[bad]} rows of the grid are absent before it, so "
                f"the known inputs ({', '.join(self.part.u)}) are not known there, and {KNOWN}"
            )


def merged(found: dict[str, np.ndarray], how: str) -> dict[str, np.ndarray]:
    """One row for every point: the first, the last or the mean of those that share it (a mean over what is not NaN)."""
    index = found["index"]
    new = np.diff(index, prepend=-1) > 0
    if new.all():
        return found
    starts = np.flatnonzero(new)
    if how == "last":
        return {key: values[np.append(starts[1:], len(index)) - 1] for key, values in found.items()}
    first = {key: values[starts] for key, values in found.items()}
    if how == "mean":
        for key in ("y", "u"):
            there = ~np.isnan(found[key])
            count = np.add.reduceat(there, starts, axis=0, dtype=np.int64)
            total = np.add.reduceat(np.where(there, found[key], 0.0), starts, axis=0)
            first[key] = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return first
