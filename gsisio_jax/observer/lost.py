"""How far bounds can be off because stored gains do not cancel exactly (theory 10)."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, magnitude
from gsisio_jax.interval.image import loose_matvec_upper
from gsisio_jax.interval.minmax import cut
from gsisio_jax.observer.bank import CancellationResidual
from gsisio_jax.observer.types import Observer


class Lost:
    """What the gains leave of x[k] and of d[k-1].

    ``|d[k-1]| <= inputs + input_state |x[k]|`` from every left inverse, and by the input bounds.
    """

    def __init__(self, observer: Observer, d_fixed: Interval):
        self.constants, self.limit = observer.rounding_constants, magnitude(observer.system.input_bounds)
        self.inputs = jnp.asarray(self.limit)
        if rounding.outward():
            for i, j in enumerate(self.constants.direct):
                V = self.constants.input_inverses[i]
                self.inputs = cut(self.inputs, loose_matvec_upper(V, magnitude(d_fixed[j])))

    def magnitudes(self, box: Interval) -> tuple[Any, Any]:
        """Bounds of ``|x[k]|`` (n,) and ``|d[k-1]|`` (p,), from a box of x[k]."""
        x = magnitude(box)
        return x, cut(jnp.asarray(self.limit), self.inputs + loose_matvec_upper(self.constants.input_state, x))

    def radius(self, residual: CancellationResidual, box: Interval) -> Any:
        """Radius (K, r) by which a bank's bounds are to be widened; None to nearest."""
        if not rounding.outward():
            return None
        return loose_matvec_upper(jnp.concatenate([residual.x, residual.d], -1), jnp.concatenate(self.magnitudes(box)))

    def of_inputs(self, weights: Any, box: Interval) -> Any:
        """The same for rows that leave only d[k-1], (..., p)."""
        return loose_matvec_upper(weights, self.magnitudes(box)[1]) if rounding.outward() else None


def plainly_wider(box: Interval, radius: Any) -> Interval:
    """A linear bound, wider by what gains leave; the rounding of one more sum is in what was widened before."""
    return box if radius is None else Interval.unchecked(box.lower - radius, box.upper + radius)
