"""Gains of a design that knows no bounds, kept so that a true bound never widens a box.

The certified gain is the best one for its own steady width. With a bound more it may lean on that where data would have
said more: boxes are intersections, and mostly narrower than the steady width. So the rows of the gain without the bound
are kept beside those of the certified one.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from gsisio_jax.design.gain_selection import main_gain, profile_of, with_rows
from gsisio_jax.design.problem import GainProblem
from gsisio_jax.errors import NoDesignFound
from gsisio_jax.interval.box import Interval

_SHARES = (1.0, 0.3, 0.1, 0.0)  # of the steady width, at which rows are compared
_BETTER = 1e-6  # share of the width that a row must bring somewhere


def gains_with_less(problem: GainProblem, bank: list[np.ndarray], region: Interval) -> list[np.ndarray]:
    """Gains whose rows are those of the design without the state bounds, without the input bounds, and without both.

    Args:
        problem: of the design.
        bank: gains that are kept already, the certified one in front.
        region: of the design.

    Returns:
        As few gains as hold the rows that are better than the certified ones for boxes of some size; a gain has the
        certified row for a state of which there is no other.
    """
    main = bank[0]
    width = profile_of(problem, problem.steady_width(main), region)
    rows: list[list[np.ndarray]] = [[] for _ in range(problem.n)]
    for less, usable in _cases(problem):
        try:
            gain = main_gain(less, region, usable)
        except NoDesignFound:
            continue
        for i in range(problem.n):
            known = [*(kept[i] for kept in bank), *rows[i]]
            if not any(_same(gain[i], row) for row in known) and _helps(problem, gain, main, i, width):
                rows[i].append(gain[i])
    return with_rows(main, rows)


def certified_with_less(
    problem: GainProblem, main: np.ndarray, region: Interval, promised: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """The gain with the narrowest promise, of the certified one and those of the designs with less.

    The certified one is best for slopes of the whole region. Counted slice by slice it may lean on a bound where the
    others follow the state: a bound more would then widen the promise, and the boxes that are held to it.

    Args:
        problem: of the design.
        main: the certified gain.
        region: of the design.
        promised: steady widths (n,) with a gain, as the certificate will have them.
    """
    others = []
    for less, usable in _cases(problem):
        with contextlib.suppress(NoDesignFound):
            others.append(main_gain(less, region, usable))
    if not others:
        return main
    best, width = main, promised(main)
    for other in others:
        reached = promised(other)
        # Rows of (*) are apart from each other, so the better row of every state may be taken (theory 4.2).
        mixed = np.where((reached < width)[:, None], other, best)
        for gain, now in ((other, reached), (mixed, promised(mixed))):
            if (now <= width).all() and (now < width * (1 - _BETTER)).any():
                best, width = gain, now
    return best


def _cases(problem: GainProblem) -> Iterator[tuple[GainProblem, np.ndarray]]:
    """The problems that know less, and which entries of a gain they may use."""
    everything = np.full(problem.columns, True)
    unbounded = everything.copy()
    unbounded[problem.l + problem.q :] = False
    free = replace(problem, free=np.full(len(problem.free), True), dd=np.zeros(0))
    states, inputs = bool(len(problem.ds)), bool(len(problem.dd))
    if states:
        yield problem, unbounded
    if inputs:
        yield free, everything
    if states and inputs:
        yield free, unbounded


def _helps(problem: GainProblem, gain: np.ndarray, main: np.ndarray, i: int, width: np.ndarray) -> bool:
    """Is this row narrower than the certified one for boxes of some size?"""
    return any(
        problem.row_cost(gain, share * width)[i] < problem.row_cost(main, share * width)[i] * (1 - _BETTER)
        for share in _SHARES
    )


def _same(row: np.ndarray, other: np.ndarray) -> bool:
    return bool(np.allclose(row, other, rtol=1e-7, atol=1e-12))
