"""The search for rows over several steps on simulated runs (theory 5.7): what is found, and which of it is kept."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from gsisio_jax.design.problem import GainProblem
from gsisio_jax.design.window_program import WindowProgram, best_rows, rows_of_gains
from gsisio_jax.design.window_runs import FAR, RUNS, Measured, Rows, Runs, mean_log_width, sizes_of_parts

WORTH = 0.05  # share of the width of some state that a window must bring to be worth its operations
_SAMPLES = 6  # steps of a round of runs for which exact rows are asked
_ROUNDS_EARLY = 2  # of runs from the region's width
_MOST_ROWS = 16  # of a state
_EVERY = 5  # lengths up to this are all looked at for rows of typical widths
_LEAST_GAIN = 2e-3  # share of the width that one more row must bring
_EARLY = 10  # steps from the region's width, in which boxes have not settled yet
_WORTH_EARLY = 0.2  # share of the width there that a window must bring, which costs its operations in all later steps
_LEAST_EARLY = 1e-2  # share of the width there that one more row must bring
_LOOKS = 8  # steps for which "auto" asks what a window could bring
_SETTLING = 300  # rounds of widths, at most
_GAIN_LAGS = 8  # rows of a window that cost as much as a row of a gain, for every step that they look back
_CARRIED = 0.2  # share of the time of a step that the bounds of older steps cost, however few the rows
_SMALL_STATES = 6  # up to so many all samples are taken; beyond fewer, as there are more and larger programs a sample


class Search:
    """Rows over windows of up to `length` steps, found on simulated runs of an observer that has a bank of gains.

    Attributes:
        rows: those of the gains first, then all that were found.
        own: how many of them are of the gains; every run uses them, and none of them is kept.
    """

    def __init__(self, problem: GainProblem, length: int, gains: list[np.ndarray], start: np.ndarray, seed: int):
        self.problem, self.length, self.start, self.seed = problem, length, start, seed
        self.rng = np.random.default_rng(seed)
        self.rows = rows_of_gains(problem, gains, length)
        self.own = len(self.rows.parts)
        self.bank, self.gains = gains, len(gains)
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
        return self.early(steps, self._useful([*runs.of(self.rows, True), *runs.of(self.rows, False)]))

    def early(self, steps: int, kept: list[int]) -> list[int]:
        """Looks for rows over up to that many steps that close wide boxes, and says which ones to keep besides."""
        if not (np.isfinite(self.start).all() and (self.start > 1.5).any()):
            return kept
        whole = WindowProgram.of(self.problem, steps, self.length)
        for _ in range(_ROUNDS_EARLY):
            for size, drift, *sides in self._first_steps(self.rows):
                for state in range(self.problem.n):
                    for sign, now in zip((-1, 1), sides, strict=True):
                        best = whole.best(state, size[0], sign * drift[0])
                        if best is not None and best[1] < now[0, state] * (1 - _LEAST_EARLY):
                            self.rows.add(state, best[0])
        return self._useful(self._first_steps(self.rows), kept, _LEAST_EARLY)

    def begins_narrower(self, kept: list[int]) -> bool:
        """Whether these rows close wide boxes so much sooner that they are worth their operations ever after."""
        if not kept or not np.isfinite(self.start).all():
            return False
        now, best = (self._first_steps(self.with_gains(rows)) for rows in ([], kept))
        return bool((mean_log_width(best) < mean_log_width(now) + np.log(1 - _WORTH_EARLY)).any())

    def _first_steps(self, rows: Rows) -> list:
        """Of runs that begin at the region's width."""
        runs = Runs(self.problem, self.length, self.start, np.random.default_rng(self.seed + 3))
        return runs.of(rows, False, from_start=True)[:_EARLY]

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
            if best < (1 - WORTH) * now:
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
            if (half < (1 - WORTH) * before).any():
                return True
        return False

    def settled(self, rows: Rows) -> np.ndarray:
        """Half the widths (n,) that boxes settle at or below, if they begin at the units of the problem."""
        parts, states = np.abs(rows.matrix()), np.array(rows.states)
        half, looked = np.full(self.problem.n, 0.5), Measured(self.problem)
        for _ in range(_SETTLING if len(parts) else 0):
            reach = parts @ sizes_of_parts(self.problem, [half] * self.length)
            least = [reach[states == i].min(initial=np.inf) for i in range(self.problem.n)]
            least = np.minimum(half, least)[None]
            half, before = looked([least.copy(), least], np.zeros((1, self.problem.q)))[0][0], half
            if (before - half <= 1e-4 * before).all():
                break
        return half

    def widths(self, kept: list[int]) -> np.ndarray:
        """Mean widths (n,) of the last steps of runs with these rows, noise uniform: at its vertices, every row that
        has some component of it cuts half of a box away."""
        runs = self.runs(self.seed + 1).of(self.with_gains(kept), False)
        return np.mean([below + above for _, _, below, above in runs[-8:]], (0, 1))

    def brings(self, kept: list[int]) -> float:
        """The largest share of a state's width that these rows take away in runs, or where boxes settle."""
        return self.narrower(kept, self._by_gains)

    def narrower(self, kept: list[int], typical: np.ndarray) -> float:
        """The same beside widths that were `typical` of other rows."""
        with np.errstate(all="ignore"):
            shares = 1 - self.typical(kept) / typical
        return float(np.nan_to_num(shares, nan=0.0).max(initial=0.0))

    @cached_property
    def _by_gains(self) -> np.ndarray:
        """With the gains alone: the same for all banks that are compared once rows have been `collected`."""
        return self.typical([])

    def typical(self, kept: list[int]) -> np.ndarray:
        """Widths (2, n) with these rows: in simulated runs, and where boxes settle."""
        return np.array([self.widths(kept), self.settled(self.with_gains(kept))])

    def cost(self, kept: list[int]) -> float:
        """About how many times as long a step takes with these rows: as measured, f and g linear."""
        lags = sum(self.looks_back(self.rows.parts[r]) for r in kept)
        return 1 + _CARRIED + lags / (_GAIN_LAGS * self.problem.n * self.gains)

    def looks_back(self, parts: np.ndarray) -> int:
        """How many steps a row looks back."""
        n, l, N = self.problem.n, self.problem.l, self.length
        of_f, of_g = parts[N * n : 2 * N * n].reshape(N, n), parts[2 * N * n : N * (2 * n + l)].reshape(N, l)
        used = of_f.any(1) | of_g.any(1)
        return N - int(np.argmax(used)) if used.any() else 0

    def first_of_each(self, kept: list[int], most: int) -> list[int]:
        """So many rows of every state at most, those that help most."""
        seen = [0] * self.problem.n
        found = []
        for r in kept:
            state = self.rows.states[r]
            seen[state] += 1
            if seen[state] <= most:
                found.append(r)
        return found

    def with_gains(self, kept: list[int]) -> Rows:
        return self.rows.kept([*range(self.own), *kept])

    def _useful(self, steps: list, already: Sequence[int] = (), least: float = _LEAST_GAIN) -> list[int]:
        """Row by row what helps most on these runs, beside the gains and what is kept already, as long as it helps.
        Narrow boxes count as much as wide ones: in relation to the exact hull they are what is hardest."""
        parts = self.rows.matrix()
        size, drift = np.concatenate([step[0] for step in steps]), np.concatenate([step[1] for step in steps])
        spread, moved = size @ np.abs(parts).T, drift @ parts.T
        above, below = spread + moved, spread - moved
        kept = list(already)
        for state in range(self.problem.n):
            places = self.rows.of(state)
            there = (places < self.own) | np.isin(places, already)
            own, places = places[there], places[~there]
            up, down = (side[:, own].min(1, initial=FAR) for side in (above, below))
            score = np.log(np.maximum(up + down, 1e-12)).mean()
            for _ in range(min(_MOST_ROWS, len(places))):
                tried = np.minimum(up[:, None], above[:, places]) + np.minimum(down[:, None], below[:, places])
                scores = np.log(np.maximum(tried, 1e-12)).mean(0)
                best = int(np.argmin(scores))
                if not scores[best] < score - least:
                    break
                score = scores[best]
                kept.append(int(places[best]))
                up, down = np.minimum(up, above[:, places[best]]), np.minimum(down, below[:, places[best]])
        return kept


def _add_profile_rows(problem: GainProblem, steps: int, length: int, rows: Rows) -> np.ndarray:
    """Adds the best rows over every window for boxes of the widths that they themselves lead to, and says these."""
    half = np.full(problem.n, 0.5)
    # Of long windows some lengths: the programs are as many as there are lengths, and larger.
    for count in [c for c in range(1, steps + 1) if c <= _EVERY or c in (steps // 2, steps)]:
        program = WindowProgram.of(problem, count, length)
        best = []
        for _ in range(30 if count == 1 else 3):
            size = sizes_of_parts(problem, [half] * length)
            best, reached = best_rows(program, problem.n, size)
            reached = np.minimum(reached, FAR)
            settled = np.allclose(reached, half, rtol=1e-3)
            half = np.maximum(reached, 1e-12)
            if settled:
                break
        for state, row in enumerate(best):
            if row is not None:
                rows.add(state, row[0])
    return half
