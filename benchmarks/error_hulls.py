"""Exact hulls of many records of a linear plant, in errors: deviations from the true run that the record allows.

With nothing known of the inputs neither the hull nor the box of a step depends on states and inputs, but for where it
lies. All programs of a step have one polytope, whose sides alone change from record to record, so HiGHS begins each one
where the last one ended.
"""

from __future__ import annotations

from typing import Any

import highspy
import numpy as np
from scipy import sparse

_TOLERANCE = 1e-10


def error_hulls(plant: Any, noise: list[tuple[np.ndarray, np.ndarray, np.ndarray]], step: int, later: int = 0) -> Any:
    """Sides (records, 2, n) of the hull of ``x[step] - (true x[step])`` from y[0], ..., y[step + later].

    Args:
        plant: with A, C, G, H and the magnitudes w, v, start.
        noise: of every record the first state (n,), w (T, n) and v (T, l) as they were; the first state lies around 0.
        step: k.
        later: measurements after step k that count, of an observer with a delay.
    """
    n, s = len(plant.A), step + later + 1
    before, after = sparse.eye_array(s - 1, s), sparse.eye_array(s - 1, s, k=1)
    along = sparse.kron(after, np.eye(n)) - sparse.kron(before, plant.A)
    moves = sparse.hstack([along, -sparse.kron(sparse.eye_array(s - 1, s), plant.G)])
    sees = sparse.hstack([sparse.kron(sparse.eye_array(s), plant.C), sparse.kron(sparse.eye_array(s), plant.H)])
    matrix: Any = sparse.csc_array(sparse.vstack([moves, sees]))
    columns = matrix.shape[1]
    solver = _solver(matrix)
    numbers = np.arange(max(matrix.shape), dtype=np.int32)
    found = np.empty((len(noise), 2, n))
    for r, (first, w, v) in enumerate(noise):
        # Of another run: e+ - A e - G (any) is its w less the true one, C e + H (any) the true v less its own.
        own = np.concatenate([w[: s - 1].ravel(), -v[:s].ravel()])
        most = np.concatenate([np.tile(plant.w, s - 1), np.tile(plant.v, s)])
        solver.changeRowsBounds(len(own), numbers[: len(own)], -most - own, most - own)
        sides = np.full(columns, np.inf)
        lower, upper = -sides, sides.copy()
        lower[:n], upper[:n] = -plant.start - first, plant.start - first
        solver.changeColsBounds(columns, numbers[:columns], lower, upper)
        for i in range(n):
            for side, sign in enumerate((1.0, -1.0)):
                cost = np.zeros(columns)
                cost[step * n + i] = sign
                found[r, side, i] = sign * _minimum(solver, cost, numbers)
    return found


class _Quiet(highspy.Highs):
    """Its constructor connects callbacks, which prints a banner; none are used here."""

    def enableCallbacks(self) -> None:
        self.setOptionValue("output_flag", False)


def _solver(matrix: Any) -> Any:
    program = highspy.HighsLp()
    rows, columns = matrix.shape
    program.num_col_, program.num_row_ = columns, rows
    program.col_cost_ = np.zeros(columns)
    program.col_lower_, program.col_upper_ = np.full(columns, -np.inf), np.full(columns, np.inf)
    program.row_lower_, program.row_upper_ = np.zeros(rows), np.zeros(rows)
    entries: Any = program.a_matrix_
    entries.format_ = highspy.MatrixFormat.kColwise
    entries.start_, entries.index_, entries.value_ = matrix.indptr, matrix.indices, matrix.data
    solver = _Quiet()
    options = {"output_flag": False, "threads": 1, "primal_feasibility_tolerance": _TOLERANCE}
    for option, value in (options | {"dual_feasibility_tolerance": _TOLERANCE}).items():
        solver.setOptionValue(option, value)
    solver.passModel(program)
    return solver


def _minimum(solver: Any, cost: np.ndarray, numbers: np.ndarray) -> float:
    solver.changeColsCost(len(cost), numbers[: len(cost)], cost)
    for method in ("simplex", "ipm", "simplex"):
        solver.setOptionValue("solver", method)
        solver.run()
        status = solver.getModelStatus()
        if status == highspy.HighsModelStatus.kOptimal:
            return float(solver.getInfo().objective_function_value)
        if status == highspy.HighsModelStatus.kUnbounded:
            return -np.inf
        solver.clearSolver()
    return np.nan
