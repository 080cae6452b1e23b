"""The linear program for one row of an input over several steps (theory 7.5), and the kinds of rows that there are."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsisio_jax.design.problem import GainProblem
from gsisio_jax.design.window_program import WindowProgram

_DEPTHS = (1, 2, 3, 4, 6, 9)  # numbers of steps that have rows of their own, besides the largest
BEYOND = 4  # steps before a block that its first rows look back to
_PHASES = 3  # rows of one phase of a block must bring up to so many times as much


@dataclass(frozen=True)
class Sample:
    """A step of the runs: number of its input within a block (0 where there are none), sizes and drifts (S, k) of the
    parts of a row for it."""

    phase: int
    size: np.ndarray
    drift: np.ndarray


@dataclass(frozen=True)
class InputKind:
    """Rows that look back so many steps, with `ahead` to d[k]; for blocks those at one phase, None: in the middle."""

    steps: int
    ahead: bool
    phase: int | None = None
    block: int | None = None
    main: bool = True  # others serve young records, lost measurements and the like

    def share(self, samples: int) -> int:
        """How many samples are taken for it."""
        if not self.main:
            return samples // 4
        return samples if self.block is None else max(samples // 4, samples * 4 // self.block)

    def least(self, gain: float) -> float:
        """Share of the width that one more row must bring: more where it serves few steps, of those at one phase."""
        return gain * (1 if self.main else 4) * (1 if self.block is None else min(self.block, _PHASES))

    def may_move(self, lag: int) -> bool:
        """Whether the move to d[k-1-lag] may be used."""
        if lag < 0 and not self.ahead:
            return False
        return self.phase is None or self.block is None or (self.phase - lag) % self.block != 0

    def of(self, samples: list[Sample]) -> list[Sample]:
        """Those at such a phase."""
        if self.block is None:
            return samples
        return [s for s in samples if (s.phase >= self.steps if self.phase is None else s.phase == self.phase)]

    def holds(self, moved: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Which rows are of this kind, (R,)."""
        never = np.array([not self.may_move(lag) for lag in range(-1, moved.shape[1] - 1)])
        return ~(moved & never).any(1) & (depth <= self.steps)


def kinds_of_rows(steps: int, block: int | None, shows: bool) -> list[InputKind]:
    """Where d[k] shows in y[k] a row can use it, but not where y[k] is lost, nor where a block ends; and a row cannot
    lead d across the beginning of a block, before which it can only be cancelled. Fewer steps serve young records."""
    lost = [InputKind(steps, False, None, block, False)] if shows else []
    if block is None:
        short = [InputKind(s, shows, main=False) for s in _DEPTHS if s < steps]
        return [*short, InputKind(steps, shows), *lost]
    phases = range(min(block, steps))
    short = [InputKind(phase + 1, shows and phase + 1 < block, phase, block, False) for phase in phases]
    kinds = [*short, *(replace(kind, steps=min(steps, kind.steps + BEYOND), main=True) for kind in short)]
    return [*kinds, InputKind(steps, shows, None, block), *lost] if block > steps else kinds


@dataclass(frozen=True)
class InputSizes:
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
        blocks = [*[half] * (N + 1), *[of_f] * N, *[of_g] * (N + 1), *[move] * (N + 1), *[self.d] * N]
        return np.concatenate(blocks)

    def program(self, kind: InputKind) -> WindowProgram:
        """Rows linear in lambda, a, moves and boxes of every one of their steps, and a of y[k]."""
        steps = kind.steps
        P, p = self.problem, len(self.d)
        n, l = P.n, P.l
        bounded, moving = np.flatnonzero(~P.free), np.flatnonzero(np.isfinite(self.move))
        sizes = [n, l, len(moving), p]
        # What has no bound of its move must be in no output of y[k]: nothing bounds d[k], so no rounding of it either.
        still = ~np.isfinite(self.move) | (not kind.may_move(-1))
        latest = np.flatnonzero(~P.H[:, still].any(1))
        count = steps * sum(sizes) + len(latest)
        *unknown, now = np.split(np.eye(count), np.cumsum(np.tile(sizes, steps)))
        output = np.zeros((l, count))
        output[latest] = now
        to_come = P.H.T @ output
        states, outputs, moves, boxes = ([*unknown[i::4]] for i in range(4))
        none = np.zeros((n, count))
        slopes, of_f, of_g, of_moves, of_boxes, equal = [], [], [], [], [], []
        for j in range(steps):
            before = states[j - 1] if j else none
            slopes.append(before - P.F.T @ states[j] - P.E.T @ outputs[j])
            of_f.append(states[j])
            of_g.append(outputs[j])
            move, box = np.zeros((p, count)), np.zeros((p, count))
            after = to_come if j + 1 == steps else np.zeros((p, count))
            if j > 0 and kind.may_move(steps - 1 - j):
                move[moving] = moves[j]
            if j + 1 < steps and kind.may_move(steps - 2 - j):
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

        parts = [
            *blocks(slopes), states[-1] - P.E.T @ output, *blocks(of_f), *blocks(of_g), output, *blocks(of_moves),
            to_come, *blocks(of_boxes),
        ]  # fmt: skip
        target = np.zeros((steps * p, p))
        target[-p * self.over :] = np.tile(-np.eye(p), (self.over, 1))
        stacked = np.vstack(parts)
        return WindowProgram(stacked, np.zeros((len(stacked), p)), np.vstack(equal), target)


def depths_of(parts: np.ndarray, sizes: InputSizes) -> np.ndarray:
    """How many steps rows look back, (R,)."""
    P, N, p, R = sizes.problem, sizes.length, len(sizes.d), len(parts)
    if not R:
        return np.zeros(0, int)
    ends = np.cumsum([(N + 1) * P.n, N * P.n, N * P.l, P.l, N * p, p])
    _, of_f, of_g, _, moves, _, boxes = (part.reshape(R, -1) for part in np.split(parts, ends, 1))
    used = np.concatenate([part.reshape(R, N, -1) for part in (of_f, of_g, moves, boxes)], 2)
    used = (used != 0).any(-1)
    return np.where(used.any(-1), N - used.argmax(-1), 1)


def moves_of(parts: np.ndarray, length: int, p: int) -> np.ndarray:
    """Which moves rows (R, k) of inputs use: to d[k], d[k-1], ..., (R, length + 1)."""
    end = parts.shape[1] - length * p
    moves = parts[:, end - (length + 1) * p : end].reshape(len(parts), length + 1, p)
    return (moves != 0).any(-1)[:, ::-1]
