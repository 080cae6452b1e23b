"""Rows over windows of several steps: which linear combinations of the plant's equations bound a state most tightly.

For a state and a profile of box widths the best row is a linear program, and so it is for one simulated run: then it is
the dual of the exact program over that window, so its row is exact for that run. Rows are collected from simulated
runs, and those are kept that a fresh set of runs profits from (theory 5.7).

A run is simulated in errors: how far the sides of a box are from the true state depends on the noise and on the boxes
before, and on nothing else where f and g are affine. Where they are not, the spread of their slopes counts as noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.optimize import linprog

from gsisio_jax.design.problem import GainProblem
from gsisio_jax.observer.window import Window

_SMALL = 1e-9  # multipliers below this are what a solver leaves, in units of the noise and the boxes
_FAR = 1e6  # steady widths beyond this many units are not waited for
_RUNS, _STEPS = 12, 20
_SAMPLES = 24  # steps of a round for which exact rows are asked
_MOST_ROWS = 16  # of a state
_LEAST_GAIN = 2e-3  # share of the width that one more row must bring


@dataclass(frozen=True)
class WindowProgram:
    """Everything that a row over m steps is made of, as linear in its unknowns (a of every step, lambda, n_z).

    Attributes:
        parts: (k, unknowns), with `offset` (k, n) for each state: slopes on the boxes of x, lambda, a, ``n_z T2``, n_z,
            and what is left of bounded inputs; blocks over N steps, the oldest first.
        equal: (e, unknowns), with `equal_offset` (e, n): must vanish, so that free inputs cancel.
        multipliers: places of lambda in `parts`.
    """

    parts: np.ndarray
    offset: np.ndarray
    equal: np.ndarray
    equal_offset: np.ndarray

    @classmethod
    def of(cls, problem: GainProblem, steps: int, length: int) -> WindowProgram:
        """Rows over the last `steps` of `length` steps: nothing is asked of the older ones."""
        n, l, q = problem.n, problem.l, problem.q
        F, E, C, G, H = problem.F, problem.E, problem.C[:q], problem.G, problem.H
        count = steps * l + (steps - 1) * n + q
        unknown = np.eye(count)
        a = [unknown[j * l : (j + 1) * l] for j in range(steps)]
        states = unknown[steps * l : steps * l + (steps - 1) * n].reshape(steps - 1, n, count)
        n_z = unknown[count - q :]
        none, whole = np.zeros((n, count)), np.zeros((n, n))
        # lambda_j for j = 0 (0), ..., steps (e_i - C' n_z).
        weights = [none, *states, -C.T @ n_z]
        constant = [whole] * steps + [np.eye(n)]
        slopes, of_f, of_g, offsets, equal, equal_offset, known, known_offset = [], [], [], [], [], [], [], []
        for j in range(steps):
            slopes.append(F.T @ weights[j + 1] - weights[j] - E.T @ a[j])
            offsets.append(F.T @ constant[j + 1] - constant[j])
            of_f.append(weights[j + 1])
            of_g.append(a[j])
            through, through_offset = G.T @ weights[j + 1] - H.T @ a[j], G.T @ constant[j + 1]
            equal.append(through[problem.free])
            equal_offset.append(through_offset[problem.free])
            known.append(through[~problem.free])
            known_offset.append(through_offset[~problem.free])
        older = length - steps

        def blocks(found: list[np.ndarray], rows: int, columns: int) -> list[np.ndarray]:
            return [np.zeros((rows, columns))] * older + found

        b = int((~problem.free).sum())
        parts = [
            *blocks(slopes, n, count), *blocks(of_f, n, count), *blocks(of_g, l, count),
            problem.T2.T @ n_z, n_z, *blocks(known, b, count),
        ]  # fmt: skip
        offset = [
            *blocks(offsets, n, n), *blocks(constant[1:], n, n), *[np.zeros((l, n))] * length,
            np.zeros((l, n)), np.zeros((q, n)), *blocks(known_offset, b, n),
        ]  # fmt: skip
        return cls(np.vstack(parts), np.vstack(offset), np.vstack(equal), np.vstack(equal_offset))

    def best(self, state: int, size: np.ndarray, drift: np.ndarray) -> tuple[np.ndarray, float] | None:
        """The parts of the row with the least ``size |parts| + drift parts``, and that; None where there is none."""
        k, count = self.parts.shape
        split = [sparse.csr_array(self.parts), -sparse.eye_array(k), sparse.eye_array(k)]
        rows = sparse.hstack(split)
        if len(self.equal):
            rows = sparse.vstack([rows, sparse.hstack([self.equal, sparse.csr_array((len(self.equal), 2 * k))])])
        found = linprog(
            np.concatenate([np.zeros(count), size + drift, size - drift]),
            A_eq=sparse.csc_array(rows),
            b_eq=-np.concatenate([self.offset[:, state], self.equal_offset[:, state]]),
            bounds=[(None, None)] * count + [(0, None)] * (2 * k),
            method="highs-ds",
        )
        if found.status != 0:
            return None
        x = self._exactly_free(found.x[:count], state)
        if x is None:
            return None
        parts = self.parts @ x + self.offset[:, state]
        parts[np.abs(parts) < _SMALL] = 0
        return parts, found.fun

    def _exactly_free(self, x: np.ndarray, state: int) -> np.ndarray | None:
        """Small multipliers are 0, and the others moved so that free inputs cancel to rounding."""
        used = np.abs(x) > _SMALL
        x = np.where(used, x, 0.0)
        if len(self.equal):
            missing = -self.equal_offset[:, state] - self.equal @ x
            x[used] += np.linalg.lstsq(self.equal[:, used], missing, rcond=None)[0]
            if np.abs(self.equal @ x + self.equal_offset[:, state]).max() > _SMALL:
                return None
        return x


@dataclass
class Rows:
    """Rows found so far: parts (R, k) over `length` steps, and the state of each."""

    parts: list[np.ndarray]
    states: list[int]

    def add(self, state: int, parts: np.ndarray) -> None:
        """Unless it is there."""
        same = (
            np.allclose(parts, old, atol=1e-7) for old, of in zip(self.parts, self.states, strict=True) if of == state
        )
        if not any(same):
            self.parts.append(parts)
            self.states.append(state)

    def of(self, state: int) -> np.ndarray:
        return np.flatnonzero(np.array(self.states) == state)


class Runs:
    """Simulated runs of the observer in errors, `_RUNS` side by side: distances (S, n) of both sides from the state."""

    def __init__(self, problem: GainProblem, length: int, start: np.ndarray, rng: np.random.Generator):
        self.problem, self.length, self.start, self.rng = problem, length, start, rng

    def of(self, rows: Rows, vertices: bool) -> list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
        """For every step with a whole window: sizes and drifts (S, k) of the parts of a row, and the distances to the
        lower and the upper side (S, n)."""
        P, N, n = self.problem, self.length, self.problem.n
        total = N + _STEPS
        w, v = self._noise(P.dw / 2, total, vertices), self._noise(P.dv / 2, total, vertices)
        below, above = [np.tile(self.start, (_RUNS, 1))], [np.tile(self.start, (_RUNS, 1))]
        parts = np.array(rows.parts)
        belongs = np.array(rows.states)
        found = []
        for k in range(1, total):
            size, drift = self._terms(below, above, w, v, k)
            spread, moved = size @ np.abs(parts).T, drift @ parts.T
            sides = []
            for sign in (-1, 1):
                reach = spread + sign * moved
                best = [reach[:, belongs == i].min(1, initial=np.inf) for i in range(n)]
                sides.append(np.minimum(np.stack(best, 1), _FAR * self.start))
            below.append(sides[0])
            above.append(sides[1])
            if k > N + 3:
                found.append((size, drift, *sides))
        return found

    def _noise(self, radius: np.ndarray, steps: int, vertices: bool) -> np.ndarray:
        shape = (_RUNS, steps, len(radius))
        unit = self.rng.choice([-1.0, 1.0], shape) if vertices else self.rng.uniform(-1, 1, shape)
        return radius * unit

    def _terms(self, below: list, above: list, w: np.ndarray, v: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
        P, N, n = self.problem, self.length, self.problem.n
        unknown = np.zeros((_RUNS, n)), np.tile(_FAR * self.start, (_RUNS, 1))
        boxes = [
            (0.5 * (above[j] - below[j]), 0.5 * (above[j] + below[j])) if j >= 0 else unknown for j in range(k - N, k)
        ]
        off, half = [box[0] for box in boxes], [box[1] for box in boxes]
        none_w, none_v = np.zeros((_RUNS, n)), np.zeros((_RUNS, P.l))
        of_f = [P.dw / 2 + h @ P.F_radius.T for h in half]
        of_g = [P.dv / 2 + h @ P.E_radius.T for h in half]
        of_z = half[-1] @ P.R.T
        known = np.tile(P.dd / 2, (_RUNS, N))
        size = [*half, *of_f, *of_g, np.tile(P.dv / 2, (_RUNS, 1)), of_z, known]
        drift = [
            *off,
            *(-w[:, j] if j >= 0 else none_w for j in range(k - N, k)),
            *(v[:, j] if j >= 0 else none_v for j in range(k - N, k)),
            v[:, k],
            np.zeros_like(of_z),
            np.zeros_like(known),
        ]
        return np.concatenate(size, 1), np.concatenate(drift, 1)


def window_rows(problem: GainProblem, length: int, width: np.ndarray, seed: int = 0) -> Window | None:
    """The rows of a bank over windows of 1 to `length` steps.

    Args:
        problem: of the design, on its region.
        length: N >= 2.
        width: (n,) typical widths of boxes; a first guess.
        seed: of the simulated runs.

    Returns:
        The window without what rounding leaves of its rows (see `with_rounding_constants`); None where no row exists.
    """
    scaled = problem.scaled(width)
    rng = np.random.default_rng(seed)
    rows, half = _profile_rows(scaled, length)
    if not rows.parts:
        return None
    whole = WindowProgram.of(scaled, length, length)
    runs = Runs(scaled, length, 3 * half, rng)
    for vertices in (True, False):
        steps = runs.of(rows, vertices)
        for _ in range(_SAMPLES):
            size, drift, below, above = steps[rng.integers(len(steps))]
            s = rng.integers(_RUNS)
            for state in range(scaled.n):
                for sign, now in ((-1, below[s, state]), (1, above[s, state])):
                    found = whole.best(state, size[s], sign * drift[s])
                    if found is not None and found[1] < now * (1 - 1e-3):
                        rows.add(state, found[0])
    kept = _useful(rows, [*runs.of(rows, True), *runs.of(rows, False)], scaled.n)
    return _as_window(problem, length, rows, kept, width)


def _profile_rows(problem: GainProblem, length: int) -> tuple[Rows, np.ndarray]:
    """The best rows over every window for boxes of the widths that they themselves lead to."""
    rows, half = Rows([], []), np.full(problem.n, 0.5)
    for steps in range(1, length + 1):
        program = WindowProgram.of(problem, steps, length)
        best = []
        for _ in range(30 if steps == 1 else 3):
            size = _profile(problem, length, half)
            best = [program.best(state, size, np.zeros_like(size)) for state in range(problem.n)]
            reached = np.array([np.inf if row is None else row[1] for row in best])
            reached = np.minimum(reached, _FAR)
            settled = np.allclose(reached, half, rtol=1e-3)
            half = np.maximum(reached, 1e-12)
            if settled:
                break
        for state, row in enumerate(best):
            if row is not None:
                rows.add(state, row[0])
    return rows, half


def _profile(problem: GainProblem, length: int, half: np.ndarray) -> np.ndarray:
    of_f, of_g = problem.dw / 2 + problem.F_radius @ half, problem.dv / 2 + problem.E_radius @ half
    return np.concatenate(
        [
            np.tile(half, length), np.tile(of_f, length), np.tile(of_g, length), problem.dv / 2, problem.R @ half,
            np.tile(problem.dd / 2, length),
        ]
    )  # fmt: skip


def _useful(rows: Rows, steps: list, n: int) -> list[int]:
    """Row by row what helps most on these runs, as long as it helps."""
    parts = np.array(rows.parts)
    size, drift = np.concatenate([step[0] for step in steps]), np.concatenate([step[1] for step in steps])
    spread, moved = size @ np.abs(parts).T, drift @ parts.T
    above, below = spread + moved, spread - moved
    kept: list[int] = []
    for state in range(n):
        places = rows.of(state)
        up, down = np.full(len(size), np.inf), np.full(len(size), np.inf)
        for _ in range(min(_MOST_ROWS, len(places))):
            tried = np.minimum(up[:, None], above[:, places]) + np.minimum(down[:, None], below[:, places])
            best = int(np.argmin(tried.mean(0)))
            if not tried[:, best].mean() < (up + down).mean() * (1 - _LEAST_GAIN):
                break
            kept.append(int(places[best]))
            up, down = np.minimum(up, above[:, places[best]]), np.minimum(down, below[:, places[best]])
    return kept


def _as_window(problem: GainProblem, length: int, rows: Rows, kept: list[int], x: np.ndarray) -> Window:
    """The kept rows in the units of the plant, newest step first; see `GainProblem.scaled`."""
    n, l, q, N, R = problem.n, problem.l, problem.q, length, len(kept)
    b = int((~problem.free).sum())
    parts = np.array([rows.parts[r] for r in kept])
    targets = [rows.states[r] for r in kept]
    sizes = [N * n, N * n, N * l, l, q, N * b]
    _, of_f, of_g, _, remainder, _ = np.split(parts, np.cumsum(sizes)[:-1], axis=1)
    own = x[targets][:, None]
    y = np.where(problem.dv > 0, problem.dv, 1.0)
    z = np.abs(problem.T2) @ y
    of_f = own[None] * of_f.reshape(R, N, n).transpose(1, 0, 2)[::-1] / x
    of_g = own[None] * of_g.reshape(R, N, l).transpose(1, 0, 2)[::-1] / y
    multipliers = np.concatenate([of_f, -of_g], axis=2)
    remainder = own * remainder / z
    # Rows that look back farthest come first, so that those of a lag are the first ones.
    depth = np.array([max(np.flatnonzero((multipliers[:, r] != 0).any(-1)), default=-1) + 1 for r in range(R)])
    order = np.argsort(-depth, kind="stable")
    multipliers, remainder = multipliers[:, order], remainder[order]
    stacked = np.vstack([problem.G, problem.H])
    return Window(
        multipliers=multipliers,
        output=np.zeros((R, l)),
        remainder=remainder,
        known=(multipliers @ stacked)[:, :, ~problem.free],
        left_x=np.zeros((R, n)),
        left_d=np.zeros((N, R, stacked.shape[1])),
        targets=tuple(targets[r] for r in order),
        counts=tuple(int((depth > lag).sum()) for lag in range(N)),
    )
