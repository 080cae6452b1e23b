"""From a design to an observer whose bounds hold on the machine: the constants that rounding asks for. NumPy, offline.

Everything here depends on the floating type, because gains are taken as the numbers they are in that type.

Source: theory 3, 5 and 10.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.transforms import AffineForm
from gsisio_jax.interval.box import Interval
from gsisio_jax.observer.bank import LinearBounds
from gsisio_jax.observer.certificate import Certificate, spectral_radius
from gsisio_jax.observer.enclosures import Enclosures, Slopes, known
from gsisio_jax.observer.recovery_constants import AffineMaps, with_constants
from gsisio_jax.observer.residuals import (
    cancellation_residual,
    exact,
    input_row_residual,
    nearest_feedthrough,
    product,
    rounded_up,
    row_cancellation_residual,
    upper_inverse,
    window_residual,
)
from gsisio_jax.observer.slice_bounds import slices_of
from gsisio_jax.observer.slices import Slices
from gsisio_jax.observer.types import InitialContraction, Observer, RoundingConstants, cast

_UP = 1 + 1e-12  # covers the rounding of a few float64 sums of nonnegative numbers
_STEPS = ((0.1, 1), (0.3, 3), (0.6, 5), (0.8, 8))  # see `_corrections`


def _slices(narrow: Observer, slopes_on: Callable[[Interval], Slopes]) -> Slices | None:
    """The slices of the certificate for gains of single precision."""
    certificate = narrow.certificate
    if certificate.slices is None:
        return None
    edges = np.array(certificate.slices.edges)
    edges[:, 0], edges[:, -1] = certificate.region.lower, certificate.region.upper
    return slices_of(np.asarray(narrow.gains.residual[0], np.float64), slopes_on, edges, np.float32, parts=2)


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

    on = Enclosures.of(system, narrow.T2, u_region, np.float32)
    region = on.slopes(observer.certificate.region)
    affine = AffineMaps.of(on.maps, system.state_bounds) if observer.recovery else None
    found = with_rounding_constants(
        narrow, system, region, on.slopes(system.state_bounds), *on.outputs(system.state_bounds),
        affine, np.float32, _slices(narrow, on.slopes),
    )  # fmt: skip
    return jax.tree.map(lambda x: jnp.asarray(x, np.float32), found)


def with_rounding_constants(
    observer: Observer,
    plant: Any,
    region: Slopes,
    everywhere: Slopes,
    form: AffineForm,
    slack: np.ndarray,
    affine: AffineMaps | None,
    dtype: Any,
    slices: Slices | None = None,
) -> Observer:
    """The observer with the constants that rounding asks for, its gains being what they are in `dtype`.

    Args:
        observer: with all arrays in NumPy, in `dtype` but for those that are filled in here.
        plant: the system as it was given, in float64.
        region, everywhere: enclosures of the derivatives on the region and on the state bounds.
        form, slack: from `Enclosures.outputs`.
        affine: bounds that rows of recovery stand on; needed where there are any.
        dtype: float64 or float32.
        slices: slopes of the certified gain on parts of the region.
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
        slices=slices,
        implicit=_cast(implicit, dtype),
        rounds=wide.certificate.rounds,
    )
    window = wide.window
    if window is not None:
        left_x, left_d = window_residual(window, system, wide.C, wide.bounded_inputs, H_slack)
        window = _cast_window(window, left_x, left_d, wide.T2, dtype)
    input_rows = wide.input_rows
    if input_rows is not None:
        input_rows = with_input_residual(input_rows, system, H_slack, dtype)
    recovery = [stored_recovery(rows, wide, system, affine, H_slack, dtype) for rows in wide.recovery or () if affine]
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
        recovery=tuple(rows for rows in recovery if rows is not None),
        input_rows=input_rows,
        corrections=_corrections(spectral_radius(implicit), certificate) if certificate.promised else 0,
        certificate=certificate,
    )


