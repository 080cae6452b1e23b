"""Runs of a nonlinear plant that agree with a record, as far apart as they are found: a hull from inside.

Linear programs along a run propose others; what counts are those that the plant itself is played through and that agree
with every measurement. Nothing is proved about what was not found, so the hull of these runs is a lower bound.
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from gsisio_jax.plant.system import System
from gsisio_jax.scalar.numpy_program import numpy_function
from gsisio_jax.study.record_program import Affine, RecordProgram, Sides, Stretch

# How far to go from a run in the middle towards the one that a program proposes.
SHARES = np.array([1, 1 - 1e-7, 0.9999, 0.999, 0.99, 0.97, 0.93, 0.85, 0.7, 0.5, 0.25])
ROUNDS = 6  # of programs along the best runs so far
ENOUGH = 1e-3  # stop where a round widens no side by more than this share of the width
FIRST = 10  # programs to find a first run
TOLERANCE = 1e-12  # of the size of a measurement: what rounding may leave of it


class Maps:
    """f and g at many points, and their derivatives along a record of at most T rows; traced once, run in NumPy."""

    def __init__(self, system: System, rows: int, many: int):
        def both(x: Any, u: Any) -> tuple[Any, Any]:
            return system.dynamics(x, u), system.measurement(x, u)

        self.rows, self.many = rows, many
        with jax.enable_x64(True):
            along, across = (
                (np.zeros((count, system.n)), np.zeros((count, system.m))) for count in (rows, many)
            )
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

    def hull(self, stretch: Stretch, near: Sides) -> Sides:
        """The hull (n,) of the last states of the runs that are found; NaN where none is.

        Args:
            stretch: the record; its state bounds are those of the plant.
            near: boxes (s, n) to look for runs in.
        """
        # The boxes guide the programs; a run that leaves them counts, too.
        inside = Stretch(**{**vars(stretch), "state": near})
        first = self._first(inside, stretch)
        n = self.n
        if first is None:
            return Sides(np.full(n, np.nan), np.full(n, np.nan))
        middle_x, middle_d = first
        best = np.tile(middle_x, (2 * n, 1, 1))
        signs, states = np.repeat([1, -1], n), np.tile(np.arange(n), 2)
        reached = signs * best[np.arange(2 * n), -1, states]
        for turn in range(ROUNDS):
            same = RecordProgram(inside, self.maps.affine(middle_x, inside.u)) if turn == 0 else None
            proposed = [self._proposed(inside, same, best[j], states[j], signs[j]) for j in range(2 * n)]
            x, d = (np.array([run[i] if run else (middle_x, middle_d)[i] for run in proposed]) for i in (0, 1))
            mix = SHARES[:, None, None, None]
            x, agrees = self._played(
                stretch, *((m + mix * (v - m)).reshape(self.maps.many, *m.shape) for m, v in ((middle_x, x), (middle_d, d)))
            )
            before = reached.copy()
            for j in range(2 * n):
                ends = np.where(agrees, signs[j] * x[:, -1, states[j]], np.inf)
                if ends.min() < reached[j]:
                    best[j], reached[j] = x[ends.argmin()], ends.min()
            width = -(reached[:n] + reached[n:])
            if (before - reached <= ENOUGH * np.tile(width, 2)).all():
                break
        return Sides(reached[:n], -reached[n:])

    def _proposed(self, inside: Stretch, program: RecordProgram | None, run: np.ndarray, state: int, sign: int) -> Any:
        """A run (x, d) that is extreme to first order; None where there is none."""
        found = (program or RecordProgram(inside, self.maps.affine(run, inside.u))).extreme(state, sign)
        return None if found.x is None else (found.x, found.d)

    def _first(self, inside: Stretch, stretch: Stretch) -> tuple[np.ndarray, np.ndarray] | None:
        """A run that needs little of the noise: the programs along it, one after the other."""
        with np.errstate(invalid="ignore"):
            center = (inside.state.lower + inside.state.upper) / 2
        x = np.where(np.isfinite(center), center, inside.state.clip(np.zeros_like(center)))
        best, least = None, np.inf
        for _ in range(FIRST):
            found = RecordProgram(inside, self.maps.affine(x, inside.u)).middle()
            if found.x is None or found.d is None:
                return best
            x = found.x
            played, agrees = self._played(stretch, x[None], found.d[None])
            if agrees[0]:
                if found.value > 0.99 * least:
                    return best
                x, best, least = played[0], (played[0], found.d), found.value
        return best

    def _played(self, stretch: Stretch, x: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The plant from x[0], under d and the noise that keeps it nearest to x: states (r, s, n), and whether they
        agree with the record and its bounds."""
        count, many = len(x), self.maps.many
        x, d = (np.concatenate([v, np.repeat(v[:1], many - count, 0)]) for v in (x, d))
        d = stretch.input.clip(d)
        now = stretch.state[0].clip(x[:, 0])
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
                now = base + stretch.w[k].clip(x[:, k + 1] - base)
                played.append(now)
        return np.stack(played, 1)[:count], agrees[:count]
