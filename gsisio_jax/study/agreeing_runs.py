"""Runs of a nonlinear plant that agree with a record, as far apart as they are found: a hull from inside.

Linear programs along a run propose others; what counts are those that the plant itself is played through and that agree
with every measurement. Nothing is proved about what was not found, so the hull of these runs is a lower bound.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import numpy as np

from gsisio_jax.plant.system import System
from gsisio_jax.scalar.numpy_program import numpy_function
from gsisio_jax.study.record_program import RecordProgram
from gsisio_jax.study.stretch import Affine, Sides, Stretch

# How far to go from a run in the middle towards the one that a program proposes.
SHARES = 1 - np.array([0, 1e-7, 1e-5, 1e-4, 3e-4, 1e-3, 3e-3, 0.01, 0.03, 0.1, 0.3, 0.6, 0.9, 0.98, 0.998])
ROUNDS = 20  # of programs along the best runs so far, at most
ENOUGH = 1e-3  # of the width: a side that moved by less was idle
PATIENCE = 3  # idle rounds, each with a smaller step, that end the search for a side
SHRINK = 0.1  # of the last step, after an idle round
FIRST = 20  # programs to find a first run
SHORTER = 0.5  # of the last step, where it led to a run that does not agree: otherwise two runs may lead to each other
TOLERANCE = 1e-12  # of the size of a measurement: what rounding may leave of it


class Maps:
    """f and g at many points, and their derivatives along a record of at most T rows; traced once, run in NumPy."""

    def __init__(self, system: System, rows: int, many: int):
        def both(x: Any, u: Any) -> tuple[Any, Any]:
            return system.dynamics(x, u), system.measurement(x, u)

        self.rows, self.many = rows, many
        with jax.enable_x64(True):
            along, across = ((np.zeros((count, system.n)), np.zeros((count, system.m))) for count in (rows, many))
            self._slopes = numpy_function(jax.vmap(jax.jacfwd(both)), *along)
            self._along = numpy_function(jax.vmap(both), *along)
            self._across = numpy_function(jax.vmap(both), *across)

    def values(self, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """f and g of a batch of states under one known input."""
        with jax.enable_x64(True):
            return self._across(x, np.tile(u, (self.many, 1)))

    def affine(self, x: np.ndarray, u: np.ndarray) -> Affine:
        """First-order expansion along a run."""
        s = len(x)
        padding = ((0, self.rows - s), (0, 0))
        x_all, u_all = np.pad(x, padding, "edge"), np.pad(u, padding, "edge")
        with jax.enable_x64(True):
            (A, C), (f, g) = ([part[:s] for part in found(x_all, u_all)] for found in (self._slopes, self._along))
        return Affine(A, f - np.einsum("sij,sj->si", A, x), C, g - np.einsum("sij,sj->si", C, x))


class AgreeingRuns:
    """Runs of a system that agree with stretches of a record of at most T rows."""

    def __init__(self, system: System, rows: int):
        self.n = system.n
        self.maps = Maps(system, rows, 2 * system.n * len(SHARES))

    def hull(self, stretch: Stretch, near: Sides, row: int) -> Sides:
        """The hull (n,) of the states in a row of the runs that are found; NaN where none is.

        Args:
            stretch: the record; its state bounds are those of the plant.
            near: boxes (s, n) to look for runs in.
            row: index of the row.
        """
        # The boxes guide the programs; a run that leaves them counts, too. The state of that row is left free: a
        # program that is extreme at a side of its box would leave open which way leads there.
        here = np.arange(stretch.length)[:, None] == row
        guide = Sides(*(np.where(here, b, a) for a, b in zip(near, stretch.state, strict=True)))
        inside = replace(stretch, state=guide)
        first = self._first(inside, stretch)
        n = self.n
        if first is None:
            return Sides(np.full(n, np.nan), np.full(n, np.nan))
        x0, d0 = first
        sides = range(2 * n)
        signs, states = np.repeat([1, -1], n), np.tile(np.arange(n), 2)
        best = np.tile(x0, (2 * n, 1, 1))
        reached = signs * x0[row, states]
        reach, idle = np.full((2 * n, n), np.inf), np.zeros(2 * n, int)  # of a step, per state; rounds
        for _ in range(ROUNDS):
            proposed = best.copy()
            inputs = np.tile(d0, (2 * n, 1, 1))
            for j in (j for j in sides if idle[j] < PATIENCE):
                found = self._program(inside, best[j], reach[j]).extreme(states[j], signs[j], row)
                if found.x is not None and found.d is not None:
                    proposed[j], inputs[j] = found.x, found.d
            share = SHARES[:, None, None, None]
            mixed = (m + share * (v - m) for m, v in ((x0, proposed), (d0, inputs)))
            x, agrees = self._played(stretch, *(v.reshape(self.maps.many, *v.shape[2:]) for v in mixed))
            x, agrees = x.reshape(len(SHARES), *best.shape), agrees.reshape(len(SHARES), -1)
            width = -(reached[:n] + reached[n:])
            for j in (j for j in sides if idle[j] < PATIENCE):
                ends = np.where(agrees[:, j], signs[j] * x[:, j, row, states[j]], np.inf)
                i = ends.argmin()
                gain = reached[j] - ends[i]
                idle[j] = 0 if gain > ENOUGH * width[states[j]] else idle[j] + 1
                reach[j] = np.abs(proposed[j] - best[j]).max(0) * (SHRINK if idle[j] else 2 * SHARES[i])
                if gain > 0:
                    best[j], reached[j] = x[i, j], ends[i]
            if (idle >= PATIENCE).all():
                break
        return Sides(reached[:n], -reached[n:])

    def _program(self, inside: Stretch, run: np.ndarray, reach: np.ndarray) -> RecordProgram:
        """Runs to first order along one, in its boxes and no further from it than that."""
        near = Sides(*(inside.state.clip(run + side) for side in (-reach, reach)))
        return RecordProgram(replace(inside, state=near), self.maps.affine(run, inside.u))

    def _first(self, inside: Stretch, stretch: Stretch) -> tuple[np.ndarray, np.ndarray] | None:
        """A run that needs little of the noise: the programs along it, one after the other, in shorter and shorter
        steps as long as none agrees."""
        with np.errstate(invalid="ignore"):
            center = (inside.state.lower + inside.state.upper) / 2
        x = np.where(np.isfinite(center), center, inside.state.clip(np.zeros_like(center)))
        best, least, reach = None, np.inf, np.full(self.n, np.inf)
        for _ in range(FIRST):
            found = self._program(inside, x, reach).middle()
            if found.x is None or found.d is None:
                return best
            moved, x = np.abs(found.x - x).max(0), found.x
            played, agrees = self._played(stretch, x[None], found.d[None])
            if agrees[0]:
                if found.value > 0.99 * least:
                    return best
                x, best, least = played[0], (played[0], found.d), found.value
            elif best is None:
                reach = SHORTER * moved
        return best

    def _played(self, stretch: Stretch, x: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The plant from x[0], under d and the noise that keeps it nearest to x: states (r, s, n), and whether they
        agree with the record and its bounds."""
        count, many = len(x), self.maps.many
        x, d = (np.concatenate([v, np.repeat(v[:1], many - count, 0)]) for v in (x, d))
        d = stretch.input.clip(d)
        now = stretch.state.rows(0).clip(x[:, 0])
        played, agrees = [now], np.ones(many, bool)
        for k in range(stretch.length):
            f, g = self.maps.values(now, stretch.u[k])
            by_d = d[:, k] @ stretch.H.T
            with np.errstate(invalid="ignore"):
                room = TOLERANCE * (np.abs(g) + np.abs(by_d) + np.abs(stretch.y[k]))
                v = stretch.y[k] - g - by_d
                fits = (stretch.v.lower[k] - room <= v) & (v <= stretch.v.upper[k] + room)
                agrees &= (fits | np.isnan(stretch.y[k])).all(1)
                agrees &= ((stretch.state.lower[k] <= now) & (now <= stretch.state.upper[k])).all(1)
            if k + 1 < stretch.length:
                base = f + stretch.push[k] + d[:, k] @ stretch.G.T
                now = base + stretch.w.rows(k).clip(x[:, k + 1] - base)
                played.append(now)
        return np.stack(played, 1)[:count], agrees[:count]
