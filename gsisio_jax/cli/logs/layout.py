"""Separator and header of a text: the line that has the wanted names, or the shape that most lines have."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass

from . import numerals
from .config import DialectPart

SEPARATORS: tuple[str, ...] = (",", ";", "\t", "|", " ")
LOOKED_AT = 200  # lines that may come before the header
SAMPLE = 100  # rows whose cells show how numbers are written


@dataclass(frozen=True)
class Layout:
    """Separator, names of the columns and where the header is."""

    separator: str
    columns: list[str]
    header: int  # its line, from 1; 0 where there is none
    first: int  # index of the first line after it


def rows_of(lines: list[str], separator: str, quote: str) -> list[tuple[int, list[str]]]:
    """Index and cells of every line that is not empty; of a row of several lines the index of the last one."""
    found = []
    index = 0
    while index < len(lines):
        line = lines[index]
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


def find_layout(
    raw: list[str], lines: list[str], part: DialectPart, comment: str, quote: str, wanted: list[str]
) -> Layout:
    """The layout that most lines agree with.

    Args:
        raw: lines of the file.
        lines: the same without comments.
        part: what the configuration says.
        comment, quote: marks of comments (empty where there are none) and of quoted cells.
        wanted: names of columns that are known to be there.
    """
    candidates = [part.separator] if part.separator is not None else list(SEPARATORS)
    begin = part.skip or 0
    named = [] if part.header is False else _by_names(raw, candidates, comment, quote, wanted, begin, part.skip)
    layouts = named or [_by_shape(lines, separator, part, quote) for separator in candidates]
    # More lines of the header's length are better, then more numbers, more columns, the usual separator.
    # A single column agrees with everything, so without a name that is no sign of it.
    return max(
        layouts,
        key=lambda one: (
            *(_agreement(lines, one, quote) if named or len(one.columns) > 1 else (0.0, 0.0)),
            len(one.columns),
            -candidates.index(one.separator),
        ),
    )


def _by_names(
    raw: list[str], candidates: list[str], comment: str, quote: str, wanted: list[str], begin: int, skip: int | None
) -> list[Layout]:
    """The first line with all wanted names, for every separator; a header may itself stand in a comment."""
    found = []
    for separator in candidates if wanted else ():
        for index in range(begin, min(len(raw), begin + (LOOKED_AT if skip is None else 1))):
            line = raw[index].strip()
            if comment and line.startswith(comment):
                line = line.removeprefix(comment).strip()
            cells = split(line, separator, quote)
            if set(wanted) <= set(cells):
                found.append(Layout(separator, _named(cells), index + 1, index + 1))
                break
    return found


def _by_shape(lines: list[str], separator: str, part: DialectPart, quote: str) -> Layout:
    """The first line with as many cells as most lines have; without a header where all its cells are numbers."""
    begin = part.skip or 0
    rows = rows_of(lines[begin:], separator, quote)[: LOOKED_AT + SAMPLE] or [(0, [""])]
    widths = [len(cells) for _, cells in rows]
    usual = max(set(widths), key=lambda width: (widths.count(width), width))
    first = 0 if part.skip is not None else widths.index(usual)
    index, cells = rows[first]
    numeric = all(numerals.is_number(cell) for cell in cells if cell) and any(cells)
    if part.header is False or (part.header is None and numeric):
        return Layout(separator, [f"c{number + 1}" for number in range(usual)], 0, begin + index)
    return Layout(separator, _named(cells), begin + index + 1, begin + index + 1)


def _named(cells: list[str]) -> list[str]:
    """Names of a header; a separator at its end begins no column."""
    return cells[:-1] if len(cells) > 1 and not cells[-1] else cells


def _agreement(lines: list[str], layout: Layout, quote: str) -> tuple[float, float]:
    """Shares, in tenths: of the lines after the header that have as many cells; of their cells that are numbers."""
    rows = rows_of(lines[layout.first :], layout.separator, quote)[:SAMPLE]
    same = sum(len(cells) == len(layout.columns) for _, cells in rows)
    every = [cell for _, cells in rows for cell in cells]
    return round(same / max(len(rows), 1), 1), round(sum(map(numerals.is_number, every)) / max(len(every), 1), 1)


def unit_rows(rows: list[list[str]], layout: Layout, wanted: Sequence[str], missing: Sequence) -> int:
    """Lines after the header in which no wanted cell is a number or missing, at most three: units, descriptions.

    Some cells may be empty, as that of a clock without a unit, where no word of the line is in a later one: a row with
    a sensor's "off" is a row of measurements.
    """
    if not layout.header:
        return 0
    chosen = [layout.columns.index(name) for name in wanted if name in layout.columns] or range(len(layout.columns))
    words = {str(word).strip().lower() for word in missing} | numerals.MISSING

    def speaks(place: int, cells: list[str]) -> bool:
        if len(cells) != len(layout.columns):
            return False
        said = {index: cells[index] for index in chosen if cells[index]}
        if any(cell[:1].isdigit() or numerals.is_number(cell) or cell.lower() in words for cell in said.values()):
            return False
        later = (row for row in rows[place + 1 :] if len(row) == len(cells))
        return bool(said) and (
            len(said) == len(chosen) or not any(row[index] == cell for row in later for index, cell in said.items())
        )

    count = next((place for place, cells in enumerate(rows[:3]) if not speaks(place, cells)), min(len(rows), 3))
    # A table of text alone has no units: what comes must be numbers.
    return count if count < len(rows) else 0
