"""Rows over windows of several steps, chosen offline (theory 5.7).

For a state and a profile of box widths the best row is a linear program, and so it is for one simulated run: then it is
the dual of the exact program over that window, so its row is exact for that run. Rows are collected from simulated
runs, and those are kept that a fresh set of runs profits from.
"""

from __future__ import annotations

import numpy as np

from gsisio_jax.design.problem import GainProblem
from gsisio_jax.design.window_program import WindowProgram
from gsisio_jax.design.window_runs import FAR, RUNS, Rows, Runs, sizes_of_parts
from gsisio_jax.observer.window import Window

_SAMPLES = 24  # steps of a round for which exact rows are asked
_MOST_ROWS = 16  # of a state
_LEAST_GAIN = 2e-3  # share of the width that one more row must bring
_TRIED = (3, 5)  # windows that "auto" looks at
_WORTH = 0.05  # share of the width of some state that a window must bring to be worth its operations


def window_rows(problem: GainProblem, length: int | str, width: np.ndarray, seed: int = 0) -> Window | None:
    """The rows of a bank over windows of 1 to `length` steps.

    Args:
        problem: of the design, on its region.
        length: N >= 2; "auto" takes the shortest window that is worth it on simulated runs, or none.
        width: (n,) typical widths of boxes; a first guess.
        seed: of the simulated runs.

    Returns:
        The window without what rounding leaves of its rows (see `with_rounding_constants`); None where no row exists.
    """
    scaled = problem.scaled(width)
    if isinstance(length, int):
        found = _collected(scaled, length, seed)
        return None if found is None else as_window(problem, length, *found, width)
    rows, half = _profile_rows(scaled, 1)
    reached, chosen = _widths(scaled, 1, rows, half, seed), None
    for steps in _TRIED:
        found = _collected(scaled, steps, seed)
        if found is None:
            continue
        narrower = _widths(scaled, steps, found[0].kept(found[1]), half, seed)
        if (narrower < (1 - _WORTH) * reached).any():
            reached, chosen = np.minimum(narrower, reached), (steps, *found)
    return None if chosen is None else as_window(problem, *chosen, width)


def _collected(problem: GainProblem, length: int, seed: int) -> tuple[Rows, list[int]] | None:
    """Rows of simulated runs, and which of them to keep."""
    rng = np.random.default_rng(seed)
    rows, half = _profile_rows(problem, length)
    if not rows.parts:
        return None
    whole = WindowProgram.of(problem, length, length)
    runs = Runs(problem, length, 3 * half, rng)
    for vertices in (True, False):
        steps = runs.of(rows, vertices)
        for _ in range(_SAMPLES):
            size, drift, below, above = steps[rng.integers(len(steps))]
            s = rng.integers(RUNS)
            for state in range(problem.n):
                for sign, now in ((-1, below[s, state]), (1, above[s, state])):
                    found = whole.best(state, size[s], sign * drift[s])
                    if found is not None and found[1] < now * (1 - 1e-3):
                        rows.add(state, found[0])
    return rows, _useful(rows, [*runs.of(rows, True), *runs.of(rows, False)], problem.n)


def _widths(problem: GainProblem, length: int, rows: Rows, half: np.ndarray, seed: int) -> np.ndarray:
    """Mean widths (n,) of the last steps of runs with these rows, noise uniform: at its vertices, every row that has
    some component of it cuts half of a box away."""
    runs = Runs(problem, length, 3 * half, np.random.default_rng(seed + 1))
    return np.mean([below + above for _, _, below, above in runs.of(rows, False)[-8:]], (0, 1))


def _profile_rows(problem: GainProblem, length: int) -> tuple[Rows, np.ndarray]:
    """The best rows over every window for boxes of the widths that they themselves lead to."""
    rows, half = Rows([], []), np.full(problem.n, 0.5)
    for steps in range(1, length + 1):
        program = WindowProgram.of(problem, steps, length)
        best = []
        for _ in range(30 if steps == 1 else 3):
            size = sizes_of_parts(problem, [half] * length)
            best = [program.best(state, size, np.zeros_like(size)) for state in range(problem.n)]
            reached = np.array([np.inf if row is None else row[1] for row in best])
            reached = np.minimum(reached, FAR)
            settled = np.allclose(reached, half, rtol=1e-3)
            half = np.maximum(reached, 1e-12)
            if settled:
                break
        for state, row in enumerate(best):
            if row is not None:
                rows.add(state, row[0])
    return rows, half


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


def as_window(
    problem: GainProblem, length: int, rows: Rows, kept: list[int], x: np.ndarray, shortened: bool = True
) -> Window:
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
    if shortened:
        N = max(1, int(depth.max()))  # older steps are in no row that was kept
    multipliers, remainder = multipliers[:N, order], remainder[order]
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
