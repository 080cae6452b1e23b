"""Rows that need no box to begin with: over the shortest window that determines the state (theory 5.8)."""

from __future__ import annotations

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


def dead_beat_rows(problem: GainProblem, maps: AffineMaps, width: np.ndarray) -> Recovery | None:
    """One row for every state, with no weight on any box of an earlier step, of least noise.

    Args:
        problem: of the design.
        maps: affine bounds of f, g and T2 g on the state bounds; what these leave open counts as noise.
        width: (n,) typical widths of boxes, as units.

    Returns:
        The rows without what rounding leaves of them (see `recovery_constants`); None where y[k] alone determines the
        state, or n + 1 steps do not.
    """
    n, l, q = problem.n, problem.l, problem.q
    if n > _LARGEST or np.linalg.matrix_rank(maps.slope[n + l :]) == n:
        return None
    F, E, Z = np.split(maps.slope, [n, n + l])
    affine = replace(problem, F=F, E=E, C=np.vstack([Z, problem.C[q:]]))
    scaled = affine.scaled(width)
    # Widths of what is known of an equation, over its units.
    y = np.where(problem.dv > 0, problem.dv, 1.0)
    of_f, of_g, of_z = np.split(maps.radius / np.concatenate([width, y, np.abs(problem.T2) @ y]), [n, n + l])
    of_f, of_g = of_f + scaled.dw / 2, of_g + scaled.dv / 2
    d = [scaled.dd / 2]
    for steps in range(1, n + 1):
        program = _without_boxes(WindowProgram.of(scaled, steps, steps), steps * n)
        size = np.concatenate([*[of_f] * steps, *[of_g] * steps, scaled.dv / 2, of_z, *d * steps])
        size = np.where(size > 0, size, 1e-6)
        rows, radius = Rows([], []), []
        for state in range(n):
            row = program.best(state, size, np.zeros_like(size))
            if row is None:
                break
            rows.parts.append(np.concatenate([np.zeros(steps * n), row[0]]))
            rows.states.append(state)
            radius.append(row[1])
        if len(radius) == n:
            found = as_window(affine, steps, rows, list(range(n)), width, shortened=False)
            return Recovery(
                multipliers=found.multipliers,
                output=found.output,
                remainder=found.remainder,
                known=found.known,
                constant=Interval.unchecked(np.zeros(n), np.zeros(n)),
                slack=np.zeros(n),
                scales=1 / np.concatenate([width, y]),
                floor=np.zeros(()),
                width=2 * np.array(radius) * width,
                targets=found.targets,
            )
    return None


def _without_boxes(program: WindowProgram, slopes: int) -> WindowProgram:
    """The same program where the first parts, slopes on boxes, must vanish."""
    return replace(
        program,
        parts=program.parts[slopes:],
        offset=program.offset[slopes:],
        equal=np.vstack([program.parts[:slopes], program.equal]),
        equal_offset=np.vstack([program.offset[:slopes], program.equal_offset]),
    )
