"""Jacobian enclosures of the plant on a region, as NumPy centres and radii."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax import inclusion
from gsisio_jax.interval import Interval
from gsisio_jax.system import System


@dataclass(frozen=True)
class Slopes:
    """``df in F +- F_radius``, ``dg in E +- E_radius``, ``d(T2 g) in Z +- Z_radius`` on a box, jointly bounded.

    Source: design 4.2.
    """

    F: np.ndarray
    F_radius: np.ndarray
    E: np.ndarray
    E_radius: np.ndarray
    Z: np.ndarray
    Z_radius: np.ndarray

    @property
    def finite(self) -> bool:
        """Every bound is finite."""
        return all(np.isfinite(x).all() for x in (self.F_radius, self.E_radius, self.Z_radius))

    @property
    def affine(self) -> bool:
        """The enclosures are points: f and g are affine there."""
        return not any(x.any() for x in (self.F_radius, self.E_radius, self.Z_radius))


def slopes_on(system: System, T2: np.ndarray, box: Interval, u_box: Interval) -> Slopes:
    """Enclose the Jacobians on a box, uniformly over `u_box`; computed in float64 whatever JAX is set to."""
    with jax.enable_x64(True):
        box, u_box = box.astype(np.float64), u_box.astype(np.float64)
        T2_array = jnp.asarray(T2)
        maps = (system.dynamics, system.measurement, lambda x, u: T2_array @ system.measurement(x, u))
        # Compiled as one program: eager interval arithmetic would pay for every primitive apart.
        enclose = jax.jit(lambda box, u: [inclusion.jacobian(q)(box, u) for q in maps])
        found = enclose(box, u_box)
        parts = [_center_and_radius(jacobian) for jacobian in found]
    return Slopes(*parts[0], *parts[1], *parts[2])


def _center_and_radius(jacobian: Interval) -> tuple[np.ndarray, np.ndarray]:
    lower, upper = np.array(jacobian.lower, dtype=np.float64), np.array(jacobian.upper, dtype=np.float64)
    with np.errstate(invalid="ignore"):
        center = np.where(np.isfinite(lower) & np.isfinite(upper), 0.5 * lower + 0.5 * upper, 0.0)
        radius = np.maximum(upper - center, center - lower)
    return center, radius
