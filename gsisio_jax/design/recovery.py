"""When do boxes become finite again: after lost rows of measurements, and from a state of which nothing is known?

From an unknown state rows of `dead_beat` prove it for affine plants. All else is tried on the nominal trajectory; where
f and g are affine, which boxes are infinite depends on no data, so the trial is the rule.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.interval.box import Interval
from gsisio_jax.observer.certificate import Certificate
from gsisio_jax.observer.delayed import DelayedObserver
from gsisio_jax.observer.enclosures import known
from gsisio_jax.observer.scan import advance, blank
from gsisio_jax.observer.types import Observer
from gsisio_jax.plant.system import Noise
from gsisio_jax.scalar.numpy_program import numpy_function

_MOST_STATES = 12  # beyond, a trial takes seconds, and is left out where rows prove as much
_FAR = 1e5  # widths from a bound that has no other side
_LISTED = 3  # so many lost rows at least, if they are no more than states: boxes are as wide as the gap is long


def with_recovery(observer: Observer | DelayedObserver, width: np.ndarray, u_region: Interval) -> Certificate:
    """The certificate, with `recoverable`, `recovery_steps`, `recovery_width`, `lost_row_steps` and `lost_row_width`.

    Args:
        observer: a finished observer.
        width: typical width (n,) of the box to start from.
        u_region: known inputs of the design; its centre is applied.
    """
    rows, n = (observer.inner if isinstance(observer, DelayedObserver) else observer).recovery, observer.system.n
    steps, reached = np.full(n, np.inf), np.full(n, np.inf)
    for group in [group for group in rows or () if group.anchor is None]:
        steps[list(group.targets)], reached[list(group.targets)] = group.length, group.width
    bounds = np.asarray(observer.system.state_bounds.width)
    at_once = np.where(steps == 0, np.minimum(reached, bounds), bounds)
    steps, reached = (np.where(np.isfinite(bounds), now, later) for now, later in ((0.0, steps), (at_once, reached)))
    proved = bool(np.isfinite(steps).all())
    trial = None if proved and n > _MOST_STATES else Trial.of(observer, u_region)
    if trial is None:
        lost = (_plain(steps),) if proved else ()
        return replace(
            observer.certificate, recoverable=proved, lost_row_steps=lost,
            recovery_steps=_plain(steps) if proved else (), recovery_width=reached if proved else None,
            lost_row_width=reached[None] if proved else None,
        )  # fmt: skip
    if not proved:
        steps, reached = _first_finite(trial.widths(observer.system.state_bounds, trial.rows))
    around = Interval.unchecked(trial.start - width / 2, trial.start + width / 2)
    found: list[tuple[float, ...]] = []
    then: list[np.ndarray] = []
    # After a gap no box comes back later than from any state, and then stays finite.
    for widths in trial.after_gaps(around, int(steps.max()) + 1 if np.isfinite(steps).all() else None):
        now, size = _first_finite(widths)
        found.append(_plain(now))
        then.append(size)
        if found[-1] == _plain(steps) and len(found) >= _LISTED:
            break  # more rows cannot take more than all that was known
    return replace(
        observer.certificate, recoverable=bool(np.isfinite(found[0]).all()), recovery_steps=_plain(steps),
        recovery_width=reached, lost_row_steps=tuple(found), lost_row_width=np.array(then),
    )  # fmt: skip


def _first_finite(widths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """After how many of these rows (T, n) a box is finite and stays so, (n,), and how wide it is there; ``inf`` where
    the last one is infinite."""
    infinite = np.isinf(widths)
    count = np.where(infinite.any(0), len(widths) - np.argmax(infinite[::-1], 0), 0)
    return np.where(infinite[-1], np.inf, count), widths[count.clip(max=len(widths) - 1), np.arange(widths.shape[1])]


def _plain(steps: np.ndarray) -> tuple[float, ...]:
    return tuple(map(float, steps))


class Trial:
    """A noise-free run from the centre of the region over n + 5 steps, and up to n more if it can be followed so long.
    In NumPy: a few steps take less time than the compilation of one.

    Where f and g are affine it is a run of which every bound is as far away on either side (`_centred`): boxes of other
    data meet each other and the bounds off their middle, and so are no wider.
    """

    def __init__(
        self, observer: Observer | DelayedObserver, start: np.ndarray, u: np.ndarray, rows: np.ndarray, noise: Noise
    ):
        self.observer, self.start, self.u, self.rows, self.noise = observer, start, u, rows, noise
        self.step: Any = None

    @classmethod
    def of(cls, observer: Observer | DelayedObserver, u_region: Interval) -> Trial | None:
        """None where the trajectory leaves the domain of f or g: nothing can be said for it."""
        system = observer.system
        least = system.n + 5 + _delay(observer)
        with jax.enable_x64(True):
            start, u = (np.asarray(box.center, np.float64) for box in (observer.certificate.region, u_region))
            noise = Noise.unchecked(*(known(box, np.float64) for box in (observer.noise.w, observer.noise.v)))
            if not observer.certificate.region_matters and _lopsided(system, noise):
                start, y, noise = _centred(observer, start, u, noise)
                return cls(observer, start, u, np.tile(y, (least + system.n, 1)), noise)
            d, w, v = (_nearest_to_zero(box) for box in (system.input_bounds, noise.w, noise.v))
            moved, seen = np.asarray(system.G) @ d + w, np.asarray(system.H) @ d + v

            def nominal(x: Any, u: Any) -> tuple[Any, Any]:
                """Output of this step and state of the next one, without noise."""
                y = system.measurement(x, u) + jnp.asarray(system.D) @ u
                x = system.dynamics(x, u) + jnp.asarray(system.B) @ u
                return y + seen if seen.any() else y, x + moved if moved.any() else x

            x, plant, rows = start, numpy_function(nominal, start, u), []
            while len(rows) < least + system.n:
                y, x = plant(x, u)
                if not np.isfinite(y).all():
                    break
                rows.append(y)
        return cls(observer, start, u, np.array(rows), noise) if len(rows) >= least else None

    @property
    def most_lost(self) -> int:
        """So many rows can be lost, and n + 4 follow: after n of them no more becomes infinite."""
        n = self.observer.system.n
        return min(n, len(self.rows) - _delay(self.observer) - n - 4)

    def widths(self, initial: Interval, rows: np.ndarray) -> np.ndarray:
        """Widths of the boxes of all steps, (T, n)."""
        carries = self._begin(initial)
        return np.max([self._widths(carry, rows)[1][_delay(self.observer) :] for carry in carries], 0)

    def after_gaps(self, initial: Interval, most: int | None) -> Iterator[np.ndarray]:
        """Widths (T, n) of the boxes from the first row on after gaps of 1, 2, ... `most_lost` rows behind the first
        one; of so many rows at most, or of all that there are."""
        delay, lost = _delay(self.observer), np.full_like(self.rows[0], np.nan)
        carries = [self._widths(carry, self.rows[:1])[0] for carry in self._begin(initial)]
        for count in range(1, self.most_lost + 1):
            carries = [self._widths(carry, [lost])[0] for carry in carries]
            after = self.rows[1 + count :]
            after = after if most is None else after[: most + delay]
            yield np.max([self._widths(carry, after)[1][delay:] for carry in carries], 0)

    def _begin(self, initial: Interval) -> list[Any]:
        """Carries before the first step: one, or one for every step of the run in which an input that is constant for
        some steps may change first."""
        with jax.enable_x64(True):
            box = known(initial, np.float64)
            carry = numpy_function(lambda box: blank(self.observer, box), box)(box)
        block = self.observer.system.input_constant or 1
        if carry.memory is None or block == 1:
            return [carry]
        phases = range(block - 1, max(-1, block - 2 - len(self.rows)), -1)
        return [replace(carry, memory=replace(carry.memory, phase=np.asarray(phase, np.float64))) for phase in phases]

    def _widths(self, carry: Any, rows: Any) -> tuple[Any, np.ndarray]:
        """The carry behind these rows, and the widths that the steps report, (T, n)."""
        found = []
        with jax.enable_x64(True):
            if self.step is None:
                self.step = numpy_function(self._step, carry, rows[0])
            for y in rows:
                carry, state = self.step(carry, y)
                found.append(np.asarray(state.upper) - np.asarray(state.lower))
        return carry, np.array(found)

    def _step(self, carry: Any, y: Any) -> tuple[Any, Interval]:
        after, out = advance(self.observer, carry, y, self.u, self.noise, False)
        return after, out.state


def _lopsided(system: Any, noise: Noise) -> bool:
    """Is a nominal run nearer to one side of some bound than to the other, or may it become so?"""
    boxes = system.input_bounds, noise.w, noise.v
    around_zero = all((np.asarray(box.lower) == -np.asarray(box.upper)).all() for box in boxes)
    bounds = np.array([system.state_bounds.lower, system.state_bounds.upper])
    return not around_zero or bool(np.isfinite(bounds).any())


def _centred(
    observer: Observer | DelayedObserver, start: np.ndarray, u: np.ndarray, noise: Noise
) -> tuple[np.ndarray, np.ndarray, Noise]:
    """A state that stays where it is, in the middle of its bounds as the input is, its output, and noise bounds that
    have the same widths and what keeps the state there in their middle.

    Widths of boxes of affine maps depend on data by where boxes and bounds are cut alone, and on no offset of w.
    """
    system, certificate = observer.system, observer.certificate
    x = _middle(system.state_bounds, start, np.asarray(certificate.steady_width))
    d = _middle(system.input_bounds, np.zeros(system.p), np.asarray(certificate.input_width))
    w, v = (np.asarray(box.center, np.float64) for box in (noise.w, noise.v))
    y = np.asarray(system.measurement(x, u)) + system.D @ u + system.H @ d + v
    stays = x - np.asarray(system.dynamics(x, u)) - system.B @ u - system.G @ d - w
    moved = Interval.unchecked(noise.w.lower + stays, noise.w.upper + stays)
    return x, np.asarray(y), Noise.unchecked(moved, noise.v)


def _middle(box: Interval, free: np.ndarray, width: np.ndarray) -> np.ndarray:
    """The centre of bounds; far from a bound that is alone, in widths of boxes; `free` where there is none."""
    low, high = np.asarray(box.lower, np.float64), np.asarray(box.upper, np.float64)
    below, above = np.isfinite(low), np.isfinite(high)
    far = 2 * _FAR * np.where(np.isfinite(width) & (width > 0), width, 1.0)
    from_one = np.where(below, low + far, np.where(above, high - far, free))
    both = below & above
    return np.where(both, 0.5 * np.where(both, low, 0) + 0.5 * np.where(both, high, 0), from_one)


def _nearest_to_zero(box: Interval) -> np.ndarray:
    return np.clip(0.0, np.asarray(box.lower, np.float64), np.asarray(box.upper, np.float64))


def _delay(observer: Observer | DelayedObserver) -> int:
    return observer.delay if isinstance(observer, DelayedObserver) else 0
