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
NOTHING = 1e-9  # singular values below this share count as 0


def dead_beat_rows(
    problem: GainProblem,
    maps: AffineMaps,
    width: np.ndarray,
    lost: tuple[Collection[int], Collection[int]] | None = None,
    always: bool = False,
) -> tuple[Recovery, ...]:
    """One row for every state that measurements determine, over its own shortest window, with no weight on any box of
    an earlier step, of least noise.

    Args:
        problem: of the design.
        maps: affine bounds of f, g and T2 g on the state bounds; what these leave open counts as noise.
        width: (n,) typical widths of boxes, as units.
        lost: outputs of y[k-1] and of y[k] to do without; then rows look back one step at most.
        always: also where all of y[k] alone determines all states, as gains say so as well, but for rounding.

    Returns:
        The rows, those of one length together, without what rounding leaves of them (see `recovery_constants`).
    """
    n, l = problem.n, problem.l
    if n > _LARGEST or (lost is None and not always and np.linalg.matrix_rank(maps.slope[n + l :]) == n):
        return ()
    before, now = (np.isin(np.arange(l), list(outputs)) for outputs in lost or ((), ()))
    affine = affine_problem(problem, maps, before, now)
    scaled, y = affine.scaled(width), problem.output_units
    determined = steps_until_determined(scaled)
    found, waiting = [], [i for i in range(n) if np.isfinite(determined[i])]
    for steps in range(n + 1 if lost is None else 2):
        if not waiting:
            break
        program = _without_boxes(scaled, steps)
        size = sizes_without_boxes(affine, scaled, maps, width, steps)
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
            found.append(as_recovery(affine, steps, rows, radius, width, scales))
    return tuple(found)


def steps_until_determined(problem: GainProblem) -> np.ndarray:
    """For every state the least N with which y[k-N..k] determine it, whatever x[k-N] and the free inputs were, (n,);
    ``inf`` where none does. Slopes are taken as constant.

    The states that no measurement of the window tells from 0 are a subspace, and that of one more step follows from it;
    where it stays what it is, it stays so for good.
    """
    n = problem.n
    unseen, before, steps = _kernel(problem.C[: problem.q]), np.eye(n), np.full(n, np.inf)
    for N in range(n + 1):
        steps = np.where(np.isinf(steps) & (np.abs(unseen).max(1, initial=0.0) < NOTHING), N, steps)
        after = unseen_after(problem, before, True, True)
        if after.shape[1] == unseen.shape[1]:
            break
        unseen = before = after
    return steps


def unseen_after(problem: GainProblem, before: np.ndarray, measured: bool, measured_now: bool) -> np.ndarray:
    """A basis of the states that follow in one step from those that a basis spans, whatever the free inputs are, if
    y[k-1] does not show what it begins with, where it was measured, nor y[k] what it leads to, whatever d[k] is."""
    Z, G, H = problem.C[: problem.q], problem.G[:, problem.free], problem.H[:, problem.free]
    ahead = np.hstack([problem.F @ before, G])
    shown = [np.hstack([problem.E @ before, H])] * measured + [Z @ ahead] * measured_now
    return _basis(ahead @ _kernel(np.vstack([np.zeros((0, ahead.shape[1])), *shown])))


def affine_problem(problem: GainProblem, maps: AffineMaps, before: np.ndarray, now: np.ndarray) -> GainProblem:
    """The problem with the slopes of affine bounds, without the outputs of y[k-1] and of y[k] in these masks (l,)."""
    F, E, Z = np.split(maps.slope, [problem.n, problem.n + problem.l])
    # An output without slopes and inputs is none.
    E, H = np.where(before[:, None], 0, E), np.where(before[:, None], 0, problem.H)
    Z = np.where((problem.T2[:, now] != 0).any(1)[:, None], 0, Z)
    return replace(problem, F=F, E=E, H=H, C=np.vstack([Z, problem.C[problem.q :]]))


def sizes_without_boxes(
    problem: GainProblem, scaled: GainProblem, maps: AffineMaps, width: np.ndarray, steps: int
) -> np.ndarray:
    """Half widths of what is known of the equations of a window, over their units; for a `WindowProgram` of the problem
    `scaled` to these widths, without slopes on boxes."""
    y = problem.output_units
    units = np.concatenate([width, y, np.abs(problem.T2) @ y])
    of_f, of_g, of_z = np.split(maps.radius / units, [problem.n, problem.n + problem.l])
    of_f, of_g = of_f + scaled.dw / 2, of_g + scaled.dv / 2
    size = np.concatenate([*[of_f] * steps, *[of_g] * steps, scaled.dv / 2, of_z, *[scaled.dd / 2] * steps])
    return np.where(size > 0, size, 1e-6)


def _kernel(matrix: np.ndarray) -> np.ndarray:
    """An orthonormal basis of what a matrix makes 0, in columns."""
    _, values, rows = np.linalg.svd(matrix)
    return rows[int((values > NOTHING * values.max(initial=1.0)).sum()) :].T


def _basis(columns: np.ndarray) -> np.ndarray:
    """An orthonormal basis of what columns span."""
    left, values, _ = np.linalg.svd(columns, full_matrices=False)
    return left[:, values > NOTHING * values.max(initial=1.0)]


def as_recovery(
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
        remainder = (
            width[list(targets), None] * np.array(rows.parts)[:, l:] / (np.abs(problem.T2) @ problem.output_units)
        )
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
