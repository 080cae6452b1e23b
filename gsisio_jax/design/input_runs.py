"""Simulated runs of an observer that knows how inputs move, in errors (see `window_runs`): what rows are chosen on.

Where a box of x lies about the state is not independent of the noise that a row adds up: the same measurements made it.
Rows that are chosen for independent draws are 1.2 to 2 times as wide on records as those chosen on runs.
"""

from __future__ import annotations

import numpy as np

from gsisio_jax.design.input_program import Sample, moves_of
from gsisio_jax.design.problem import GainProblem
from gsisio_jax.design.window_program import rows_of_gains
from gsisio_jax.design.window_runs import FAR, Measured, Rows
from gsisio_jax.observer.window import Window

_RUNS = 16  # side by side, half of them with noise and moves on their vertices
_SETTLED = 4  # steps from the first whole window on that are not looked at
_STEPS = 12  # that are


class InputRuns:
    """Runs in the units of `problem`.

    Args:
        problem: scaled, see `GainProblem.scaled`.
        states: rows for the boxes of x over `window` steps, see `rows_of_states`.
        window: how many.
        length: N, of rows for inputs.
        move: half widths (p,) of moves; infinite where an input has none.
        block: number of steps within which moves are 0; None: `move` holds at each.
    """

    def __init__(
        self, problem: GainProblem, states: Rows, window: int, length: int, move: np.ndarray, block: int | None
    ):
        self.problem, self.window, self.length, self.block = problem, window, length, block
        self.states, self.of = states.matrix(), [states.of(i) for i in range(problem.n)]
        self.move = move

    def samples(self, rows: Rows, seed: int) -> list[Sample]:
        """Steps of new runs with these rows for inputs; `seed`: of their draws."""
        P, N, M, S = self.problem, self.length, self.window, _RUNS
        n, p, rng = P.n, len(self.move), np.random.default_rng(seed)
        first = max(N, M)
        steps = first + _SETTLED + (2 * self.block if self.block else _STEPS)
        if self.block:
            first += -first % self.block
            steps += self.block
        total = first + steps
        vertices = np.arange(S)[:, None, None] % 2 == 0

        def drawn(radius: np.ndarray) -> np.ndarray:
            shape = (S, total + 1, len(radius))
            return radius * np.where(vertices, rng.choice([-1.0, 1.0], shape), rng.uniform(-1, 1, shape))

        moving = np.isfinite(self.move)
        known = np.where(moving, self.move, 0.0)
        w, v, moves = drawn(P.dw / 2), drawn(P.dv / 2), drawn(known)
        half, off = np.full((S, total, n), FAR), np.zeros((S, total, n))
        half[:, first - 1] = 1.5
        d_half, d_off = np.full((S, total, p), FAR), np.zeros((S, total, p))
        parts, looked = rows.matrix(), Measured(P)
        size_of = np.abs(parts).T
        moved_at, lags = moves_of(parts, N, p), np.arange(-1, N)
        targets, most = np.array(rows.states), np.full((S, n), FAR)
        most[:, P.bounded_states] = P.ds / 2
        found = []
        for k in range(first, total):
            last, phase = slice(k - N, k), (k - 1) % self.block if self.block else 0
            below, above = self._states(half, off, w, v, k, most.copy())
            below, above = looked([below, above], v[:, k] @ P.T2.T)
            half[:, k], off[:, k] = (above + below) / 2, (above - below) / 2
            # d[k-1]: from d[k-2] and its move, then from every row that may be used.
            inside = not self.block or phase > 0
            d_below, d_above = (
                np.where(moving & inside, d_half[:, k - 2] + sign * d_off[:, k - 2] + known, FAR) for sign in (-1, 1)
            )
            d_below, d_above = d_below + moves[:, k - 1], d_above - moves[:, k - 1]
            d_half[:, k - 1], d_off[:, k - 1] = (d_above + d_below) / 2, (d_above - d_below) / 2
            spread = [0.5 * P.dw + half[:, last] @ P.F_radius.T, 0.5 * P.dv + half[:, k - N : k + 1] @ P.E_radius.T]
            older = np.clip(np.arange(k - N, k), None, k - 2)
            ones = np.ones((S, N + 1, 1))
            size = [half[:, k - N : k + 1], *spread, ones * known, d_half[:, older]]
            drift = [off[:, k - N : k + 1], w[:, last], v[:, k - N : k + 1], moves[:, k - N : k + 1], -d_off[:, older]]
            size, drift = (np.concatenate([b.reshape(S, -1) for b in blocks], 1) for blocks in (size, drift))
            usable = np.ones(len(parts), bool)
            if self.block:
                usable = ~(moved_at & ((phase - lags) % self.block == 0)).any(1)
            wide, moved = size @ size_of, drift @ parts.T
            for j in range(p):
                places = np.flatnonzero(usable & (targets == j))
                d_above[:, j] = np.minimum(d_above[:, j], (wide + moved)[:, places].min(1, initial=np.inf))
                d_below[:, j] = np.minimum(d_below[:, j], (wide - moved)[:, places].min(1, initial=np.inf))
            d_half[:, k - 1], d_off[:, k - 1] = (d_above + d_below) / 2, (d_above - d_below) / 2
            # The plant's equation takes it on to x[k].
            center = off[:, k - 1] @ P.F.T + d_off[:, k - 1] @ P.G.T - w[:, k - 1]
            radius = half[:, k - 1] @ (np.abs(P.F) + P.F_radius).T + d_half[:, k - 1] @ np.abs(P.G).T + 0.5 * P.dw
            below, above = np.minimum(below, radius - center), np.minimum(above, radius + center)
            half[:, k], off[:, k] = (above + below) / 2, (above - below) / 2
            if k >= first + max(N, M) + _SETTLED if not self.block else k >= total - 2 * self.block:
                found.append(Sample(phase, size, drift))
        return found

    def _states(
        self, half: np.ndarray, off: np.ndarray, w: np.ndarray, v: np.ndarray, k: int, most: np.ndarray
    ) -> list:
        """Distances (S, n) of both sides of the box of x[k] by the rows for states."""
        P, M, S = self.problem, self.window, len(half)
        last = slice(k - M, k)
        bounded = np.tile(0.5 * P.dd, (S, M))
        of_f, of_g = 0.5 * P.dw + half[:, last] @ P.F_radius.T, 0.5 * P.dv + half[:, last] @ P.E_radius.T
        blocks = [half[:, last], of_f, of_g, np.broadcast_to(0.5 * P.dv, (S, P.l)), half[:, k - 1] @ P.R.T, bounded]
        size = np.concatenate([b.reshape(S, -1) for b in blocks], 1)
        blocks = [off[:, last], -w[:, last], v[:, last], v[:, k], np.zeros((S, P.q)), 0 * bounded]
        drift = np.concatenate([b.reshape(S, -1) for b in blocks], 1)
        spread, moved = size @ np.abs(self.states).T, drift @ self.states.T
        sides = [most, most.copy()]
        for side, reach in zip(sides, (spread - moved, spread + moved), strict=True):
            for i, places in enumerate(self.of):
                side[:, i] = np.minimum(side[:, i], reach[:, places].min(1, initial=np.inf))
        return sides


