"""Lines of text to columns, through the C parser of pandas.

It does not say where a cell is that it cannot read, drops cells of lines that are too long and fills up lines that are
too short. So lines are measured first, on bytes, and a block that the parser refuses is read again as text.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..._extras import need
from ..errors import UserError, reason
from .cells import Block, Cells, check_columns
from .dialect import Dialect, without_comments
from .text import BLOCK, blocks_of_lines, end_of_lines, opened

_LINE_FEED, _SPACE, _TAB = b"\n \t"
_NO_ROW = b"\x1a"  # in place of a comment: an empty line is an empty cell where there is one column


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
            frame = self._as_text(data, dict.fromkeys(self.wanted, object), rows)
        columns = {one: frame[index].to_numpy() for index, one in self.wanted.items()}
        block = Block(self.name, columns, rows, self._units(line))
        for index, one in self.wanted.items():
            if index not in self.as_text:
                columns[one] = self.cells.numbers(block, one)
        return block

    def parse_up_to_fault(self, line: int, text: str) -> Iterator[Block]:
        """`parse`; where a row is at fault, first the rows before it, found by halving, and then the error."""
        try:
            block = self.parse(line, text)
        except UserError:
            middle = end_of_lines(text[: text.find("\n", len(text) // 2) + 1], self.dialect.quote)
            if middle in (0, len(text)):  # the half may be the whole where its last line is long
                middle = end_of_lines(text[: text.find("\n") + 1], self.dialect.quote)
            if middle in (0, len(text)):
                raise
            yield from self.parse_up_to_fault(line, text[:middle])
            yield from self.parse_up_to_fault(line + text.count("\n", 0, middle), text[middle:])
            return
        if len(block):
            yield block

    def text(self, line: int, text: str) -> tuple[Any, np.ndarray]:
        """All columns of some whole lines as text, by position, and the numbers of the rows."""
        data, rows = self._rows(line, text)
        everything = dict.fromkeys(range(len(self.dialect.columns)), object)
        return self._as_text(data, everything, rows), rows

    def _units(self, line: int) -> str:
        """Of the lines that begin with this one: what may be wrong with their first row."""
        known = self.dialect.skip_after
        if known is None or line > self.dialect.first_line:
            return ""
        return f"; where this row is one of units: set table.dialect.skip_after = {known + 1}"

    def _rows(self, line: int, text: str) -> tuple[bytes, np.ndarray]:
        """The lines that are rows, and their numbers; comments and what comes before the first row are dropped."""
        skipped = self.dialect.first_line - line
        if skipped > 0:
            lines = text.split("\n", skipped)
            text, line = lines[-1] if len(lines) > skipped else "", self.dialect.first_line
        text = without_comments(text, self.dialect.comment, self.dialect.quote, alone=_NO_ROW.decode())
        if " \n" in text:
            text = re.sub(" +\n", "\n", text)
        if not text:
            return b"", np.empty(0, np.int64)
        return self._measured(text.encode("utf-8", "surrogatepass"), line)

    def _measured(self, data: bytes, line: int) -> tuple[bytes, np.ndarray]:
        """Drop empty lines; complain about a line with too many or too few cells."""
        width = len(self.dialect.columns)
        quoted = self.dialect.quote.encode() in data
        cells, rows, surplus, data = self._counted_one_by_one(data, line) if quoted else self._counted(data, line)
        wrong = (cells != width) & ~surplus
        if wrong.any():
            bad = int(np.argmax(wrong))
            raise UserError(
                f"{self.name}: row {rows[bad]} has {cells[bad]} cell{'s' if cells[bad] > 1 else ''}, "
                f"the header has {width}"
            )
        return data, rows

    def _counted(self, data: bytes, line: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, bytes]:
        """Cells of every line, numbers of the lines, whether there is one empty cell too many, lines that are rows."""
        separator, width = ord(self.dialect.separator), len(self.dialect.columns)
        bytes_ = np.frombuffer(data, np.uint8)
        ends = np.flatnonzero(bytes_ == _LINE_FEED)
        starts = np.concatenate([[0], ends[:-1] + 1])
        if self.dialect.separator == " ":
            gap = (bytes_ == _SPACE) | (bytes_ == _TAB) | (bytes_ == _LINE_FEED)
            marks = ~gap
            marks[1:] &= gap[:-1]  # cells begin after a gap
            cells = np.add.reduceat(marks, starts, dtype=np.int32)
        else:
            cells = np.add.reduceat(bytes_ == separator, starts, dtype=np.int32) + 1
        kept = np.ones(len(ends), bool)
        if width > 1 or _NO_ROW in data:
            # A table of one column may have empty cells; elsewhere a line without anything is no row.
            no_rows = (b"", _NO_ROW) if width > 1 else (_NO_ROW,)
            for index in np.flatnonzero(cells <= 1):
                kept[index] = data[starts[index] : ends[index]].strip(b" \t") not in no_rows
            if not kept.all():
                data = bytes_[np.repeat(kept, ends - starts + 1)].tobytes()
        surplus = (cells == width + 1) & (bytes_[ends - 1] == separator)  # 1,2,3, has no fourth cell
        return np.maximum(cells, 1)[kept], (line + np.arange(len(ends)))[kept], surplus[kept], data

    def _counted_one_by_one(self, data: bytes, line: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, bytes]:
        """The same where cells stand in quotes, which may hold separators and line breaks; a row of several lines is
        named by its last one."""
        text, width = data.decode("utf-8", "surrogatepass"), len(self.dialect.columns)
        if self.dialect.separator == " ":
            text = "\n".join(" ".join(line.split()) for line in text.split("\n"))
        reader = csv.reader(
            io.StringIO(text),
            delimiter=self.dialect.separator,
            quotechar=self.dialect.quote,
            skipinitialspace=True,
        )
        cells, rows, surplus = [], [], []
        try:
            for record in reader:
                alone = record[0].strip() if len(record) == 1 else "" if not record else None
                if alone == _NO_ROW.decode() or (alone == "" and width > 1):
                    continue
                cells.append(max(len(record), 1))
                rows.append(line + reader.line_num - 1)
                surplus.append(len(record) == width + 1 and not record[-1])
        except csv.Error as error:
            raise UserError(f"{self.name}: row {line + reader.line_num - 1}: {reason(error)}") from error
        data = re.sub(rb"(?m)^[ \t]*\x1a\n" if width == 1 else rb"(?m)^[ \t]*\x1a?\n", b"", data)
        return np.array(cells, np.int32), np.array(rows, np.int64), np.array(surplus, bool), data

    def _fast(self, data: bytes) -> Any:
        """Floats by the C parser; None where it meets a cell that it cannot read."""
        types = {index: object if index in self.as_text else np.float64 for index in self.wanted}
        try:
            return self.frame(data, types)
        except ValueError:
            return None

    def _as_text(self, data: bytes, types: dict[int, Any], rows: np.ndarray) -> Any:
        try:
            return self.frame(data, types)
        except ValueError as error:
            raise UserError(f"{self.name}: rows {rows[0]} to {rows[-1]} cannot be read: {reason(error)}") from error

    def frame(self, data: bytes, types: dict[int, Any]) -> Any:
        """Columns by their position, each of its type: floats with NaN where missing, or text."""
        space = self.dialect.separator == " "
        numbers = [index for index, kind in types.items() if kind is not object]
        # Older versions of pandas round the last digit wrongly unless they are told not to.
        version = tuple(map(int, self._pandas.__version__.split(".")[:2]))
        exact = {} if version >= (3, 1) else {"float_precision": "round_trip"}
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
