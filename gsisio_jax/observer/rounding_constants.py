"""From a design to an observer whose bounds hold on the machine: the constants that rounding asks for. NumPy, offline.

Everything here depends on the floating type, because gains are taken as the numbers they are in that type.

Source: theory 3, 5 and 10.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax import inclusion
from gsisio_jax.inclusion.transforms import AffineForm, affine_with_slack
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.cast import cast_down, cast_up
from gsisio_jax.observer.bank import LinearBounds
from gsisio_jax.observer.certificate import spectral_radius
from gsisio_jax.observer.residuals import (
    cancellation_residual,
    exact,
    nearest_feedthrough,
    rounded_up,
    row_cancellation_residual,
    upper_inverse,
    window_residual,
)
from gsisio_jax.observer.types import InitialContraction, Observer, RoundingConstants, cast
from gsisio_jax.scalar.numpy_program import numpy_function

_UP = 1 + 1e-12  # covers the rounding of a few float64 sums of nonnegative numbers
_STEPS = ((0.1, 1), (0.3, 3), (0.6, 5), (0.8, 8))  # see `_corrections`


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
    def affine(self) -> bool:
        """f and g are affine there."""
        return self.near_affine(self.F_radius, self.E_radius, self.Z_radius)


def slopes_of(system: Any, T2: Any, u_box: Interval, dtype: Any = np.float64) -> Callable[..., Slopes]:
    """Enclosures of the Jacobians as a function of the box (and of that of u), uniformly over `u_box` where no other is
    given; traced once for all boxes, run in NumPy, and computed in that type whatever JAX is set to."""

    def enclose(box: Interval, u: Interval) -> list[Interval]:
        T2_array = jnp.asarray(np.asarray(T2), dtype)
        maps = (system.dynamics, system.measurement, lambda x, u: T2_array @ system.measurement(x, u))
        return [inclusion.jacobian(q)(box, u) for q in maps]

    program: list[Callable[..., list[Interval]]] = []

    def on(box: Interval, u: Interval = u_box) -> Slopes:
        with _able_to_hold(dtype):
            boxes = known(box, dtype), known(u, dtype)
            if not program:
                program.append(numpy_function(enclose, *boxes))
            parts = [_center_and_distance(jacobian) for jacobian in program[0](*boxes)]
        return Slopes(*parts[0], *parts[1], *parts[2])

    return on


def known(box: Interval, dtype: Any) -> Interval:
    """`Interval.astype` in NumPy: JAX would compile each of its operations by itself."""
    lower, upper = (np.asarray(side) for side in (box.lower, box.upper))
    sides = np.asarray(cast_down(lower, dtype)), np.asarray(cast_up(upper, dtype))
    return Interval.unchecked(*rounding.normal(*sides))


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


def first_form(system: Any, T2: Any, u_region: Interval, dtype: Any = np.float64) -> tuple[AffineForm, np.ndarray]:
    """Affine bounds of T2 g on the state bounds, uniformly over `u_region`, and the slack of their slope (q, n): every
    step begins with them.

    Source: theory 5.3.
    """
    with _able_to_hold(dtype):
        matrix = jnp.asarray(np.asarray(T2), dtype)
        bounds, u_box = known(system.state_bounds, dtype), known(u_region, dtype)
        bound = affine_with_slack(lambda x, u: matrix @ system.measurement(x, u))
        form, slack = numpy_function(bound, bounds, u_box)(bounds, u_box)
        return form, np.asarray(slack, np.float64)


def contracting_gains(N_z: np.ndarray, Q: np.ndarray, C: Any, everywhere: Slopes) -> list[np.ndarray | None]:
    """For each gain an upper inverse of ``I - |N_z| R - Q`` on the state bounds, or None where there is none."""
    with np.errstate(invalid="ignore"):
        R = (np.abs(everywhere.Z - C) + everywhere.Z_radius) * _UP
    return [upper_inverse((_weighted(np.abs(weights), R) + left) * _UP) for weights, left in zip(N_z, Q, strict=True)]


def _weighted(weights: np.ndarray, R: np.ndarray) -> np.ndarray:
    """``weights @ R`` with 0 * inf = 0."""
    with np.errstate(invalid="ignore"):
        return np.where(weights[:, :, None] == 0, 0.0, weights[:, :, None] * R).sum(axis=1)


def single_precision(observer: Observer) -> Observer:
    """An observer that was designed in float64, for data in float32."""
    narrow = jax.tree.map(np.asarray, cast(observer, np.float32))
    narrow = replace(
        narrow, gains=with_output(narrow.gains, narrow.T2), inverses=with_output(narrow.inverses, narrow.T2)
    )
    system = observer.system
    u_region = observer.u_region if system.takes_u else Interval(np.zeros(system.m), np.zeros(system.m))

    slopes = slopes_of(system, narrow.T2, u_region, np.float32)
    region = slopes(observer.certificate.region)
    found = with_rounding_constants(
        narrow, system, region, slopes(system.state_bounds), *first_form(system, narrow.T2, u_region, np.float32),
        np.float32,
    )  # fmt: skip
    return jax.tree.map(lambda x: jnp.asarray(x, np.float32), found)


def with_rounding_constants(
    observer: Observer,
    plant: Any,
    region: Slopes,
    everywhere: Slopes,
    form: AffineForm,
    slack: np.ndarray,
    dtype: Any,
) -> Observer:
    """The observer with the constants that rounding asks for, its gains being what they are in `dtype`.

    Args:
        observer: with all arrays in NumPy, in `dtype` but for those that are filled in here.
        plant: the system as it was given, in float64.
        region, everywhere: enclosures of the derivatives on the region and on the state bounds.
        form, slack: from `first_form`.
        dtype: float64 or float32.
    """
    wide: Any = jax.tree.map(lambda x: np.asarray(x, np.float64), observer)
    system = plant
    n, p = system.n, system.p
    H_slack = nearest_feedthrough(wide.T2, system.H)
    common = (system, wide.C, wide.bounded_states, wide.bounded_inputs)
    of_gains = cancellation_residual(wide.gains, *common, True, H_slack)
    of_inverses = cancellation_residual(wide.inverses, *common, False, H_slack)

    # |d| <= input_inverse |d without x| + input_state |x|, from every left inverse of [G; H] itself.
    direct = [j for j in range(len(wide.inverses.residual)) if not wide.inverses.remainder[j].any()]
    direct = [j for j in direct if not (wide.inverses.output[j].any() or wide.inverses.bounds[j].any())]
    found = {j: upper_inverse(of_inverses.d[j]) for j in direct}
    inverses = {j: V for j, V in found.items() if V is not None}
    through = [V @ (np.abs(wide.inverses.state[j]) + of_inverses.x[j]) * _UP for j, V in inverses.items()]
    input_state = np.max(through, axis=0) if through else np.full((p, n), np.inf)
    with np.errstate(invalid="ignore"):
        Q = np.array([x + _weighted(d, input_state) for x, d in zip(of_gains.x, of_gains.d, strict=True)]) * _UP
    Q = Q.reshape(-1, n, n)

    N_z = wide.gains.remainder
    closed = contracting_gains(N_z, Q, wide.C, everywhere)
    linear = {k: _solved(N_z[k], Q[k], form, slack, wide.C, dtype) for k in range(len(N_z))}
    linear = {k: parts for k, parts in linear.items() if parts is not None}
    maps, left, bounds = (
        np.array(parts).reshape(-1, n, n) for parts in (zip(*linear.values(), strict=True) if linear else ((), (), ()))
    )

    implicit = (np.abs(N_z[0]) @ _R(region, wide.C)) * _UP if region.finite else np.full((n, n), np.inf)
    region_inverse = upper_inverse(implicit) if wide.certificate.promised else None
    rounding_constants = RoundingConstants(
        gains=_cast(of_gains, dtype),
        inverses=_cast(of_inverses, dtype),
        rows=_cast(
            row_cancellation_residual(wide.exact.rows, wide.exact.known, system, True, wide.bounded_inputs, H_slack),
            dtype,
        ),
        circuits=_cast(
            row_cancellation_residual(
                wide.exact.circuits, wide.exact.circuits_known, system, False, wide.bounded_inputs, H_slack
            ),
            dtype,
        ),
        input_inverses=_cast(np.array(list(inverses.values())).reshape(len(inverses), p, p), dtype),
        input_state=_cast(input_state, dtype),
        growth=_cast(_slope(-wide.gains.residual[0], region, n), dtype),
        input_growth=_cast(_slope(-wide.inverses.residual[0], region, n), dtype),
        feedthrough=_cast(H_slack, dtype),
        direct=tuple(inverses),
    )
    window = wide.window
    if window is not None:
        left_x, left_d = window_residual(window, system, wide.C, wide.bounded_inputs, H_slack)
        window = _cast_window(window, left_x, left_d, wide.T2, dtype)
    first = InitialContraction(
        form=None if system.g_takes_u else jax.tree.map(lambda x: np.asarray(x, dtype), form),
        slack=_cast(slack, dtype),
        inverses=_cast(np.array([V for V in closed if V is not None]).reshape(-1, n, n), dtype),
        cancellation_residual=_cast(Q, dtype),
        maps=np.asarray(maps, dtype),
        left=_cast(left, dtype),
        bounds=_cast(bounds, dtype),
        gains=tuple(k for k, V in enumerate(closed) if V is not None),
        linear=() if system.g_takes_u else tuple(linear),
        affine_output=everywhere.near_affine(everywhere.Z_radius),
    )
    inverse = np.zeros((n, n)) if region_inverse is None else region_inverse
    certificate = observer.certificate
    if certificate.promised and region_inverse is None:
        certificate = replace(certificate, promised=False)
    return replace(
        observer,
        first=first,
        rounding_constants=rounding_constants,
        region_inverse=_cast(inverse, dtype),
        window=window,
        corrections=_corrections(spectral_radius(implicit)) if certificate.promised else 0,
        certificate=certificate,
    )


def _corrections(rate: float) -> int:
    """Newton steps that leave less than a percent of the promised width, by the spectral radius of ``|N_z| R``.

    Where the slopes of psi vary most, a step brings a factor of 2.5: ranges to beacons, rate .86, one sweep, boxes as
    wide as the region: an excess of 360, 40, 3 and .1 % after 3, 5, 8 and 12 steps.
    """
    return 0 if rate < 1e-9 else next((steps for limit, steps in _STEPS if rate < limit), 12)


def with_output(bank: LinearBounds, T2: Any) -> LinearBounds:
    """The bank with ``output = remainder T2`` rounded once, and exactly 0 where it is 0: as `image` takes it to be."""
    dtype = bank.remainder.dtype
    products = [exact(Z).dot(exact(T2)) if Z.size else np.zeros((len(Z), T2.shape[1])) for Z in bank.remainder]
    return replace(bank, output=np.array(products, np.float64).reshape(bank.output.shape).astype(dtype))


def _cast_window(window: Any, left_x: np.ndarray, left_d: np.ndarray, T2: np.ndarray, dtype: Any) -> Any:
    """Multipliers as they are in that type; what they leave, rounded up; ``output = remainder T2`` rounded once."""
    output = exact(window.remainder).dot(exact(T2)).astype(np.float64).reshape(window.output.shape)
    stored = replace(window, output=output)
    stored = jax.tree.map(lambda x: np.asarray(x, dtype), replace(stored, left_x=np.zeros(0), left_d=np.zeros(0)))
    return replace(stored, left_x=_cast(left_x, dtype), left_d=_cast(left_d, dtype))


def _R(slopes: Slopes, C: Any) -> np.ndarray:
    return (np.abs(slopes.Z - C) + slopes.Z_radius) * _UP


def _slope(weights: np.ndarray, slopes: Slopes, n: int) -> np.ndarray:
    """Upper bound of the slope of ``weights [f; g]`` around its middle, for the enclosures' centers and radii."""
    F, radius = np.vstack([slopes.F, slopes.E]), np.vstack([slopes.F_radius, slopes.E_radius])
    if not np.isfinite(radius).all():
        return np.full((len(weights), n), np.inf)
    joint = rounded_up(exact(weights).dot(exact(F))) if weights.size else np.zeros((len(weights), n))
    return (joint + np.abs(weights) @ radius) * (1 + 1e-14)


