"""Cells to numbers: what means missing, how numbers are written, and whose row and column a complaint names."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import UserError
from . import numerals


@dataclass(frozen=True)
class Block:
    """Some rows of a table.

    Attributes:
        name: of the file, for messages.
        columns: for every wanted name (R,) floats with NaN where missing, or an object array or Series where the cells
            are no plain numbers (the clock; every column where `transform` comes after).
        rows: (R,) numbers of the rows: lines of a text file, else counted from 1.
        units: what is to be said of the first row where it is the first one after a header: it may be one of units.
    """

    name: str
    columns: dict[str, Any]
    rows: np.ndarray
    units: str = ""

    def __len__(self) -> int:
        return len(self.rows)

    def cut(self, begin: int, end: int) -> Block:
        """Rows `begin` to `end`."""
        columns = {name: cells[begin:end] for name, cells in self.columns.items()}
        return Block(self.name, columns, self.rows[begin:end], "" if begin else self.units)

    def row(self, index: int) -> str:
        """The beginning of a message about a row."""
        return f"{self.name}: row {self.rows[index]}"


class Cells:
    """From single cells to numbers: what is missing and how numbers are written.

    Args:
        missing: values that mean missing, besides empty cells and the usual words.
        decimal, thousands: marks inside of numbers.
    """

    def __init__(self, missing: Sequence[float | str], decimal: str = ".", thousands: str = ""):
        own = {word.strip() for word in missing if isinstance(word, str)}
        usual = {form for word in numerals.MISSING for form in (word, word.upper(), word.title())}
        self.words = sorted(own | usual | {"NaN", "-NaN"})
        self.decimal, self.thousands = decimal, thousands
        self._own = own
        self._values = [float(word) for word in missing if not isinstance(word, str)]

    def convert(self, column: Any) -> tuple[np.ndarray, int | None]:
        """(R,) floats of a column, NaN where missing, and the index of the first cell that is no number."""
        dtype = getattr(column, "dtype", None)
        kind = getattr(dtype, "kind", "O")
        bad = None
        if kind in "iufb":
            values = column.to_numpy(dtype=np.float64, na_value=np.nan) if hasattr(column, "to_numpy") else column
            values = np.asarray(values, dtype=np.float64)
        elif kind in "mM":
            values, bad = np.full(len(column), np.nan), 0
        else:
            values, bad = self._one_by_one(np.asarray(column, dtype=object))
        for value in self._values:
            values = np.where(values == value, np.nan, values)
        return values, bad

    def _one_by_one(self, column: np.ndarray) -> tuple[np.ndarray, int | None]:
        values = np.full(len(column), np.nan)
        first = None
        for index, cell in enumerate(column):
            number = self._number(cell)
            if number is None:
                first = index if first is None else first
            else:
                values[index] = number
        return values, first

    def _number(self, cell: Any) -> float | None:
        if isinstance(cell, str):
            cell = cell.strip()
            if cell in self._own or cell.lower() in numerals.MISSING:
                return np.nan
            cell = numerals.plain(cell, self.decimal, self.thousands)
        elif cell is None or type(cell).__name__ in ("NAType", "NaTType"):
            return np.nan
        try:
            return None if cell is None else float(cell)
        except (TypeError, ValueError):
            return None

    def numbers(self, block: Block, name: str) -> np.ndarray:
        """(R,) floats of a block's column, NaN where missing.

        Raises:
            UserError: a cell is no finite number; with its row and column, and the key that would accept it.
        """
        values, bad = self.convert(block.columns[name])
        if bad is not None:
            hint = "" if bad else block.units
            raise UserError(f"{block.row(bad)}, column '{name}': {self._complaint(block.columns[name], bad)}{hint}")
        if np.isinf(values).any():
            bad = int(np.argmax(np.isinf(values)))
            raise UserError(
                f"{block.row(bad)}, column '{name}': {values[bad]} is not finite; leave a missing value empty, "
                f"or set missing = [{values[bad]}]"
            )
        return values

    def _complaint(self, column: Any, index: int) -> str:
        cell = column.iloc[index] if hasattr(column, "iloc") else column[index]
        word = str(cell).strip()
        shown = word if len(word) <= 40 else word[:37] + "..."
        if not isinstance(cell, str):
            return f"'{shown}' is not a number"
        if self.decimal == "." and numerals.plain(word, ",", "") is not None:
            return f"'{shown}' is not a number; where commas are decimal: set table.dialect.decimal = \",\""
        if ":" in word and word[:1].isdigit():
            return f"'{shown}' is not a number; a date or a time of day needs time.format, such as \"%H:%M:%S\""
        return (
            f"'{shown}' is not a number; where it means missing: set missing = [{json.dumps(word, ensure_ascii=False)}]"
        )


def check_columns(name: str, columns: Sequence[Any], wanted: Sequence[str]) -> None:
    """Complain about a column that is not there, or there more than once."""
    names = [str(one) for one in columns]
    for one in wanted:
        if one not in names:
            raise UserError(f"{name}: there is no column '{one}'; the columns are: {', '.join(names)}")
        if names.count(one) > 1:
            raise UserError(f"{name}: the column '{one}' is there {names.count(one)} times")
