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
        total = N + _STEPS
        w, v = self._noise(P.dw / 2, total, vertices), self._noise(P.dv / 2, total, vertices)
        below, above = [np.tile(self.start, (RUNS, 1))], [np.tile(self.start, (RUNS, 1))]
        parts = rows.matrix()
        belongs = np.array(rows.states)
        most = FAR * self.start
        most[P.bounded_states] = P.ds / 2  # of a state in the middle of its bounds
        found = []
        for k in range(1, total):
            size, drift = self._terms(below, above, w, v, k)
            none = np.zeros((RUNS, 0))
            spread, moved = (size @ np.abs(parts).T, drift @ parts.T) if len(parts) else (none, none)
            sides = []
            for sign in (-1, 1):
                reach = spread + sign * moved
                best = [reach[:, belongs == i].min(1, initial=np.inf) for i in range(n)]
                sides.append(np.minimum(np.stack(best, 1), most))
            sides = measured(P, sides, v[:, k] @ P.T2.T)
            below.append(sides[0])
            above.append(sides[1])
            if from_start or k > N + 3:
                found.append((size, drift, *sides))
        return found

    def _noise(self, radius: np.ndarray, steps: int, vertices: bool) -> np.ndarray:
        shape = (RUNS, steps, len(radius))
        unit = self.rng.choice([-1.0, 1.0], shape) if vertices else self.rng.uniform(-1, 1, shape)
        return radius * unit

    def _terms(self, below: list, above: list, w: np.ndarray, v: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
        P, N, n = self.problem, self.length, self.problem.n
        unknown = np.zeros((RUNS, n)), np.tile(FAR * self.start, (RUNS, 1))
        boxes = [
            (0.5 * (above[j] - below[j]), 0.5 * (above[j] + below[j])) if j >= 0 else unknown for j in range(k - N, k)
        ]
        off, half = [box[0] for box in boxes], [box[1] for box in boxes]
        none_w, none_v = np.zeros((RUNS, n)), np.zeros((RUNS, P.l))
        drift = [
            *off,
            *(-w[:, j] if j >= 0 else none_w for j in range(k - N, k)),
            *(v[:, j] if j >= 0 else none_v for j in range(k - N, k)),
            v[:, k],
            np.zeros((RUNS, P.q + N * len(P.dd))),
        ]
        return sizes_of_parts(P, half), np.concatenate(drift, 1)


def measured(problem: GainProblem, sides: list[np.ndarray], noise: np.ndarray) -> list[np.ndarray]:
    """Distances of the sides (S, n) once every output of T2 alone has been solved for every state, as each step does.

    Args:
        problem: in some units.
        sides: distances to the lower and the upper side.
        noise: T2 v of the step, (S, q).
    """
    C, below, above = problem.C[: problem.q], *(side.copy() for side in sides)
    radius = 0.5 * np.abs(problem.T2) @ problem.dv
    for j, i in np.argwhere(C):
        others = np.where(np.arange(problem.n) == i, 0.0, C[j])
        plus, minus = np.maximum(others, 0), np.maximum(-others, 0)
        slack = radius[j] + 0.5 * (below + above) @ problem.R[j]
        high = below @ plus + above @ minus + slack + noise[:, j]
        low = above @ plus + below @ minus + slack - noise[:, j]
        high, low = (high, low) if C[j, i] > 0 else (low, high)
        above[:, i] = np.minimum(above[:, i], high / abs(C[j, i]))
        below[:, i] = np.minimum(below[:, i], low / abs(C[j, i]))
    return [below, above]


def sizes_of_parts(problem: GainProblem, half: list[np.ndarray]) -> np.ndarray:
    """What the parts of a row (`WindowProgram.parts`) count, (..., k), for boxes of half widths `half` (..., n), the
    oldest step first."""
    lead = half[-1].shape[:-1]
    w, v, d = (np.broadcast_to(0.5 * width, (*lead, len(width))) for width in (problem.dw, problem.dv, problem.dd))
    of_f = [w + h @ problem.F_radius.T for h in half]
    of_g = [v + h @ problem.E_radius.T for h in half]
    return np.concatenate([*half, *of_f, *of_g, v, half[-1] @ problem.R.T, *[d] * len(half)], -1)
