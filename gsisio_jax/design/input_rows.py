"""Rows for the unknown input over several steps, where it is known how it moves; chosen offline (theory 7.5).

As for windows (theory 5.7) the best row for given sizes is a linear program, and so it is for one step of a simulated
run: rows are collected from runs, and those are kept that fresh runs profit from.
"""

from __future__ import annotations

import numpy as np

from gsisio_jax.design.input_program import BEYOND, InputKind, InputSizes, Sample, depths_of, kinds_of_rows, moves_of
from gsisio_jax.design.input_runs import InputRuns, rows_of_states
from gsisio_jax.design.problem import GainProblem
from gsisio_jax.design.window_runs import FAR, Rows
from gsisio_jax.observer.input_memory import InputRows
from gsisio_jax.observer.window import Window
from gsisio_jax.plant.system import System

_STEPS = 16  # how far rows look back where `window` does not say more
_ROUNDS, _SAMPLES = 2, 32  # of runs, and samples of each that exact rows are asked for
_DRAWN = 100  # samples for sums
_MIDDLE = 4  # steps of a long block that are simulated beyond those with rows of their own
_MOST_LAGS, _STRICTER = 64, 10  # steps that rows look back to, in all, for each input: twice as many for rates
_ALONE = 2.5, 1 / 3  # as many of these, and as small a gain, where there is one input: its rows are few
_LEAST_WIDTH = 1e-300  # without noise all may be points
_NARROW = 0.05  # of the median width: boxes below count as wide as that where rows are chosen
_MOST_ROWS, _LEAST_GAIN = 16, 3e-3  # of an input, and share of the width that one more row must bring


def rows_of_inputs(
    problem: GainProblem,
    system: System,
    window: int | str,
    width: np.ndarray,
    gains: list[np.ndarray],
    rows: Window | None,
) -> InputRows | None:
    """The rows; without what rounding leaves of them (see `with_rounding_constants`).

    Args:
        problem: of the design, on its region.
        system: what is known of the input.
        window: of the design; rows look back at least as far.
        width: (n,) typical widths of boxes.
        gains, rows: what bounds the states, (n, columns) each, and over several steps.

    Returns:
        None where no row exists.
    """
    scaled, unit = problem.scaled(width), problem.input_units(width)
    p, rate = len(unit), _rate(system) / unit
    farthest = max(_STEPS, window if isinstance(window, int) else 1)
    profiles: list[tuple[np.ndarray, int, int | None]] = []
    if system.input_constant is not None:
        profiles.append((np.zeros(p), min(system.input_constant + BEYOND, farthest), system.input_constant))
    if np.isfinite(rate).any():
        profiles.append((rate, farthest, None))
    if not profiles:
        return None
    length = max(steps for _, steps, _ in profiles)
    found, kept, of_states = Rows([], []), [], rows_of_states(problem, gains, rows, width)
    for move, steps, block in profiles:
        # The box that a row starts from is what the rows before it have found.
        sizes = InputSizes(scaled, length, move, np.full(p, FAR))
        for _ in range(3):
            best = _profile_rows(found, sizes, steps)
            sizes = InputSizes(scaled, length, move, np.minimum(sizes.d, best + np.where(np.isfinite(move), move, 0)))
        if not found.parts:
            continue
        kinds = kinds_of_rows(steps, block, bool(scaled.H[:, np.isfinite(move)].any()))
        runs = InputRuns(scaled, *of_states, length, move, block and min(block, steps + _MIDDLE))
        for _ in range(_ROUNDS):
            samples = runs.samples(found, seed=len(found.parts))
            for kind in kinds:
                _sampled_rows(found, sizes, kind, kind.of(samples), kind.share(_SAMPLES))
        samples = runs.samples(found, seed=1)
        own: list[int] = []
        more, less = _ALONE if p == 1 else (1.0, 1.0)
        for least in less * _LEAST_GAIN * 1.5 ** np.arange(_STRICTER):
            own = list(kept)
            for kind in kinds:
                _keep(own, found, sizes, kind, kind.of(samples), kind.least(least))
            # Beyond so many terms a compiled step is slower by far more than their number.
            if depths_of(np.array(found.parts)[own], sizes).sum() <= more * (1 if block else 2) * _MOST_LAGS * p:
                break
        kept = own
    return _as_rows(problem, sizes, found, kept, width, unit) if kept else None


def rows_of_sums(problem: GainProblem, system: System, steps: int, width: np.ndarray) -> InputRows | None:
    """Rows for the sum of each input over the last `steps` steps; arguments and result as `rows_of_inputs`."""
    scaled, unit = problem.scaled(width), problem.input_units(width)
    sizes = InputSizes(scaled, steps, _rate(system) / unit, np.full(len(unit), FAR), steps)
    found, kept = Rows([], []), []
    _profile_rows(found, sizes, steps)
    if not found.parts:
        return None
    # Of a sum, what lies between both ends of it hardly counts: independent draws are near enough.
    size, rng = np.tile(sizes.of_parts(), (_DRAWN, 1)), np.random.default_rng(0)
    first, fresh = (Sample(0, size, size * rng.uniform(-1, 1, size.shape)) for _ in range(2))
    _sampled_rows(found, sizes, InputKind(steps, True), [first], _SAMPLES)
    _keep(kept, found, sizes, InputKind(steps, True), [fresh], _LEAST_GAIN)
    return _as_rows(problem, sizes, found, kept, width, unit)


