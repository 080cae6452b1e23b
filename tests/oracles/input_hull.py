"""Independent truth for boxes of the unknown input: linear programs solved by SciPy's HiGHS.

Source: theory 7; paper, Definition 4 (tightness: the box of all compatible inputs).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import linprog

_OPTIONS = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}


def program(
    cost: np.ndarray,
    S: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    bounds: list[tuple[float, float]] | None = None,
) -> float | None:
    """``min cost d`` subject to ``lower <= S d <= upper`` and bounds of d; ``-inf``: unbounded, None: infeasible."""
    result = _solved(cost, S, lower, upper, bounds)
    if result is None:
        raise AssertionError("HiGHS gave up")
    return {0: result.fun, 2: None, 3: -np.inf}[result.status]


def _solved(cost: Any, S: Any, lower: Any, upper: Any, bounds: Any) -> Any:
    A, b = np.concatenate([S, -S]), np.concatenate([upper, -lower])
    finite = np.isfinite(b)
    for presolve in (True, False):  # the presolve cannot always tell unbounded from infeasible
        options = _OPTIONS | {"presolve": presolve}
        result = linprog(cost, A[finite], b[finite], bounds=bounds or (None, None), options=options)
        if result.status in (0, 2, 3):
            return result
    return None


def feasibility_slack(S: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> float:
    """How far all sides of the box of h can be moved inward until no d is left; negative: outward, until one is."""
    r, p = S.shape
    widened = np.concatenate(
        [np.concatenate([S, np.ones((r, 1))], axis=1), np.concatenate([-S, np.ones((r, 1))], axis=1)]
    )
    b = np.concatenate([upper, -lower])
    finite = np.isfinite(b)
    cost = np.append(np.zeros(p), -1.0)
    bounds = [(-np.inf, np.inf)] * p + [(-1e3, 1e3)]
    result = linprog(cost, widened[finite], b[finite], bounds=bounds, options=_OPTIONS)
    assert result.status == 0, result.message
    return float(-result.fun)


def input_hull(
    S: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    bounds: list[tuple[float, float]] | None = None,
) -> tuple[np.ndarray, np.ndarray] | None:
    """The smallest box of d with ``lower <= S d <= upper``, sides infinite where nothing bounds them; None if empty."""
    p = S.shape[1]
    costs = np.concatenate([np.eye(p), -np.eye(p)])
    # All sides in one program with a copy of d for each; where one side is unbounded, one program per side.
    together = np.kron(np.eye(2 * p), S)
    every = bounds and bounds * (2 * p)
    joint = _solved(costs.ravel(), together, np.tile(lower, 2 * p), np.tile(upper, 2 * p), every)
    if joint is not None and joint.status == 0:
        low, high = np.split((costs * joint.x.reshape(2 * p, p)).sum(1), 2)
        return low, -high
    sides = [program(cost, S, lower, upper, bounds) for cost in costs]
    if any(side is None for side in sides):
        return None
    low, high = np.split(np.array(sides, dtype=float), 2)
    return low, -high
