"""Exact sums of floating numbers, for many sums at once: error-free transformations instead of fractions.

A sum of float64 terms is turned into an equal one whose first term is nearly all of it (Knuth's two-sum, Veltkamp's and
Dekker's two-product); its sign is that of the first term where that is larger than what the others and the bound
of their errors can be, and `math.fsum`, which rounds the exact sum correctly, decides where it is not. NumPy is IEEE
arithmetic; nothing may overflow, and products not underflow. The tests compare with fractions."""

from __future__ import annotations

import math
from typing import Any

import numpy as np


def product(a: Any, b: Any) -> list[Any]:
    """Two arrays whose exact sum is ``a * b``."""
    p = a * b
    (ah, al), (bh, bl) = _halves(a), _halves(b)
    return [p, al * bl - (((p - ah * bh) - al * bh) - ah * bl)]


def _halves(a: Any) -> tuple[Any, Any]:
    large = a * 134217729.0
    high = large - (large - a)
    return high, a - high


def distilled(terms: list[Any], passes: int) -> list[Any]:
    """Terms with the same exact sum, the last one being about the sum rounded, the others what that lost."""
    terms = [np.asarray(t, np.float64) for t in terms]
    for _ in range(passes):
        for i in range(1, len(terms)):
            a, b = terms[i - 1], terms[i]
            total = a + b
            part = total - a
            terms[i - 1], terms[i] = (a - (total - part)) + (b - part), total
    return terms


def sign(terms: list[Any]) -> np.ndarray:
    """Sign of the exact sum of the terms, elementwise: -1, 0 or 1."""
    parts = np.broadcast_arrays(*distilled(terms, 2))
    rest = sum(abs(part) for part in parts[:-1])
    found = np.sign(parts[-1])
    # The sum of the magnitudes is itself rounded, by far less than half of it.
    for index in map(tuple, np.argwhere((abs(parts[-1]) <= 2 * rest) & (rest > 0))):
        found[index] = np.sign(math.fsum(float(part[index]) for part in parts))
    return found


def hull(terms: list[Any], dtype: Any, over: Any = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """The smallest numbers of a floating type around the exact ``sum(terms) / over``; equal where it is such a number.

    `over` is a positive number of few bits.
    """
    parts = distilled(terms, 3)
    near = np.asarray(parts[-1] / over).astype(dtype)

    def side(candidate: Any) -> np.ndarray:
        """Sign of what the sum is above the candidate."""
        there = -candidate.astype(np.float64)
        return sign([*parts, *([there] if over == 1 else product(there, np.float64(over)))])

    # The quotient is one of the two numbers around, or the next one beside these.
    above = side(near)
    lower, upper = np.where(above < 0, _next(near, -np.inf), near), np.where(above > 0, _next(near, np.inf), near)
    if over == 1:
        return lower, upper
    beyond = side(lower) < 0
    upper, lower = np.where(beyond, lower, upper), np.where(beyond, _next(lower, -np.inf), lower)
    beyond = side(upper) > 0
    return np.where(beyond, upper, lower), np.where(beyond, _next(upper, np.inf), upper)


def _next(a: Any, towards: float) -> Any:
    return np.nextafter(a, a.dtype.type(towards))