def _solved(N_z: Any, Q: Any, form: AffineForm, slack: Any, C: Any, dtype: Any) -> Any:
    """K, what ``K A`` misses of the identity together with what rounding leaves, and its upper inverse.

    Here ``A = I + N_z (S - C)``.

    ``x = K (A x) + (I - K A) x``, and ``A x`` is known but for ``(|N_z| slack + Q) |x|``; so ``|x| <= |b| + left |x|``.
    """
    n = len(N_z)
    used = (N_z != 0).any(axis=0)
    offset = np.isfinite(form.offset.lower) & np.isfinite(form.offset.upper)
    if not offset[used].all():
        return None
    S = np.asarray(form.slope, np.float64)
    A = exact(np.eye(n)) + exact(N_z[:, used]).dot(exact(S[used]) - exact(np.asarray(C)[used]))
    plain = np.array(A, np.float64).reshape(n, n)
    if abs(np.linalg.det(plain)) <= 1e-6:
        return None
    K = np.asarray(np.linalg.inv(plain), dtype)
    K = np.where(np.abs(K) < 1e-13 * np.abs(K).max(initial=0.0), 0, K)
    missed = rounded_up(exact(np.eye(n)) - exact(K).dot(A))
    left = (missed + np.abs(np.float64(K)) @ (np.abs(N_z) @ slack + Q)) * _UP
    V = upper_inverse(left)
    return None if V is None else (K, left, V)


def _cast(tree: Any, dtype: Any) -> Any:
    """Nonnegative arrays in another type, rounded up."""

    def up(x: Any) -> np.ndarray:
        with np.errstate(over="ignore"):
            narrow = np.asarray(x, dtype)
        return np.where(narrow < x, np.nextafter(narrow, np.asarray(np.inf, dtype)), narrow)

    return jax.tree.map(up, tree)
