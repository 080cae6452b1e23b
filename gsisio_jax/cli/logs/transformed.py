"""The whole table through a function of the user: DataFrame to DataFrame."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..._extras import need
from ..errors import UserError, reason
from .cells import Block, Cells, check_columns
from .config import TablePart
from .dialect import Dialect
from .parquet import parquet_frame
from .parser import Parser
from .text import blocks_of_lines, opened


def transformed(
    path: Path, dialect: Dialect | None, part: TablePart, transform: Callable[[Any], Any]
) -> Iterator[Block]:
    """One block: the wanted columns of what `transform` makes of the file.

    Args:
        path: the file.
        dialect: of a text file; None for Parquet.
        part: the table ``[table]`` of the configuration.
        transform: gets columns of numbers as floats with NaN where missing, other columns as they are; its result
            counts its rows from 1.

    Raises:
        UserError: the file cannot be read, or the function fails or returns something else.
    """
    pandas = need("pandas", extra="cli", purpose="the command line")
    if dialect is None:
        frame, cells = parquet_frame(path), Cells(part.missing)
    else:
        frame, cells = _text_frame(path, dialect, pandas), Cells(part.missing, dialect.decimal, dialect.thousands)
    if len(frame) == 0:
        raise UserError(f"{path.name}: the file has a header but no rows")
    if frame.columns.is_unique:
        for name in frame.columns:
            values, bad = cells.convert(frame[name])
            if bad is None:
                frame[name] = values
    label = getattr(transform, "__name__", repr(transform))
    try:
        frame = transform(frame)
    except Exception as error:
        raise UserError(
            f"{path.name}: table.transform: {label} raised {type(error).__name__}: {reason(error)}"
        ) from error
    if not isinstance(frame, pandas.DataFrame):
        raise UserError(f"table.transform: {label} must return a DataFrame, got {type(frame).__name__}")
    if len(frame) == 0:
        raise UserError(f"{path.name}: table.transform: {label} returned no rows")
    name = f"{path.name} after {label}"
    check_columns(name, frame.columns, part.wanted)
    # The clock stays as it is, because it may hold dates.
    clock = () if part.time is None else set(part.time.column).difference(part.y, part.u)
    block = Block(name, {one: frame[one] for one in part.wanted}, np.arange(1, len(frame) + 1))
    for one in part.wanted:
        if one not in clock:
            block.columns[one] = Cells(part.missing).numbers(block, one)
    yield block


def _text_frame(path: Path, dialect: Dialect, pandas: Any) -> Any:
    """All columns as text; names may repeat, for only a repeated name that is used is an error."""
    parser = Parser(path.name, dialect, (), ())
    frames = []
    with opened(path, dialect.compression) as stream:
        for line, text in blocks_of_lines(stream, dialect.encoding, dialect.quote, path.name):
            frames.append(parser.text(line, text)[0])
    frame = pandas.concat(frames, ignore_index=True) if frames else pandas.DataFrame()
    if len(frame):
        frame.columns = list(dialect.columns)
    return frame
