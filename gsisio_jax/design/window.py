"""Rows over windows of several steps, chosen offline (theory 5.7).

For a state and a profile of box widths the best row is a linear program, and so it is for one simulated run: then it is
the dual of the exact program over that window, so its row is exact for that run. Rows are collected from simulated
runs, and those are kept that a fresh set of runs profits from.
"""

from __future__ import annotations

import numpy as np

from gsisio_jax.design.problem import GainProblem
from gsisio_jax.design.window_program import WindowProgram, rows_of_gains
from gsisio_jax.design.window_runs import FAR, RUNS, Rows, Runs, measured, sizes_of_parts
from gsisio_jax.observer.window import Window

_ROUNDS, _SAMPLES = 4, 6  # rounds, each of runs with all rows so far; steps of a round for which exact rows are asked
_MOST_ROWS = 16  # of a state
_LEAST_GAIN = 2e-3  # share of the width that one more row must bring
_TRIED = (3, 5)  # windows that "auto" looks at
_WORTH = 0.05  # share of the width of some state that a window must bring to be worth its operations
_LOOKS = 8  # steps for which "auto" asks what a window could bring
_SETTLING = 300  # rounds of widths, at most
_MOST_STATES = 10  # beyond, the programs of "auto" would take too long
_SMALL_STATES = 6  # up to so many all samples are taken; beyond fewer, as there are more and larger programs a sample


def window_rows(
    problem: GainProblem, length: int | str, width: np.ndarray, gains: list[np.ndarray], seed: int = 0
) -> Window | None:
    """The rows of a bank over windows of 1 to `length` steps.

    Args:
        problem: of the design, on its region.
        length: N >= 2; "auto" takes the shortest window that is worth it on simulated runs, or none.
        width: (n,) typical widths of boxes; a first guess.
        gains: the bank of one step, (n, columns) each: what its rows say already, no row of a window need say.
        seed: of the simulated runs.

    Returns:
        The window without what rounding leaves of its rows (see `with_rounding_constants`); None where no row exists.
    """
    scaled = problem.scaled(width)
    if isinstance(length, int):
        search = _Search(scaled, length, [problem.scaled_gain(N, width) for N in gains], seed)
        kept = search.collected(length, _ROUNDS)
        return as_window(problem, length, search.rows, kept, width) if kept else None
    if problem.n > _MOST_STATES:
        return None
    # On narrow boxes slopes vary less than on the region: the truth lies between the two.
    for sizes in [scaled, scaled.with_fixed_slopes()] if scaled.nonlinear else [scaled]:
        found = _worth_it(sizes, [problem.scaled_gain(N, width) for N in gains], seed)
        window = None if found is None else as_window(problem, max(_TRIED), *found, width)
        if window is not None and window.length > 1:  # rows of one step only are what `gains` is for
            return window
    return None


def _worth_it(problem: GainProblem, gains: list[np.ndarray], seed: int) -> tuple[Rows, list[int]] | None:
    """Rows over the shortest window that is worth it, and which of them to keep."""
    search = _Search(problem, max(_TRIED), gains, seed)
    if not (search.settles_narrower(max(_TRIED)) or search.could_bring(max(_TRIED), [])):
        return None
    steps = _TRIED[0]
    kept = search.collected(steps, 1)
    for longer in _TRIED[1:]:
        if search.could_bring(longer, kept, steps):
            steps = longer
    kept = search.collected(steps, _ROUNDS - 1)
    narrower = search.widths(kept) < (1 - _WORTH) * search.widths([])
    settles = search.settled(search.with_gains(kept)) < (1 - _WORTH) * search.settled(search.with_gains([]))
    return (search.rows, kept) if (narrower | settles).any() else None