def _corrections(rate: float, certificate: Certificate) -> int:
    """Newton steps that leave less than a percent of the promised width, by the spectral radius of ``|N_z| R``; the
    rounds of the certificate, which follow, are enough where that is small and the region bounded.

    Where the slopes of psi vary most, a step brings a factor of 2.5: ranges to beacons, rate .86, one sweep, boxes as
    wide as the region: an excess of 360, 40, 3 and .1 % after 3, 5, 8 and 12 steps.
    """
    bounded = bool(certificate.rounds) and np.isfinite(np.asarray(certificate.region.width)).all()
    if rate < 1e-9 or (rate < 0.1 and bounded):
        return 0
    return next((steps for limit, steps in _STEPS if rate < limit), 12)


def with_output(bank: LinearBounds, T2: Any) -> LinearBounds:
    """The bank with ``output = remainder T2`` rounded once, and exactly 0 where it is 0: as `image` takes it to be."""
    dtype = bank.remainder.dtype
    products = [_rounded_once(Z, T2) for Z in bank.remainder]
    return replace(bank, output=np.array(products).reshape(bank.output.shape).astype(dtype))


def _rounded_once(remainder: np.ndarray, T2: Any) -> np.ndarray:
    """``remainder T2`` (r, l) in float64."""
    return np.asarray(product(exact(remainder), exact(T2)), np.float64).reshape(len(remainder), T2.shape[1])


def _cast_window(window: Any, left_x: np.ndarray, left_d: np.ndarray, T2: np.ndarray, dtype: Any) -> Any:
    """Multipliers as they are in that type; what they leave, rounded up; ``output = remainder T2`` rounded once."""
    stored = replace(window, output=_rounded_once(window.remainder, T2))
    stored = jax.tree.map(lambda x: np.asarray(x, dtype), replace(stored, left_x=np.zeros(0), left_d=np.zeros(0)))
    return replace(stored, left_x=_cast(left_x, dtype), left_d=_cast(left_d, dtype))


def with_input_residual(rows: Any, system: Any, H_slack: np.ndarray, dtype: Any) -> Any:
    """Rows for inputs as they are in that type, with what they leave."""
    rows = jax.tree.map(lambda x: np.asarray(x, dtype), rows)
    left, left_now = input_row_residual(rows, system, H_slack)
    return replace(rows, left=_cast(left, dtype), left_now=_cast(left_now, dtype))


def stored_recovery(rows: Any, wide: Any, system: Any, affine: AffineMaps, H_slack: np.ndarray, dtype: Any) -> Any:
    """Rows of recovery, as `_cast_window`; None where they do not hold in that type."""
    rows = replace(rows, output=_rounded_once(rows.remainder, wide.T2))
    rows = jax.tree.map(lambda x: np.asarray(x, dtype).astype(np.float64), rows)
    free = ~(wide.bounded_inputs != 0).any(0)
    found = with_constants(rows, system, affine, wide.T2, H_slack, free, dtype)
    if found is None:
        return None
    sides = known(found.constant, dtype)
    names = "slack", "scales", "floor", "width", "anchor_scales"
    upward = {name: _cast(getattr(found, name), dtype) for name in names}
    return replace(jax.tree.map(lambda x: np.asarray(x, dtype), found), constant=sides, **upward)


def _R(slopes: Slopes, C: Any) -> np.ndarray:
    return (np.abs(slopes.Z - C) + slopes.Z_radius) * _UP


def _slope(weights: np.ndarray, slopes: Slopes, n: int) -> np.ndarray:
    """Upper bound of the slope of ``weights [f; g]`` around its middle, for the enclosures' centers and radii."""
    F, radius = np.vstack([slopes.F, slopes.E]), np.vstack([slopes.F_radius, slopes.E_radius])
    if not np.isfinite(radius).all():
        return np.full((len(weights), n), np.inf)
    joint = rounded_up(product(exact(weights), exact(F))) if weights.size else np.zeros((len(weights), n))
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
    A = exact(np.eye(n)) + product(exact(N_z[:, used]), exact(S[used]) - exact(np.asarray(C)[used]))
    plain = np.array(A, np.float64).reshape(n, n)
    if abs(np.linalg.det(plain)) <= 1e-6:
        return None
    K = np.asarray(np.linalg.inv(plain), dtype)
    K = np.where(np.abs(K) < 1e-13 * np.abs(K).max(initial=0.0), 0, K)
    missed = rounded_up(exact(np.eye(n)) - product(exact(K), A))
    with np.errstate(invalid="ignore"):  # where there is no bound: refused below
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
