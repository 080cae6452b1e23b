"""Gains by linear programming: the exactly optimal one, and the best one for a given box size.

Nothing a solver returns is trusted: gains are projected back onto the equality they
must satisfy, and `GainProblem` evaluates them anew in NumPy.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from gsisio_jax.design.linear_program import Expression, LinearProgram, diagonal
from gsisio_jax.design.problem import GainProblem

_SPARSE = 1e-7  # scaled gain entries below this are the interior-point solver's noise
_LEAST = 1e-4  # of the largest effect of an input on a state: with 1e-12 of that, rounding of it
_SOLVER: dict[str, Any] = {
    "solver": "CLARABEL",
    "tol_gap_abs": 1e-11,
    "tol_gap_rel": 1e-11,
    "tol_feas": 1e-11,
    "tol_infeas_abs": 1e-11,
    "tol_infeas_rel": 1e-11,
}


def optimal_gain(
    problem: GainProblem, weight: np.ndarray, scale: np.ndarray, usable: np.ndarray | None = None
) -> np.ndarray | None:
    """The gain whose steady width is componentwise smallest among all gains, or None if no gain contracts.

    With a weight lambda per state and Y = diag(lambda) N everything is linear (theory 4):

        minimise 1'b(Y)  subject to  lambda' - 1'|Y_z| R - 1'A(lambda, Y) >= weight',   Y [H; C G] = diag(lambda) G.

    Args:
        problem: the gain problem.
        weight: the vector c > 0 (n,); the optimal gain does not depend on it.
        scale: expected widths (n,), the units in which the program is solved.
        usable: as in `profile_gain`; None: all.
    """
    usable = np.full(problem.columns, True) if usable is None else usable
    inner = problem.scaled(scale)
    program = LinearProgram()
    lam, Y = program.variable(inner.n), program.variable(inner.n, inner.columns)
    growth, noise = _rows(program, inner, diagonal(lam), Y, usable)
    program.nonnegative(lam)
    program.nonnegative(lam - growth.sum(axis=0) - weight)
    found = program.minimise(noise.sum(), lam, Y)
    if found is None or found[0].min() <= 0:
        return None
    return _finish(problem, inner, found[1] / found[0][:, None], scale, usable)


def profile_gain(problem: GainProblem, width: np.ndarray, usable: np.ndarray, scale: np.ndarray) -> np.ndarray | None:
    """The gain that is best, row by row, for boxes of the given width, using only some of the measurements.

    Args:
        problem: the gain problem.
        width: width (n,) of the box before the step.
        usable: (columns,) False for entries of [y[k-1], z[k], state bounds] that must not be used.
        scale: units of the states in which the program is solved (n,).

    Returns:
        N (n, columns) with every row optimal, or None if the input cannot be cancelled with these measurements.

    Source: theory 4.3.
    """
    inner = problem.scaled(scale)
    program = LinearProgram()
    N = program.variable(inner.n, inner.columns)
    growth, noise = _rows(program, inner, np.eye(inner.n), N, usable)
    # Rows are independent: any positive combination of their costs has the same minimiser.
    found = program.minimise((growth @ (width / scale) + noise).sum(), N)
    return None if found is None else _finish(problem, inner, found[0], scale, usable)


def improve(problem: GainProblem, N: np.ndarray, rounds: int = 4, usable: np.ndarray | None = None) -> np.ndarray:
    """Policy iteration: replace rows by better ones at the current steady width until nothing changes.

    The linear program already is at the optimum up to the solver's tolerance; this takes it to rounding.
    """
    everything = np.full(problem.columns, True) if usable is None else usable
    for _ in range(rounds):
        width = problem.steady_width(N)
        if not np.isfinite(width).all():
            return N
        scale = _positive(width)
        candidate = profile_gain(problem, width, everything, scale)
        if candidate is None:
            return N
        better = problem.row_cost(candidate, width) < problem.row_cost(N, width) * (1 - 1e-12)
        if not better.any():
            return N
        mixed = np.where(better[:, None], candidate, N)
        after = problem.steady_width(mixed)
        if not (after <= width).all():
            return N
        N = mixed
        if (after >= width * (1 - 1e-10)).all():
            return N
    return N


def _rows(
    program: LinearProgram, inner: GainProblem, L: Any, Y: Expression, usable: np.ndarray
) -> tuple[Expression, Expression]:
    """Expressions of diag(L) (A + |N_z| R) and of diag(L) b, linear in (L, Y); the equality becomes a constraint."""
    l, q = inner.l, inner.q
    size = program.absolute
    Y_y, Y_z, Y_s = Y[:, :l], Y[:, l : l + q], Y[:, l + q :]
    P = L - Y[:, l:] @ inner.C
    growth = size(P @ inner.F - Y_y @ inner.E)
    noise = size(P) @ inner.dw
    if inner.F_radius.any():
        growth = growth + size(P) @ inner.F_radius
    if inner.E_radius.any():
        growth = growth + size(Y_y) @ inner.E_radius
    if inner.R.any():
        growth = growth + size(Y_z) @ inner.R
    noise = noise + size(Y_y) @ inner.dv + size(Y_z @ inner.T2) @ inner.dv + size(Y_s) @ inner.ds
    if inner.G.shape[1]:
        residual = L @ inner.G - Y @ inner.seen
        program.zero(residual[:, inner.free])
        noise = noise + size(residual[:, ~inner.free]) @ inner.dd
    program.zero(Y[:, ~usable])
    return growth, noise


def solve(goal: Any) -> bool:
    """Solve a problem of cvxpy with Clarabel; True where it claims a solution (which the caller checks)."""
    from cvxpy.error import SolverError

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # "may be inaccurate": the result is checked, not believed
        try:
            goal.solve(**_SOLVER)
        except SolverError:
            return False
    return goal.status in ("optimal", "optimal_inaccurate")


def _finish(
    problem: GainProblem, inner: GainProblem, N: np.ndarray, scale: np.ndarray, usable: np.ndarray
) -> np.ndarray | None:
    """Drop the solver's noise entries, restore the equality exactly, and return to the user's units."""
    sparse = _project(inner, N, (np.abs(N) > _SPARSE) & usable)
    plain = _project(inner, N, np.broadcast_to(usable, N.shape))
    width = np.ones(inner.n)
    cost_plain, cost_sparse = inner.row_cost(plain, width), inner.row_cost(sparse, width)
    exact = _cancels(inner, sparse, 1e-12)
    N = np.where((exact & (cost_sparse <= cost_plain * (1 + 1e-6)))[:, None], sparse, plain)
    if not _cancels(inner, N, 1e-9).all():
        return None
    return _project(problem, problem.unscale(N, scale), N != 0)


def _cancels(problem: GainProblem, N: np.ndarray, share: float) -> np.ndarray:
    """Does every row of a gain cancel the free inputs, (n,)? To a share of what cancels in it: an input has no bound,
    so what is left of one that hardly moves a state, in units of wide boxes, is as wrong as that of any other."""
    free = problem.free
    left = np.abs(problem.residual(N)[:, free]).max(axis=1, initial=0.0)
    sizes = (np.abs(problem.G) + np.abs(N) @ np.abs(problem.seen))[:, free].max(axis=1, initial=0.0)
    # Rows of states that no input moves hold what rounding leaves of others.
    moved = np.abs(problem.G[:, free]).max(initial=0.0)
    return left <= share * np.minimum(np.maximum(sizes, _LEAST * moved if moved else 1.0), 1.0)


def _project(problem: GainProblem, N: np.ndarray, support: np.ndarray) -> np.ndarray:
    """The nearest gain on the given support with ``N [H; C G] = G`` in the columns of free inputs."""
    N = np.where(support, N, 0.0)
    seen, target = problem.seen[:, problem.free], problem.G[:, problem.free]
    for i in range(problem.n):
        rows = np.flatnonzero(support[i])
        for _ in range(2 if seen.shape[1] else 0):  # the second pass removes the rounding of the first
            gap = target[i] - N[i, rows] @ seen[rows]
            N[i, rows] += np.linalg.lstsq(seen[rows].T, gap, rcond=None)[0] if len(rows) else 0.0
        N[i, rows] = _without_remains(problem, N[i], i, rows, seen, target[i])
    return N


def _without_remains(
    problem: GainProblem, row: np.ndarray, i: int, rows: np.ndarray, seen: np.ndarray, target: np.ndarray
) -> np.ndarray:
    """Entries of ``P = I - N_z C`` that a solver has left at 1e-12 instead of 0, made 0 together with the equation: a
    bound that needs nothing of the past must not lose anything to it."""
    slopes = np.vstack([np.zeros((problem.l, problem.n)), problem.C])
    P = np.eye(problem.n)[i] - row @ slopes
    near = (P != 0) & (np.abs(P) < 1e-9)
    kept = row[rows]
    if not len(rows) or not near.any():
        return kept
    matrix = np.hstack([seen[rows], slopes[rows][:, near]])
    wanted = np.concatenate([target, np.eye(problem.n)[i, near]])
    better = kept
    for _ in range(2):
        better = better + np.linalg.lstsq(matrix.T, wanted - better @ matrix, rcond=None)[0]
    return better if np.abs(wanted - better @ matrix).max() < 1e-14 * (1 + np.abs(better).max()) else kept


def _positive(width: np.ndarray) -> np.ndarray:
    """Widths as units: zero widths replaced by a share of the largest."""
    largest = width.max(initial=0.0)
    return np.maximum(width, 1e-6 * largest) if largest > 0 else np.ones_like(width)
