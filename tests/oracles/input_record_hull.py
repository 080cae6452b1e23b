"""The exact hull of the unknown input of a record of a linear plant, where it is known how the input moves."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import linprog


def exact_input_hull(
    A: Any, G: Any, C: Any, w: Any, v: Any, start: Any, y: Any, k: int,
    rate: float = np.inf, constant: int = 1, mean: int = 1,
) -> np.ndarray:  # fmt: skip
    """Both sides of the mean of d[k-mean+1..k] from y[0..k+1], for ``x+ = A x + G d + w, y = C x + v`` and one input.

    Args:
        A, G, C: (n, n), (n, 1) and (l, n).
        w, v, start: bounds of magnitudes, (n,), (l,) and (n,).
        y: (T, l).
        rate: bound of |d[j] - d[j-1]|; within a block of `constant` steps, from a multiple of it on, it is 0.
    """
    n, T = len(A), k + 2
    x, d = np.split(np.eye(T * n + T - 1), [T * n])
    x = x.reshape(T, n, -1)
    rows, middle, radius = [x[0]], [np.zeros(n)], [start]
    for j in range(T):
        rows, middle, radius = [*rows, C @ x[j]], [*middle, y[j]], [*radius, v]
        if j + 1 < T:
            rows.append(x[j + 1] - A @ x[j] - G @ d[j : j + 1])
            middle, radius = [*middle, np.zeros(n)], [*radius, w]
        bound = rate if j % constant == 0 else 0.0
        if 0 < j < T - 1 and np.isfinite(bound):
            rows, middle, radius = [*rows, d[j : j + 1] - d[j - 1 : j]], [*middle, [0.0]], [*radius, [bound]]
    M, c, r = np.vstack(rows), np.concatenate(middle), np.concatenate(radius)
    cost = d[k - mean + 1 : k + 1].mean(0)
    limits = np.vstack([M, -M]), np.concatenate([c + r, r - c])
    return np.array([sign * linprog(sign * cost, *limits, bounds=(None, None)).fun for sign in (1, -1)])
