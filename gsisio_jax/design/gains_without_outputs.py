"""Gains that leave one output out, kept so that a further output, however poor, seldom widens a box.

The certified gain is the best one for its own steady width. With an output more that width is smaller, and the rows may
lean on the new output where boxes, being intersections, would have told more without it. A gain of the plant without an
output is one of the plant with it, its weight there 0. Those are kept that narrow boxes in simulated runs:
keeping all of them would keep every box, but cost a gain for every output.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsisio_jax.design.gain_selection import main_gain, profile_of, with_rows
from gsisio_jax.design.problem import GainProblem
from gsisio_jax.design.window_program import rows_of_gains
from gsisio_jax.design.window_runs import Rows, Runs, mean_log_width
from gsisio_jax.errors import NoDesignFound
from gsisio_jax.interval.box import Interval

_LEAST_GAIN = 2e-3  # share of the width that a row must bring on simulated runs
_MOST_OUTPUTS = 12  # beyond, too many programs


def gains_without_outputs(problem: GainProblem, bank: list[np.ndarray], region: Interval) -> list[np.ndarray]:
    """Gains whose rows are those of the designs without one of the outputs.

    Args:
        problem: of the design.
        bank: gains that are kept already, the certified one in front.
        region: of the design.

    Returns:
        As few gains as hold the rows that narrow boxes in simulated runs; a gain has the certified row for a state of
        which there is no other.
    """
    l = problem.l
    if not 2 <= l <= _MOST_OUTPUTS:
        return []
    main = bank[0]
    width = profile_of(problem, problem.steady_width(main), region)
    scaled = problem.scaled(width)
    known = rows_of_gains(scaled, [problem.scaled_gain(N, width) for N in bank], 1)

    def reached_with(gains: list[np.ndarray]) -> np.ndarray:
        """Mean logarithm (n,) of the widths of simulated runs with the bank and these gains, in units of `width`."""
        rows = Rows([*known.parts], [*known.states])
        more = rows_of_gains(scaled, [problem.scaled_gain(N, width) for N in gains], 1)
        for state, parts in zip(more.states, more.parts, strict=True):
            rows.add(state, parts)
        return mean_log_width(Runs(scaled, 1, np.full(problem.n, 1.5), np.random.default_rng(0)).of(rows, False))

    now = reached_with([])
    rows: list[list[np.ndarray]] = [[] for _ in range(problem.n)]
    for j in range(l):
        gain = _without(problem, j, region)
        if gain is None:
            continue
        for i in range(problem.n):
            tried = np.where((np.arange(problem.n) == i)[:, None], gain, main)
            reached = reached_with([*with_rows(main, rows), tried])
            if reached[i] < now[i] - _LEAST_GAIN:
                rows[i].append(gain[i])
                now = reached
    return with_rows(main, rows)


def reduced(problem: GainProblem, j: int) -> tuple[GainProblem, np.ndarray]:
    """The problem of the plant without output j, and what its rows of T2 are in those of the plant, (q', q).

    What is free of the input without that output are the combinations of the rows of T2 in which it does not appear.
    """
    others, q = np.delete(np.arange(problem.l), j), problem.q
    mixed = _combinations(problem.T2[:, j])
    less = replace(
        problem,
        E=problem.E[others],
        E_radius=problem.E_radius[others],
        T2=(mixed @ problem.T2)[:, others],
        C=np.vstack([mixed @ problem.C[:q], problem.C[q:]]),
        R=np.abs(mixed) @ problem.R,
        H=problem.H[others],
        dv=problem.dv[others],
    )
    return less, mixed


def _without(problem: GainProblem, j: int, region: Interval) -> np.ndarray | None:
    """The certified gain of the plant without output j, as a gain of the plant; None where there is none."""
    l, q = problem.l, problem.q
    others = np.delete(np.arange(l), j)
    less, mixed = reduced(problem, j)
    seen = less.seen[:, less.free]
    if np.linalg.matrix_rank(seen) < seen.shape[1]:
        return None
    try:
        found = main_gain(less, region)
    except NoDesignFound:
        return None
    gain = np.zeros((problem.n, problem.columns))
    gain[:, others] = found[:, : l - 1]
    gain[:, l : l + q] = found[:, l - 1 : l - 1 + len(mixed)] @ mixed
    gain[:, l + q :] = found[:, l - 1 + len(mixed) :]
    if np.abs(problem.residual(gain)[:, problem.free]).max(initial=0.0) > 1e-9 * (1 + np.abs(problem.G).max(initial=0)):
        return None
    return gain


def _combinations(column: np.ndarray) -> np.ndarray:
    """Rows that span what a column (q,) does not see: rows of the identity where it is 0, else one less."""
    q = len(column)
    if not column.any():
        return np.eye(q)
    pivot = int(np.argmax(np.abs(column)))
    mixed = np.eye(q)
    mixed[:, pivot] -= column / column[pivot]
    return np.delete(mixed, pivot, axis=0)
