"""How wide boxes are that the best rows over so many steps lead to: which windows are worth a search (theory 5.7)."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from gsisio_jax.design.problem import GainProblem
from gsisio_jax.design.window_program import WindowProgram, best_rows
from gsisio_jax.design.window_runs import FAR, sizes_of_parts

_ROUNDS = 5  # from boxes of which nothing is known; each is a bound by itself
_OFF = 10.0  # factor by which units must be off to be replaced
_NARROWER = 0.25  # share of a width that a window twice as long must take away
_LARGEST = 160  # states times steps, beyond which these programs are slow
_SETTLED = 0.02  # share of a width by which a round must narrow some state to be followed by another


def widths_from_above(problem: GainProblem, steps: int) -> np.ndarray:
    """Half the widths (n,) at or below which boxes settle with the best rows over `steps` steps for these widths, from
    boxes of any width: a few linear programs a state. About `FAR` where rows need a box that they do not narrow.

    Args:
        problem: in some units; where slopes vary, on its region.
        steps: that a row looks back, at least 1.
    """
    program, half = WindowProgram.of(problem, steps, steps), np.full(problem.n, FAR)
    half[problem.bounded_states] = np.minimum(FAR, problem.ds / 2)
    for _ in range(_ROUNDS):
        size = sizes_of_parts(problem, [half] * steps)
        before, half = half, np.minimum(half, best_rows(program, problem.n, size)[1])
        if (half >= (1 - _SETTLED) * before).all():
            break
    return np.maximum(half, 1e-12)


def units_of_windows(problem: GainProblem, width: np.ndarray, steps: int) -> np.ndarray:
    """Typical widths (n,) of boxes, as units: what rows over `steps` steps lead to where no single step promises one.

    What outputs of one step resolve says nothing of states that only several of them show, and units that are far too
    small hide from a search what a window brings, and from a solver what determines a state.
    """
    if problem.nonlinear:
        return width
    reach = _moving_what_is_seen(problem, width)
    half = widths_from_above(problem.scaled(reach), steps)
    found = 2 * reach * half
    return np.where((half < FAR / 10) & (np.abs(np.log(found / width)) > np.log(_OFF)), found, width)


def length_worth_trying(problem: GainProblem, lengths: tuple[int, ...]) -> int:
    """The longest of these windows, each next one only if the best rows over it lead to boxes that are narrower by
    `_NARROWER` in some state than those of the one before."""
    before = widths_from_above(problem, lengths[0])
    for shorter, longer in pairwise(lengths):
        if problem.n * longer > _LARGEST:
            return shorter
        now = widths_from_above(problem, longer)
        if not (now < (1 - _NARROWER) * before).any():
            return shorter
        before = now
    return lengths[-1]


def share_left(problem: GainProblem, shorter: int, longer: int) -> float | None:
    """The least share of a width that the best rows over the longer window leave of the shorter one's; None where that
    window is not worth trying (`length_worth_trying`)."""
    if problem.n * longer > _LARGEST:
        return None
    share = float((widths_from_above(problem, longer) / widths_from_above(problem, shorter)).min())
    return share if share < 1 - _NARROWER else None


def _moving_what_is_seen(problem: GainProblem, width: np.ndarray) -> np.ndarray:
    """Widths (n,): those of states that outputs show as they are, and of the others as much as moves one of these in a
    step by its own width, and so on."""
    moves, found = np.abs(problem.F), np.where(problem.E.any(0), width, np.inf)
    for _ in range(problem.n):
        with np.errstate(divide="ignore", invalid="ignore"):
            reached = np.where(moves > 0, found[:, None] / moves, np.inf)
        new = np.where(np.isinf(found), reached.min(0), found)
        if np.array_equal(new, found):
            break
        found = new
    return np.where(np.isinf(found), width, np.maximum(found, width))
