"""A whole file on the grid of the sample time: measurements, known inputs and missing rows."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import UserError
from .cells import Block
from .clock import MAXIMUM_STEPS
from .config import TablePart
from .dialect import Dialect, sniff_file
from .parquet import parquet_blocks
from .parser import text_blocks
from .reader import Rows, TableReader
from .stamps import is_date
from .text import is_parquet
from .transformed import transformed


@dataclass(frozen=True)
class Table:
    """Measurements, one row a step.

    Attributes:
        time: (T,) seconds; the file's own value where the row is in the file, between its neighbours' where it is not.
        y: (T, l); NaN is missing.
        u: (T, m) of known inputs, or None where the system has none. With ``dt = "as_input"`` the last column is the
            time step: row k holds the seconds from row k to row k + 1.
        notes: what was found in the file and is not plain, as (label, text).
        zone: as of `StampReader`.
    """

    time: np.ndarray
    y: np.ndarray
    u: np.ndarray | None
    notes: tuple[tuple[str, str], ...] = ()
    zone: str | None = None


def read_table(path: Path, part: TablePart, transform: Callable[[Any], Any] | None = None) -> Table:
    """Read a file of measurements, text or Parquet.

    Args:
        path: the file; compressed or not.
        part: the table ``[table]`` of the configuration: columns, clock, dialect, units.
        transform: DataFrame to DataFrame, applied before the columns are taken. Columns of numbers reach it as floats
            with NaN where missing, other columns as text.

    Returns:
        The table on its grid.

    Raises:
        UserError: anything in the file that cannot be used; one line that names file, row and column. Rows of a text
            file are its lines (the header is line 1), rows of Parquet or of a transformed table count from 1.
    """
    blocks, dialect = open_blocks(path, part, transform)
    if part.on_unsorted == "sort" and part.time is not None:
        blocks = joined(blocks)
    reader = TableReader(path.name, part)
    found = [*map(reader.feed, blocks), reader.finish()]
    last = max(int(rows.index[-1]) for rows in found if len(rows.index))
    if last > MAXIMUM_STEPS:
        raise UserError(f"{path.name}: the times span {last:,} steps, more than {MAXIMUM_STEPS:,}; check sample_time")
    table = filled(found, reader.notes(dialect))
    return table if reader.stamps is None else replace(table, zone=reader.stamps.zone)


def open_blocks(
    path: Path, part: TablePart, transform: Callable[[Any], Any] | None = None
) -> tuple[Iterator[Block], Dialect | None]:
    """Blocks of the wanted columns, read as they are asked for, and the dialect of a text file."""
    if is_parquet(path):
        if transform is not None:
            return transformed(path, None, part, transform), None
        return parquet_blocks(path, part.wanted, part.missing, as_text(part, None)), None
    dialect = sniff_file(path, part.dialect, () if transform else part.wanted, part.missing)
    if transform is not None:
        return transformed(path, dialect, part, transform), dialect
    return text_blocks(path, dialect, part.wanted, part.missing, as_text(part, dialect)), dialect


def as_text(part: TablePart, dialect: Dialect | None) -> list[str]:
    """The clock where its cells are not numbers of a text file, so that they are kept as they are."""
    clock = part.time
    if clock is None:
        return []
    names = [name for name in clock.column if name not in (*part.y, *part.u)]
    if dialect is None or clock.format is not None or clock.unit == "iso8601" or len(clock.column) > 1:
        return names
    dates = clock.unit is None and any(is_date(cell) for name in names for cell in dialect.cells(name))
    return names if dates else []


def joined(blocks: Iterator[Block]) -> Iterator[Block]:
    """All blocks as one."""
    every = list(blocks)
    if every:
        columns = {
            name: np.concatenate([np.asarray(block.columns[name]) for block in every]) for name in every[0].columns
        }
        yield Block(every[0].name, columns, np.concatenate([block.rows for block in every]), every[0].units)


def filled(found: list[Rows], notes: tuple[tuple[str, str], ...] = ()) -> Table:
    """Rows of all blocks on the whole grid: NaN where a point has no row, its time between those of its neighbours."""
    index = np.concatenate([rows.index for rows in found])
    points = np.arange(index[-1] + 1)
    time = np.interp(points, index, np.concatenate([rows.time for rows in found]))
    y = np.full((len(points), found[0].y.shape[1]), np.nan)
    y[index] = np.concatenate([rows.y for rows in found])
    inputs = [rows.u for rows in found if rows.u is not None and len(rows.u)]
    return Table(time, y, np.concatenate(inputs) if inputs else None, notes)
