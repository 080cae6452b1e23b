"""How a text file is written, found by looking at its beginning; every finding can be overridden by a key."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..errors import UserError
from . import numerals
from .config import DialectPart
from .text import find_compression, find_encoding, head_of, opened

SEPARATORS: tuple[str, ...] = (",", ";", "\t", "|", " ")
COMMENTS = ("#", "%", "//")
LOOKED_AT = 200  # lines that may come before the header
SAMPLE = 100  # rows whose cells show how numbers are written
_WORDS = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars", " ": "spaces"}


@dataclass(frozen=True)
class Dialect:
    """What is needed to read a text file.

    Attributes:
        separator: between cells; a space stands for one or more spaces or tabs.
        decimal, thousands: marks inside of numbers; `thousands` is empty where there is none.
        comment: what begins a comment, empty where there is none.
        quote: character around cells that hold separators.
        encoding, compression: of the file.
        columns: names, in order; ``c1, c2, ...`` where the file has no header.
        first_line: number of the first line that may be a row, counted from 1.
        found: what is not plain (commas, UTF-8, a header in line 1), in words; empty where all is plain.
        sample: cells of the first rows.
    """

    separator: str
    decimal: str
    thousands: str
    comment: str
    quote: str
    encoding: str
    compression: str
    columns: tuple[str, ...]
    first_line: int
    found: str
    sample: tuple[tuple[str, ...], ...]

    def cells(self, name: str) -> list[str]:
        """The sample of one column, without empty cells; nothing where there is no such column."""
        if name not in self.columns:
            return []
        index = self.columns.index(name)
        return [row[index].strip() for row in self.sample if index < len(row) and row[index].strip()]


def sniff_file(path: Path, part: DialectPart, wanted: Sequence[str] = (), missing: Sequence = ()) -> Dialect:
    """`sniff` of a file's beginning."""
    with opened(path, part.compression) as stream:
        head = head_of(stream)
    compression = part.compression
    if compression is None:
        with opened(path, "none") as raw:
            compression = find_compression(raw.read(8))
    return sniff(head, path.name, part, wanted, missing, compression)


def sniff(
    head: bytes,
    name: str,
    part: DialectPart,
    wanted: Sequence[str] = (),
    missing: Sequence = (),
    compression: str = "none",
) -> Dialect:
    """Find how a text is written.

    The header is the first line that has all wanted columns with one of the separators; where none has (or none is
    wanted), the first line with as many cells as most lines have.

    Args:
        head: the first bytes of the text, decompressed.
        name: of the file, for messages.
        part: what the configuration says; the rest is found.
        wanted: names of columns that are known to be there.
        missing: cells that mean missing, so that they count as numbers here.
        compression: of the file, for the description.

    Raises:
        UserError: the file is empty or no text, or its numbers can be read in two ways.
    """
    if not head.strip():
        raise UserError(f"{name}: the file is empty")
    try:
        encoding = part.encoding or find_encoding(head)
        text = head.decode(encoding, errors="ignore" if part.encoding is None else "strict").lstrip("\ufeff")
    except UnicodeDecodeError as error:
        raise UserError(f"{name}: not {part.encoding} text; set table.dialect.encoding, or leave it out") from error
    except ValueError as error:
        raise UserError(f"{name}: not a table of text: {error}") from error
    lines = re.sub("\r\n?", "\n", text).split("\n")
    # The last line is cut off where the file is longer than the head.
    lines = lines[: min(len(lines) - (len(lines) > 2), 4 * LOOKED_AT)]
    comment, quote = _comment(lines) if part.comment is None else part.comment, part.quote or '"'
    layout = _layout(lines, part, comment, quote, [*wanted])
    rows = [cells for _, cells in _rows(lines[layout.first :], layout.separator, comment, quote)][:SAMPLE]
    units = part.skip_after if part.skip_after is not None else _unit_rows(rows, layout, wanted, missing)
    kept = [index for index, _ in _rows(lines[layout.first :], layout.separator, comment, quote)][:units]
    first = layout.first + (kept[-1] + 1 if kept else 0)
    sample = tuple(tuple(cells) for cells in rows[units:])
    chosen = [layout.columns.index(one) for one in wanted if one in layout.columns] or range(len(layout.columns))
    cells = [row[index].strip() for row in sample for index in chosen if index < len(row)]
    try:
        decimal, thousands = numerals.find(cells, layout.separator, part.decimal, part.thousands)
    except ValueError as error:
        raise UserError(f"{name}: {error}; set decimal or thousands in [table.dialect]") from error
    facts = [
        f"{_WORDS.get(layout.separator, repr(layout.separator))} between cells" if layout.separator != "," else "",
        "decimal comma" if decimal == "," else "",
        f"thousands as in 1{thousands}000" if thousands else "",
        f"comments after {comment}" if comment and comment in text else "",
        f"header in line {layout.header}"
        if layout.header > 1
        else ""
        if layout.header
        else "no header: columns c1, c2, ...",
        f"{units} line{'s' if units > 1 else ''} of units" if units else "",
        "" if encoding in ("utf-8", "utf-8-sig") else encoding,
        "" if compression == "none" else compression,
    ]
    return Dialect(
        layout.separator, decimal, thousands, comment, quote, encoding, compression, tuple(layout.columns), first + 1,
        ", ".join(filter(None, facts)), sample,
    )  # fmt: skip


