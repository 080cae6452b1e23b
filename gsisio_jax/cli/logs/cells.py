"""Blocks of columns: text through pandas' C parser or Parquet through pyarrow, every row with its place in the file.

The C parser does not say where a cell is that it cannot read, drops cells of lines that are too long and fills up lines
that are too short. So lines are measured first, on bytes, and a block that the parser refuses is read again as text.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..._extras import need
from ..errors import UserError, reason
from . import numerals
from .dialect import Dialect
from .text import BLOCK, blocks_of_lines, opened

_LINE_FEED, _SPACE, _TAB = b"\n \t"


@dataclass(frozen=True)
class Block:
    """Some rows of a table.

    Attributes:
        name: of the file, for messages.
        columns: for every wanted name (R,) floats with NaN where missing, or an object array or Series where the cells
            are no plain numbers (the clock; every column where `transform` comes after).
        rows: (R,) numbers of the rows: lines of a text file, else counted from 1.
    """

    name: str
    columns: dict[str, Any]
    rows: np.ndarray

    def __len__(self) -> int:
        return len(self.rows)

    def row(self, index: int) -> str:
        """The beginning of a message about a row."""
        return f"{self.name}: row {self.rows[index]}"


def text_blocks(
    path: Path,
    dialect: Dialect,
    wanted: Sequence[str],
    missing: Sequence[float | str],
    as_text: Sequence[str] = (),
    size: int = BLOCK,
) -> Iterator[Block]:
    """Blocks of a text file.

    Args:
        path: the file.
        dialect: how it is written.
        wanted: columns that are read.
        missing: cells that mean missing, besides empty ones and the usual words.
        as_text: those of `wanted` whose cells stay text.
        size: characters of a block.

    Raises:
        UserError: anything that cannot be read; one line with row and column.
    """
    parser = Parser(path.name, dialect, wanted, missing, as_text)
    with opened(path, dialect.compression) as stream:
        for line, text in blocks_of_lines(stream, dialect.encoding, dialect.quote, path.name, size):
            block = parser.parse(line, text)
            if len(block):
                yield block


class Parser:
    """Lines of text to columns; arguments as of `text_blocks`."""

    def __init__(
        self,
        name: str,
        dialect: Dialect,
        wanted: Sequence[str],
        missing: Sequence[float | str],
        as_text: Sequence[str] = (),
    ):
        check_columns(name, dialect.columns, wanted)
        self.name, self.dialect = name, dialect
        self.wanted = {dialect.columns.index(one): one for one in wanted}
        self.as_text = {index for index, one in self.wanted.items() if one in as_text}
        self.cells = Cells(missing, dialect.decimal, dialect.thousands)
        self._pandas = need("pandas", extra="cli", purpose="the command line")
        self._comment = None
        if dialect.comment:
            quote, mark = re.escape(dialect.quote), re.escape(dialect.comment)
            self._comment = re.compile(rf"({quote}[^{quote}]*{quote})|{mark}[^\n]*")

    def parse(self, line: int, text: str) -> Block:
        """Columns of some whole lines.

        Args:
            line: number of the first one in the file, counted from 1.
            text: lines, each with a line feed at its end.
        """
        data, rows = self._rows(line, text)
        if not len(rows):
            return Block(self.name, {one: np.empty(0) for one in self.wanted.values()}, rows)
        # Only a strict look at every cell tells 1,234 from 1,23 where commas stand between thousands.
        frame = None if self.dialect.thousands else self._fast(data)
        if frame is None:
            frame = self.frame(data, dict.fromkeys(self.wanted, object))
        columns = {one: frame[index].to_numpy() for index, one in self.wanted.items()}
        block = Block(self.name, columns, rows)
        for index, one in self.wanted.items():
            if index not in self.as_text:
                columns[one] = self.cells.numbers(block, one)
        return block

    def text(self, line: int, text: str) -> tuple[Any, np.ndarray]:
        """All columns of some whole lines as text, by position, and the numbers of the rows."""
        data, rows = self._rows(line, text)
        everything = dict.fromkeys(range(len(self.dialect.columns)), object)
        return self.frame(data, everything), rows

    def _rows(self, line: int, text: str) -> tuple[bytes, np.ndarray]:
        """The lines that are rows, and their numbers; comments and what comes before the first row are dropped."""
        skipped = self.dialect.first_line - line
        if skipped > 0:
            lines = text.split("\n", skipped)
            text, line = lines[-1] if len(lines) > skipped else "", self.dialect.first_line
        if self._comment is not None and self.dialect.comment in text:
            text = self._comment.sub(lambda found: found[1] or "", text)
        if not text:
            return b"", np.empty(0, np.int64)
        return self._measured(text.encode("utf-8", "surrogatepass"), line)

    def _measured(self, data: bytes, line: int) -> tuple[bytes, np.ndarray]:
        """Drop empty lines; complain about a line with too many or too few cells."""
        separator, width = ord(self.dialect.separator), len(self.dialect.columns)
        bytes_ = np.frombuffer(data, np.uint8)
        ends = np.flatnonzero(bytes_ == _LINE_FEED)
        rows = line + np.arange(len(ends))
        if self.dialect.separator == " ":
            gap = (bytes_ == _SPACE) | (bytes_ == _TAB) | (bytes_ == _LINE_FEED)
            marks = ~gap
            marks[1:] &= gap[:-1]  # cells begin after a gap
        else:
            marks = bytes_ == separator
        if self.dialect.quote.encode() in data:
            inside = np.cumsum(bytes_ == ord(self.dialect.quote), dtype=np.uint8) % 2 == 1
            # A cell in quotes begins with its quote, which is the first byte that counts as inside.
            marks &= ~inside | (bytes_ == ord(self.dialect.quote))
            kept = ~inside[ends]
            ends, rows = ends[kept], rows[kept]
        starts = np.concatenate([[0], ends[:-1] + 1])
        cells = np.add.reduceat(marks, starts, dtype=np.int32) + (self.dialect.separator != " ")
        if width > 1:
            # A table of one column may have empty cells; elsewhere a line without anything is no row.
            empty = np.zeros(len(ends), bool)
            for index in np.flatnonzero(cells <= 1):
                empty[index] = not data[starts[index] : ends[index]].strip()
            if empty.any():
                data = bytes_[np.repeat(~empty, ends - starts + 1)].tobytes()
                starts, ends, rows, cells = starts[~empty], ends[~empty], rows[~empty], cells[~empty]
        else:
            cells = np.maximum(cells, 1)
        closing = (cells == width + 1) & (bytes_[ends - 1] == separator)  # 1,2,3, has no fourth cell
        wrong = (cells != width) & ~closing
        if wrong.any():
            bad = int(np.argmax(wrong))
            raise UserError(
                f"{self.name}: row {rows[bad]} has {cells[bad]} cell{'s' if cells[bad] > 1 else ''}, "
                f"the header has {width}"
            )
        return data, rows

    def _fast(self, data: bytes) -> Any:
        """Floats by the C parser; None where it meets a cell that it cannot read."""
        types = {index: object if index in self.as_text else np.float64 for index in self.wanted}
        try:
            return self.frame(data, types)
        except ValueError:
            return None

    def frame(self, data: bytes, types: dict[int, Any]) -> Any:
        """Columns by their position, each of its type: floats with NaN where missing, or text."""
        space = self.dialect.separator == " "
        numbers = [index for index, kind in types.items() if kind is not object]
        # Older versions of pandas round the last digit wrongly unless they are told not to.
        exact = {} if int(self._pandas.__version__.split(".")[0]) > 2 else {"float_precision": "round_trip"}
        return self._pandas.read_csv(
            io.BytesIO(data),
            sep=r"\s+" if space else self.dialect.separator,
            header=None,
            names=range(len(self.dialect.columns)),
            index_col=False,
            usecols=list(types),
            dtype=types,
            decimal=self.dialect.decimal,
            quotechar=self.dialect.quote,
            skipinitialspace=True,
            skip_blank_lines=False,
            na_values={index: self.cells.words for index in numbers},
            keep_default_na=False,
            na_filter=bool(numbers),
            encoding="utf-8",
            engine="c",
            **exact,
        )


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
            raise UserError(f"{block.row(bad)}, column '{name}': {self._complaint(block.columns[name], bad)}")
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
            return f"'{shown}' is not a number; a date or a time of day needs time = {{column = ..., format = \"%H:%M:%S\"}}"
        return f"'{shown}' is not a number; where it means missing: set missing = [{json.dumps(word, ensure_ascii=False)}]"


def check_columns(name: str, columns: Sequence[Any], wanted: Sequence[str]) -> None:
    """Complain about a column that is not there, or there more than once."""
    names = [str(one) for one in columns]
    for one in wanted:
        if one not in names:
            raise UserError(f"{name}: there is no column '{one}'; the columns are: {', '.join(names)}")
        if names.count(one) > 1:
            raise UserError(f"{name}: the column '{one}' is there {names.count(one)} times")
