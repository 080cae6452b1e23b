"""The exact hull of an unknown input of a record of a linear plant, where it is known how the inputs move."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import linprog


def exact_input_hull(
    A: Any, G: Any, C: Any, w: Any, v: Any, start: Any, y: Any, k: int,
    rate: Any = np.inf, constant: int = 1, mean: int = 1, H: Any = None, of: int = 0,
) -> np.ndarray:  # fmt: skip
    """Both sides of the mean of d[k-mean+1..k] from y[0..k+1], for ``x+ = A x + G d + w, y = C x + H d + v``.

    Args:
        A, G, C: (n, n), (n, p) and (l, n).
        w, v, start: bounds of magnitudes, (n,), (l,) and (n,).
        y: (T, l); what is NaN says nothing.
        rate: bound of |d[j] - d[j-1]|, a number or (p,); within a block of `constant` steps, from a multiple of it on,
            it is 0.
        H: (l, p); None: 0.
        of: the input that is asked for.
    """
    (n, p), T = np.shape(G), k + 2
    x, d = np.split(np.eye(T * (n + p)), [T * n])
    x, d = x.reshape(T, n, -1), d.reshape(T, p, -1)
    rows, middle, radius = [x[0]], [np.zeros(n)], [start]
    for j in range(T):
        seen = np.isfinite(y[j])
        output = C @ x[j] if H is None else C @ x[j] + np.asarray(H) @ d[j]
        rows, middle, radius = [*rows, output[seen]], [*middle, y[j][seen]], [*radius, v[seen]]
        if j + 1 < T:
            rows.append(x[j + 1] - A @ x[j] - G @ d[j])
            middle, radius = [*middle, np.zeros(n)], [*radius, w]
        bound = np.broadcast_to(rate if j % constant == 0 else 0.0, (p,))
        bounded = np.isfinite(bound)
        # The input of the last step is in y[k+1], where H is not 0.
        if 0 < j < (T - 1 if H is None else T):
            rows.append((d[j] - d[j - 1])[bounded])
            middle, radius = [*middle, np.zeros(bounded.sum())], [*radius, bound[bounded]]
    M, c, r = np.vstack(rows), np.concatenate(middle), np.concatenate(radius)
    cost = d[k - mean + 1 : k + 1, of].mean(0)
    limits = np.vstack([M, -M]), np.concatenate([c + r, r - c])
    return np.array([sign * linprog(sign * cost, *limits, bounds=(None, None)).fun for sign in (1, -1)])