class _Search:
    """Rows over windows of up to `length` steps, found on simulated runs of an observer that has a bank of gains.

    Attributes:
        rows: those of the gains first, then all that were found.
        own: how many of them are of the gains; every run uses them, and none of them is kept.
    """

    def __init__(self, problem: GainProblem, length: int, gains: list[np.ndarray], seed: int):
        self.problem, self.length, self.seed = problem, length, seed
        self.rng = np.random.default_rng(seed)
        self.rows = rows_of_gains(problem, gains, length)
        self.own = len(self.rows.parts)
        self.half = np.full(problem.n, 0.5)

    def runs(self, seed: int) -> Runs:
        return Runs(self.problem, self.length, 3 * self.half, np.random.default_rng(seed))

    def collected(self, steps: int, rounds: int) -> list[int]:
        """Looks for rows over up to that many steps, and says which ones to keep."""
        rng, n = self.rng, self.problem.n
        samples = max(2, round(_SAMPLES * min(1.0, _SMALL_STATES / n) ** 2))
        self.half = _add_profile_rows(self.problem, steps, self.length, self.rows)
        if not self.rows.parts:
            return []
        whole = WindowProgram.of(self.problem, steps, self.length)
        runs = Runs(self.problem, self.length, 3 * self.half, rng)
        for _ in range(rounds):
            for vertices in (True, False):
                found = runs.of(self.rows, vertices)
                for _ in range(samples):
                    size, drift, *sides = found[rng.integers(len(found))]
                    s = rng.integers(RUNS)
                    for state in range(n):
                        for sign, now in zip((-1, 1), sides, strict=True):
                            best = whole.best(state, size[s], sign * drift[s])
                            if best is not None and best[1] < now[s, state] * (1 - 1e-3):
                                self.rows.add(state, best[0])
        return self._useful([*runs.of(self.rows, True), *runs.of(self.rows, False)])

    def could_bring(self, steps: int, kept: list[int], than: int = 0) -> bool:
        """Whether exact rows over so many steps would narrow some state by what is worth it, in runs with these rows:
        narrower than their boxes, or than exact rows over `than` steps make them."""
        exact, other = (WindowProgram.of(self.problem, count or steps, self.length) for count in (steps, than))
        runs, rng = self.runs(self.seed + 2).of(self.with_gains(kept), False), np.random.default_rng(self.seed)
        looks = [runs[j] for j in np.linspace(0, len(runs) - 1, _LOOKS).astype(int)]
        for state in range(self.problem.n):
            now = best = 0.0
            for size, drift, *sides in looks:
                s = rng.integers(RUNS)
                for sign, side in zip((-1, 1), sides, strict=True):
                    reached = [side[s, state]]
                    for program in (other, exact) if than else (exact,):
                        row = program.best(state, size[s], sign * drift[s])
                        reached.append(min(reached[-1], np.inf if row is None else row[1]))
                    now, best = now + reached[-2], best + reached[-1]
            if best < (1 - _WORTH) * now:
                return True
        return False

    def settles_narrower(self, steps: int) -> bool:
        """Whether the best rows for the widths that they lead to make some state settle at what is worth it: little a
        step is much in the end, where boxes shrink slowly."""
        program, rows = WindowProgram.of(self.problem, steps, self.length), self.with_gains([])
        before = half = self.settled(rows)
        for _ in range(2):
            size = sizes_of_parts(self.problem, [half] * self.length)
            for state in range(self.problem.n):
                found = program.best(state, size, np.zeros_like(size))
                if found is not None:
                    rows.add(state, found[0])
            half = self.settled(rows)
            if (half < (1 - _WORTH) * before).any():
                return True
        return False

    def settled(self, rows: Rows) -> np.ndarray:
        """Half the widths (n,) that boxes settle at or below, if they begin at the units of the problem."""
        parts, states = np.abs(rows.matrix()), np.array(rows.states)
        half = np.full(self.problem.n, 0.5)
        for _ in range(_SETTLING if len(parts) else 0):
            reach = parts @ sizes_of_parts(self.problem, [half] * self.length)
            least = [reach[states == i].min(initial=np.inf) for i in range(self.problem.n)]
            sides = [np.minimum(half, least)[None]] * 2
            half, before = measured(self.problem, sides, np.zeros((1, self.problem.q)))[0][0], half
            if (before - half <= 1e-4 * before).all():
                break
        return half

    def widths(self, kept: list[int]) -> np.ndarray:
        """Mean widths (n,) of the last steps of runs with these rows, noise uniform: at its vertices, every row that
        has some component of it cuts half of a box away."""
        runs = self.runs(self.seed + 1).of(self.with_gains(kept), False)
        return np.mean([below + above for _, _, below, above in runs[-8:]], (0, 1))

    def with_gains(self, kept: list[int]) -> Rows:
        return self.rows.kept([*range(self.own), *kept])

    def _useful(self, steps: list) -> list[int]:
        """Row by row what helps most on these runs, beside the gains, as long as it helps. Narrow boxes count as much
        as wide ones: in relation to the exact hull they are what is hardest."""
        parts = self.rows.matrix()
        size, drift = np.concatenate([step[0] for step in steps]), np.concatenate([step[1] for step in steps])
        spread, moved = size @ np.abs(parts).T, drift @ parts.T
        above, below = spread + moved, spread - moved
        kept: list[int] = []
        for state in range(self.problem.n):
            places = self.rows.of(state)
            own, places = places[places < self.own], places[places >= self.own]
            up, down = (side[:, own].min(1, initial=FAR) for side in (above, below))
            score = np.log(np.maximum(up + down, 1e-12)).mean()
            for _ in range(min(_MOST_ROWS, len(places))):
                tried = np.minimum(up[:, None], above[:, places]) + np.minimum(down[:, None], below[:, places])
                scores = np.log(np.maximum(tried, 1e-12)).mean(0)
                best = int(np.argmin(scores))
                if not scores[best] < score - _LEAST_GAIN:
                    break
                score = scores[best]
                kept.append(int(places[best]))
                up, down = np.minimum(up, above[:, places[best]]), np.minimum(down, below[:, places[best]])
        return kept


