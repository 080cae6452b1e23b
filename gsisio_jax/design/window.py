"""Rows over windows of several steps, chosen offline (theory 5.7).

For a state and a profile of box widths the best row is a linear program, and so it is for one simulated run: then it is
the dual of the exact program over that window, so its row is exact for that run. Rows are collected from simulated
runs, and those are kept that a fresh set of runs profits from: runs that have settled, and the first steps of runs that
begin as wide as the region.
"""

from __future__ import annotations

import numpy as np

from gsisio_jax.design.problem import GainProblem
from gsisio_jax.design.window_length import length_worth_trying, share_left
from gsisio_jax.design.window_runs import Rows
from gsisio_jax.design.window_search import WORTH, Search
from gsisio_jax.interval.box import Interval
from gsisio_jax.observer.types import Observer
from gsisio_jax.observer.window import Window

_ROUNDS = 4  # of runs, each with all rows so far
_TRIED = (3, 5)  # windows that "auto" looks at
_LONGER = (5, 10, 20)  # and where 5 is worth it, as long as each leads to much narrower boxes than the one before
_THINNER_LONG = (4, 2, 1)  # of long windows, whose rows cost more
_THINNER = (16, 8, 4, 2)  # rows a state that are tried, the first ones of a bank, where all cost more than they bring
_MOST_STATES = 20  # beyond, the programs of "auto" would take too long


def window_rows(
    problem: GainProblem,
    length: int | str,
    width: np.ndarray,
    gains: list[np.ndarray],
    region: Interval,
    seed: int = 0,
) -> Window | None:
    """The rows of a bank over windows of 1 to `length` steps.

    Args:
        problem: of the design, on its region.
        length: N >= 2; "auto" takes the shortest window that is worth it on simulated runs, or none.
        width: (n,) typical widths of boxes; a first guess.
        gains: the bank of one step, (n, columns) each: what its rows say already, no row of a window need say.
        region: of the design: boxes begin that wide, and rows are looked for that close them soonest.
        seed: of the simulated runs.

    Returns:
        The window without what rounding leaves of its rows (see `with_rounding_constants`); None where no row exists.
    """
    scaled, start = problem.scaled(width), np.asarray(region.width, np.float64) / width / 2
    if isinstance(length, int):
        search = Search(scaled, length, [problem.scaled_gain(N, width) for N in gains], start, seed)
        kept = search.collected(length, _ROUNDS)
        return as_window(problem, length, search.rows, kept, width) if kept else None
    if problem.n > _MOST_STATES:
        return None
    # On narrow boxes slopes vary less than on the region: the truth lies between the two.
    for sizes in [scaled, scaled.with_fixed_slopes()] if scaled.nonlinear else [scaled]:
        found = _worth_it(sizes, [problem.scaled_gain(N, width) for N in gains], start, seed)
        window = None if found is None else as_window(problem, *found, width)
        if window is not None and window.length > 1:  # rows of one step only are what `gains` is for
            return window
    return None


def what_is_cut(asked: int | str, window: Window | None) -> str:
    """A note where rows look back fewer steps than `window=` asked for; empty where they do, or it asked for none."""
    length = 1 if window is None else window.length
    if not isinstance(asked, int) or length >= asked:
        return ""
    if window is None:
        return (
            f"`window={asked}` changes nothing here: no row over several steps narrows a box in simulated runs "
            "(or none cancels the unknown inputs), so a step looks back one step"
        )
    return (
        f"`window={asked}`: the rows that were chosen look back {length} steps; none that looks back farther narrows "
        "simulated runs beside these"
    )


def what_windows_may_give(observer: Observer, problem: GainProblem, width: np.ndarray) -> str:
    """A note of what "auto" leaves to be tried; empty where that is nothing."""
    longest = max(_LONGER)
    if observer.window is not None:
        if observer.window.length <= longest // 2:
            return ""
        share = share_left(problem.scaled(width), longest, 2 * longest)
        if share is None:
            return ""
        return (
            f'window="auto" ends at {longest} steps; the best rows over {2 * longest} make boxes of some state '
            f"{1 / share:.2g} times narrower in the end: `window={2 * longest}`, where a step may take as much longer"
        )
    if observer.system.n > _MOST_STATES:
        return f'window="auto" tries none for more than {_MOST_STATES} states: `window=3` may give narrower boxes'
    endless = set(np.flatnonzero(~np.isfinite(observer.certificate.steady_width)))
    if endless and endless <= {state for rows in observer.recovery for state in rows.targets}:
        return "no width is promised, but outputs of several steps determine the state: try `window=5` or `window=20`"
    return ""


def _worth_it(
    problem: GainProblem, gains: list[np.ndarray], start: np.ndarray, seed: int
) -> tuple[int, Rows, list[int]] | None:
    """The shortest window that is worth it, rows over it, and which of them to keep."""
    search = Search(problem, max(_TRIED), gains, start, seed)
    steps = _TRIED[0]
    if not (search.settles_narrower(max(_TRIED)) or search.could_bring(max(_TRIED), [])):
        kept = search.early(steps, [])
        return (search.length, search.rows, kept) if search.begins_narrower(kept) else None
    kept = search.collected(steps, 1)
    for longer in _TRIED[1:]:
        if search.could_bring(longer, kept, steps):
            steps = longer
    kept = search.collected(steps, _ROUNDS - 1)
    if search.brings(kept) > WORTH:
        for most in _THINNER:
            fewer = search.first_of_each(kept, most)
            if search.brings(fewer) > WORTH * worth_of_time(search.cost(fewer)):
                found = search.length, search.rows, fewer
                return (_longer(search, fewer) if steps == max(_TRIED) else None) or found
    return (search.length, search.rows, kept) if search.begins_narrower(kept) else None


def _longer(short: Search, kept: list[int]) -> tuple[int, Rows, list[int]] | None:
    """A longer window than that of a search which keeps these rows, with a few rows that are worth more, or None.

    They are worth it for what a step takes with them beside one without a window, and narrower by `WORTH` than the
    short ones, and by as much more as they take longer than these.
    """
    problem = short.problem
    steps = length_worth_trying(problem, _LONGER)
    if steps == short.length:
        return None
    search = Search(problem, steps, short.bank, short.start, short.seed)
    rows, by_short, so_far = search.collected(steps, 1), short.typical(kept), short.cost(kept)
    for most in _THINNER_LONG:
        fewer = search.first_of_each(rows, most)
        cost, widths = search.cost(fewer), search.typical(fewer)
        # Shares end at 1: half as wide, and half of that again, count the same.
        brings, more = (-np.log1p(-share) for share in (search.brings(fewer), search.narrower(fewer, by_short)))
        worth_it = brings > WORTH * worth_of_time(cost) and more > WORTH * max(1, worth_of_time(cost / so_far))
        if worth_it and not (widths > (1 + WORTH) * by_short).any():
            return steps, search.rows, fewer
    return None


def worth_of_time(cost: float) -> float:
    """How much more than `WORTH` a bank must bring that makes a step `cost` times as long: once for half as much again,
    twice for twice as much. Proportional to the time that it adds, and more where a step takes longer than that: what
    runs promise is not kept to the last per cent, and no step may be slower than twice for less than `WORTH`."""
    return (cost - 1) * cost


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
