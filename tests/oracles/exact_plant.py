"""Linear plants in rational arithmetic, with the tightest noise bounds that a record leaves possible.

x and y are floating numbers; w and v are the exact differences, so the plant equations hold exactly; and the bounds are
the smallest floating boxes that hold these. Whatever is lost by one rounding more than allowed shows as a miss.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np

exact = np.vectorize(Fraction, otypes=[object])


@dataclass(frozen=True)
class Record:
    """A record (steps, .) and the noise bounds (steps, .) that hold it, lower and upper."""

    x: np.ndarray
    y: np.ndarray
    d: np.ndarray
    w: tuple[np.ndarray, np.ndarray]
    v: tuple[np.ndarray, np.ndarray]


def tight_record(
    rng: np.random.Generator, A: Any, C: Any, G: Any, H: Any, steps: int, d_size: float, noise: float, dtype: Any
) -> Record:
    """A run of ``x+ = A x + G d + w``, ``y = C x + H d + v``; matrices are taken as floating numbers of float64."""
    A, C, G, H = (np.asarray(m, np.float64) for m in (A, C, G, H))
    n, p, l = A.shape[0], G.shape[1], C.shape[0]
    x, y = np.zeros((steps, n), dtype), np.zeros((steps, l), dtype)
    d = (d_size * rng.standard_normal((steps, p))).astype(dtype)
    w, v = np.zeros((2, steps, n), dtype), np.zeros((2, steps, l), dtype)
    x[0] = rng.standard_normal(n)
    A_, C_, G_, H_ = (exact(m) if m.size else np.zeros(m.shape, object) for m in (A, C, G, H))
    for k in range(steps):
        now, given = exact(np.float64(x[k])), exact(np.float64(d[k])) if p else np.zeros(0, object)
        seen = C_.dot(now) + (H_.dot(given) if p else 0)
        y[k] = _rounded(seen, dtype) + (noise * rng.uniform(-1, 1, l)).astype(dtype)
        v[0, k], v[1, k] = _hull(exact(np.float64(y[k])) - seen, dtype)
        if k + 1 < steps:
            moved = A_.dot(now) + (G_.dot(given) if p else 0)
            x[k + 1] = _rounded(moved, dtype) + (noise * rng.uniform(-1, 1, n)).astype(dtype)
            w[0, k], w[1, k] = _hull(exact(np.float64(x[k + 1])) - moved, dtype)
    return Record(x, y, d, (w[0], w[1]), (v[0], v[1]))


def _rounded(values: Any, dtype: Any) -> np.ndarray:
    return np.array([float(value) for value in values]).astype(dtype)


def _hull(values: Any, dtype: Any) -> tuple[np.ndarray, np.ndarray]:
    """The neighbours of every number in the floating type, the number itself where it is one."""
    near = _rounded(values, dtype)
    below = [
        np.nextafter(a, dtype(-np.inf)) if Fraction(float(a)) > b else a for a, b in zip(near, values, strict=True)
    ]
    above = [np.nextafter(a, dtype(np.inf)) if Fraction(float(a)) < b else a for a, b in zip(near, values, strict=True)]
    return np.array(below, dtype), np.array(above, dtype)
