"""Arithmetic of pairs (lower, upper) of float64 arrays in NumPy, which is IEEE: one step to the neighbour is
outward.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gsisio_jax.interval.box import Interval

Sides = tuple[np.ndarray, np.ndarray]


def sides(box: Interval) -> Sides:
    """Of a box, in float64."""
    return np.asarray(box.lower, np.float64), np.asarray(box.upper, np.float64)


def box(pair: Sides) -> Interval:
    """Back to a box, in float64 whatever JAX's settings are."""
    return Interval.unchecked(*pair)


def magnitude(pair: Sides) -> np.ndarray:
    """Largest absolute value."""
    return np.maximum(abs(pair[0]), abs(pair[1]))


def add(*pairs: Sides) -> Sides:
    """The sum."""
    low, high = pairs[0]
    for other in pairs[1:]:
        low, high = np.nextafter(low + other[0], -np.inf), np.nextafter(high + other[1], np.inf)
    return low, high


def negative(pair: Sides) -> Sides:
    """The box of -x."""
    return -pair[1], -pair[0]


def times(a: Sides, b: Sides) -> Sides:
    """The product, elementwise, with ``0 * inf = 0``."""
    with np.errstate(invalid="ignore", over="ignore"):
        products = np.array([np.where((p == 0) | (q == 0), 0, p * q) for p in a for q in b])
    return np.nextafter(products.min(0), -np.inf), np.nextafter(products.max(0), np.inf)


def apply(matrix: Sides, vector: Sides) -> Sides:
    """A box of matrices (m, n) times a box (n,)."""
    low, high = times(matrix, vector)
    none = np.zeros(len(low)), np.zeros(len(low))
    return add(none, *((low[:, j], high[:, j]) for j in range(low.shape[1])))


def meet(a: Sides, b: Sides) -> Sides:
    """The intersection of two bounds of the same numbers."""
    return np.maximum(a[0], b[0]), np.minimum(a[1], b[1])


def hull(pairs: list[Sides]) -> Sides:
    """The smallest box around all."""
    return np.min([low for low, _ in pairs], 0), np.max([high for _, high in pairs], 0)


def symmetric(radius: Any) -> Sides:
    """The box from -r to r."""
    return -np.asarray(radius, float), np.asarray(radius, float)


def joined(*pairs: Sides) -> Sides:
    """Boxes one after the other."""
    return np.concatenate([low for low, _ in pairs]), np.concatenate([high for _, high in pairs])


def inside(a: Sides, b: Sides) -> bool:
    """Does b hold a?"""
    return bool((b[0] <= a[0]).all() and (a[1] <= b[1]).all())
