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
    In NumPy: a few steps take less time than the compilation of one."""

    def __init__(self, observer: Observer | DelayedObserver, start: np.ndarray, u: np.ndarray, rows: np.ndarray):
        self.observer, self.start, self.u, self.rows = observer, start, u, rows
        self.noise = Noise.unchecked(*(known(box, np.float64) for box in (observer.noise.w, observer.noise.v)))
        self.step: Any = None

    @classmethod
    def of(cls, observer: Observer | DelayedObserver, u_region: Interval) -> Trial | None:
        """None where the trajectory leaves the domain of f or g: nothing can be said for it."""
        system = observer.system

        def nominal(x: Any, u: Any) -> tuple[Any, Any]:
            """Output of this step and state of the next one, without noise."""
            y = system.measurement(x, u) + jnp.asarray(system.D) @ u
            return y, system.dynamics(x, u) + jnp.asarray(system.B) @ u

        with jax.enable_x64(True):
            start, u = (np.asarray(box.center, np.float64) for box in (observer.certificate.region, u_region))
            x, plant, rows = start, numpy_function(nominal, start, u), []
            least = system.n + 5 + _delay(observer)
            while len(rows) < least + system.n:
                y, x = plant(x, u)
                if not np.isfinite(y).all():
                    break
                rows.append(y)
        return cls(observer, start, u, np.array(rows)) if len(rows) >= least else None

    @property
    def most_lost(self) -> int:
        """So many rows can be lost, and n + 4 follow: after n of them no more becomes infinite."""
        n = self.observer.system.n
        return min(n, len(self.rows) - _delay(self.observer) - n - 4)

    def widths(self, initial: Interval, rows: np.ndarray) -> np.ndarray:
        """Widths of the boxes of all steps, (T, n)."""
        return self._widths(self._begin(initial), rows)[1][_delay(self.observer) :]

    def after_gaps(self, initial: Interval, most: int | None) -> Iterator[np.ndarray]:
        """Widths (T, n) of the boxes from the first row on after gaps of 1, 2, ... `most_lost` rows behind the first
        one; of so many rows at most, or of all that there are."""
        delay, lost = _delay(self.observer), np.full_like(self.rows[0], np.nan)
        carry, _ = self._widths(self._begin(initial), self.rows[:1])
        for count in range(1, self.most_lost + 1):
            carry, _ = self._widths(carry, [lost])
            after = self.rows[1 + count :]
            yield self._widths(carry, after if most is None else after[: most + delay])[1][delay:]

    def _begin(self, initial: Interval) -> Any:
        """The carry before the first step."""
        with jax.enable_x64(True):
            box = known(initial, np.float64)
            return numpy_function(lambda box: blank(self.observer, box), box)(box)

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


def _delay(observer: Observer | DelayedObserver) -> int:
    return observer.delay if isinstance(observer, DelayedObserver) else 0
