"""Designs that stay certain while up to q outputs of a step are wrong: what to keep for every guess which these are."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from math import comb
from typing import Any

import numpy as np

from gsisio_jax.design.dead_beat import dead_beat_rows
from gsisio_jax.design.feedthrough import Feedthrough
from gsisio_jax.design.gain_selection import typical_width, units
from gsisio_jax.design.gains import profile_gain
from gsisio_jax.design.problem import GainProblem
from gsisio_jax.errors import NoDesignFound
from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.reading import is_whole
from gsisio_jax.observer.checks import refuse_input_model
from gsisio_jax.observer.recovery import Recovery
from gsisio_jax.observer.recovery_constants import AffineMaps
from gsisio_jax.observer.tolerant import MOST_GUESSES, TolerantObserver
from gsisio_jax.observer.types import Observer
from gsisio_jax.plant.system import System

_ROUNDS = 3  # widths without the same outputs in every step, from one step to the next


def check_tolerate(tolerate: Any, system: System, form: str, missing: bool, window: Any, delay: Any) -> None:
    """Refuses wrong outputs that cannot be tolerated.

    Raises:
        ValueError: it is no whole number, leaves no output, takes too many guesses, or goes with nothing.
    """
    l, whole = system.l, is_whole(tolerate)
    if not whole or tolerate < 0:
        raise ValueError(f"design_observer: `tolerate` must be a whole number of outputs, at least 0, got {tolerate!r}")
    if tolerate == 0:
        return
    if tolerate >= l:
        raise ValueError(
            f"design_observer: `tolerate` must be below the number of outputs, {l}, got {tolerate}: nothing would be "
            "left to bound the state with; tolerate fewer, or add outputs"
        )
    if comb(l, tolerate) > MOST_GUESSES:
        raise ValueError(
            f"design_observer: `tolerate` must leave at most {MOST_GUESSES} ways to choose the wrong outputs, got "
            f"{tolerate} of {l}, which are {comb(l, tolerate)}, and a step takes the square of it; tolerate fewer, or "
            "join outputs that fail together into one"
        )
    for name, legal, got in (
        ("form", '"current"', None if form == "current" else repr(form)),
        ("missing", "True (a wrong output is taken as missing)", None if missing else "False"),
        ("window", "1 (guesses are about two measurements)", None if window in (1, "auto") else repr(window)),
        ("delay", "0 (a wrong output would be in the outputs of several steps)", None if delay == 0 else repr(delay)),
    ):
        if got is not None:
            raise ValueError(f"design_observer: with `tolerate`, `{name}` must be {legal}, got {got}")
    why = "which boxes of guesses about wrong outputs do not carry; leave it out, or tolerate nothing"
    refuse_input_model("design_observer", system, why)
    if system.periodic or system.periodic_states:
        raise ValueError(
            "design_observer: with `tolerate`, no output or state may be periodic; unwrap the outputs (numpy.unwrap), "
            "and leave the periods out"
        )


class Guessed:
    """Rows and gains for every guess which q outputs of y[k-1] and which of y[k] are wrong."""

    def __init__(self, problem: GainProblem, main: np.ndarray, region: Interval, feedthrough: Feedthrough, q: int):
        self.problem, self.support = problem, feedthrough.T2 != 0
        self.sets = list(combinations(range(problem.l), q))
        steady = problem.steady_width(main)
        self.typical = 2 * units(steady) if np.isfinite(steady).all() else typical_width(problem, region)

    def gains(self) -> list[np.ndarray]:
        """Gains that are best, each for its guess, for the widths that the guess about y[k-1] leads to.

        Raises:
            NoDesignFound: without some outputs the unknown input does not show.
        """
        width = {}
        for wrong in self.sets:
            reached = self.typical
            for _ in range(_ROUNDS):
                reached = np.minimum(
                    self.problem.row_cost(self._gain(wrong, wrong, reached), reached), 1e3 * self.typical
                )
            width[wrong] = units(reached)
        return [self._gain(before, now, width[before]) for before in self.sets for now in self.sets]

    def _gain(self, before: tuple[int, ...], now: tuple[int, ...], width: np.ndarray) -> np.ndarray:
        l, q = self.problem.l, self.problem.q
        usable = np.full(self.problem.columns, True)
        usable[list(before)] = False
        usable[l : l + q] = ~self.support[:, list(now)].any(1)
        found = profile_gain(self.problem, width, usable, units(width))
        if found is None:
            raise NoDesignFound(
                "design_observer: `tolerate` must leave outputs that show the unknown input, but without "
                f"{_names(now)} of a step and {_names(before)} of the step before no gain cancels it; tolerate fewer, "
                "add outputs, or bound inputs or states (`input_bounds`, `state_bounds`)"
            )
        return found

    def rows(self, maps: AffineMaps, width: np.ndarray) -> tuple[Recovery, ...]:
        """Rows that need no box to begin with."""
        found = []
        for now in self.sets:
            of_now = []
            for before in self.sets:
                rows = dead_beat_rows(self.problem, maps, width, (before, now))
                of_now.extend(group for group in rows if group.length or not any(not old.length for old in of_now))
            found.extend(of_now)
        return tuple(found)


def tolerant(observer: Observer, tolerate: int) -> TolerantObserver:
    """The observer of guesses, from a finished one that has what `Guessed` gives."""
    certificate = observer.certificate.without_promise(
        f"tolerate={tolerate}: boxes are certain while at most {tolerate} output{'s are' if tolerate > 1 else ' is'} "
        "wrong in any step; how wide they are depends on how many guesses agree with the data"
    )
    return TolerantObserver(replace(observer, certificate=certificate, corrections=0), tolerate)


def _names(outputs: tuple[int, ...]) -> str:
    return ("output " if len(outputs) == 1 else "outputs ") + " and ".join(str(j + 1) for j in outputs)
