"""Boxes of every kind, and points in them: ends, corners, what lies next to them, turning points, anything between."""

from __future__ import annotations

from typing import Any

import numpy as np
from oracles.real_functions import Real

KINDS = ("usual", "thin", "point", "huge", "tiny", "subnormal", "half infinite", "infinite", "across", "far ends")
POINTS = 8  # fewest points of an interval: two ends, their neighbours, two that are special, and two anywhere


def boxes(rng: np.random.Generator, count: int, dtype: Any, real: Real) -> tuple[np.ndarray, np.ndarray]:
    """`count` boxes, most of them in the domain of a function, every side of any kind; both ends (count, n)."""
    sides = [_intervals(rng, count, dtype, real.domain if i == 0 else (-np.inf, np.inf)) for i in range(real.size)]
    return np.stack([side[0] for side in sides], 1), np.stack([side[1] for side in sides], 1)


def _intervals(rng: np.random.Generator, count: int, dtype: Any, domain: tuple[float, float]) -> np.ndarray:
    info = np.finfo(dtype)
    kind = rng.integers(len(KINDS), size=count)
    far = np.exp2(rng.uniform(1, np.log2(float(info.max)) - 1, (2, count))) * rng.choice([-1, 1], (2, count))
    near = np.exp2(rng.uniform(np.log2(float(info.tiny)), -1, (2, count))) * rng.choice([-1, 1], (2, count))
    below = rng.uniform(-1, 1, (2, count)) * float(info.tiny)
    middle = rng.uniform(-8, 8, count) * np.exp2(rng.integers(-3, 4, count))
    # A tenth of all numbers are whole, where many functions have something to lose.
    middle = np.where(rng.random(count) < 0.1, np.round(middle), middle)
    width = np.exp2(rng.uniform(-30, 3, count))
    ends = np.stack([middle - width, middle + width])
    thin = np.stack([middle, middle * (1 + float(info.eps) * rng.integers(-9, 9, count))])
    # The point boxes are of all magnitudes.
    sizes = rng.integers(8, size=count)
    point = np.select([sizes == 0, sizes == 1, sizes == 2], [far[0], near[0], below[0]], middle)
    both = np.stack([np.full(count, -np.inf), np.full(count, np.inf)])
    half = np.where(rng.random(count) < 0.5, [middle, both[1]], [both[0], middle])
    across = np.stack([-width, width * rng.uniform(0, 2, count)])
    mixed = np.where(rng.random(count) < 0.5, [middle, far[0]], [near[0], far[1]])
    found = [ends, thin, [point, point], far, near, below, half, both, across, mixed]
    pair = np.select([kind == i for i in range(len(KINDS))], [np.asarray(x) for x in found])
    # One of ten reaches beyond the domain.
    pair = np.sort(np.where(rng.random(count) < 0.1, pair, np.clip(pair, *domain)), axis=0)
    with np.errstate(over="ignore"):
        pair = pair.astype(dtype) + dtype(0)  # no negative zero
    pair[0] = np.where(pair[0] == np.inf, info.max, pair[0])
    pair[1] = np.where(pair[1] == -np.inf, info.min, pair[1])
    return pair


def points(rng: np.random.Generator, lower: Any, upper: Any, count: int, real: Real) -> np.ndarray:
    """Floating numbers of every box (boxes, n), corners among them: (boxes, count, n)."""
    sides = [_inside(rng, a, b, count, real.special) for a, b in zip(lower.T, upper.T, strict=True)]
    for i, side in enumerate(sides[1:], 1):
        # Columns 0 and 1 are ends: all four corners of the first two sides, then whatever comes.
        order = np.concatenate([[1, 0], rng.permutation(np.arange(2, count))]) if i == 1 else rng.permutation(count)
        sides[i] = side[:, order]
    found = np.stack(sides, 2)
    if len(sides) > 1:
        found[:, 2, 0], found[:, 2, 1] = found[:, 0, 0], sides[1][:, 1]
        found[:, 3, 0], found[:, 3, 1] = found[:, 1, 0], sides[1][:, 0]
    return found


def _inside(rng: np.random.Generator, lower: Any, upper: Any, count: int, special: Any) -> np.ndarray:
    info, shape = np.finfo(lower.dtype), (len(lower), max(count, POINTS))
    with np.errstate(all="ignore"):
        a, b = (np.clip(x, info.min, info.max)[:, None] for x in (lower, upper))
        share = rng.random(shape, np.float32).astype(np.float64) ** rng.choice([1, 4, 12], (1, shape[1]))
        half = b / 2.0 - a / 2.0
        inner = np.where(rng.random(shape, np.float32) < 0.5, a + share * half * 2, b - share * half * 2)
        wild = np.exp2(rng.uniform(-30, 30, (shape[0], shape[1] // 4))) * rng.choice([-1, 1], (1, shape[1] // 4))
        inner[:, : wild.shape[1]] = wild
        inner[:, 0], inner[:, 1] = a[:, 0], b[:, 0]
        inner = inner.astype(lower.dtype)
        inner[:, 2], inner[:, 3] = np.nextafter(a, np.inf)[:, 0], np.nextafter(b, -np.inf)[:, 0]
        inner[:, 4] = rng.choice(np.asarray(special), len(lower))
        turn = np.ceil(np.clip(a[:, 0], -1e6, 1e6).astype(np.float64) / (np.pi / 2)) * (np.pi / 2)
        inner[:, 5] = turn
        for column in (4, 5):
            for _ in range(2):  # it, or one of the numbers around it
                there = inner[:, column]
                inner[:, column] = np.where(
                    rng.random(len(lower)) < 0.5, there, np.nextafter(there, rng.choice([-np.inf, np.inf], len(lower)))
                )
        inner = np.nan_to_num(inner, nan=0.0)
        return (np.clip(inner, a, b) + lower.dtype.type(0))[:, :count]
