"""How a text file is written, found by looking at its beginning; every finding can be overridden by a key."""

from __future__ import annotations

import codecs
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from ..errors import UserError
from . import numerals
from .config import DialectPart
from .layout import LOOKED_AT, SAMPLE, find_layout, rows_of, unit_rows
from .text import compression_of, find_encoding, head_of, opened

COMMENTS = ("#", "%", "//")
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
        skip_after: lines of units after the header; None where the file has no header.
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
    skip_after: int | None
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
    compression = part.compression or compression_of(path)
    with opened(path, compression) as stream:
        head = head_of(stream)
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
    text, encoding = _decoded(head, name, part)
    raw = text.split("\n")
    comment, quote = _comment(raw) if part.comment is None else part.comment, part.quote or '"'
    lines = without_comments(text, comment, quote).split("\n")
    # The last line is cut off where the file is longer than the head.
    raw, lines = (one[: min(len(one) - (len(one) > 2), 4 * LOOKED_AT)] for one in (raw, lines))
    layout = find_layout(raw, lines, part, comment, quote, list(wanted))
    rows = rows_of(lines[layout.first :], layout.separator, quote)[:SAMPLE]
    cells = [row for _, row in rows]
    units = unit_rows(cells, layout, wanted, missing) if part.skip_after is None else min(part.skip_after, len(rows))
    first = layout.first + (rows[units - 1][0] + 1 if units else 0)
    sample = tuple(map(tuple, cells[units:]))
    chosen = [layout.columns.index(one) for one in wanted if one in layout.columns] or range(len(layout.columns))
    numbers = [row[index] for row in sample for index in chosen if index < len(row)]
    try:
        decimal, thousands = numerals.find(numbers, layout.separator, part.decimal, part.thousands)
    except ValueError as error:
        raise UserError(f"{name}: {error}; set decimal or thousands in [table.dialect]") from error
    dialect = Dialect(
        layout.separator, decimal, thousands, comment, quote, encoding, compression, tuple(layout.columns), first + 1,
        units if layout.header else None, "", sample,
    )  # fmt: skip
    return replace(dialect, found=_described(dialect, layout.header, units, bool(comment) and comment in text))


def without_comments(text: str, comment: str, quote: str, alone: str = "") -> str:
    """A text without its comments, with as many lines as before.

    Args:
        text: whole lines.
        comment: what begins a comment, as long as it stands outside of quotes; nothing is done where it is empty.
        quote: character around cells.
        alone: what is left of a line that is a comment and nothing else.
    """
    if not comment or comment not in text:
        return text
    quote, comment = re.escape(quote), re.escape(comment)
    pattern = re.compile(rf"({quote}[^{quote}\n]*{quote})|^[ \t]*{comment}[^\n]*()|{comment}[^\n]*", re.MULTILINE)
    return pattern.sub(lambda found: found[1] or ("" if found[2] is None else alone), text)


def _decoded(head: bytes, name: str, part: DialectPart) -> tuple[str, str]:
    try:
        encoding = part.encoding or find_encoding(head)
        # A character that is cut in two at the end of the head is left out.
        text = codecs.getincrementaldecoder(encoding)().decode(head)
    except UnicodeDecodeError as error:
        raise UserError(f"{name}: not {part.encoding} text; set table.dialect.encoding, or leave it out") from error
    except ValueError as error:
        raise UserError(f"{name}: not a table of text: {error}") from error
    return re.sub("\r\n?", "\n", text.lstrip("\ufeff")), encoding


def _comment(lines: list[str]) -> str:
    """A mark that a line begins with, as long as some lines do not."""
    begins = [next((mark for mark in COMMENTS if line.lstrip().startswith(mark)), "") for line in lines if line.strip()]
    return next(filter(None, begins), "")


def _described(dialect: Dialect, header: int, units: int, commented: bool) -> str:
    """What is not plain, in words."""
    separator = _WORDS.get(dialect.separator, repr(dialect.separator))
    facts = {
        f"{separator} between cells": dialect.separator != ",",
        "decimal comma": dialect.decimal == ",",
        f"thousands as in 1{dialect.thousands}000": dialect.thousands,
        f"comments after {dialect.comment}": commented,
        "no header: columns c1, c2, ...": header == 0,
        f"header in line {header}": header > 1,
        f"{units} line{'s' if units > 1 else ''} of units": units,
        dialect.encoding: dialect.encoding not in ("utf-8", "utf-8-sig"),
        dialect.compression: dialect.compression != "none",
    }
    return ", ".join(fact for fact, said in facts.items() if said)
