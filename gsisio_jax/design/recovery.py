"""When do boxes become finite again: after a lost row of measurements, and from a state of which nothing is known?

Rows of `dead_beat` prove it for affine plants; for others it is tried on the nominal trajectory.
"""

from __future__ import annotations

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


def with_recovery(observer: Observer | DelayedObserver, width: np.ndarray, u_region: Interval) -> Certificate:
    """The certificate, with `recoverable`, `recovery_steps` and `recovery_width`.

    Args:
        observer: a finished observer.
        width: typical width (n,) of the box to start from.
        u_region: known inputs of the design; its centre is applied.
    """
    rows, n = (observer.inner if isinstance(observer, DelayedObserver) else observer).recovery, observer.system.n
    if rows is not None:
        return replace(
            observer.certificate, recoverable=True, recovery_steps=(rows.length,) * n,
            recovery_width=np.asarray(rows.width, np.float64),
        )  # fmt: skip
    trial = Trial.of(observer, u_region)
    if trial is None:
        return replace(observer.certificate, recoverable=False)
    lost = trial.rows.copy()
    lost[1] = np.nan
    around = Interval.unchecked(trial.start - width / 2, trial.start + width / 2)
    recoverable = bool(np.isfinite(trial.widths(around, lost)[-1]).all())
    widths = trial.widths(observer.system.state_bounds, trial.rows)
    finite = np.isfinite(widths)
    steps = tuple(float(np.argmax(column)) if column.any() else np.inf for column in finite.T)
    return replace(observer.certificate, recoverable=recoverable, recovery_steps=steps, recovery_width=widths[-1])


class Trial:
    """A noise-free run from the centre of the region over n + 5 steps. In NumPy: a few steps take less time than the
    compilation of one."""

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
            for _ in range(system.n + 5 + _delay(observer)):
                y, x = plant(x, u)
                rows.append(y)
        return cls(observer, start, u, np.array(rows)) if np.isfinite(rows).all() else None

    def widths(self, initial: Interval, rows: np.ndarray) -> np.ndarray:
        """Widths of the boxes of the first n + 5 steps, (n + 5, n)."""
        with jax.enable_x64(True):
            begin = known(initial, np.float64)
            carry = numpy_function(lambda box: blank(self.observer, box), begin)(begin)
            if self.step is None:
                self.step = numpy_function(
                    lambda c, y, u, noise: advance(self.observer, c, y, u, noise, False),
                    carry, rows[0], self.u, self.noise,
                )  # fmt: skip
            found = []
            for y in rows:
                carry, out = self.step(carry, y, self.u, self.noise)
                found.append(np.asarray(out.state.upper) - np.asarray(out.state.lower))
        return np.array(found[_delay(self.observer) :])


def _delay(observer: Observer | DelayedObserver) -> int:
    return observer.delay if isinstance(observer, DelayedObserver) else 0
