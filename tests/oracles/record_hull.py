"""The exact hull of the last state of a record of a linear plant without unknown input: two linear programs a state."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import sparse
from scipy.optimize import linprog


def exact_hull(A: Any, C: Any, w: Any, v: Any, start: Any, y: Any) -> np.ndarray:
    """Widths (n,) for ``x+ = A x + w, y = C x + v, |w|, |v|, |x0|`` bounded.

    Args:
        A, C: (n, n) and (l, n).
        w, v, start: bounds (n,), (l,) and (n,).
        y: (T, l).
    """
    steps, n = len(y), len(A)
    before, after = sparse.eye_array(steps - 1, steps), sparse.eye_array(steps - 1, steps, k=1)
    moves = sparse.kron(after, np.eye(n)) - sparse.kron(before, A)
    sees = sparse.kron(sparse.eye_array(steps), C)
    begins = sparse.eye_array(n, steps * n)
    rows = sparse.vstack([moves, sees, begins])
    center = np.concatenate([np.zeros((steps - 1) * n), np.ravel(y), np.zeros(n)])
    radius = np.concatenate([np.tile(w, steps - 1), np.tile(v, steps), start])
    limits = np.concatenate([center + radius, radius - center])
    width = []
    for i in range(n):
        cost = np.zeros(steps * n)
        cost[(steps - 1) * n + i] = 1
        low, high = (
            linprog(sign * cost, sparse.csr_array(sparse.vstack([rows, -rows])), limits, bounds=(None, None)).fun * sign
            for sign in (1, -1)
        )
        width.append(high - low)
    return np.array(width)
