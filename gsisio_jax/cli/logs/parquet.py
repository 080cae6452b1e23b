"""Parquet files in blocks of rows; what pandas wrote as an index counts as a column."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..._extras import need
from ..errors import UserError, reason
from .cells import Block, Cells, check_columns

ROWS = 1 << 18  # of a block


def parquet_blocks(
    path: Path,
    wanted: Sequence[str],
    missing: Sequence[float | str],
    as_text: Sequence[str] = (),
    size: int = ROWS,
) -> Iterator[Block]:
    """Blocks of a Parquet file; arguments as of `text_blocks`, `size` in rows, columns of `as_text` as they are.

    Raises:
        UserError: the file, a column or a cell cannot be read.
    """
    cells = Cells(missing)
    name = path.name
    file = _opened(path)
    span = _range_index(file)
    stored = {_name(one): one for one in file.schema_arrow.names}
    check_columns(name, _names(file, span), wanted)
    done = 0
    chosen = [stored[one] for one in wanted if one in stored]
    try:
        for batch in file.iter_batches(batch_size=size, columns=chosen):
            frame = batch.to_pandas(ignore_metadata=True)
            rows = np.arange(done + 1, done + 1 + batch.num_rows)
            columns: dict[str, Any] = {one: frame[stored[one]] for one in wanted if one in stored}
            if span and span[0] in wanted:
                columns[span[0]] = span[1] + span[2] * (rows - 1)
            block = Block(name, columns, rows)
            for one in wanted:
                if one not in as_text:
                    columns[one] = cells.numbers(block, one)
            done += batch.num_rows
            yield block
    except OSError as error:
        raise UserError(f"{path}: cannot read the table: {reason(error)}") from error


def parquet_columns(path: Path) -> list[str]:
    """Names of the columns, index included."""
    file = _opened(path)
    return _names(file, _range_index(file))


def parquet_frame(path: Path) -> Any:
    """The whole file as a DataFrame, index included as columns."""
    pandas = need("pandas", extra="cli", purpose="the command line")
    _opened(path)
    frame = pandas.read_parquet(path)
    plain = isinstance(frame.index, pandas.RangeIndex) and frame.index.name is None
    return frame if plain else frame.reset_index()


def _opened(path: Path) -> Any:
    parquet = need("pyarrow.parquet", extra="cli", purpose="reading Parquet")
    try:
        if path.stat().st_size == 0:
            raise UserError(f"{path.name}: the file is empty")
        file = parquet.ParquetFile(path)
    except UserError:
        raise
    except OSError as error:
        raise UserError(f"{path}: cannot read the table: {reason(error)}") from error
    except Exception as error:
        raise UserError(f"{path.name}: not a Parquet file: {reason(error)}") from error
    if file.metadata.num_rows == 0:
        raise UserError(f"{path.name}: the file has a header but no rows")
    return file


def _names(file: Any, span: tuple[str, int, int] | None) -> list[str]:
    return [_name(one) for one in file.schema_arrow.names] + ([span[0]] if span else [])


def _name(stored: str) -> str:
    """Name of a column; pandas stores an index without a name under one of its own."""
    return "index" if stored.startswith("__index_level_") else stored


def _range_index(file: Any) -> tuple[str, int, int] | None:
    """Name, start and step of a named index that pandas stored as a range, without a column."""
    metadata = (file.schema_arrow.metadata or {}).get(b"pandas")
    for index in json.loads(metadata)["index_columns"] if metadata else ():
        if isinstance(index, dict) and index.get("name") is not None:
            return str(index["name"]), int(index["start"]), int(index["step"])
    return None
