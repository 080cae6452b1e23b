"""Left inverses for the boxes of the unknown input (theory 7).

Two families: left inverses J of [G; H] applied to ``[x - f - B u - w; y - g - D u - v]``, and left inverses of the
lifted rows [H; C G], which see the next output without going through the box of the next state. Each is chosen by a
linear program to be best at the steady width, row by row.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from gsisio_jax.design.basic_inverses import basic_left_inverses, circuits
from gsisio_jax.design.gain_selection import units
from gsisio_jax.design.linear_program import Expression, LinearProgram
from gsisio_jax.design.problem import GainProblem, without_rounding
from gsisio_jax.observer.bank import LinearBounds
from gsisio_jax.observer.types import ExactInputs

_NEAR = 10  # powers of two between units that a solver does not mind
MOST_SUPPORTS = 500  # basic left inverses per group of inputs that share rows; each costs time in every step


class InputBounds(NamedTuple):
    """Everything that bounds d[k-1]: the joint bounds, the exact ones for a box of [G; H] d, and a note on these."""

    inverses: LinearBounds
    exact: ExactInputs
    note: str


def input_bounds(problem: GainProblem, width: np.ndarray) -> InputBounds:
    """The bounds of the unknown input; the first of the joint ones is of [G; H] and carries the certificate.

    Args:
        problem: the gain problem.
        width: typical width of the state boxes, (n,).
    """
    exact, note = _exact(problem, width)
    return InputBounds(_joint(problem, width, exact.complete), exact, note)


def _joint(problem: GainProblem, width: np.ndarray, complete: bool) -> LinearBounds:
    n, l, q, p = problem.n, problem.l, problem.q, problem.G.shape[1]
    s = problem.columns - l - q
    direct, lifted = [], []
    if p:
        inner, (x, y, z, d) = _scaled(problem, width)
        direct = _distinct([_direct(inner, width / x, use_y) for use_y in (True, False)])
        lifted = _distinct([_lifted(inner, width / x, *use) for use in product((True, False), repeat=2)])
        if not complete:  # where all basic rows are there, the pseudo-inverse adds nothing to them
            direct = _distinct([*direct, _pseudo_inverse(inner)])
        of_rows = np.concatenate([x, y]), np.concatenate([y, z, x[problem.bounded_states]])
        direct, lifted = (
            [d[:, None] * rows / of for rows in found] for found, of in zip((direct, lifted), of_rows, strict=True)
        )
    else:
        direct = [np.zeros((0, n + l))]
    rows = []
    for J in direct:
        known = (np.eye(p) - J @ np.vstack([problem.G, problem.H]))[:, ~problem.free]
        rows.append((-J, np.zeros((p, l)), np.zeros((p, q)), np.zeros((p, s)), known, J[:, :n]))
    for L in lifted:
        L_y, L_z, L_s = problem.split(L)
        known = (np.eye(p) - L @ problem.seen)[:, ~problem.free]
        residual = -np.concatenate([without_rounding(L[:, l:] @ problem.C), L_y], axis=1)
        rows.append((residual, without_rounding(L_z @ problem.T2), L_z, L_s, known, np.zeros((p, n))))
    return LinearBounds(*(np.stack(parts) for parts in zip(*rows, strict=True)))


def _exact(problem: GainProblem, width: np.ndarray) -> tuple[ExactInputs, str]:
    """All basic left inverses of [G; H] and its circuits, or the best of them where there are too many, and a note."""
    stacked = np.vstack([problem.G, problem.H])
    p, bounded = stacked.shape[1], ~problem.free
    left = np.concatenate([2 * width + problem.dw, problem.dv + np.abs(problem.E) @ width])
    inverses = basic_left_inverses(stacked, problem.free, MOST_SUPPORTS, left)
    rings = circuits(stacked, problem.free, MOST_SUPPORTS)
    # A circuit of one row is a row that d does not enter: the step contracts with these anyway.
    rows = rings.rows[(rings.rows != 0).sum(axis=1) > 1]
    exact = ExactInputs(
        rows=inverses.rows,
        known=(np.eye(p) - inverses.rows @ stacked)[:, :, bounded],
        circuits=rows,
        circuits_known=-(rows @ stacked)[:, bounded],
        complete=inverses.complete and rings.complete,
    )
    return exact, "" if exact.complete else "input boxes are not exact: " + (inverses.note or rings.note)


def _scaled(problem: GainProblem, width: np.ndarray) -> tuple[GainProblem, tuple[np.ndarray, ...]]:
    """The problem in units of boxes, noise and inputs, where these are far from those of the plant, and the units:
    solvers take what is small for nothing."""
    x = np.where(width > 0, width, units(width))
    found = problem.units(x, powers=True)
    if all((abs(np.log2(unit)) <= _NEAR).all() for unit in found):
        return problem, tuple(np.ones_like(unit) for unit in found)
    return problem.scaled(x, powers=True), found


def _direct(problem: GainProblem, width: np.ndarray, use_y: bool) -> np.ndarray | None:
    """J with ``J [G; H] = I`` in the columns of free inputs, smallest input width row by row."""
    n, p = problem.n, problem.G.shape[1]
    program = LinearProgram()
    J = program.variable(p, n + problem.l)
    J1, J2, size = J[:, :n], J[:, n:], program.absolute
    cost = size(J1) @ (width + problem.dw + problem.F_radius @ width)
    cost = cost + size(J1 @ problem.F + J2 @ problem.E) @ width + size(J2) @ (problem.E_radius @ width + problem.dv)
    usable = np.concatenate([np.full(n, True), np.full(problem.l, use_y)])
    return _solve(program, J, cost, np.vstack([problem.G, problem.H]), problem, usable)


def _lifted(problem: GainProblem, width: np.ndarray, use_y: bool, use_measured: bool) -> np.ndarray | None:
    """L with ``L [H; C G] = I`` in the columns of free inputs."""
    l, q, p = problem.l, problem.q, problem.G.shape[1]
    program = LinearProgram()
    L, size = program.variable(p, problem.columns), program.absolute
    L_y, L_z, L_s = L[:, :l], L[:, l : l + q], L[:, l + q :]
    through = L[:, l:] @ problem.C
    cost = size(L_y @ problem.E + through @ problem.F) @ width + size(through) @ (problem.F_radius @ width + problem.dw)
    cost = cost + size(L_y) @ (problem.E_radius @ width + problem.dv)
    cost = cost + size(L_z) @ (problem.R @ width) + size(L_z @ problem.T2) @ problem.dv + size(L_s) @ problem.ds
    usable = np.concatenate([np.full(l, use_y), np.full(q, use_measured), np.full(len(problem.ds), True)])
    return _solve(program, L, cost, problem.seen, problem, usable)


def _solve(
    program: LinearProgram,
    J: Expression,
    cost: Expression,
    stacked: np.ndarray,
    problem: GainProblem,
    usable: np.ndarray,
) -> np.ndarray | None:
    p = problem.G.shape[1]
    gap = np.eye(p) - J @ stacked
    free = np.flatnonzero(problem.free)
    program.zero(gap[:, free])
    program.zero(J[:, ~usable])
    cost = cost + program.absolute(gap[:, ~problem.free]) @ problem.dd
    # Rows are independent; divide by the size of a unit input so that inputs of any unit count alike.
    weights = np.abs(stacked).max(axis=0)
    values = program.minimise(cost @ weights, J)
    if values is None:
        return None
    found = np.where((np.abs(values[0]) > 1e-9 * np.abs(values[0]).max()) & usable, values[0], 0.0)
    for i in range(p):  # restore the equality on the entries that are left
        rows = np.flatnonzero(found[i])
        for _ in range(2):
            rest = np.eye(p)[i, free] - found[i] @ stacked[:, free]
            if len(rows) and len(free):
                found[i, rows] += np.linalg.lstsq(stacked[np.ix_(rows, free)].T, rest, rcond=None)[0]
    residual = np.abs((np.eye(p) - found @ stacked)[:, free]).max(initial=0.0)
    return found if residual < 1e-9 else None


def _pseudo_inverse(problem: GainProblem) -> np.ndarray:
    """The paper's left inverse of [G; H]."""
    return without_rounding(np.linalg.pinv(np.vstack([problem.G, problem.H])))


def _distinct(found: Sequence[np.ndarray | None]) -> list[np.ndarray]:
    kept: list[np.ndarray] = []
    for matrix in found:
        if matrix is not None and not any(np.allclose(matrix, other, rtol=1e-7, atol=1e-12) for other in kept):
            kept.append(matrix)
    return kept
