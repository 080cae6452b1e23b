"""Rows of left inverses in floating point: units taken out, the equality restored and checked.

Every J with ``J [G; H] = I`` gives a correct box of the unknown input, and every row counts for itself. So a row more
never harms and a row less never lies: numerical doubt is settled by dropping rows. What a row leaves of the equality is
rounding only; the bounds online must account for it (theory 10), because the unknown input is unbounded.
"""

from __future__ import annotations

import numpy as np

RESIDUAL = 1e-9  # largest error of J [G; H] = I that a row may keep, in units in which the columns are of size one


def restored(row: np.ndarray, target: np.ndarray, S: np.ndarray, threshold: float) -> np.ndarray:
    """The row with its small weights dropped and ``row S = target`` restored on what is left, if that can be done."""
    rows, columns = equilibration(S)
    A, goal, weights = S / (rows[:, None] * columns), target / columns, row * rows
    found: list[tuple[float, np.ndarray]] = []
    for share in (threshold, 0.0):
        support = np.abs(weights) > share * np.abs(weights).max(initial=0.0)
        w = np.where(support, weights, 0.0)
        for _ in range(2):  # the second pass removes the rounding of the first
            w[support] += np.linalg.lstsq(A[support].T, goal - w @ A, rcond=None)[0] if support.any() else 0.0
        found.append((residual((w / rows)[None], target, S)[0], w / rows))
        if found[0][0] <= 1e-12:
            break
    return min(found, key=lambda pair: pair[0])[1]


def residual(rows: np.ndarray, target: np.ndarray, S: np.ndarray) -> np.ndarray:
    """Largest error of ``rows S = target`` per row, in units in which no entry of S is above one."""
    scale, columns = equilibration(S)
    size = (np.abs(target) / columns).max(axis=-1, initial=0.0)
    size = np.where(size > 0, size, (np.abs(rows) * scale).max(axis=-1, initial=0.0))
    error = (np.abs(rows @ S - target) / columns).max(axis=-1, initial=0.0)
    return np.where(np.isfinite(error), error, np.inf) / np.where(size > 0, size, 1.0)


def equilibration(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Factors (rows, columns) with ``matrix = rows * scaled * columns`` and no entry of `scaled` above one."""
    _, rows, columns = equilibrated(matrix[None])
    return rows[0], columns[0]


def equilibrated(stack: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rows = np.abs(stack).max(axis=2, initial=0.0)
    rows = np.where(rows > 0, rows, 1.0)
    stack = stack / rows[:, :, None]
    columns = np.abs(stack).max(axis=1, initial=0.0)
    columns = np.where(columns > 0, columns, 1.0)
    return stack / columns[:, None, :], rows, columns


def checked(call: str, stacked: np.ndarray) -> np.ndarray:
    if stacked.ndim != 2 or not np.isfinite(stacked).all():
        raise ValueError(f"{call}: [G; H] must be a finite matrix (n + l, p), got {stacked.tolist()}")
    p = stacked.shape[1]
    norms = np.linalg.norm(stacked, axis=0)
    if p and ((norms == 0).any() or np.linalg.matrix_rank(stacked / norms) < p):
        raise ValueError(
            f"{call}: [G; H] must have full column rank {p}, got {stacked.tolist()}; remove or merge unknown inputs"
        )
    return stacked