def _add_profile_rows(problem: GainProblem, steps: int, length: int, rows: Rows) -> np.ndarray:
    """Adds the best rows over every window for boxes of the widths that they themselves lead to, and says these."""
    half = np.full(problem.n, 0.5)
    for count in range(1, steps + 1):
        program = WindowProgram.of(problem, count, length)
        best = []
        for _ in range(30 if count == 1 else 3):
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
    return half


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
    y = problem.output_units
    z = np.abs(problem.T2) @ y
    of_f = own[None] * of_f.reshape(R, N, n).transpose(1, 0, 2)[::-1] / x
    of_g = own[None] * of_g.reshape(R, N, l).transpose(1, 0, 2)[::-1] / y
    multipliers = np.concatenate([of_f, -of_g], axis=2)
    remainder = own * remainder / z
    if shortened:
        multipliers = multipliers[: max(1, int(_depths(multipliers).max()))]  # older steps are in no row that was kept
    return deepest_first(problem, multipliers, remainder, targets)


def deepest_first(problem: GainProblem, multipliers: np.ndarray, remainder: np.ndarray, targets: list[int]) -> Window:
    """Rows in the units of the plant as a window, without what rounding leaves: those that look back farthest come
    first, so that those of a lag are the first ones."""
    N, R = multipliers.shape[:2]
    depth = _depths(multipliers)
    order = np.argsort(-depth, kind="stable")
    multipliers = multipliers[:, order]
    stacked = np.vstack([problem.G, problem.H])
    return Window(
        multipliers=multipliers,
        output=np.zeros((R, problem.l)),
        remainder=remainder[order],
        known=(multipliers @ stacked)[:, :, ~problem.free],
        left_x=np.zeros((R, problem.n)),
        left_d=np.zeros((N, R, stacked.shape[1])),
        targets=tuple(targets[r] for r in order),
        counts=tuple(int((depth > lag).sum()) for lag in range(N)),
    )


def _depths(multipliers: np.ndarray) -> np.ndarray:
    """How many steps the rows (R,) look back."""
    return np.array([np.flatnonzero(row).max(initial=-1) + 1 for row in (multipliers != 0).any(-1).T])
