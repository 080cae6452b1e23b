"""Rows of windows, and simulated runs of an observer that has them.

A run is simulated in errors: how far the sides of a box are from the true state depends on the noise and on the boxes
before, and on nothing else where f and g are affine. Where they are not, the spread of their slopes counts as noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsisio_jax.design.problem import GainProblem

FAR = 1e6  # steady widths beyond this many units are not waited for
RUNS, _STEPS = 12, 20


@dataclass
class Rows:
    """Rows found so far: parts (R, k) over `length` steps, and the state of each."""

    parts: list[np.ndarray]
    states: list[int]

    def add(self, state: int, parts: np.ndarray) -> None:
        """Unless it is there."""
        own = np.array([old for old, of in zip(self.parts, self.states, strict=True) if of == state])
        own = own.reshape(-1, len(parts))
        if not (np.abs(parts - own) <= 1e-7 + 1e-5 * np.abs(own)).all(1).any():
            self.parts.append(parts)
            self.states.append(state)

    def kept(self, places: list[int]) -> Rows:
        """Only those."""
        return Rows([self.parts[r] for r in places], [self.states[r] for r in places])

    def matrix(self) -> np.ndarray:
        """Parts of all rows, (R, k)."""
        return np.array(self.parts).reshape(len(self.parts), -1) if self.parts else np.zeros((0, 0))

    def of(self, state: int) -> np.ndarray:
        return np.flatnonzero(np.array(self.states) == state)


def mean_log_width(run: list) -> np.ndarray:
    """Mean logarithm (n,) of the widths in the steps of a run: narrow boxes count as much as wide ones."""
    return np.mean([np.log(np.maximum(below + above, 1e-12)) for *_, below, above in run], (0, 1))


class Runs:
    """Simulated runs of the observer in errors, `RUNS` side by side: distances (S, n) of both sides from the state."""

    def __init__(self, problem: GainProblem, length: int, start: np.ndarray, rng: np.random.Generator):
        self.problem, self.length, self.start, self.rng = problem, length, start, rng

    def of(
        self, rows: Rows, vertices: bool, from_start: bool = False
    ) -> list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
        """For every step with a whole window, or from the first one: sizes and drifts (S, k) of the parts of a row, and
        the distances to the lower and the upper side (S, n)."""
        P, N, n = self.problem, self.length, self.problem.n
        looked = Measured(P)
        total = N + _STEPS
        w, v = self._noise(P.dw / 2, total, vertices), self._noise(P.dv / 2, total, vertices)
        # Of N steps before the first one nothing is known; every block of a step is computed once.
        start = np.tile(self.start, (RUNS, 1))
        half, off = np.empty((RUNS, N + total, n)), np.zeros((RUNS, N + total, n))
        half[:, :N], half[:, N] = FAR * start[:, None], start
        seen_noise = v @ looked.T2.T
        of_f, of_g = (np.empty((RUNS, N + total, len(radius))) for radius in (P.dw, P.dv))
        for block, radius, spread in ((of_f, P.dw, P.F_radius), (of_g, P.dv, P.E_radius)):
            block[:, : N + 1] = 0.5 * radius + half[:, : N + 1] @ spread.T
        minus_w, past_v = (np.concatenate([np.zeros_like(noise[:, :N]), noise], 1) for noise in (-w, v))
        known = np.tile(0.5 * P.dd, (RUNS, N))
        v_now, nothing = np.broadcast_to(0.5 * P.dv, (RUNS, P.l)), np.zeros((RUNS, P.q + N * len(P.dd)))
        best = _Best(rows)
        most = FAR * start
        most[:, P.bounded_states] = P.ds / 2  # of a state in the middle of its bounds
        found = []
        for k in range(1, total):
            last = slice(k, k + N)
            blocks = [block[:, last].reshape(RUNS, -1) for block in (half, of_f, of_g)]
            size = np.concatenate([*blocks, v_now, half[:, k + N - 1] @ P.R.T, known], 1)
            blocks = [block[:, last].reshape(RUNS, -1) for block in (off, minus_w, past_v)]
            drift = np.concatenate([*blocks, v[:, k], nothing], 1)
            below, above = looked(best.sides(size, drift, most), seen_noise[:, k])
            half[:, k + N], off[:, k + N] = 0.5 * (above + below), 0.5 * (above - below)
            of_f[:, k + N] = 0.5 * P.dw + half[:, k + N] @ P.F_radius.T
            of_g[:, k + N] = 0.5 * P.dv + half[:, k + N] @ P.E_radius.T
            if from_start or k > N + 3:
                found.append((size, drift, below, above))
        return found

    def _noise(self, radius: np.ndarray, steps: int, vertices: bool) -> np.ndarray:
        shape = (RUNS, steps, len(radius))
        unit = self.rng.choice([-1.0, 1.0], shape) if vertices else self.rng.uniform(-1, 1, shape)
        return radius * unit


class _Best:
    """Rows in the order of their states, to say the best one of each."""

    def __init__(self, rows: Rows):
        order = np.argsort(rows.states, kind="stable")
        self.parts = rows.matrix()[order]
        self.sizes = np.abs(self.parts).T
        self.states, self.first = np.unique(np.array(rows.states, int)[order], return_index=True)

    def sides(self, size: np.ndarray, drift: np.ndarray, most: np.ndarray) -> list[np.ndarray]:
        """Distances (S, n) of both sides, at most `most`."""
        sides = [most.copy(), most.copy()]
        if len(self.parts):
            spread, moved = size @ self.sizes, drift @ self.parts.T
            for side, reach in zip(sides, (spread - moved, spread + moved), strict=True):
                least = np.minimum.reduceat(reach, self.first, axis=1)
                side[:, self.states] = np.minimum(least, side[:, self.states])
        return sides


class Measured:
    """Distances of the sides of boxes once every output of T2 alone has been solved for every state, as each step does.

    Args:
        problem: in some units.
    """

    def __init__(self, problem: GainProblem):
        C = problem.C[: problem.q]
        radius = 0.5 * np.abs(problem.T2) @ problem.dv
        self.T2, self._R = problem.T2, problem.R if problem.R.any() else None
        self._solved = []
        for j, i in np.argwhere(C):
            others = np.where(np.arange(problem.n) == i, 0.0, C[j]) / abs(C[j, i])
            upper_first = C[j, i] > 0
            self._solved.append((j, i, np.maximum(others, 0), np.maximum(-others, 0), radius[j], C[j, i], upper_first))

    def __call__(self, sides: list[np.ndarray], noise: np.ndarray) -> list[np.ndarray]:
        """`sides`: distances (S, n) to the lower and the upper side, which are overwritten; `noise`: T2 v, (S, q)."""
        below, above = sides
        for j, i, plus, minus, radius, own, upper_first in self._solved:
            slack = radius if self._R is None else radius + 0.5 * (below + above) @ self._R[j]
            high = below @ plus + above @ minus + (slack + noise[:, j]) / abs(own)
            low = above @ plus + below @ minus + (slack - noise[:, j]) / abs(own)
            high, low = (high, low) if upper_first else (low, high)
            np.minimum(above[:, i], high, out=above[:, i])
            np.minimum(below[:, i], low, out=below[:, i])
        return [below, above]


def sizes_of_parts(problem: GainProblem, half: list[np.ndarray]) -> np.ndarray:
    """What the parts of a row (`WindowProgram.parts`) count, (..., k), for boxes of half widths `half` (..., n), the
    oldest step first."""
    lead = half[-1].shape[:-1]
    w, v, d = (np.broadcast_to(0.5 * width, (*lead, len(width))) for width in (problem.dw, problem.dv, problem.dd))
    of_f = [w + h @ problem.F_radius.T for h in half]
    of_g = [v + h @ problem.E_radius.T for h in half]
    return np.concatenate([*half, *of_f, *of_g, v, half[-1] @ problem.R.T, *[d] * len(half)], -1)
