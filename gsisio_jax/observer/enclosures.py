"""Enclosures of a plant on a box, offline and in NumPy: of its Jacobians, and affine bounds on the state bounds."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax import inclusion
from gsisio_jax.inclusion.transforms import AffineForm, affine_and_jacobian
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.cast import cast_known
from gsisio_jax.observer.known_inputs import input_matrix
from gsisio_jax.scalar.numpy_program import numpy_functions

_Program = Callable[..., Any]
BoundsOfBox = Callable[[Interval], tuple[AffineForm, np.ndarray]]
"""Affine bounds of a function of x on a box, and the slack of their slope."""
SlopesOfBox = Callable[..., "Slopes"]
"""`Slopes` on a box of x; on one of u, too, if it is given."""


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


def slopes_of(system: Any, T2: Any, u_box: Interval, dtype: Any = np.float64) -> SlopesOfBox:
    """Enclosures of the Jacobians as a function of the box (and of that of u), uniformly over `u_box` where no other is
    given; traced once for all boxes, run in NumPy, and computed in that type whatever JAX is set to. `Enclosures` have
    affine bounds, too."""
    bounds = inclusion.jacobian(all_maps(system, T2, dtype))
    return _slopes(system, _traced_once(lambda *boxes: (bounds(*boxes),), 1)[0], u_box, dtype)


def _slopes(system: Any, jacobian: _Program, u_box: Interval, dtype: Any) -> SlopesOfBox:
    ends = np.cumsum([system.n, system.l])

    def on(box: Interval, u: Interval = u_box) -> Slopes:
        with _able_to_hold(dtype):
            center, radius = _center_and_distance(jacobian(known(box, dtype), known(u, dtype)))
        F, E, Z = zip(np.split(center, ends), np.split(radius, ends), strict=True)
        return Slopes(*F, *E, *Z)

    return on


def all_maps(system: Any, T2: Any, dtype: Any) -> Callable[[Any, Any], Any]:
    """[f; g; T2 g] of x and u, (n + l + q,): what they have in common is traced once."""
    matrix = np.asarray(T2, dtype)

    def maps(x: Any, u: Any) -> Any:
        g = system.measurement(x, u)
        return jnp.concatenate([system.dynamics(x, u), g, matrix @ g])

    return maps


class Enclosures(NamedTuple):
    """What is known of a plant on a box of states, uniformly over a box of known inputs; the maps are walked through
    once for all of it and for all boxes.

    Attributes:
        slopes: as from `slopes_of`.
        outputs: affine bounds of T2 g on a box of states, and the slack of their slope (q, n): every step begins with
            those on the state bounds. Source: theory 5.3.
        maps: the same of [f; g; T2 g], without known inputs; None where these enter in another way than by a matrix
            (`known_inputs`), or angles come back to where they were.
    """

    slopes: SlopesOfBox
    outputs: BoundsOfBox
    maps: BoundsOfBox | None

    @staticmethod
    def of(system: Any, T2: Any, u_region: Interval, dtype: Any = np.float64) -> Enclosures:
        of_all, first = affine_and_jacobian(all_maps(system, T2, dtype), with_slack=True), system.n + system.l
        outputs_alone = bool(system.periodic_states) or (system.takes_u and not _moved_by_inputs(system, dtype))

        def bounds(x: Interval, u: Interval) -> tuple[Any, Any]:
            affine, jacobian = of_all(x, u)
            return _rows_from(first, affine) if outputs_alone else affine, jacobian

        affine, jacobian = _traced_once(bounds, 2)
        slopes, found = _slopes(system, jacobian, u_region, dtype), _affine(affine, u_region, dtype)
        if outputs_alone:
            return Enclosures(slopes, found, None)
        still = np.zeros(system.m)
        maps = _affine(affine, Interval.unchecked(still, still), dtype) if system.takes_u else found
        return Enclosures(slopes, lambda box: _rows_from(first, found(box)), maps)


def _moved_by_inputs(system: Any, dtype: Any) -> bool:
    """Known inputs only move f and g, as ``B u`` and ``D u`` do."""
    with _able_to_hold(dtype):
        return input_matrix(system, dtype) is not None


def _rows_from(first: int, affine: Any) -> Any:
    return jax.tree.map(lambda rows: rows[first:], affine)


def known(box: Interval, dtype: Any) -> Interval:
    """`Interval.astype` in NumPy: JAX would compile each of its operations by itself."""
    lower, upper = (np.asarray(side) for side in (box.lower, box.upper))
    sides = cast_known(lower, dtype, -np.inf), cast_known(upper, dtype, np.inf)
    return Interval.unchecked(*rounding.normal(*sides))


def _traced_once(function: Callable[..., tuple[Any, ...]], parts: int) -> list[_Program]:
    """`numpy_functions` of it, made at the first call, for the shapes and types of all."""
    programs: list[_Program] = []

    def of(part: int, *boxes: Interval) -> Any:
        if not programs:
            programs.extend(numpy_functions(function, *boxes))
        return programs[part](*boxes)

    return [partial(of, part) for part in range(parts)]


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


def _affine(program: _Program, u_region: Interval, dtype: Any) -> BoundsOfBox:
    """Affine bounds and their slack as a function of the box of x, uniformly over `u_region`; once for each."""
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
