"""A look at one column: numbers or text, range, resolution, what is missing."""

from __future__ import annotations

import math
import re
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np

from .logs import numerals

MOST_WORDS = 3
MOST_DIGITS = 300
WRITTEN = 1000  # numbers whose digits are counted
OFTEN = 0.5  # share of cells that must be numbers in a column of numbers
FEW = 10  # distinct values that say nothing of a grid
CHANCE = 1e-6  # that values on a finer grid look like those of a coarser one
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
        resolution: `resolution_of` the values, sentinels aside; None where there are not two.
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
    values, empty, words, decimals = _numbers(cells, decimal, thousands)
    said = np.isfinite(values)
    numeric = bool(said.any()) and said.sum() >= OFTEN * (len(values) - empty)
    sentinels = _sentinels(values[said]) if numeric else ()
    kept = values[said & ~np.isin(values, sentinels)]
    distinct = np.unique(kept)
    resolution = resolution_of(distinct, decimals) if len(distinct) > 1 else None
    low, high = (float(distinct[0]), float(distinct[-1])) if len(distinct) else (np.nan, np.nan)
    step = np.diff(values[said])
    rises = numeric and not sentinels and bool((step >= 0).all() and (step > 0).any())
    common = tuple(words.most_common(MOST_WORDS)) if numeric else ()
    return Column(name, values, numeric, empty, common, sentinels, resolution, low, high, rises)


def resolution_of(values: np.ndarray, decimals: int) -> float:
    """The step between values that can be told apart: the last digit, or a coarser one that the values prove.

    Differences alone prove nothing: a column with three decimals that is seldom logged, or a switch between 0.00 and
    1.50, would seem to have a resolution of the least difference that happens to be there. Values all lie on a coarser
    grid by chance only where they are few.

    Args:
        values: (K,) distinct numbers in order, two at least.
        decimals: most digits after the point that one of them is written with.

    >>> resolution_of(np.array([0.0, 1.5]), 2), resolution_of(np.arange(20) * 0.25, 2)
    (0.01, 0.25)
    """
    least, digit = float(np.diff(values).min()), float(f"1e{-decimals}")
    if least <= digit or len(values) < FEW:
        return float(f"{min(least, digit):.6g}")
    whole = np.rint(values / digit)
    if np.abs(whole).max() < 2**53:
        step = math.gcd(*(int(one) for one in np.diff(whole)))
        sure = step > 1 and step ** -(len(values) - 2.0) < CHANCE
        return float(f"{step * digit:.6g}") if sure else digit
    # Sixteen digits are those of a computed number, such as counts times a scale; they are whole up to rounding.
    count = (values - values[0]) / least
    return float(f"{least:.6g}") if np.abs(count - np.rint(count)).max() < CHANCE else digit


def _decimals(number: str) -> int:
    """Digits after the point of a number as Python writes it.

    >>> _decimals("1.50"), _decimals("-3"), _decimals("2.25e-2")
    (2, 0, 4)
    """
    digits, exponent = re.fullmatch(r"[^.eE]*\.?(\d*)(?:[eE]([+-]?\d+))?", number).groups()  # type: ignore[union-attr]
    return len(digits) - int(exponent or 0)


def _numbers(cells: Any, decimal: str, thousands: str) -> tuple[np.ndarray, int, Counter[str], int]:
    """Values, cells that are empty, words, and the digits after the point."""
    kind = getattr(getattr(cells, "dtype", None), "kind", "O")
    if kind in "iufb":
        values = np.asarray(cells, dtype=np.float64)
        written = np.unique(np.asarray(cells)[np.isfinite(values)])[:WRITTEN] if kind == "f" else ()
        decimals = max((_decimals(np.format_float_positional(one, trim="-")) for one in written), default=0)
        return values, int(np.isnan(values).sum()), Counter(), decimals
    known: dict[Any, float | str | None] = {}
    values, empty, words, decimals = np.full(len(cells), np.nan), 0, Counter(), -MOST_DIGITS
    for index, cell in enumerate(np.asarray(cells, dtype=object)):
        text = "" if cell is None or cell != cell else str(cell).strip()
        if text not in known:
            number = numerals.plain(text, decimal, thousands)
            if number is not None and math.isfinite(float(number)):
                decimals = max(decimals, _decimals(number))
            known[text] = None if text.lower() in numerals.MISSING else text if number is None else float(number)
        found = known[text]
        if found is None:
            empty += 1
        elif isinstance(found, str):
            words[found] += 1
        else:
            values[index] = found
    return values, empty, words, decimals


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
