"""Outputs that come every so many rows: rows that look back to where they came, and what that promises (theory 5.7, 6).

Where one output is missing in most rows, a row of a window that needs it in every step says nothing. Rows here take
it where it comes, the others in between; they are chosen for the phases in which a slow output comes, and gains for
missing outputs carry what they find to the next.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from gsisio_jax.design.gain_selection import profile_of, units
from gsisio_jax.design.gains import profile_gain
from gsisio_jax.design.problem import GainProblem
from gsisio_jax.design.window import as_window
from gsisio_jax.design.window_program import best_rows, masked_program
from gsisio_jax.design.window_runs import FAR, Rows, sizes_of_parts
from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.reading import is_whole
from gsisio_jax.observer.rate_widths import RateWidths
from gsisio_jax.observer.window import Window
from gsisio_jax.observer.window_widths import WindowWidths, slopes_by_lag

_LONGEST = 200  # rows of a pattern: the least common multiple of its rates
_STEPS = (5, 10, 20, 40)  # about so many steps "auto" tries, whole periods
_NARROWER = 0.25  # share of a width that each of these must take away beside the one before
_LARGEST = 160, 600  # states times steps: of those that are tried beyond one period; at all
_WORTH = 0.05  # share of the width that a row must take away
_VISITS = 12  # of a phase, at most, until widths have settled
_SETTLED = 0.02


def check_rates(rates: Any, l: int, form: str, missing: bool, delay: Any, tolerate: int) -> tuple[int, ...] | None:
    """`rates` as whole numbers, one an output.

    Raises:
        ValueError: they are none, or there is no such design.
    """
    if rates is None:
        return None
    given = np.asarray(rates).tolist() if isinstance(rates, list | tuple | np.ndarray) else rates
    if not isinstance(given, list) or len(given) != l or not all(is_whole(rate) and rate >= 1 for rate in given):
        raise ValueError(
            f"design_observer: `rates` must be {l} whole number{'s' * (l != 1)}, for each output every how many rows "
            f"it comes (1: in every row), got {rates!r}"
        )
    others = {
        'form="prediction"': form == "prediction", "missing=False": not missing, "delay": delay != 0,
        "tolerate": tolerate != 0,
    }  # fmt: skip
    for name in [name for name, there in others.items() if there]:
        raise ValueError(f"design_observer: `rates` cannot go with {name}: leave one of them out")
    period = int(np.lcm.reduce(given))
    if period > _LONGEST:
        raise ValueError(
            f"design_observer: `rates` must repeat after at most {_LONGEST} rows, but {tuple(given)} do after "
            f"{period}; take rates that divide each other, or leave `rates` out (entries may be missing all the same)"
        )
    return tuple(given)


def pattern(rates: tuple[int, ...]) -> np.ndarray:
    """Which outputs come in which phase, (P, l); in phase 0 all do."""
    return np.arange(np.lcm.reduce(rates))[:, None] % np.array(rates) == 0


def gains_of_rates(
    problem: GainProblem, rates: tuple[int, ...], main: np.ndarray, region: Interval
) -> list[np.ndarray]:
    """Gains for the outputs that come together in some phase, and for those of the phase before with them."""
    present, profile = pattern(rates), profile_of(problem, problem.steady_width(main), region)
    found = []
    for before, now in dict.fromkeys(
        (tuple(a), tuple(b)) for a, b in zip(np.roll(present, 1, 0), present, strict=True)
    ):
        of_z = (np.array(now) | (problem.T2 == 0)).all(1)
        usable = np.concatenate([before, of_z, np.full(len(problem.C) - problem.q, True)])
        gain = profile_gain(problem, profile, usable, units(profile))
        found += [] if gain is None else [gain]
    return found


def rows_of_rates(
    problem: GainProblem, rates: tuple[int, ...], window: int | str, width: np.ndarray, gains: list[np.ndarray]
) -> Window | None:
    """The rows, in the units of the plant, without what rounding leaves of them; None where none narrows a box.

    Args:
        problem: of the design, on its region.
        rates: of the outputs.
        window: how many steps rows look back; "auto" takes whole periods, as long as some state gets much narrower.
        width: (n,) typical widths of boxes, as units.
        gains: the bank of one step, (n, columns) each.
    """
    scaled, present = problem.scaled(width), pattern(rates)
    own = rate_widths(scaled, rates, None, [problem.scaled_gain(N, width) for N in gains])
    lengths = [window] if isinstance(window, int) else _lengths(problem.n, len(present))
    found = [_Found(scaled, present, lengths[0], own)] if lengths else []
    for _, longer in pairwise(lengths):
        next_one = _Found(scaled, present, longer, own)
        if not (next_one.half < (1 - _NARROWER) * found[-1].half).any():
            break
        found.append(next_one)
    rows = found[-1].rows if found else Rows([], [])
    return as_window(problem, found[-1].steps, rows, list(range(len(rows.parts))), width) if rows.parts else None


def _lengths(n: int, period: int) -> list[int]:
    """Whole periods, about as long as what "auto" tries."""
    found = sorted({period * max(1, round(steps / period)) for steps in _STEPS} | {2 * period})
    return [steps for steps in found if n * steps <= (_LARGEST[0] if steps > period else _LARGEST[1])]


class _Found:
    """The best rows over so many steps for the widths that they and the gains lead to.

    Attributes:
        steps: that they look back.
        rows: in the units of the problem; those that narrow a box where gains alone would not.
        half: half the widths (n,) when all outputs have come.
    """

    def __init__(self, problem: GainProblem, present: np.ndarray, steps: int, own: RateWidths):
        self.steps, self.rows = steps, Rows([], [])
        P, n = len(present), problem.n
        added = problem.dw @ own.noise_w.T + problem.dv @ own.noise_v.T + own.fixed
        slow = ~present.all(0)
        phases = [phase for phase in range(P) if present[phase, slow].any() or not slow.any()]
        middle = [phase for phase in (P // 2, P - 1) if phase not in phases]
        programs = {phase: masked_program(problem, steps, present, phase) for phase in [*phases, *middle]}
        history = [np.full(n, FAR)] * steps  # oldest first
        seen, self.half = dict.fromkeys(phases, np.full(n, FAR)), np.full(n, FAR)
        last = _VISITS - 1
        for visit in range(_VISITS):
            still = True
            for phase in range(P):
                lags = np.array(history[::-1])
                by_gains = np.minimum(own.next_widths(2 * lags, phase, added) / 2, FAR)
                now = by_gains
                # Between phases in which slow outputs come, rows are asked for in the end only, and kept if they tell.
                if phase in phases or (visit == last and phase in middle):
                    size = sizes_of_parts(problem, history)
                    best, reached = best_rows(programs[phase], n, size)
                    now = np.minimum(by_gains, reached)
                    least = _WORTH if phase in phases else _NARROWER
                    if visit == last:
                        for state in np.flatnonzero(reached < (1 - least) * by_gains):
                            self.rows.add(int(state), best[state][0])  # type: ignore[index]
                if phase in seen:
                    still &= bool((now > (1 - _SETTLED) * seen[phase]).all())
                    seen[phase] = now
                history = [*history[1:], np.maximum(now, 1e-12)]
                if phase == 0:
                    self.half = now
            if visit == last:
                break
            if still and (visit + 1) * P > steps:
                last = visit + 1


def rate_widths(
    problem: GainProblem, rates: tuple[int, ...], window: Window | None, gains: list[np.ndarray]
) -> RateWidths:
    """What gains, bounds of states, outputs of one state and rows of a window make of widths, where f and g are affine.

    All in the units of the problem.
    """
    n, l, q = problem.n, problem.l, problem.q
    present = pattern(rates)
    N = 1 if window is None else window.length
    support = problem.T2 != 0
    slopes, of_w, of_v, fixed, targets, holds = [], [], [], [], [], []

    def add(lags: list[np.ndarray], w: np.ndarray, v: np.ndarray, more: float, needs: list[np.ndarray], i: int) -> None:
        """`needs`: outputs of y[k], y[k-1], ... that a row uses, (l,) each."""
        slopes.append(np.abs([*lags, *[np.zeros(n)] * (N - len(lags))]))
        of_w.append(np.abs(w))
        of_v.append(np.abs(v))
        fixed.append(more)
        targets.append(i)
        lag = np.arange(len(present))[:, None] - np.arange(len(needs))
        holds.append((present[lag % len(present)] | ~np.array(needs)).all((1, 2)))

    for gain in gains:
        N_y, N_z, N_s = problem.split(gain)
        P = np.eye(n) - gain[:, l:] @ problem.C
        P = np.where(np.abs(P) < 1e-11 * (1 + np.abs(gain[:, l:]) @ np.abs(problem.C)), 0, P)
        slope, left = P @ problem.F - N_y @ problem.E, problem.residual(gain)[:, ~problem.free]
        slope = np.where(np.abs(slope) < 1e-13 * (1 + np.abs(P) @ np.abs(problem.F)), 0, slope)
        for i in range(n):
            more = float(np.abs(N_s[i]) @ problem.ds + np.abs(left[i]) @ problem.dd)
            v = np.abs(N_y[i]) + np.abs(N_z[i] @ problem.T2)
            add([slope[i]], P[i], v, more, [support[N_z[i] != 0].any(0), N_y[i] != 0], i)
    for i, bound in zip(problem.bounded_states, problem.ds, strict=True):
        add([], np.zeros(n), np.zeros(l), float(bound), [np.zeros(l, bool)], int(i))
    for j in range(q):
        if np.count_nonzero(problem.C[j]) == 1:
            i = int(np.flatnonzero(problem.C[j])[0])
            add([], np.zeros(n), problem.T2[j] / problem.C[j, i], 0.0, [support[j]], i)
    if window is not None:
        widths = WindowWidths.of(window, problem.F, problem.E, problem.T2, problem.dd)
        lags = slopes_by_lag(window, problem.F, problem.E)
        for r, i in enumerate(window.targets):
            needs = [support[window.remainder[r] != 0].any(0), *(window.multipliers[:, r, n:] != 0)]
            add(list(lags[:, r]), widths.noise_w[r], widths.noise_v[r], float(widths.fixed[r]), needs, i)
    return RateWidths(
        slopes=np.array(slopes).transpose(1, 0, 2), noise_w=np.array(of_w), noise_v=np.array(of_v),
        fixed=np.array(fixed), holds=np.array(holds).T, targets=tuple(targets), rates=rates,
    )  # fmt: skip
