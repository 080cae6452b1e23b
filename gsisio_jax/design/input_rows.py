"""Rows for the unknown input over several steps, where it is known how it moves; chosen offline (theory 7.5).

As for windows (theory 5.7) the best row for given sizes is a linear program, and so it is for one sample of where noise
and states lie within their bounds: rows are collected from samples, and those are kept that fresh samples profit from.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsisio_jax.design.problem import GainProblem
from gsisio_jax.design.window_program import WindowProgram
from gsisio_jax.design.window_runs import FAR, Rows
from gsisio_jax.observer.input_memory import InputRows
from gsisio_jax.plant.system import System

_STEPS = 16  # how far rows look back where `window` does not say more
_DEPTHS = (1, 2, 3, 4, 6, 9)  # numbers of steps that have rows of their own, besides the largest
_SAMPLES, _TESTED = 12, 100  # samples that exact rows are asked for, and that rows are chosen on
_MOST_ROWS, _LEAST_GAIN = 16, 5e-3  # of an input, and share of the width that one more row must bring


def rows_of_inputs(problem: GainProblem, system: System, window: int | str, width: np.ndarray) -> InputRows | None:
    """The rows; without what rounding leaves of them (see `with_rounding_constants`).

    Args:
        problem: of the design, on its region.
        system: what is known of the input.
        window: of the design; rows look back at least as far.
        width: (n,) typical widths of boxes.

    Returns:
        None where no row exists.
    """
    scaled, unit = problem.scaled(width), problem.input_units(width)
    p, rate = len(unit), _rate(system) / unit
    least = window if isinstance(window, int) else 1
    profiles = []
    if system.input_constant is not None:
        profiles.append((np.zeros(p), max(2, min(system.input_constant, max(_STEPS, least)))))
    if np.isfinite(rate).any():
        profiles.append((rate, max(_STEPS, least)))
    length = max((steps for _, steps in profiles), default=0)
    found, kept = Rows([], []), []
    for move, steps in profiles:
        # The box that a row starts from is what the rows before it have found.
        sizes = _Sizes(scaled, length, move, np.full(p, FAR))
        for _ in range(3):
            best = _profile_rows(found, sizes, steps)
            sizes = _Sizes(scaled, length, move, np.minimum(sizes.d, best + np.where(np.isfinite(move), move, 0)))
        # Rows may not look back beyond the beginning of a block or of a record: fewer steps have rows of their own.
        depths = range(1, steps + 1) if not move.any() else [*(s for s in _DEPTHS if s < steps), steps]
        for depth in depths:
            _sampled_rows(found, sizes, depth, _SAMPLES if depth == steps else _SAMPLES // 4)
            _keep(kept, found, sizes, depth, _LEAST_GAIN if depth == steps else 4 * _LEAST_GAIN)
    return _as_rows(problem, length, found, kept, width, unit) if kept else None


def rows_of_sums(problem: GainProblem, system: System, steps: int, width: np.ndarray) -> InputRows | None:
    """Rows for the sum of each input over the last `steps` steps; arguments and result as `rows_of_inputs`."""
    scaled, unit = problem.scaled(width), problem.input_units(width)
    sizes = _Sizes(scaled, steps, _rate(system) / unit, np.full(len(unit), FAR), steps)
    found, kept = Rows([], []), []
    _profile_rows(found, sizes, steps)
    if not found.parts:
        return None
    _sampled_rows(found, sizes, steps, _SAMPLES)
    _keep(kept, found, sizes, steps, _LEAST_GAIN)
    return _as_rows(problem, steps, found, kept, width, unit, steps)


def _rate(system: System) -> np.ndarray:
    """Half widths (p,) of what the inputs move by in a step."""
    if system.input_rate is None:
        return np.full(system.p, np.inf)
    return np.asarray(system.input_rate.width, np.float64) / 2


@dataclass(frozen=True)
class _Sizes:
    """What the parts of a row count: half widths (p,) of moves and of the box of d, in units; `over` is of the rows."""

    problem: GainProblem
    length: int
    move: np.ndarray
    d: np.ndarray
    over: int = 1

    def of_parts(self) -> np.ndarray:
        P, N = self.problem, self.length
        half = np.full(P.n, 0.5)
        of_f, of_g = P.dw / 2 + P.F_radius @ half, P.dv / 2 + P.E_radius @ half
        move = np.where(np.isfinite(self.move), self.move, 0.0)
        blocks = [*[half] * (N + 1), *[of_f] * N, *[of_g] * N, *[move] * N, *[self.d] * N]
        return np.concatenate(blocks)

    def depth(self, parts: np.ndarray) -> int:
        """How many steps a row looks back."""
        P, N = self.problem, self.length
        _, *rest = np.split(parts, np.cumsum([(N + 1) * P.n, N * P.n, N * P.l, N * len(self.d)]))
        used = np.concatenate([part.reshape(N, -1) for part in rest], 1)
        return N - int(np.flatnonzero(used.any(1)).min())

    def program(self, steps: int) -> WindowProgram:
        """Rows over the last `steps` steps, linear in lambda, a, moves and boxes of every one of them."""
        P, p = self.problem, len(self.d)
        n, l = P.n, P.l
        bounded, moving = np.flatnonzero(~P.free), np.flatnonzero(np.isfinite(self.move))
        sizes = [n, l, len(moving), p]
        count = steps * sum(sizes)
        unknown = np.split(np.eye(count), np.cumsum(np.tile(sizes, steps))[:-1])
        states, outputs, moves, boxes = ([*unknown[i::4]] for i in range(4))
        none = np.zeros((n, count))
        slopes, of_f, of_g, of_moves, of_boxes, equal = [], [], [], [], [], []
        for j in range(steps):
            before = states[j - 1] if j else none
            slopes.append(before - P.F.T @ states[j] - P.E.T @ outputs[j])
            of_f.append(states[j])
            of_g.append(outputs[j])
            move, box, after = (np.zeros((p, count)) for _ in range(3))
            if j > 0:
                move[moving] = moves[j]
            if j + 1 < steps:
                after[moving] = moves[j + 1]
            # The box that was found for d is of use at the oldest step; that of an input with bounds always is.
            allowed = np.arange(p) if j == 0 and steps > self.over else bounded
            box[allowed] = boxes[j][allowed]
            of_moves.append(move)
            of_boxes.append(box)
            equal.append(P.G.T @ states[j] + P.H.T @ outputs[j] - box - move + after)
        older = self.length - steps

        def blocks(found: list[np.ndarray]) -> list[np.ndarray]:
            return [np.zeros_like(found[0])] * older + found

        parts = [*blocks(slopes), states[-1], *blocks(of_f), *blocks(of_g), *blocks(of_moves), *blocks(of_boxes)]
        target = np.zeros((steps * p, p))
        target[-p * self.over :] = np.tile(-np.eye(p), (self.over, 1))
        stacked = np.vstack(parts)
        return WindowProgram(stacked, np.zeros((len(stacked), p)), np.vstack(equal), target)


def _profile_rows(found: Rows, sizes: _Sizes, steps: int) -> np.ndarray:
    """Add the best rows over every number of steps; the half widths (p,) that they reach."""
    size, reached = sizes.of_parts(), np.full(len(sizes.d), FAR)
    for s in range(sizes.over, steps + 1):
        program = sizes.program(s)
        for j in range(len(reached)):
            row = program.best(j, size, np.zeros_like(size))
            if row is not None:
                reached[j] = min(reached[j], row[1])
                _add(found, j, row[0], sizes)
    return reached


def _sampled_rows(found: Rows, sizes: _Sizes, steps: int, samples: int) -> None:
    """Add rows that are best for samples of where everything lies within its bounds."""
    rng, size, program = np.random.default_rng(0), sizes.of_parts(), sizes.program(steps)
    for _ in range(samples):
        drift = size * rng.uniform(-1, 1, len(size))
        for j in range(len(sizes.d)):
            for sign in (-1, 1):
                row = program.best(j, size, sign * drift)
                if row is not None:
                    _add(found, j, row[0], sizes)


def _keep(kept: list[int], found: Rows, sizes: _Sizes, steps: int, least: float) -> None:
    """Add to `kept` what helps most on fresh samples, of the rows that look back so many steps: as long as one brings
    that share of the width."""
    parts, size = np.array(found.parts), sizes.of_parts()
    drift = size * np.random.default_rng(1).uniform(-1, 1, (_TESTED, len(size)))
    spread, moved = np.abs(parts) @ size, drift @ parts.T
    above, below = spread + moved, spread - moved
    near = np.array([sizes.depth(row) <= steps for row in parts])
    for j in range(len(sizes.d)):
        places = [r for r in found.of(j) if near[r]]
        up, down = np.full(_TESTED, FAR), np.full(_TESTED, FAR)
        for r in (r for r in places if r in kept):
            up, down = np.minimum(up, above[:, r]), np.minimum(down, below[:, r])
        for _ in range(min(_MOST_ROWS, len(places))):
            tried = np.minimum(up[:, None], above[:, places]) + np.minimum(down[:, None], below[:, places])
            best = int(np.argmin(tried.mean(0)))
            if not tried[:, best].mean() < (up + down).mean() * (1 - least):
                break
            kept.append(int(places[best]))
            up, down = np.minimum(up, above[:, kept[-1]]), np.minimum(down, below[:, kept[-1]])


def _add(found: Rows, state: int, parts: np.ndarray, sizes: _Sizes) -> None:
    """Unless it is made of boxes of d alone."""
    P, N = sizes.problem, sizes.length
    first = (N + 1) * P.n
    if parts[first : first + N * (P.n + P.l)].any():
        found.add(state, parts)


def _as_rows(
    problem: GainProblem, length: int, rows: Rows, kept: list[int], x: np.ndarray, d: np.ndarray, over: int = 1
) -> InputRows:
    """The kept rows in the units of the plant, newest step first."""
    n, l, p, N, R = problem.n, problem.l, len(d), length, len(kept)
    parts = np.array([rows.parts[r] for r in kept])
    targets = np.array([rows.states[r] for r in kept])
    sizes = [N * n, n, N * n, N * l, N * p, N * p]
    _, _, *found = np.split(parts, np.cumsum(sizes)[:-1], axis=1)
    own, y = d[targets][:, None], problem.output_units
    units = [x, y, d, d]
    of_f, of_g, moves, boxes = (
        own[None] * part.reshape(R, N, len(unit)).transpose(1, 0, 2)[::-1] / unit
        for part, unit in zip(found, units, strict=True)
    )
    multipliers = np.concatenate([of_f, of_g], axis=2)
    # Rows that look back farthest come first, so that those of a lag are the first ones.
    used = np.concatenate([multipliers, moves, boxes], 2)
    depth = np.array([np.flatnonzero((used[:, r] != 0).any(-1)).max() + 1 for r in range(R)])
    order = np.argsort(-depth, kind="stable")
    N = int(depth.max())  # older steps are in no row that was kept
    return InputRows(
        multipliers=multipliers[:N, order],
        boxes=boxes[:N, order],
        moves=moves[:N, order],
        left=np.zeros((N, R, p)),
        targets=tuple(int(targets[r]) for r in order),
        counts=tuple(int((depth > lag).sum()) for lag in range(N)),
        over=over,
    )
