"""A look at one column: numbers or text, range, resolution, what is missing."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np

from .logs import numerals

MOST_WORDS = 3
OFTEN = 0.5  # share of cells that must be numbers in a column of numbers
FAR = 10.0  # times the range of the other values that a value standing for "missing" lies away


@dataclass(frozen=True)
class Column:
    """What was found.

    Attributes:
        name: of the column.
        values: (R,) floats, NaN where a cell is no number.
        numeric: most cells that say anything are numbers.
        empty: cells that are empty or say so by a usual word.
        words: other cells that are no numbers, with how often they are there; the most frequent ones.
        sentinels: numbers that look as if they stood for a missing value.
        resolution: smallest difference between two values, sentinels aside; None where there are not two.
        low, high: range, sentinels aside.
        rises: no value falls below the one before, and some rise.
    """

    name: str
    values: np.ndarray
    numeric: bool
    empty: int
    words: tuple[tuple[str, int], ...]
    sentinels: tuple[float, ...]
    resolution: float | None
    low: float
    high: float
    rises: bool

    @property
    def stand_ins(self) -> int:
        """Cells with one of the `sentinels`."""
        return int(np.isin(self.values, self.sentinels).sum())

    @property
    def constant(self) -> bool:
        return self.resolution is None


def look_at(name: str, cells: Any, decimal: str, thousands: str) -> Column:
    """Look at the cells of a column.

    Args:
        name: of the column.
        cells: (R,) text, or what Parquet has.
        decimal, thousands: marks inside of numbers.
    """
    values, empty, words = _numbers(cells, decimal, thousands)
    said = np.isfinite(values)
    numeric = bool(said.any()) and said.sum() >= OFTEN * (len(values) - empty)
    sentinels = _sentinels(values[said]) if numeric else ()
    kept = values[said & ~np.isin(values, sentinels)]
    distinct = np.unique(kept)
    resolution = float(f"{np.diff(distinct).min():.6g}") if len(distinct) > 1 else None
    low, high = (float(distinct[0]), float(distinct[-1])) if len(distinct) else (np.nan, np.nan)
    step = np.diff(values[said])
    rises = numeric and not sentinels and bool((step >= 0).all() and (step > 0).any())
    common = tuple(words.most_common(MOST_WORDS)) if numeric else ()
    return Column(name, values, numeric, empty, common, sentinels, resolution, low, high, rises)


def _numbers(cells: Any, decimal: str, thousands: str) -> tuple[np.ndarray, int, Counter[str]]:
    kind = getattr(getattr(cells, "dtype", None), "kind", "O")
    if kind in "iufb":
        values = np.asarray(cells, dtype=np.float64)
        return values, int(np.isnan(values).sum()), Counter()
    known: dict[Any, float | str | None] = {}
    values, empty, words = np.full(len(cells), np.nan), 0, Counter()
    for index, cell in enumerate(np.asarray(cells, dtype=object)):
        text = "" if cell is None or cell != cell else str(cell).strip()
        if text not in known:
            number = numerals.plain(text, decimal, thousands)
            known[text] = None if text.lower() in numerals.MISSING else text if number is None else float(number)
        found = known[text]
        if found is None:
            empty += 1
        elif isinstance(found, str):
            words[found] += 1
        else:
            values[index] = found
    return values, empty, words


def _stands_for_missing(value: float) -> bool:
    """-99, -9999, 999999, or the end of a range of integers."""
    digits = f"{abs(value):.0f}"
    nines = value == round(value) and len(digits) > 1 and set(digits) == {"9"}
    return nines or abs(value) in (32767, 32768, 65535, 2147483647, 2147483648)


def _sentinels(values: np.ndarray) -> tuple[float, ...]:
    """Numbers such as -9999 or 32767, at an end and far from all others, that are there more than once."""
    found: list[float] = []
    for end in (np.min, np.max, np.min):  # the one at the far end may hide the other
        rest = values[~np.isin(values, found)]
        if len(rest) < 3:
            break
        value = float(end(rest))
        others = rest[rest != value]
        if _stands_for_missing(value) and len(rest) - len(others) > 1 and len(others) > 1:
            near = min(abs(others.min() - value), abs(others.max() - value))
            if near > FAR * (others.max() - others.min()) or abs(value) > FAR * np.abs(others).max():
                found.append(value)
    return tuple(sorted(found))
