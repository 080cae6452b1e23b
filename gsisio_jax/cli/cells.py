"""Files of columns: CSV and Parquet read so that every complaint can name the row and the column.

Cells of a CSV file are read as text and converted here, one by one: pandas would not say where a cell is that it cannot
read, and its fast parser is sometimes off in the last digit.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .._extras import need
from .errors import UserError, reason


@dataclass(frozen=True)
class Source:
    """Columns as they were read, and how to name a row of them: by its line in the file, or counted from 1."""

    name: str
    frame: Any
    rows: Sequence[int] | None

    def row(self, index: int) -> str:
        number = index + 1 if self.rows is None else self.rows[index]
        return f"{self.name}: row {number}"


def read_csv(path: Path, pandas: Any) -> Source:
    """Read a CSV file as text: comma separated, one header line, UTF-8; blank lines are skipped."""
    records: list[list[str]] = []
    lines: list[int] = []
    try:
        with open(path, newline="", encoding="utf-8-sig") as stream:
            reader = csv.reader(stream, skipinitialspace=True)
            header = next(filter(None, reader), None)
            if header is None:
                raise UserError(f"{path.name}: the file is empty")
            header = [name.strip() for name in header]
            for record in reader:
                if not record:
                    continue
                if len(record) != len(header):
                    raise UserError(
                        f"{path.name}: row {reader.line_num} has {len(record)} cells, the header has {len(header)}"
                    )
                records.append(record)
                lines.append(reader.line_num)
    except OSError as error:
        raise UserError(f"{path}: cannot read the table: {reason(error)}") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{path.name}: not a CSV file: the file is not UTF-8 text") from error
    except csv.Error as error:
        raise UserError(f"{path.name}: not a CSV file: {reason(error)}") from error
    columns = list(zip(*records, strict=True)) or [()] * len(header)
    # Built column by column because names may repeat in a header; only a repeated name that is used is an error.
    series = [pandas.Series(cells, name=name, dtype=object) for name, cells in zip(header, columns, strict=True)]
    frame = pandas.concat(series, axis=1)
    return Source(path.name, frame, lines)


def read_parquet(path: Path, pandas: Any) -> Source:
    """Read a Parquet file."""
    need("pyarrow", extra="cli", purpose="reading Parquet")
    try:
        if path.stat().st_size == 0:
            raise UserError(f"{path.name}: the file is empty")
        frame = pandas.read_parquet(path)
    except OSError as error:
        raise UserError(f"{path}: cannot read the table: {reason(error)}") from error
    except UserError:
        raise
    except Exception as error:
        raise UserError(f"{path.name}: not a Parquet file: {reason(error)}") from error
    return Source(path.name, frame, None)


def check_columns(source: Source, wanted: Sequence[str]) -> None:
    """Complain about a column that is not there, or there more than once."""
    names = [str(name) for name in source.frame.columns]
    for name in wanted:
        if name not in names:
            raise UserError(f"{source.name}: there is no column '{name}'; the columns are: {', '.join(names)}")
        if names.count(name) > 1:
            raise UserError(f"{source.name}: the column '{name}' is there {names.count(name)} times")


def convert(column: Any, missing: tuple) -> tuple[np.ndarray, int | None]:
    """Floats of one column with NaN where missing, and the index of the first cell that is no number."""
    words = {value.strip() for value in missing if isinstance(value, str)} | {""}
    if column.dtype.kind in "iufb":
        values, bad = column.to_numpy(dtype=np.float64, na_value=np.nan), None
    elif column.dtype.kind in "mM":
        return np.full(len(column), np.nan), 0
    else:
        values, bad = np.empty(len(column)), None
        for index, cell in enumerate(column):
            number = _number(cell, words)
            if number is None:
                values[index], bad = np.nan, index if bad is None else bad
            else:
                values[index] = number
    for value in missing:
        if not isinstance(value, str):
            values = np.where(values == value, np.nan, values)
    return values, bad


def _number(cell: Any, words: set[str]) -> float | None:
    if isinstance(cell, str):
        cell = cell.strip()
        if cell in words:
            return math.nan
        # float() would take the underscores of Python source code, which no table means as a number.
        if "_" in cell:
            return None
    elif cell is None or type(cell).__name__ in ("NAType", "NaTType"):
        return math.nan
    try:
        return float(cell)
    except (TypeError, ValueError):
        return None


def numbers(source: Source, name: str, missing: tuple) -> np.ndarray:
    """One column as floats, NaN where missing; complain about any other cell that is not a finite number."""
    values, bad = convert(source.frame[name], missing)
    if bad is not None:
        cell = source.frame[name].iloc[bad]
        raise UserError(f"{source.row(bad)}, column '{name}': '{cell}' is not a number")
    if np.isinf(values).any():
        bad = int(np.argmax(np.isinf(values)))
        raise UserError(f"{source.row(bad)}, column '{name}': {values[bad]} is not finite; leave a missing value empty")
    return values
