"""How numbers are written in cells: marks of decimals and of thousands, and words that mean missing."""

from __future__ import annotations

import re
from collections.abc import Iterable

MISSING = frozenset(
    {
        "",
        "nan",
        "-nan",
        "+nan",
        "na",
        "n/a",
        "#n/a",
        "#na",
        "<na>",
        "null",
        "none",
        "nat",
        "1.#qnan",
        "1.#ind",
        "-1.#ind",
    }
)
_EXPONENT = r"([eE][+-]?\d+)?"
_PLAIN = re.compile(rf"[+-]?(\d+\.?\d*|\.\d+){_EXPONENT}|[+-]?inf(inity)?", re.IGNORECASE)
_COMMA = re.compile(rf"[+-]?(\d+,\d*|,\d+){_EXPONENT}")


def _grouped(mark: str) -> re.Pattern[str]:
    tail = ".,".replace(mark, "")
    return re.compile(rf"[+-]?\d{{1,3}}({re.escape(mark)}\d{{3}})+([{tail}]\d*)?{_EXPONENT}")


_THOUSANDS = {mark: _grouped(mark) for mark in (",", ".", " ", "'", "_")}


def is_number(cell: str) -> bool:
    """Whether a cell is a number in one of the usual ways of writing it, or missing by a usual word.

    >>> [is_number(cell) for cell in ("1.5e3", "1,5", "1'000.5", "nan", "12:30", "m/s")]
    [True, True, True, True, False, False]
    """
    if cell.lower() in MISSING or _PLAIN.fullmatch(cell) or _COMMA.fullmatch(cell):
        return True
    return any(pattern.fullmatch(cell) for pattern in _THOUSANDS.values())


def find(cells: Iterable[str], separator: str, decimal: str | None, thousands: str | None) -> tuple[str, str]:
    """Marks of decimals and of thousands (empty: none) that all cells agree with.

    Args:
        cells: of the columns that hold numbers; others do not matter.
        separator: of the file.
        decimal: mark of decimals where it is known.
        thousands: mark of thousands where it is known.

    Raises:
        ValueError: every number with a comma could be a decimal or a thousand, as 1,234 could.

    >>> find(["1.234,5", "2"], ";", None, None), find(["0,125", "1,250"], ";", None, None)
    ((',', '.'), (',', ''))
    """
    cells = {cell.replace("\u00a0", " ").replace("\u202f", " ") for cell in cells}
    if decimal is not None and thousands is not None:
        return decimal, thousands
    points = [cell for cell in cells if _PLAIN.fullmatch(cell) and "." in cell]
    commas = [cell for cell in cells if _COMMA.fullmatch(cell)]
    if thousands is None:
        for mark, other in ((",", "."), (".", ",")):
            both = [
                c for c in cells if mark in c and other in c and _THOUSANDS[mark].fullmatch(c) and c.count(other) == 1
            ]
            repeated = [c for c in cells if c.count(mark) > 1 and _THOUSANDS[mark].fullmatch(c)]
            if (both or repeated) and decimal in (None, other):
                return other, mark
        for mark in (" ", "'"):
            if mark != separator and any(mark in cell and _THOUSANDS[mark].fullmatch(cell) for cell in cells):
                thousands = mark
    if decimal is None:
        decimal = "," if commas and not points and thousands != "," else "."
        certain = [cell for cell in commas if not _THOUSANDS[","].fullmatch(cell) or re.match(r"[+-]?0", cell)]
        if commas and not points and not certain and thousands is None:
            example = min(commas)
            as_decimal, as_thousands = example.replace(",", "."), example.replace(",", "")
            raise ValueError(f"'{example}' may mean {as_decimal} or {as_thousands}, and no cell says which")
        if commas and points and not certain and thousands is None:
            thousands = ","
    return decimal, thousands or ""


def plain(cell: str, decimal: str, thousands: str) -> str | None:
    """A cell as Python writes numbers; None where it is none, also where thousands are grouped wrongly.

    >>> plain("1.234,5", ",", "."), plain("1.23,5", ",", "."), plain("1_0", ".", "")
    ('1234.5', None, None)
    """
    cell = cell.replace("\u00a0", " ").replace("\u202f", " ").strip().replace("\u2212", "-")
    if thousands and thousands in cell:
        if not _THOUSANDS[thousands].fullmatch(cell):
            return None
        cell = cell.replace(thousands, "")
    if decimal != ".":
        if "." in cell:
            return None
        cell = cell.replace(decimal, ".")
    return cell if _PLAIN.fullmatch(cell) else None
