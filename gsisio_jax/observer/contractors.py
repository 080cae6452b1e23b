"""Contractors of one step: each takes a correct box of x[k] and returns boxes to intersect it with.

Every function here is sound on its own and in any order. Rounding of sums is in what they are made of: states and
atoms are widened once per box, for all linear images (`inclusion.atoms`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.atoms import AtomBounds, Rows, States, of_constant, wider
from gsisio_jax.interval import devices, rounding
from gsisio_jax.interval.box import Interval, center_and_radius
from gsisio_jax.interval.direct import where
from gsisio_jax.interval.minmax import larger, smaller
from gsisio_jax.interval.primitives import matmul, scale

_SMALLEST_SLOPE = 1e-9  # share of a row's largest slope below which dividing by it can only widen
_INVERSE_RESIDUAL = 1e3  # in units of the machine epsilon: how well an inverse must verify to be used
_SMALLEST_PIVOT = 1e-6  # of matrices near the identity


class Affine(NamedTuple):
    """``m(x) in slope x + center +- radius`` for a map m and all x of a box: slope (q, n), the others (q,)."""

    slope: Any
    center: Any
    radius: Any


def affine_rows(rows: Rows, states: States, atoms: AtomBounds) -> Affine:
    """Linear combinations of atoms as affine bounds; the radius holds what the slope is off by."""
    center = matmul(rows.atoms, atoms.center) + rows.constant
    radius = scale(abs(rows.atoms), atoms.radius).sum(-1) + scale(abs(rows.states), states.error).sum(-1)
    return Affine(rows.slope(atoms), center, radius + of_constant(rows.constant))


def contract_affine_rows(states: States, form: Affine, z: Interval) -> tuple[Interval, Any]:
    """Contract with ``T2 g(x) in z``: every row solved for every state.

    Args:
        states: the box of x (n,).
        form: affine bounds of T2 g, valid on that box.
        z: box (q,) of T2 (y - D u - v).

    Returns:
        Boxes (q, n) of x, and the slack (q,) of what the form reaches and z. Where a box misses that of x, so do these.

    Source: theory 5.4.
    """
    slope, n = form.slope, states.center.shape[0]
    size = abs(slope)
    middle, spread = slope * states.center, scale(size, states.radius)  # (q, n)
    low, high = z.lower - form.center, z.upper - form.center  # of slope x, but for the radius
    all_middle, all_spread = middle.sum(-1), spread.sum(-1) + form.radius
    slack = smaller(high - (all_middle - all_spread), (all_middle + all_spread) - low)
    # Sums over the other states one by one: the total minus its own term would be inf - inf.
    others = ~np.eye(n, dtype=bool)
    rest = where(others, middle[:, None, :], 0).sum(-1)
    loose = where(others, spread[:, None, :], 0).sum(-1) + form.radius[:, None]
    own_low, own_high = low[:, None] - rest - loose, high[:, None] - rest + loose
    largest = size.max(-1, keepdims=True, initial=0.0)
    usable = size > _SMALLEST_SLOPE * largest
    inverse = 1 / where(usable, slope, 1)
    up = slope > 0
    a, b = where(up, own_low, own_high), where(up, own_high, own_low)
    # Infinite sides are left out of the product: its derivative would be 0 times infinity.
    of_a, of_b = usable & jnp.isfinite(a), usable & jnp.isfinite(b)
    a, b = where(of_a, a, 0) * inverse, where(of_b, b, 0) * inverse
    return Interval.unchecked(where(of_a, a, -jnp.inf), where(of_b, b, jnp.inf)), slack


class Newton(NamedTuple):
    """Steps to the x of ``x + N_z psi(x) = right``: the solution by affine bounds of psi, its right side, and the
    ``M = dx / d right`` of these bounds, with whether it is to be used."""

    point: Any
    right: Any
    inverse: Any
    usable: Any

    def begin(self, right: Any) -> Any:
        """x for another right side (n,)."""
        return where(self.usable, self.point + matmul(self.inverse, right - self.right), right)

    def improved(self, x: Any, missing: Any) -> Any:
        """x moved by what it misses of the right side (n,)."""
        return x + where(self.usable, matmul(self.inverse, missing), missing)


def solve_remainder(N_z: Any, right: Interval, psi: Affine, states: States, terms: int) -> tuple[Interval, Newton]:
    """Solve ``x + N_z psi(x) in right`` for x, for every gain.

    With ``psi(x) = D x + [e]``, ``A x in right - N_z [e]`` with ``A = I + N_z D``: one plain linear solve, by the
    matrix inversion lemma with a q x q inverse. Where that inverse does not verify the contraction is skipped.

    Rounding. For any matrix M, ``x = M (A x) + (I - M A) x``. With B the computed inverse of ``I + D N_z`` and
    ``M = I - N_z B D``, ``I - M A = N_z (B (I + D N_z) - I) D``. So the bound is off by ``|N_z| E |D| |x|``, E the
    residual of B, and by what M itself loses in rounding, a few eps of ``|I| + |N_z| |B| |D|``, which meets ``A x``.
    With ``T = I + |D| |N_z|`` and ``|x| <= m`` both are below ``m + |N_z| (I + |B| T) |D| m`` times eps and the number
    of operations, and E by as much again where it is computed (q > 1).

    Args:
        N_z: (K, n, q).
        right: box (K, n) of the right side without its psi term.
        psi: affine bounds of the remainder on the current box.
        states: the current box (n,).
        terms: of a row, for rounding.

    Returns:
        Box (K, n) of x[k] for every gain; NaN where it overflowed. And the solution of the first gain as a point.

    Source: theory 5.3.
    """
    D, q, n = psi.slope, psi.slope.shape[0], psi.slope.shape[1]
    identity = jnp.eye(q, dtype=D.dtype)
    small = identity + matmul(D, N_z)  # (K, q, q)
    B, E, verified = _verified_inverse(small)
    center, radius = _center_and_wider_radius(right, terms)
    moved = center - matmul(N_z, psi.center)
    radius = radius + scale(abs(N_z), psi.radius).sum(-1)
    M = jnp.eye(n, dtype=D.dtype) - matmul(N_z, matmul(B, D))
    middle = matmul(M, moved[..., None])[..., 0]
    spread = scale(abs(M), radius[:, None, :]).sum(-1)
    if rounding.outward():
        size, reached = abs(N_z), scale(abs(D), states.magnitude).sum(-1)
        T = identity + matmul(abs(D), size)
        bent = reached + matmul(abs(B), matmul(T, reached[:, None]))[..., 0]  # (K, q)
        if q > 1:
            eps = float(jnp.finfo(D.dtype).eps)
            left = E + matmul(abs(B), T) * (4.0 * q * eps) + identity * (4 * eps)
            spread = spread + scale(size, matmul(left, reached[:, None])[:, None, :, 0]).sum(-1) * (1 + 2.0**-10)
        spread = spread + wider(states.magnitude + scale(size, bent[:, None, :]).sum(-1), terms + 2 * n + 2 * q)
    keep = verified[:, None]
    box = Interval.unchecked(where(keep, middle - spread, -jnp.inf), where(keep, middle + spread, jnp.inf))
    return box, Newton(middle[0], center[0], M[0], verified[0])


def _center_and_wider_radius(box: Interval, terms: int) -> tuple[Any, Any]:
    """`center_and_radius`, the latter widened for linear images of so many terms."""
    center, radius = center_and_radius(box)
    return center, radius + wider(abs(center) + radius, terms)


def _verified_inverse(matrix: Any) -> tuple[Any, Any, Any]:
    """Inverse of a stack (K, q, q) of matrices near the identity, by elimination without LAPACK, what its product
    with the matrix misses of the identity (magnitudes, as evaluated), and whether it verifies. A small pivot gives a
    wrong inverse, which the residual reveals; it is never trusted unverified. A 1 x 1 matrix needs no residual: it is
    that of a division."""
    q = matrix.shape[-1]
    if q == 1:
        usable = abs(matrix) > _SMALLEST_PIVOT
        return 1 / where(usable, matrix, 1), jnp.zeros_like(matrix), usable[..., 0, 0]
    identity = jnp.broadcast_to(jnp.eye(q, dtype=matrix.dtype), matrix.shape)
    work = jnp.concatenate([matrix, identity], axis=-1)
    for i in range(q):
        pivot = work[..., i : i + 1, i : i + 1]
        row = work[..., i : i + 1, :] / where(jnp.abs(pivot) > _SMALLEST_PIVOT, pivot, 1)
        work = work - work[..., :, i : i + 1] * row
        work = jnp.concatenate([work[..., :i, :], row, work[..., i + 1 :, :]], axis=-2)
    inverse = work[..., q:]
    defect = jnp.abs(matmul(inverse, matrix) - identity)
    error = defect.sum(-1).max(-1) if q else jnp.zeros(matrix.shape[:-2], matrix.dtype)
    return inverse, defect, error < _INVERSE_RESIDUAL * float(jnp.finfo(matrix.dtype).eps)


def centred_form(
    right: Interval,
    N_z: Any,
    inverse: Any,
    remainder: Any,
    within: Interval,
    terms: int,
    left: Any = None,
    newton: Newton | None = None,
    corrections: int = 1,
    written: int = 3,
) -> Interval:
    """Bound x by its distance from one point c, where ``x + N_z psi(x) in right`` and x lies in `within`.

    With ``mid +- rad = right``, any b in `within` and ``c = clip(mid - N_z psi(b))``, r = |c - b|: clipping is
    nonexpansive, so ``|x - c| <= rad + |N_z| R |x - b| <= rad + |N_z| R (|x - c| + r)``, hence ``|x - c| <= V rad +
    V |N_z| R r <= V (rad + r) - r`` for ``V (I - |N_z| R) >= I``. The nearer b is to the solution of ``b + N_z psi(b)
    = mid``, the smaller is r.

    Args:
        right: box (n,).
        N_z: (n, q).
        inverse: V >= 0 with ``V (I - |N_z| R - left) >= I``, (n, n).
        remainder: psi at a point, as center and radius (q,).
        within: box (n,) on which R holds and in which x is known to lie.
        terms: of a row, for rounding.
        left: (n, n), what `right` leaves of x by rounding.
        newton: where b comes from; without it ``b = clip(mid)``.
        corrections: number of its steps. Every one after the first takes a value of psi.
        written: more are a loop, in which psi is compiled once.

    Source: theory 5.3 and 5.6.
    """
    middle, radius = _center_and_wider_radius(right, terms)
    before = clip(middle if newton is None else newton.begin(middle), within)
    center, error = remainder(before)
    if newton is not None:

        def corrected(found: Any) -> Any:
            before, center, _ = found
            before = clip(newton.improved(before, middle - matmul(N_z, center) - before), within)
            return before, *remainder(before)

        before, center, error = repeated(corrected, (before, center, error), corrections - 1, written)
    c = clip(middle - matmul(N_z, center), within)
    error = matmul(abs(N_z), error) + wider(abs(middle) + matmul(abs(N_z), abs(center)), terms)
    move = abs(c - before)
    if left is not None and rounding.outward():
        error = error + rounding.generous(matmul(left, abs(c)))
    far = radius + error + move
    away = scale(inverse, far).sum(-1)
    away = away - move + wider(abs(c) + away + far, terms)
    return Interval.unchecked(c - away, c + away)


def repeated(turn: Callable[[Any], Any], state: Any, count: int, written: int) -> Any:
    """`turn` applied `count` times: written out up to `written`, else a loop."""
    if count <= written:
        for _ in range(count):
            state = turn(state)
        return state
    return devices.scan(lambda state, _: (turn(state), None), state, None, length=count)[0]


def clip(value: Any, box: Interval) -> Any:
    return smaller(larger(value, box.lower), box.upper)
