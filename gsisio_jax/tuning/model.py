"""An observer for a plant whose f and g have other numbers, as a differentiable function of them."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from gsisio_jax import inclusion
from gsisio_jax.interval.box import Interval
from gsisio_jax.observer.types import Observer
from gsisio_jax.plant.system import System


def with_model(observer: Observer, system: System) -> Observer:
    """The same gains on another f and g: everything that the design derived from f and g is computed anew.

    Any gain that cancels the unknown input is sound for every f and g, because the slopes C are a choice. What rests on
    enclosures of the derivatives does change: how a step begins, and the certificate. What rounding leaves of the gains
    is known for given numbers only, so the result rounds to nearest.

    Args:
        observer: designed for a system with the same matrices and bounds.
        system: may close over traced numbers.

    Raises:
        ValueError: the systems differ in more than numbers of f and g, or the bounds use planes found offline.

    Source: theory 3 and 4.
    """
    old = observer.system
    for name in ("G", "H", "B", "D"):
        if not np.array_equal(getattr(old, name), getattr(system, name)):
            raise ValueError(f"with_model: the models must share the matrix {name}; only f and g may change")
    if (old.periodic, old.periodic_states) != (system.periodic, system.periodic_states):
        raise ValueError("with_model: the models must have the same periodic outputs and states")
    if (old.f_takes_u, old.g_takes_u) != (system.f_takes_u, system.g_takes_u):
        raise ValueError("with_model: f and g must take the same arguments as those of the design")
    if "abstraction" in observer.bounds:
        raise ValueError('with_model: the bounds "abstraction" were found offline for one model; design without them')
    T2 = jnp.asarray(observer.T2)
    certificate, first, n = observer.certificate, observer.first, old.n
    u_region = observer.u_region if old.takes_u else Interval(np.zeros(old.m), np.zeros(old.m))

    def outputs(x: object, u: object) -> jnp.ndarray:
        return T2 @ system.measurement(x, u)

    def reach(box: Interval) -> jnp.ndarray:
        """R: bound of the derivative of T2 g(x) - C x."""
        slope = inclusion.jacobian(outputs, "nearest")(box, u_region)
        return jnp.maximum(jnp.abs(slope.lower - observer.C), jnp.abs(slope.upper - observer.C))

    form = first.form
    if form is not None:
        form = inclusion.affine(outputs, "nearest")(old.state_bounds, jnp.zeros(old.m))
    # Where T2 g was affine with slope C, psi was 0 and is not any more.
    first = replace(first, form=form, linear=(), affine_output=False)
    if first.gains:
        whole = reach(old.state_bounds)
        weights = jnp.stack([jnp.abs(jnp.asarray(observer.gains.remainder[k])) for k in first.gains])
        first = replace(first, inverses=jnp.linalg.inv(jnp.eye(n, dtype=whole.dtype) - weights @ whole))
    changed = replace(observer, system=system, first=first, rounding="nearest")
    if not certificate.promised:
        return changed
    slopes = inclusion.jacobian(system.maps, "nearest")(certificate.region, u_region)
    center, radius = 0.5 * (slopes.lower + slopes.upper), 0.5 * (slopes.upper - slopes.lower)

    def spread(rows: object) -> jnp.ndarray:
        weights = jnp.asarray(rows)
        return jnp.abs(weights @ center) + jnp.abs(weights) @ radius

    implicit = jnp.abs(jnp.asarray(observer.gains.remainder[0])) @ reach(certificate.region)
    growth = spread(observer.gains.residual[0])
    before = spread(observer.inverses.residual[0])
    return replace(
        changed,
        certificate=replace(certificate, growth=growth, implicit=implicit, input_state_before=before),
        rounding_constants=replace(observer.rounding_constants, growth=growth, input_growth=before, implicit=implicit),
        region_inverse=jnp.linalg.inv(jnp.eye(n, dtype=growth.dtype) - implicit),
    )
