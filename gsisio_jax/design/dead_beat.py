"""Rows that need no box to begin with: over the shortest window that determines a state (theory 5.8)."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from gsisio_jax.design.problem import GainProblem
from gsisio_jax.design.window import as_window
from gsisio_jax.design.window_program import WindowProgram
from gsisio_jax.design.window_runs import Rows
from gsisio_jax.interval.box import Interval
from gsisio_jax.observer.recovery import Recovery
from gsisio_jax.observer.recovery_constants import AffineMaps

_LARGEST = 60  # states beyond which these programs take minutes
_NOTHING = 1e-9  # singular values below this share count as 0


def dead_beat_rows(
    problem: GainProblem,
    maps: AffineMaps,
    width: np.ndarray,
    lost: tuple[Collection[int], Collection[int]] | None = None,
) -> tuple[Recovery, ...]:
    """One row for every state that measurements determine, over its own shortest window, with no weight on any box of
    an earlier step, of least noise.

    Args:
        problem: of the design.
        maps: affine bounds of f, g and T2 g on the state bounds; what these leave open counts as noise.
        width: (n,) typical widths of boxes, as units.
        lost: outputs of y[k-1] and of y[k] to do without; then rows look back one step at most.

    Returns:
        The rows, those of one length together, without what rounding leaves of them (see `recovery_constants`); none
        where all of y[k] alone determines all states.
    """
    n, l, q = problem.n, problem.l, problem.q
    if n > _LARGEST or (lost is None and np.linalg.matrix_rank(maps.slope[n + l :]) == n):
        return ()
    F, E, Z = np.split(maps.slope, [n, n + l])
    before, now = (np.isin(np.arange(l), list(outputs)) for outputs in lost or ((), ()))
    # An output without slopes and inputs is none.
    E, H = np.where(before[:, None], 0, E), np.where(before[:, None], 0, problem.H)
    Z = np.where((problem.T2[:, now] != 0).any(1)[:, None], 0, Z)
    affine = replace(problem, F=F, E=E, H=H, C=np.vstack([Z, problem.C[q:]]))
    scaled = affine.scaled(width)
    # Widths of what is known of an equation, over its units.
    y = np.where(problem.dv > 0, problem.dv, 1.0)
    of_f, of_g, of_z = np.split(maps.radius / np.concatenate([width, y, np.abs(problem.T2) @ y]), [n, n + l])
    of_f, of_g = of_f + scaled.dw / 2, of_g + scaled.dv / 2
    determined = steps_until_determined(scaled)
    found, waiting = [], [i for i in range(n) if np.isfinite(determined[i])]
    for steps in range(n + 1 if lost is None else 2):
        if not waiting:
            break
        program = _without_boxes(scaled, steps)
        size = np.concatenate([*[of_f] * steps, *[of_g] * steps, scaled.dv / 2, of_z, *[scaled.dd / 2] * steps])
        size = np.where(size > 0, size, 1e-6)
        rows, radius = Rows([], []), {}
        for state in [i for i in waiting if determined[i] <= steps]:
            row = program.best(state, size, np.zeros_like(size))
            if row is not None:
                rows.parts.append(np.concatenate([np.zeros(steps * n), row[0]]))
                rows.states.append(state)
                radius[state] = row[1]
        if radius:
            waiting = [i for i in waiting if i not in radius]
            scales = np.tile(1 / np.concatenate([width, y]), (steps + 1, 1))
            scales[:steps, n:][:, before], scales[-1, n:][now] = 0, 0
            found.append(_as_recovery(affine, steps, rows, radius, width, scales))
    return tuple(found)


def steps_until_determined(problem: GainProblem) -> np.ndarray:
    """For every state the least N with which y[k-N..k] determine it, whatever x[k-N] and the free inputs were, (n,);
    ``inf`` where none does. Slopes are taken as constant.

    The states that no measurement of the window tells from 0 are a subspace, and that of one more step follows from it;
    where it stays what it is, it stays so for good.
    """
    n, Z, G, H = problem.n, problem.C[: problem.q], problem.G[:, problem.free], problem.H[:, problem.free]
    unseen, before, steps = _kernel(Z), np.eye(n), np.full(n, np.inf)
    for N in range(n + 1):
        steps = np.where(np.isinf(steps) & (np.abs(unseen).max(1, initial=0.0) < _NOTHING), N, steps)
        # (a, d) that y[k-1] does not show and that lead to a state that y[k] does not show, whatever d[k] is.
        ahead = np.hstack([problem.F @ before, G])
        quiet = _kernel(np.vstack([np.hstack([problem.E @ before, H]), Z @ ahead]))
        after = _basis(ahead @ quiet)
        if after.shape[1] == unseen.shape[1]:
            break
        unseen = before = after
    return steps


def _kernel(matrix: np.ndarray) -> np.ndarray:
    """An orthonormal basis of what a matrix makes 0, in columns."""
    _, values, rows = np.linalg.svd(matrix)
    return rows[int((values > _NOTHING * values.max(initial=1.0)).sum()) :].T


def _basis(columns: np.ndarray) -> np.ndarray:
    """An orthonormal basis of what columns span."""
    left, values, _ = np.linalg.svd(columns, full_matrices=False)
    return left[:, values > _NOTHING * values.max(initial=1.0)]


def _as_recovery(
    problem: GainProblem, steps: int, rows: Rows, radius: dict[int, float], width: np.ndarray, scales: np.ndarray
) -> Recovery:
    """Rows of one length in the units of the plant."""
    n, l, R = problem.n, problem.l, len(radius)
    if steps:
        window = as_window(problem, steps, rows, list(range(R)), width, shortened=False)
        multipliers, remainder, known, targets = window.multipliers, window.remainder, window.known, window.targets
    else:
        targets = tuple(rows.states)
        multipliers, known = np.zeros((0, R, n + l)), np.zeros((0, R, len(problem.dd)))
        y = np.where(problem.dv > 0, problem.dv, 1.0)
        remainder = width[list(targets), None] * np.array(rows.parts)[:, l:] / (np.abs(problem.T2) @ y)
    return Recovery(
        multipliers=multipliers,
        output=np.zeros((R, l)),
        remainder=remainder,
        known=known,
        constant=Interval.unchecked(np.zeros(R), np.zeros(R)),
        slack=np.zeros(R),
        scales=scales,
        floor=np.zeros(()),
        width=np.array([2 * radius[i] * width[i] for i in targets]),
        targets=targets,
    )


def _without_boxes(problem: GainProblem, steps: int) -> WindowProgram:
    """The program of a window where the first parts, slopes on boxes, must vanish."""
    n, l, q = problem.n, problem.l, problem.q
    if not steps:
        Z = problem.C[:q]
        return WindowProgram(np.vstack([problem.T2.T, np.eye(q)]), np.zeros((l + q, n)), Z.T, -np.eye(n))
    program, slopes = WindowProgram.of(problem, steps, steps), steps * n
    return replace(
        program,
        parts=program.parts[slopes:],
        offset=program.offset[slopes:],
        equal=np.vstack([program.parts[:slopes], program.equal]),
        equal_offset=np.vstack([program.offset[:slopes], program.equal_offset]),
    )
