"""Rows over several steps that a design without bounds would choose, kept so that a true bound never widens a box.

Which rows a design keeps, and whether it looks back at all, is decided on simulated runs, which bounds of states and
inputs change.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsisio_jax.design.gain_selection import distinct, gains_for_missing, main_gain, profile_of
from gsisio_jax.design.gains_without_outputs import gains_without_outputs
from gsisio_jax.design.problem import GainProblem
from gsisio_jax.design.window import deepest_first, window_rows
from gsisio_jax.errors import NoDesignFound
from gsisio_jax.interval.box import Interval
from gsisio_jax.observer.window import Window


def window_rows_with_less(
    problem: GainProblem,
    length: int | str,
    width: np.ndarray,
    bank: list[np.ndarray],
    region: Interval,
    missing: list[int] | None,
) -> Window | None:
    """As `window_rows`, with what the same search finds without the bounds of states and inputs.

    That begins with the gains and the widths of the design without them: with those of the design it would find other
    rows. `missing`: the outputs that are missing together (see `gains_for_missing`); None: there are no such gains.
    """
    own = window_rows(problem, length, width, bank, region)
    if not (len(problem.ds) or len(problem.dd)):
        return own
    everything = np.full(len(problem.free), True)
    free = replace(problem, C=problem.C[: problem.q], ds=np.zeros(0), dd=np.zeros(0), free=everything)
    if np.linalg.matrix_rank(free.seen) < free.seen.shape[1]:
        return own  # there is no observer without the bounds
    try:
        gain = main_gain(free, region)
    except NoDesignFound:
        return own
    gains = [gain] if missing is None else [gain, *gains_for_missing(free, gain, region, missing)]
    gains = distinct([*gains, *gains_without_outputs(free, distinct(gains), region)])
    less = window_rows(free, length, profile_of(free, free.steady_width(gain), region), gains, region)
    return own if less is None else _joined(problem, [less] if own is None else [own, less])


def _joined(problem: GainProblem, windows: list[Window]) -> Window:
    """All rows as those of one window; none comes twice."""
    steps = max(window.length for window in windows)
    multipliers = np.concatenate(
        [np.pad(one.multipliers, ((0, steps - one.length), (0, 0), (0, 0))) for one in windows], axis=1
    )
    remainder = np.concatenate([one.remainder for one in windows])
    targets = [i for one in windows for i in one.targets]
    kept: list[int] = []
    for r, target in enumerate(targets):
        same = (s for s in kept if targets[s] == target)
        if not any(np.allclose(multipliers[:, s], multipliers[:, r], rtol=1e-7, atol=1e-10) for s in same):
            kept.append(r)
    return deepest_first(problem, multipliers[:, kept], remainder[kept], [targets[r] for r in kept])