@dataclass(frozen=True)
class _Layout:
    separator: str
    columns: list[str]
    header: int  # its line, from 1; 0 where there is none
    first: int  # index of the first line after it


def _comment(lines: list[str]) -> str:
    """A mark that a line begins with, as long as some lines do not."""
    begins = [next((mark for mark in COMMENTS if line.lstrip().startswith(mark)), "") for line in lines if line.strip()]
    return next(filter(None, begins), "")


def _rows(lines: list[str], separator: str, comment: str, quote: str) -> list[tuple[int, list[str]]]:
    """Index and cells of every line that is neither empty nor a comment; of a row of several lines the last index."""
    found = []
    index = 0
    while index < len(lines):
        line = lines[index].partition(comment)[0] if comment else lines[index]
        if line.count(quote) % 2:
            # A line break inside of quotes; a quote that is never closed stands for itself.
            closing = (end for end in range(index + 1, len(lines)) if lines[end].count(quote) % 2)
            end = next(closing, index)
            line, index = "\n".join(lines[index : end + 1]), end
        if line.strip():
            found.append((index, split(line, separator, quote)))
        index += 1
    return found


def split(line: str, separator: str, quote: str) -> list[str]:
    """Cells of one line, stripped."""
    if separator == " ":
        line = " ".join(line.split())
    # A quote that is never closed must not swallow the line.
    quoting = csv.QUOTE_MINIMAL if line.count(quote) % 2 == 0 else csv.QUOTE_NONE
    cells = next(csv.reader([line], delimiter=separator, quotechar=quote, skipinitialspace=True, quoting=quoting), [])
    return [cell.strip() for cell in cells]


def _layout(lines: list[str], part: DialectPart, comment: str, quote: str, wanted: list[str]) -> _Layout:
    candidates = [part.separator] if part.separator is not None else list(SEPARATORS)
    begin = part.skip or 0
    named = [] if part.header is False else _by_names(lines, candidates, comment, quote, wanted, begin, part.skip)
    layouts = named or [_by_shape(lines, separator, part, comment, quote) for separator in candidates]
    # More lines of the header's length are better, then more numbers, more columns, the usual separator.
    # A single column agrees with everything, so without a name that is no sign of it.
    return max(
        layouts,
        key=lambda one: (
            *(_agreement(lines, one, comment, quote) if named or len(one.columns) > 1 else (0.0, 0.0)),
            len(one.columns),
            -candidates.index(one.separator),
        ),
    )


def _by_names(
    lines: list[str], candidates: list[str], comment: str, quote: str, wanted: list[str], begin: int, skip: int | None
) -> list[_Layout]:
    """The first line with all wanted names, for every separator; a header may itself stand in a comment."""
    found = []
    for separator in candidates if wanted else ():
        for index in range(begin, min(len(lines), begin + (LOOKED_AT if skip is None else 1))):
            line = lines[index].strip()
            if comment and line.startswith(comment):
                line = line.removeprefix(comment).strip()
            cells = split(line, separator, quote)
            if set(wanted) <= set(cells):
                found.append(_Layout(separator, cells, index + 1, index + 1))
                break
    return found


def _by_shape(lines: list[str], separator: str, part: DialectPart, comment: str, quote: str) -> _Layout:
    """The first line with as many cells as most lines have; without a header where all its cells are numbers."""
    begin = part.skip or 0
    rows = _rows(lines[begin:], separator, comment, quote)[: LOOKED_AT + SAMPLE] or [(0, [""])]
    widths = [len(cells) for _, cells in rows]
    usual = max(set(widths), key=lambda width: (widths.count(width), width))
    first = 0 if part.skip is not None else widths.index(usual)
    index, cells = rows[first]
    numeric = all(numerals.is_number(cell) for cell in cells if cell) and any(cells)
    if part.header is False or (part.header is None and numeric):
        return _Layout(separator, [f"c{number + 1}" for number in range(usual)], 0, begin + index)
    return _Layout(separator, cells, begin + index + 1, begin + index + 1)


def _agreement(lines: list[str], layout: _Layout, comment: str, quote: str) -> tuple[float, float]:
    """Shares, in tenths: of the lines after the header that have as many cells; of their cells that are numbers."""
    rows = _rows(lines[layout.first :], layout.separator, comment, quote)[:SAMPLE]
    same = sum(len(cells) == len(layout.columns) for _, cells in rows)
    every = [cell for _, cells in rows for cell in cells]
    return round(same / max(len(rows), 1), 1), round(sum(map(numerals.is_number, every)) / max(len(every), 1), 1)


def _unit_rows(rows: list[list[str]], layout: _Layout, wanted: Sequence[str], missing: Sequence) -> int:
    """Lines after the header in which no wanted cell is a number or missing, at most three: units, descriptions."""
    if not layout.header:
        return 0
    chosen = [layout.columns.index(name) for name in wanted if name in layout.columns] or range(len(layout.columns))
    words = {str(word).strip().lower() for word in missing} | numerals.MISSING

    def speaks(cells: list[str]) -> bool:
        if len(cells) != len(layout.columns):
            return False
        looked = [cells[index] for index in chosen]
        return (
            any(looked)
            and not any(cell[:1].isdigit() or numerals.is_number(cell) for cell in looked)
            and not any(cell and cell.lower() in words for cell in looked)
        )

    count = next((index for index, cells in enumerate(rows[:3]) if not speaks(cells)), min(len(rows), 3))
    # A table of text alone has no units: what comes must be numbers.
    return count if count < len(rows) else 0
