"""Do the boxes become finite again after a lost row of measurements? Tried on the nominal trajectory."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.interval.box import Interval
from gsisio_jax.observer.delayed import DelayedObserver
from gsisio_jax.observer.rounding_constants import known
from gsisio_jax.observer.scan import advance, blank
from gsisio_jax.observer.types import Observer
from gsisio_jax.plant.system import Noise
from gsisio_jax.scalar.numpy_program import numpy_function


def recovers(observer: Observer | DelayedObserver, width: np.ndarray, u_region: Interval) -> bool:
    """Run the observer without noise from the centre of the region, lose y[1], and look at what is left n + 3 steps on.

    Args:
        observer: a finished observer.
        width: typical width (n,) of the box to start from.
        u_region: known inputs of the design; its centre is applied.
    """
    system = observer.system

    def nominal(x: Any, u: Any) -> tuple[Any, Any]:
        """Output of this step and state of the next one, without noise."""
        y = system.measurement(x, u) + jnp.asarray(system.D) @ u
        return y, system.dynamics(x, u) + jnp.asarray(system.B) @ u

    # In NumPy: a few steps take less time than the compilation of one.
    with jax.enable_x64(True):
        x, u = (np.asarray(box.center, np.float64) for box in (observer.certificate.region, u_region))
        start = known(Interval.unchecked(x - width / 2, x + width / 2), np.float64)
        noise = Noise.unchecked(*(known(box, np.float64) for box in (observer.noise.w, observer.noise.v)))
        plant, rows = numpy_function(nominal, x, u), []
        for _ in range(system.n + 5 + getattr(observer, "delay", 0)):
            y, x = plant(x, u)
            rows.append(y)
        if not np.isfinite(rows).all():
            return False  # the nominal trajectory leaves the domain of f or g: nothing can be said for it
        rows[1] = np.full(system.l, np.nan)
        carry, box = numpy_function(lambda box: blank(observer, box), start)(start), start
        step = numpy_function(lambda c, y, u, noise: advance(observer, c, y, u, noise, False), carry, rows[0], u, noise)
        for y in rows:
            carry, out = step(carry, y, u, noise)
            box = out.state
        return bool(np.isfinite(box.lower).all() and np.isfinite(box.upper).all())
