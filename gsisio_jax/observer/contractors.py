"""Contractors of one step: each takes a correct box of x[k] and returns a smaller correct box.

Every function here is sound on its own and in any order; none of them ever returns a crossed box. When two pieces of
evidence contradict each other, `Evidence` remembers the size of the gap and the piece, and keeps the box it had.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion import AffineForm
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import (
    Interval,
    add,
    held,
    image,
    intersect,
    nan_to_unbounded,
    products,
    reach,
    scale,
    slip,
    spread,
    widen,
)
from gsisio_jax.interval.minmax import larger, largest, smaller, smallest
from gsisio_jax.interval.xla import add_up, multiplied, once
from gsisio_jax.observer.status import SOURCE_STRIDE, Source

_SMALLEST_SLOPE = 1e-9  # share of a strip's largest slope below which dividing by it can only widen
_ROUNDING = 2.0**12  # gaps below this many ulps of the largest number of a step are not called contradictions
_INVERSE_RESIDUAL = 1e3  # in units of the machine epsilon: how well an inverse must verify to be used


class Evidence(eqx.Module):
    """A box under contraction, with the signed slack of every intersection so far.

    Attributes:
        box: the box (n,), never crossed.
        slacks: one vector per intersection, in order.
        sources: for every slack which piece it stands for, ``Source * SOURCE_STRIDE + index``.
        scale: the largest number that entered the step, for telling a contradiction from rounding.
    """

    box: Interval
    scale: Any
    slacks: tuple[Any, ...] = ()
    sources: tuple[tuple[int, ...], ...] = eqx.field(static=True, default=())

    def weigh(self, slack: Any, kind: Source) -> Evidence:
        """Record the slack (k,) of an intersection that leaves the box as it is."""
        codes = tuple(int(kind) * SOURCE_STRIDE + i for i in range(slack.shape[0]))
        if not codes:
            return self
        # The boxes are rounded outward, so a gap is real. But the record may itself hold rounded numbers (noise on its
        # bound, zero noise), which miss the plant by as much: that is no conflict.
        tolerance = _ROUNDING * jnp.finfo(slack.dtype).eps * self.scale
        slack = jnp.where((slack < 0) & (slack >= -tolerance), 0, slack)
        if rounding.outward():  # where a side overflowed there is nothing to contradict
            slack = jnp.where(jnp.isnan(slack), jnp.inf, slack)
        return Evidence(self.box, self.scale, (*self.slacks, once(slack)), (*self.sources, codes))

    def meet(self, others: Interval, kind: Source, by_row: bool = False) -> Evidence:
        """Intersect the box with a stack (k, n) of boxes of the same vector, all at once.

        Args:
            others: k boxes; none of them crossed.
            kind: what they are.
            by_row: the slack is that of each of the k boxes, not of each component.
        """
        box, others = self.box, held(nan_to_unbounded(others))
        slack = smaller(box.upper - others.lower, others.upper - box.lower)
        lower = larger(box.lower, largest(others.lower, 0))
        upper = smaller(box.upper, smallest(others.upper, 0))
        # The others may also miss each other where each of them meets the box.
        apart = jnp.where(upper < lower, upper - lower, jnp.inf)
        tightest = smaller(smallest(slack, 0), apart)
        empty = tightest < 0
        met = held(Interval.unchecked(jnp.where(empty, box.lower, lower), jnp.where(empty, box.upper, upper)))
        noted = (
            self.weigh(smallest(slack, 1), kind).weigh(apart, Source.STATE) if by_row else self.weigh(tightest, kind)
        )
        return Evidence(met, self.scale, noted.slacks, noted.sources)

    @property
    def conflict(self) -> Any:
        """Some intersection was empty."""
        return jnp.concatenate(self.slacks).min() < 0 if self.slacks else jnp.asarray(False)

    def tightest(self) -> tuple[Any, Any]:
        """Margin and source: the first intersection that was empty (its largest gap), else the smallest slack."""
        if not self.slacks:
            return jnp.asarray(jnp.inf, self.box.dtype), jnp.asarray(0, jnp.int32)
        slack = jnp.concatenate(self.slacks)
        codes = np.concatenate([np.asarray(c, np.int32) for c in self.sources])
        order = np.repeat(np.arange(len(self.slacks), dtype=np.int32), [len(c) for c in self.sources])
        first = jnp.where(slack < 0, order, len(self.slacks)).min()
        candidate = (order == first) | (first == len(self.slacks))
        margin = smallest(jnp.where(candidate, slack, jnp.inf), 0)
        # No argmin and no gather: both are slow in batches.
        source = jnp.where(candidate & (slack == margin), codes, np.int32(np.iinfo(np.int32).max)).min()
        return margin, jnp.where(jnp.isinf(margin), 0, source)


def magnitude(*values: Any) -> Any:
    """The largest finite absolute value of some arrays."""
    finite = [jnp.where(jnp.isfinite(value), jnp.abs(value), 0) for value in values]
    return jax.lax.stop_gradient(jnp.concatenate([value.ravel() for value in finite]).max(initial=0.0))


class LinearBounds(eqx.Module):
    """K linear bounds of one vector (x[k], or d[k-1]), stacked: rows of weights on what is known to within a box.

        value = state x[k] + residual [f + B u + w; g + D u + v - y][k-1] + output (y - D u - v)[k]
                - remainder psi(x[k]) + bounds (bounded states) + known (bounded inputs)

    Attributes:
        residual: (K, r, n + l).
        output: (K, r, l).
        remainder: (K, r, q); for gains this is N_z.
        bounds: (K, r, s).
        known: (K, r, b).
        state: (K, r, n), or None where x[k] itself does not enter.

    Source: design 4.1 (identity (*)) and 4.5.
    """

    residual: Any
    output: Any
    remainder: Any
    bounds: Any
    known: Any
    state: Any = None

    @property
    def rows(self) -> int:
        """Number of bounds in all, K r."""
        return self.residual.shape[0] * self.residual.shape[1]

    def flat(self) -> LinearBounds:
        """The same bounds as one stack: (1, K r, .)."""
        fields = (self.residual, self.output, self.remainder, self.bounds, self.known)
        return LinearBounds(*(x.reshape(1, self.rows, x.shape[-1]) for x in fields))

    def predict(self, h: AffineForm, x_before: Interval, terms: Terms) -> Interval:
        """All terms but those in x[k]: box (K, r). Slopes are combined before the box is applied, so that what
        cancels cancels exactly; that is what keeps widths finite on nonlinear systems (design 4.3, step 2)."""
        slope = once(multiplied(self.residual, h.slope))
        low, high = products(slope, x_before)
        offset_low, offset_high = products(self.residual, h.offset)
        joint = Interval.unchecked(add_up(low) + add_up(offset_low), add_up(high) + add_up(offset_high))
        if rounding.outward():
            # Of the slopes before they cancelled.
            lost = _reached(abs(self.residual), once(_reached(abs(h.slope), reach(x_before))))
            n = 1.0 * sum(h.slope.shape) + 8
            joint = Interval.unchecked(
                rounding.lowered(joint.lower, lost + add_up(abs(offset_low)), n, n),
                rounding.raised(joint.upper, lost + add_up(abs(offset_high)), n, n),
            )
        box = intersect(joint, image(self.residual, h.range))[0]
        return add(box, self.linear(terms))

    def linear(self, terms: Terms) -> Interval:
        """The terms that are linear in boxes known beforehand: noise, measurements, state and input bounds."""
        weights = jnp.concatenate([self.residual, self.output, self.bounds, self.known], -1)
        boxes = (terms.shift, terms.output, terms.bounds, terms.known)
        known = Interval.unchecked(*(jnp.concatenate(sides) for sides in zip(*map(_sides, boxes), strict=True)))
        return image(weights, known)


class CancellationResidual(eqx.Module):
    """Upper bounds of what the bounds of a `LinearBounds` leave, by rounding, of what they do not know.

    Attributes:
        x: (K, r, n), of x[k].
        d: (K, r, p), of d[k-1].
    """

    x: Any
    d: Any

    def radius(self, x: Any, d: Any) -> Any:
        """How far a bound can be off, (K, r), where ``|x[k]| <= x`` and ``|d[k-1]| <= d``."""
        return slip(self.x, x) + slip(self.d, d)


class Terms(eqx.Module):
    """Boxes that enter a `LinearBounds` linearly.

    Attributes:
        shift: (n + l,) of [B u + w; D u + v - y] one step before.
        output: (l,) of (y - D u - v) now.
        bounds: (s,) bounds of the states that have two.
        known: (b,) bounds of the inputs that have them.
    """

    shift: Interval
    output: Interval
    bounds: Interval
    known: Interval


def contract_affine_rows(evidence: Evidence, form: AffineForm, z: Interval) -> Evidence:
    """Contract with ``T2 g(x) in z``: every row solved for every state.

    Args:
        evidence: evidence on x (n,).
        form: affine bounds of T2 g, valid on that box.
        z: box (q,) of T2 (y - D u - v).

    Source: design 4.3, step 4.
    """
    box, slope, offset = evidence.box, form.slope, form.offset
    if not slope.shape[0]:
        return evidence  # d reaches every output: none of them is free of it
    low, high = products(slope, box)  # (q, n)
    reached = add(Interval.unchecked(rounding.sum_down(low), rounding.sum_up(high)), offset)
    evidence = evidence.weigh(intersect(intersect(reached, form.range)[0], z)[1], Source.OUTPUT)
    # Sums over the other states as masked sums: total minus own term would be inf - inf.
    others = ~jnp.eye(box.shape[0], dtype=bool)
    rest_low = rounding.sum_down(jnp.where(others, low[:, None, :], 0))
    rest_high = rounding.sum_up(jnp.where(others, high[:, None, :], 0))
    free = add(z, Interval.unchecked(-offset.upper, -offset.lower))
    own = add(Interval.unchecked(free.lower[:, None], free.upper[:, None]), Interval.unchecked(-rest_high, -rest_low))
    usable = jnp.abs(slope) > _SMALLEST_SLOPE * jnp.max(jnp.abs(slope), axis=-1, keepdims=True)
    inverse = once(jnp.where(usable, 1 / jnp.where(usable, slope, 1), 0))
    a, b = scale(inverse, own.lower), scale(inverse, own.upper)
    solved = Interval.unchecked(
        jnp.where(usable, rounding.down(smaller(a, b), 4.0), -jnp.inf),
        jnp.where(usable, rounding.up(larger(a, b), 4.0), jnp.inf),
    )
    return evidence.meet(solved, Source.OUTPUT, by_row=True)


def solve_remainder(gains: LinearBounds, right: Interval, form: AffineForm, C: Any, box: Interval) -> Interval:
    """Solve ``x + N_z psi(x) in right`` for x, for every gain.

    On the box ``psi(x) = (S - C) x + [e]``, so ``A x in right - N_z [e]`` with ``A = I + N_z (S - C)``: one plain
    linear solve, by the matrix inversion lemma with a q x q inverse. Where that inverse does not verify the
    contraction is skipped. For any matrix M, ``x = M (A x) + (I - M A) x``: with ``D = S - C``, B the computed inverse
    of ``I + D N_z`` and ``M = I - N_z B D``, ``I - M A = N_z (B (I + D N_z) - I) D``, which counts with the reach of
    the box, as does the rounding of M and D.

    Args:
        gains: K gains.
        right: box (K, n) of the right side without its psi term.
        form: affine bounds ``S x + [e]`` of T2 g on the current box.
        C: slopes the design chose (q, n).
        box: box (n,) that x is known to lie in.

    Returns:
        Box (K, n) of x[k] for every gain.

    Source: design 4.3, step 3.
    """
    N_z = gains.remainder
    difference = form.slope - C  # (q, n)
    small = jnp.eye(C.shape[0], dtype=difference.dtype) + multiplied(difference, N_z)
    inverse, defect, verified = _verified_inverse(small)
    inverse = once(inverse)
    through = multiplied(inverse, difference)
    correction = once(multiplied(N_z, through))  # N_z (I + (S-C) N_z)^-1 (S-C)
    shifted = add(right, image(-N_z, form.offset))
    solved = image(jnp.eye(C.shape[1], dtype=difference.dtype) - correction, shifted)
    if rounding.outward():
        far = reach(box)
        D, N, B = abs(difference), abs(N_z), abs(inverse)
        size, n = sum(C.shape) + 4.0, C.shape[1] + 2.0 * C.shape[0]
        # Residual of B, with what its own evaluation loses, and that of D: |D| far is at hand as a vector.
        thrown = _reached(D, far)
        taken = multiplied(B, jnp.eye(C.shape[0], dtype=D.dtype) + multiplied(D, N))
        of_inverse = defect + rounding.error(taken, size, 2 * size)
        radius = _reached(N, _reached(of_inverse, thrown))
        # Rounding of M = I - N_z B D, which meets A x, and of D in both: (I + |N||B||D|) (far + |N||D| far).
        image_of_x = far + _reached(N, thrown)
        touched = image_of_x + _reached(N, _reached(B, _reached(D, image_of_x)))
        solved = widen(solved, rounding.generous(radius + rounding.error(touched, 2 * n)))
    keep = verified[:, None]
    return Interval.unchecked(jnp.where(keep, solved.lower, -jnp.inf), jnp.where(keep, solved.upper, jnp.inf))


def _reached(matrix: Any, reach: Any) -> Any:
    """`spread` to nearest, of nonnegative factors, with what its products lose where they are flushed to zero."""
    flushed = 2.0 * matrix.shape[-1] * float(jnp.finfo(matrix.dtype).tiny)
    return add_up(scale(matrix, reach[..., None, :])) + flushed


def _verified_inverse(matrix: Any) -> tuple[Any, Any, Any]:
    """Inverse of a stack (K, q, q) of matrices near the identity, by elimination without LAPACK, what its product
    with the matrix misses of the identity (magnitudes, as evaluated), and whether it verifies. A small pivot gives a
    wrong inverse, which the residual reveals; it is never trusted unverified."""
    q = matrix.shape[-1]
    identity = jnp.broadcast_to(jnp.eye(q, dtype=matrix.dtype), matrix.shape)
    work = jnp.concatenate([matrix, identity], axis=-1)
    for i in range(q):
        pivot = work[..., i : i + 1, i : i + 1]
        row = work[..., i : i + 1, :] / jnp.where(jnp.abs(pivot) > 1e-6, pivot, 1)
        work = work - work[..., :, i : i + 1] * row
        work = jnp.concatenate([work[..., :i, :], row, work[..., i + 1 :, :]], axis=-2)
    inverse = work[..., q:]
    defect = jnp.abs(multiplied(inverse, matrix) - identity)
    error = add_up(defect).max(-1) if q else jnp.zeros(matrix.shape[:-2])
    return inverse, defect, error < _INVERSE_RESIDUAL * jnp.finfo(matrix.dtype).eps


def centred_form(
    right: Interval,
    N_z: Any,
    inverse: Any,
    remainder: Any,
    bounded_remainder: Any,
    within: Interval,
    left: Any = None,
    rounds: int = 3,
) -> Interval:
    """Bound x by its distance from one point c, where ``x + N_z psi(x) in right`` and x lies in `within`.

    With ``mid +- rad = right``, ``c <- clip(mid - N_z psi(c))`` a few times and r the last move, ``|x - c| <=
    (I - |N_z| R)^{-1} (rad + r)``. Clipping is nonexpansive, and keeps c where R bounds the derivative of psi. Any c
    will do, so only the last move is evaluated with its rounding.

    Args:
        right: box (n,).
        N_z: (n, q).
        inverse: V >= 0 with ``V (I - |N_z| R - left) >= I``, (n, n).
        remainder: the function psi.
        bounded_remainder: the same at a point, as a box (q,).
        within: box (n,) on which R holds and in which x is known to lie.
        left: (n, n), what `right` leaves of x by rounding.
        rounds: iterations of c.

    Source: design 4.3, steps 3 and 6.
    """
    middle = right.center
    c = _clip(middle, within)
    for _ in range(rounds):
        moved = (middle - _vector(N_z, remainder(c))).astype(middle.dtype)  # constants of g may have promoted it
        c = once(_clip(moved, within))
    moved = add(Interval.unchecked(middle, middle), image(-N_z, bounded_remainder(c)))
    moved = Interval.unchecked(*(_clip(side, within) for side in (moved.lower, moved.upper)))
    move = rounding.up(larger(abs(moved.upper - c), abs(c - moved.lower)))
    # The radius is taken from the centre that is really used, so that no side is lost where one is infinite.
    radius = rounding.up(larger(right.upper - middle, middle - right.lower))
    far = radius + move if left is None else radius + move + slip(left, abs(c))
    away = spread(inverse, rounding.up(far, 4.0))
    return Interval.unchecked(
        rounding.lowered(c - away, abs(c) + away, 2.0), rounding.raised(c + away, abs(c) + away, 2.0)
    )


def _sides(box: Interval) -> tuple[Any, Any]:
    return box.lower, box.upper


def _clip(value: Any, box: Interval) -> Any:
    return smaller(larger(value, box.lower), box.upper)


def _vector(matrix: Any, vector: Any) -> Any:
    return add_up(matrix * vector)
