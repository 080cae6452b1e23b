"""Do the boxes become finite again after a lost row of measurements? Tried on the nominal trajectory."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.scalar.numpy_program import numpy_function
from gsisio_jax.interval.box import Interval
from gsisio_jax.observer.checks import prepare
from gsisio_jax.observer.scan import advance, blank
from gsisio_jax.observer.types import Observer


def recovers(observer: Observer, width: np.ndarray, u_region: Interval) -> bool:
    """Run the observer without noise from the centre of the region, lose y[1], and look at what is left n + 3 steps on.

    Args:
        observer: a finished observer.
        width: typical width (n,) of the box to start from.
        u_region: known inputs of the design; its centre is applied.
    """
    system = observer.system
    with jax.enable_x64(True):
        x = jnp.asarray(observer.certificate.region.center)
        u = jnp.asarray(u_region.center)
        box = Interval.unchecked(np.asarray(x) - width / 2, np.asarray(x) + width / 2)
        rows = []
        for _ in range(system.n + 5):
            rows.append(system.measurement(x, u) + jnp.asarray(system.D) @ u)
            x = system.dynamics(x, u) + jnp.asarray(system.B) @ u
        y = np.array(rows, dtype=np.float64)
        if not np.isfinite(y).all():
            return False  # the nominal trajectory leaves the domain of f or g: nothing can be said for it
        y[1] = np.nan
        start, y, us, noise, observer = prepare("estimate", observer, box, y, np.tile(u, (len(y), 1)), None, True)
        # A few steps in NumPy take less time than the compilation of one.
        carry = numpy_function(lambda box: blank(observer, box), start)(start)
        step = numpy_function(lambda *args: advance(observer, *args, noise, False), carry, y[0], us[0])
        last = start
        for row in zip(np.asarray(y), np.asarray(us), strict=True):
            carry, out = step(carry, *row)
            last = out.state
        return bool(np.isfinite(last.lower).all() and np.isfinite(last.upper).all())