def rows_of_states(
    problem: GainProblem, gains: list[np.ndarray], window: Window | None, x: np.ndarray
) -> tuple[Rows, int]:
    """The gains of a bank and the rows of a window in the units of ``problem.scaled(x)``, and over how many steps.

    Args:
        problem: of the design, not scaled.
        gains: (n, columns) each.
        window: None where there is none.
        x: units (n,).
    """
    scaled, length = problem.scaled(x), 1 if window is None else window.length
    rows = rows_of_gains(scaled, [problem.scaled_gain(N, x) for N in gains], length)
    if window is None:
        return rows, length
    y, bounded = problem.output_units, ~problem.free
    own, n = x[list(window.targets)][:, None], problem.n
    oldest_first = [step / own for step in np.asarray(window.multipliers)[::-1]]
    of_f, of_g = (
        [step[:, part] * unit for step in oldest_first] for part, unit in ((slice(n), x), (slice(n, None), -y))
    )
    remainder = np.asarray(window.remainder) * (np.abs(problem.T2) @ y) / own
    known = [step * problem.input_units(x)[bounded] / own for step in np.asarray(window.known)[::-1]]
    before = [np.zeros_like(of_f[0]), *of_f[:-1]]
    slopes = [f @ scaled.F - a @ scaled.E - b for f, a, b in zip(of_f, of_g, before, strict=True)]
    parts = np.concatenate([*slopes, *of_f, *of_g, remainder @ scaled.T2, remainder, *known], 1)
    for state, row in zip(window.targets, parts, strict=True):
        rows.add(state, row)
    return rows, length
