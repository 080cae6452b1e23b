"""Affine abstraction of f and g for the observers: over states and known inputs together."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp

from gsisio_jax.design.abstraction import affine_abstraction
from gsisio_jax.inclusion.planes import Abstraction
from gsisio_jax.interval.box import Interval
from gsisio_jax.plant.system import System


def plane_bounds(
    system: System, function: Callable[[Any, Any], Any], region: Interval, u_region: Interval
) -> Abstraction:
    """Planes of ``function(x, u)`` over region x u_region (over the region alone where it does not take u)."""
    n = system.n
    if not system.takes_u:
        return affine_abstraction(lambda x: function(x, jnp.zeros(system.m, x.dtype)), region)
    both = Interval(
        *(jnp.concatenate([a, b]) for a, b in ((region.lower, u_region.lower), (region.upper, u_region.upper)))
    )
    return affine_abstraction(lambda z: function(z[:n], z[n:]), both)