def _rate(system: System) -> np.ndarray:
    """Half widths (p,) of what the inputs move by in a step."""
    if system.input_rate is None:
        return np.full(system.p, np.inf)
    return np.asarray(system.input_rate.width, np.float64) / 2


def _profile_rows(found: Rows, sizes: InputSizes, steps: int) -> np.ndarray:
    """Add the best rows over every number of steps; the half widths (p,) that they reach."""
    size, reached = sizes.of_parts(), np.full(len(sizes.d), FAR)
    for s in range(sizes.over, steps + 1):
        program = sizes.program(InputKind(s, True))
        for j in range(len(reached)):
            row = program.best(j, size, np.zeros_like(size))
            if row is not None:
                reached[j] = min(reached[j], row[1])
                _add(found, j, row[0], sizes)
    return reached


def _sampled_rows(found: Rows, sizes: InputSizes, kind: InputKind, samples: list[Sample], count: int) -> None:
    """Add rows that are best for samples of where everything lies within its bounds."""
    rng, program = np.random.default_rng(0), sizes.program(kind)
    for _ in range(count):
        sample = samples[rng.integers(len(samples))]
        s = rng.integers(len(sample.size))
        for j in range(len(sizes.d)):
            for sign in (-1, 1):
                row = program.best(j, sample.size[s], sign * sample.drift[s])
                if row is not None:
                    _add(found, j, row[0], sizes)


def _keep(
    kept: list[int], found: Rows, sizes: InputSizes, kind: InputKind, samples: list[Sample], least: float
) -> None:
    """Add to `kept` what helps most on fresh samples, of the rows of that kind: as long as one brings that share of the
    width."""
    parts = np.array(found.parts)
    size, drift = (np.concatenate([getattr(s, name) for s in samples]) for name in ("size", "drift"))
    spread, moved = size @ np.abs(parts).T, drift @ parts.T
    above, below = spread + moved, spread - moved
    near = kind.holds(moves_of(parts, sizes.length, len(sizes.d)), depths_of(parts, sizes))
    for j in range(len(sizes.d)):
        places = [r for r in found.of(j) if near[r]]
        if not places:
            continue
        up, down = np.full(len(size), FAR), np.full(len(size), FAR)
        # Where noise stands on its vertices the exact box may be a point, whose logarithm would be all that counts.
        floor = max(_NARROW * float(np.median(above[:, places].min(1) + below[:, places].min(1))), _LEAST_WIDTH)
        for r in (r for r in places if r in kept):
            up, down = np.minimum(up, above[:, r]), np.minimum(down, below[:, r])
        for _ in range(min(_MOST_ROWS, len(places))):
            tried = np.minimum(up[:, None], above[:, places]) + np.minimum(down[:, None], below[:, places])
            score = np.log(np.maximum(tried, floor)).mean(0)
            best = int(np.argmin(score))
            if not score[best] < np.log(np.maximum(up + down, floor)).mean() - least:
                break
            kept.append(int(places[best]))
            up, down = np.minimum(up, above[:, kept[-1]]), np.minimum(down, below[:, kept[-1]])


def _add(found: Rows, state: int, parts: np.ndarray, sizes: InputSizes) -> None:
    """Unless it is made of boxes of d alone."""
    P, N = sizes.problem, sizes.length
    first = (N + 1) * P.n
    if parts[first : first + N * (P.n + P.l) + P.l].any():
        found.add(state, parts)


def _as_rows(
    problem: GainProblem, layout: InputSizes, rows: Rows, kept: list[int], x: np.ndarray, d: np.ndarray
) -> InputRows:
    """The kept rows in the units x and d of the plant, newest step first."""
    n, l, p, N, R = problem.n, problem.l, len(d), layout.length, len(kept)
    parts = np.array([rows.parts[r] for r in kept])
    targets = np.array([rows.states[r] for r in kept])
    sizes = [N * n, n, N * n, N * l, l, N * p, p, N * p]
    _, _, of_f, of_g, output, moves, ahead, boxes = np.split(parts, np.cumsum(sizes)[:-1], axis=1)
    found, own, y = (of_f, of_g, moves, boxes), d[targets][:, None], problem.output_units
    units = [x, y, d, d]
    of_f, of_g, moves, boxes = (
        own[None] * part.reshape(R, N, len(unit)).transpose(1, 0, 2)[::-1] / unit
        for part, unit in zip(found, units, strict=True)
    )
    multipliers = np.concatenate([of_f, of_g], axis=2)
    # Rows that look back farthest come first, so that those of a lag are the first ones.
    depth = depths_of(parts, layout)
    order = np.argsort(-depth, kind="stable")
    N = int(depth.max())  # older steps are in no row that was kept
    return InputRows(
        multipliers=multipliers[:N, order],
        output=(own * output / y)[order],
        ahead=(own * ahead / d)[order],
        boxes=boxes[:N, order],
        moves=moves[:N, order],
        left=np.zeros((N, R, p)),
        left_now=np.zeros((R, p)),
        targets=tuple(int(targets[r]) for r in order),
        counts=tuple(int((depth > lag).sum()) for lag in range(N)),
        over=layout.over,
    )
