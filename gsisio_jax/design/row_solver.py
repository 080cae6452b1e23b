"""Linear programs that share a polytope, handed to HiGHS, which begins each one where the last one ended.

A window asks for hundreds of rows: for every state, both sides, and many simulated steps. Their duals differ in goal
and sides alone, and a few pivots lead from one to the next; a fresh program takes ten times as long.
"""

from __future__ import annotations

from typing import Any

import highspy
import numpy as np
from scipy import sparse


class _Quiet(highspy.Highs):
    """Its constructor connects callbacks, which prints a banner; none are used here."""

    def enableCallbacks(self) -> None:
        self.setOptionValue("output_flag", False)


class RowSolver:
    """``max goal [y; mu]`` over ``parts' y + equal' mu = 0`` with y in a box and mu free.

    The multipliers x of the equations are the solution of the dual: the least ``size |parts x + offset| + drift (parts
    x + offset)`` with ``equal x + equal_offset = 0``, for `goal` the offsets and y in ``drift +- size``.

    Args:
        parts: (k, unknowns).
        equal: (e, unknowns).
    """

    def __init__(self, parts: np.ndarray, equal: np.ndarray):
        stacked = np.vstack([parts, equal]).T
        (count, columns), matrix = stacked.shape, sparse.csc_array(stacked)
        program = highspy.HighsLp()
        program.num_col_, program.num_row_ = columns, count
        program.col_cost_ = np.zeros(columns)
        free = np.repeat([0.0, np.inf], [len(parts), len(equal)])
        program.col_lower_, program.col_upper_ = -free, free
        program.row_lower_ = program.row_upper_ = np.zeros(count)
        entries: Any = program.a_matrix_
        entries.format_ = highspy.MatrixFormat.kColwise
        entries.start_, entries.index_, entries.value_ = matrix.indptr, matrix.indices, matrix.data
        program.sense_ = highspy.ObjSense.kMaximize
        self._solver, self._k, self._columns = _Quiet(), len(parts), np.arange(columns, dtype=np.int32)
        for option, value in (("output_flag", False), ("threads", 1), ("solver", "simplex")):
            self._solver.setOptionValue(option, value)
        self._solver.passModel(program)

    def multipliers(self, goal: np.ndarray, size: np.ndarray, drift: np.ndarray) -> tuple[np.ndarray, float] | None:
        """x (unknowns,) and the optimum; None where it is unbounded, so no x does what is asked."""
        solver: Any = self._solver
        solver.changeColsBounds(self._k, self._columns[: self._k], drift - size, drift + size)
        solver.changeColsCost(len(goal), self._columns, goal)
        solver.run()
        if solver.getModelStatus() != highspy.HighsModelStatus.kOptimal:
            return None
        return -np.array(solver.getSolution().row_dual), float(solver.getInfo().objective_function_value)
