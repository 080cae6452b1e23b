"""Enclosures of a plant on a box, offline and in NumPy: of its Jacobians, and affine bounds on the state bounds."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax import inclusion
from gsisio_jax.inclusion.transforms import AffineForm, affine_with_slack
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.cast import cast_known
from gsisio_jax.scalar.numpy_program import numpy_function


class Slopes(eqx.Module):
    """``df in F +- F_radius``, ``dg in E +- E_radius``, ``d(T2 g) in Z +- Z_radius`` on a box, jointly bounded.

    Source: theory 4.
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

    def near_affine(self, *radii: np.ndarray) -> bool:
        """These radii are what rounding makes of a point: the function is affine there."""
        size = max((np.abs(x).max(initial=0.0) for x in (self.F, self.E, self.Z)), default=0.0)
        return all((x <= 1e-12 * max(size, 1.0)).all() for x in radii)

    @property
    def bent_outputs(self) -> np.ndarray:
        """(n,): in which states T2 g is not affine."""
        return np.array([not self.near_affine(column) for column in self.Z_radius.T], bool)

    @property
    def bent_states(self) -> np.ndarray:
        """(n,): in which states f, g or T2 g is not affine."""
        radii = np.concatenate([self.F_radius, self.E_radius, self.Z_radius])
        return np.array([not self.near_affine(column) for column in radii.T], bool)

    @property
    def affine(self) -> bool:
        """f and g are affine there."""
        return self.near_affine(self.F_radius, self.E_radius, self.Z_radius)


def slopes_of(system: Any, T2: Any, u_box: Interval, dtype: Any = np.float64) -> Callable[..., Slopes]:
    """Enclosures of the Jacobians as a function of the box (and of that of u), uniformly over `u_box` where no other is
    given; traced once for all boxes, run in NumPy, and computed in that type whatever JAX is set to."""

    def enclose(box: Interval, u: Interval) -> list[Interval]:
        T2_array = jnp.asarray(np.asarray(T2), dtype)

        def outputs(x: Any, u: Any) -> Any:
            """g and T2 g: what they share is followed once."""
            y = system.measurement(x, u)
            return jnp.concatenate([y, T2_array @ y])

        of_f, of_g = (inclusion.jacobian(q)(box, u) for q in (system.dynamics, outputs))
        return [of_f, of_g[: system.l], of_g[system.l :]]

    program = _traced_once(enclose)

    def on(box: Interval, u: Interval = u_box) -> Slopes:
        with _able_to_hold(dtype):
            parts = [_center_and_distance(jacobian) for jacobian in program(known(box, dtype), known(u, dtype))]
        return Slopes(*parts[0], *parts[1], *parts[2])

    return on


class Enclosures(NamedTuple):
    """What is known of a plant on a box of states, uniformly over a box of known inputs; traced once for all boxes.

    Attributes:
        slopes: from `slopes_of`.
        outputs: from `outputs_of`.
    """

    slopes: Callable[..., Slopes]
    outputs: Callable[[Interval], tuple[AffineForm, np.ndarray]]

    @staticmethod
    def of(system: Any, T2: Any, u_region: Interval) -> Enclosures:
        return Enclosures(slopes_of(system, T2, u_region), outputs_of(system, T2, u_region))


def known(box: Interval, dtype: Any) -> Interval:
    """`Interval.astype` in NumPy: JAX would compile each of its operations by itself."""
    lower, upper = (np.asarray(side) for side in (box.lower, box.upper))
    sides = cast_known(lower, dtype, -np.inf), cast_known(upper, dtype, np.inf)
    return Interval.unchecked(*rounding.normal(*sides))


def _traced_once(function: Callable[..., Any]) -> Callable[..., Any]:
    """`numpy_function` of it, made at the first call, for the shapes and types of all."""
    program: list[Callable[..., Any]] = []

    def run(*boxes: Interval) -> Any:
        if not program:
            program.append(numpy_function(function, *boxes))
        return program[0](*boxes)

    return run


def _able_to_hold(dtype: Any) -> Any:
    """64-bit types are switched on where they are needed. They are never switched off: JAX keeps what it has traced of
    an f with NumPy constants, and mistakes the one for the other when the setting changes to and fro."""
    return jax.enable_x64(True) if np.dtype(dtype) == np.float64 else nullcontext()


def _center_and_distance(jacobian: Interval) -> tuple[np.ndarray, np.ndarray]:
    """The center as it is in float64, and the largest distance from it, rounded up; 0 for points."""
    lower, upper = np.array(jacobian.lower, dtype=np.float64), np.array(jacobian.upper, dtype=np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        center = Interval.unchecked(lower, upper).center
        radius = np.maximum(upper - center, center - lower)
    return center, np.where(lower == upper, 0.0, np.nextafter(radius, np.inf))


def outputs_of(
    system: Any, T2: Any, u_region: Interval, dtype: Any = np.float64
) -> Callable[[Interval], tuple[AffineForm, np.ndarray]]:
    """Affine bounds of T2 g on a box of states, uniformly over `u_region`, and the slack of their slope (q, n): every
    step begins with those on the state bounds.

    Source: theory 5.3.
    """
    matrix = np.asarray(T2, dtype)
    return affine_of(lambda x, u: matrix @ system.measurement(x, u), u_region, dtype)


def affine_of(
    function: Callable[..., Any], u_region: Interval, dtype: Any
) -> Callable[[Interval], tuple[AffineForm, np.ndarray]]:
    """Affine bounds of a function of x and u as a function of the box of x, uniformly over `u_region`, and the slack of
    their slope (q, n); traced once for all boxes, as in `slopes_of`, and computed once for each."""
    program = _traced_once(affine_with_slack(function))
    found: dict[bytes, tuple[AffineForm, np.ndarray]] = {}

    def on(box: Interval) -> tuple[AffineForm, np.ndarray]:
        with _able_to_hold(dtype):
            boxes = known(box, dtype), known(u_region, dtype)
            key = boxes[0].lower.tobytes() + boxes[0].upper.tobytes()
            if key not in found:
                form, slack = program(*boxes)
                found[key] = form, np.asarray(slack, np.float64)
            return found[key]

    return on
