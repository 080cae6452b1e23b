"""A file of any length on the grid of the sample time, some rows at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..._extras import need
from .config import TablePart
from .dialect import Dialect
from .read import Table, joined, open_blocks
from .reader import Rows, TableReader
from .text import head_of, is_parquet, opened


class TableStream:
    """The table of `read_table` in pieces; memory is that of a block of the file, and of the longest gap.

    All of the file is one piece where the configuration asks for it: with ``on_unsorted = "sort"`` or a `transform`.

    Args:
        path, part, transform: as for `read_table`.

    Raises:
        UserError: as `read_table`, when the piece with the fault is read.
    """

    def __init__(self, path: Path, part: TablePart, transform: Callable[[Any], Any] | None = None):
        self.path, self.part = path, part
        self._blocks, self._dialect = open_blocks(path, part, transform)
        self._reader = TableReader(path.name, part)
        self.total = None if transform is not None else _expected(path, self._dialect)
        if part.on_unsorted == "sort" and part.time is not None:
            self._blocks = joined(self._blocks)

    def __iter__(self) -> Iterator[Table]:
        return on_grid(self._rows())

    @property
    def notes(self) -> tuple[tuple[str, str], ...]:
        """What was found and is not plain, once all has been read."""
        return self._reader.notes(self._dialect)

    @property
    def zone(self) -> str | None:
        """As of `StampReader`, once a row has been read."""
        return None if self._reader.stamps is None else self._reader.stamps.zone

    def _rows(self) -> Iterator[Rows]:
        yield from map(self._reader.feed, self._blocks)
        yield self._reader.finish()


def on_grid(found: Iterable[Rows]) -> Iterator[Table]:
    """Rows to tables: NaN where a point of the grid has no row, its time between those of its neighbours."""
    last: tuple[int, float] | None = None
    for rows in found:
        if not len(rows.index):
            continue
        begin = 0 if last is None else last[0] + 1
        points = np.arange(begin, rows.index[-1] + 1)
        known = ([], []) if last is None else ([last[0]], [last[1]])
        index, stamps = np.concatenate([known[0], rows.index]), np.concatenate([known[1], rows.time])
        y = np.full((len(points), rows.y.shape[1]), np.nan)
        y[rows.index - begin] = rows.y
        yield Table(np.interp(points, index, stamps), y, rows.u)
        last = int(rows.index[-1]), float(rows.time[-1])


def _expected(path: Path, dialect: Dialect | None) -> int | None:
    """About how many rows there are, without reading all of them; None where that cannot be told."""
    if is_parquet(path):
        return need("pyarrow.parquet", extra="cli", purpose="reading Parquet").ParquetFile(path).metadata.num_rows
    if dialect is None or dialect.compression != "none":
        return None
    with opened(path, "none") as stream:
        head = head_of(stream)
    lines = head.count(b"\n")
    return int(path.stat().st_size * lines / len(head)) if lines else None
