"""The exact hull of a state of a record of a linear plant: two linear programs a state."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import sparse
from scipy.optimize import linprog


def exact_hull(
    A: Any, C: Any, w: Any, v: Any, start: Any, y: Any, G: Any = None, H: Any = None, step: int = -1
) -> np.ndarray:
    """Widths (n,) for ``x+ = A x + G d + w, y = C x + H d + v``; w, v and x0 are bounded, nothing is known of d.

    Args:
        A, C: (n, n) and (l, n).
        w, v, start: bounds of magnitudes, (n,), (l,) and (n,); w and v also (T, n) and (T, l).
        y: (T, l); NaN where missing.
        G, H: (n, p) and (l, p); None without an unknown input.
        step: of the state; the last one if none is given.
    """
    steps, n = len(y), len(A)
    G, H = (np.zeros((len(M), 0)) if N is None else N for M, N in ((A, G), (C, H)))
    before, after = sparse.eye_array(steps - 1, steps), sparse.eye_array(steps - 1, steps, k=1)
    moves = sparse.hstack([sparse.kron(after, np.eye(n)) - sparse.kron(before, A), -sparse.kron(before, G)])
    sees = sparse.hstack([sparse.kron(sparse.eye_array(steps), C), sparse.kron(sparse.eye_array(steps), H)])
    begins = sparse.eye_array(n, moves.shape[1])
    rows = sparse.vstack([moves, sees, begins])
    center = np.concatenate([np.zeros((steps - 1) * n), np.ravel(y), np.zeros(n)])
    w, v = np.broadcast_to(w, (steps, n)), np.broadcast_to(v, np.shape(y))
    radius = np.concatenate([np.ravel(w[:-1]), np.ravel(v), start])
    limits = np.concatenate([center + radius, radius - center])
    known = np.isfinite(limits)
    both, limits = sparse.csr_array(sparse.vstack([rows, -rows]))[known], limits[known]
    width = []
    for i in range(n):
        cost = np.zeros(moves.shape[1])
        cost[step % steps * n + i] = 1
        low, high = (linprog(sign * cost, both, limits, bounds=(None, None)).fun * sign for sign in (1, -1))
        width.append(high - low)
    return np.array(width)
