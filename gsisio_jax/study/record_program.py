"""Linear programs over a stretch of a record: extremes of its last state, and the run in the middle of what is allowed.

Unknowns are the states, the unknown inputs, and one common factor of the radii of the noise (1 for extremes).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy import sparse
from scipy.optimize import linprog

from gsisio_jax.study.stretch import Affine, Sides, Stretch

# The smallest tolerance that HiGHS takes; then without its simplifications, which call unbounded programs infeasible;
# then its own tolerance, for records of large numbers.
_TIGHT = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
_ATTEMPTS: tuple[dict[str, Any], ...] = (_TIGHT, _TIGHT | {"presolve": False}, {"presolve": False})


class Extreme(NamedTuple):
    """The value of a program, NaN where nothing agrees with the record, and a run (x, d) that has it, if any; or why
    the program could not be solved."""

    value: float
    x: np.ndarray | None = None
    d: np.ndarray | None = None
    failure: str = ""


@dataclass(frozen=True)
class RecordProgram:
    """All runs of an affine plant that agree with a stretch of a record."""

    stretch: Stretch
    plant: Affine

    @cached_property
    def _constraints(self) -> tuple[Any, np.ndarray]:
        """``A z <= b`` for z = (x, d, factor)."""
        known, plant = self.stretch, self.plant
        s, n = known.state.lower.shape
        seen = np.isfinite(known.y).ravel()
        step = sparse.eye_array(s * n, k=n) - sparse.block_diag([*plant.A])
        moves = sparse.csr_array(sparse.hstack([step, -sparse.kron(sparse.eye_array(s), known.G)]))[: (s - 1) * n]
        output = [sparse.block_diag([*plant.C]), sparse.kron(sparse.eye_array(s), known.H)]
        sees = sparse.csr_array(sparse.hstack(output))[seen]
        rows = sparse.vstack([moves, sees])
        pushed, measured = (plant.a + known.push)[:-1].ravel(), (known.y - plant.c).ravel()[seen]
        low = np.concatenate([pushed + known.w.lower[:-1].ravel(), measured - known.v.upper.ravel()[seen]])
        high = np.concatenate([pushed + known.w.upper[:-1].ravel(), measured - known.v.lower.ravel()[seen]])
        center, radius = (low + high) / 2, sparse.csr_array(((high - low) / 2)[:, None])
        return (
            sparse.csr_array(sparse.vstack([sparse.hstack([rows, -radius]), sparse.hstack([-rows, -radius])])),
            np.concatenate([center, -center]),
        )

    def extreme(self, state: int, sign: int, row: int = -1) -> Extreme:
        """The least (sign 1) or the greatest (sign -1) value of a state in a row, the last one if none is given."""
        s, n = self.stretch.state.lower.shape
        return self._solved(row % s * n + state, sign, (1.0, 1.0))

    def middle(self) -> Extreme:
        """The run that needs the least share of the radii of the noise; above 1 it agrees with no record."""
        return self._solved(-1, 1, (0.0, np.inf))

    def _solved(self, column: int, sign: int, factor: tuple[float, float]) -> Extreme:
        matrix, limits = self._constraints
        known = self.stretch
        (s, n), p = known.state.lower.shape, known.G.shape[1]
        low = np.concatenate([known.state.lower.ravel(), np.tile(known.input.lower, s), factor[:1]])
        high = np.concatenate([known.state.upper.ravel(), np.tile(known.input.upper, s), factor[1:]])
        if not (np.isfinite(limits).all() and np.isfinite(matrix.data).all() and (low <= high).all()):
            return Extreme(np.nan)
        cost = np.zeros(matrix.shape[1])
        cost[column] = sign
        for options in _ATTEMPTS:
            found = linprog(cost, matrix, limits, bounds=np.column_stack([low, high]), options=options)
            if found.status == 0:
                x, d = np.split(found.x[:-1], [s * n])
                return Extreme(sign * found.fun, x.reshape(s, n), d.reshape(s, p))
            if found.status == 3 and "presolve" in options:
                return Extreme(-sign * np.inf)
        return Extreme(np.nan, failure="" if found.status == 2 else found.message)


def exact_hull(stretch: Stretch, plant: Affine, row: int = -1) -> Sides:
    """The hull (n,) of the state in a row, the last one if none is given, over all runs that agree with the stretch;
    NaN where none does.

    Raises:
        RuntimeError: a program could not be solved.
    """
    program = RecordProgram(stretch, plant)
    n = stretch.state.lower.shape[1]
    ends = [[program.extreme(i, sign, row) for i in range(n)] for sign in (1, -1)]
    if failure := next((end.failure for side in ends for end in side if end.failure), ""):
        raise RuntimeError(
            f"tightness: HiGHS could not solve a program of {stretch.length} rows ({failure}); try a shorter horizon, "
            "or units in which states and outputs are of like size"
        )
    return Sides(*(np.array([end.value for end in side]) for side in ends))
