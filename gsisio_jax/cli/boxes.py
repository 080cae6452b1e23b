"""The rows of a run in order: in memory while they are few, in a file of records of one size after that."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .errors import UserError

IN_MEMORY = 1 << 18  # rows
PART = 1 << 17  # rows that are read at a time when the files are written


def record_type(n: int, p: int, l: int) -> np.dtype:
    """One row: time, measurement and what the observer says, for n states, p unknown inputs and l outputs."""
    wide = [("y", l), ("state_lower", n), ("state_upper", n), ("input_lower", p), ("input_upper", p)]
    return np.dtype(
        [
            ("time", np.float64),
            *((name, np.float64, (size,)) for name, size in wide),
            ("status", np.int32),
            ("margin", np.float64),
            ("source", np.int32),
        ]
    )


def records(kind: np.dtype, time: np.ndarray, y: np.ndarray, out: Any) -> np.ndarray:
    """Rows as `record_type` has them.

    Args:
        kind: `record_type`.
        time: (R,) seconds.
        y: (R, l), NaN where missing.
        out: their `StepOutput`; its `input` is the box of the input one step before.
    """
    rows = np.empty(len(time), kind)
    rows["time"], rows["y"] = time, y
    rows["state_lower"], rows["state_upper"] = out.state.lower, out.state.upper
    rows["input_lower"], rows["input_upper"] = out.input.lower, out.input.upper
    rows["status"], rows["margin"], rows["source"] = out.status, out.margin, out.source
    return rows


class Boxes:
    """Rows that grow at the end.

    Args:
        kind: `record_type`.
        spill: called once, when there are more than `limit` rows: the file that takes them; else they stay in memory.
        limit: rows that stay in memory.
        delay: L: what the observer says at a row is of L rows before, and the last L rows only finish the record.
    """

    def __init__(
        self, kind: np.dtype, spill: Callable[[], Path] | None = None, limit: int | None = None, delay: int = 0
    ):
        self.kind, self._spill, self._limit = kind, spill, IN_MEMORY if limit is None else limit
        self.delay = delay
        self._rows: list[np.ndarray] = []
        self._path = Path()
        self._file: Any = None
        self._count = 0

    def __len__(self) -> int:
        return self._count

    @property
    def steps(self) -> int:
        """Rows of the record that are finished."""
        return max(self._count - self.delay, 0)

    @property
    def on_disk(self) -> bool:
        return self._file is not None

    def append(self, time: np.ndarray, y: np.ndarray, out: Any) -> None:
        """Add R rows; arguments as of `records`."""
        rows = records(self.kind, time, y, out)
        if self._file is None:
            self._rows.append(rows)
        else:
            rows.tofile(self._file)
        self._count += len(rows)
        if self._file is None and self._spill is not None and self._count > self._limit:
            self._path = self._spill()
            self._file = open(self._path, "w+b")  # noqa: SIM115
            for some in self._rows:
                some.tofile(self._file)
            self._rows = []

    def reopen(self, path: Path, count: int) -> None:
        """Go on after the first `count` rows of a file; what came after them is dropped.

        Raises:
            UserError: the file is shorter.
        """
        if not path.is_file() or path.stat().st_size < count * self.kind.itemsize:
            raise UserError(f"--resume: {path} has fewer than {count:,} rows; begin anew without it")
        self._rows, self._count, self._path = [], count, path
        self._file = open(path, "r+b")  # noqa: SIM115
        self._file.truncate(count * self.kind.itemsize)
        self._file.seek(0, os.SEEK_END)

    def sync(self) -> None:
        """Make the file's rows durable."""
        self._file.flush()
        os.fsync(self._file.fileno())

    def close(self) -> None:
        if self._file is not None:
            self._file.close()

    def read(self, begin: int, end: int) -> np.ndarray:
        """Rows `begin` to `end`, or as many of them as there are."""
        begin, end = (min(place, self._count) for place in (begin, end))
        if self._file is None:
            self._rows = [np.concatenate(self._rows)] if self._rows else [np.empty(0, self.kind)]
            return self._rows[0][begin:end]
        self._file.flush()
        return np.fromfile(self._path, self.kind, end - begin, offset=begin * self.kind.itemsize)

    def parts(self, size: int = PART) -> Iterator[np.ndarray]:
        """All finished rows, some at a time, every box at its own step: that of the input at the last row is NaN.

        There is one part where all rows are in memory.
        """
        size, steps, delay = size if self.on_disk else max(self.steps, 1), self.steps, self.delay
        for begin in range(0, steps, size):
            rows = self.read(begin, begin + size + delay + 1)
            part = rows[: min(size, steps - begin)].copy()
            for name in ("state_lower", "state_upper", "status", "margin", "source"):
                part[name] = rows[name][delay : delay + len(part)]
            for side in ("input_lower", "input_upper"):
                later = rows[side][delay + 1 : delay + 1 + len(part)]
                part[side][: len(later)], part[side][len(later) :] = later, np.nan
            yield part
