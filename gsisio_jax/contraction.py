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
from gsisio_jax.interval import Interval, add, image, intersect, scale
from gsisio_jax.status import SOURCE_STRIDE, Source
from gsisio_jax.ties import larger, largest, smaller, smallest

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
        # Boxes that only touch (noise on its bound, zero noise) may miss each other by rounding: that is no conflict.
        rounding = _ROUNDING * jnp.finfo(slack.dtype).eps * self.scale
        slack = jnp.where((slack < 0) & (slack >= -rounding), 0, slack)
        return Evidence(self.box, self.scale, (*self.slacks, slack), (*self.sources, codes))

    def meet(self, others: Interval, kind: Source, by_row: bool = False) -> Evidence:
        """Intersect the box with a stack (k, n) of boxes of the same vector, all at once.

        Args:
            others: k boxes; none of them crossed.
            kind: what they are.
            by_row: the slack is that of each of the k boxes, not of each component.
        """
        box = self.box
        slack = smaller(box.upper - others.lower, others.upper - box.lower)
        lower = larger(box.lower, largest(others.lower, 0))
        upper = smaller(box.upper, smallest(others.upper, 0))
        # The others may also miss each other where each of them meets the box.
        apart = jnp.where(upper < lower, upper - lower, jnp.inf)
        tightest = smaller(smallest(slack, 0), apart)
        empty = tightest < 0
        met = Interval.unchecked(jnp.where(empty, box.lower, lower), jnp.where(empty, box.upper, upper))
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


class Bank(eqx.Module):
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

    def flat(self) -> Bank:
        """The same bounds as one stack: (1, K r, .)."""
        fields = (self.residual, self.output, self.remainder, self.bounds, self.known)
        return Bank(*(x.reshape(1, self.rows, x.shape[-1]) for x in fields))

    def explicit(self, h: AffineForm, x_before: Interval, terms: Terms) -> Interval:
        """All terms but those in x[k]: box (K, r). Slopes are combined before the box is applied, so that what
        cancels cancels exactly; that is what keeps widths finite on nonlinear systems (design 4.3, step 2)."""
        slope = (self.residual[..., None] * h.slope).sum(-2)
        joint = add(image(slope, x_before), image(self.residual, h.offset))
        box = intersect(joint, image(self.residual, h.range))[0]
        return add(box, self.linear(terms))

    def linear(self, terms: Terms) -> Interval:
        """The terms that are linear in boxes known beforehand: noise, measurements, state and input bounds."""
        return add(
            image(self.residual, terms.shift),
            image(self.output, terms.output),
            image(self.bounds, terms.bounds),
            image(self.known, terms.known),
        )


class Terms(eqx.Module):
    """Boxes that enter a `Bank` linearly.

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


def strips(evidence: Evidence, form: AffineForm, z: Interval) -> Evidence:
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
    at_lower, at_upper = scale(slope, box.lower), scale(slope, box.upper)
    low, high = smaller(at_lower, at_upper), larger(at_lower, at_upper)  # (q, n)
    reach = intersect(Interval.unchecked(low.sum(-1) + offset.lower, high.sum(-1) + offset.upper), form.range)[0]
    evidence = evidence.weigh(intersect(reach, z)[1], Source.OUTPUT)
    # Sums over the other states as masked sums: total minus own term would be inf - inf.
    others = ~jnp.eye(box.shape[0], dtype=bool)
    rest_low = jnp.where(others, low[:, None, :], 0).sum(-1)
    rest_high = jnp.where(others, high[:, None, :], 0).sum(-1)
    usable = jnp.abs(slope) > _SMALLEST_SLOPE * jnp.max(jnp.abs(slope), axis=-1, keepdims=True)
    inverse = jnp.where(usable, 1 / jnp.where(usable, slope, 1), 0)
    a = scale(inverse, (z.lower - offset.upper)[:, None] - rest_high)
    b = scale(inverse, (z.upper - offset.lower)[:, None] - rest_low)
    solved = Interval.unchecked(jnp.where(usable, smaller(a, b), -jnp.inf), jnp.where(usable, larger(a, b), jnp.inf))
    return evidence.meet(solved, Source.OUTPUT, by_row=True)


def solve_remainder(gains: Bank, right: Interval, form: AffineForm, C: Any) -> Interval:
    """Solve ``x + N_z psi(x) in right`` for x, for every gain.

    On the box ``psi(x) = (S - C) x + [e]``, so ``(I + N_z (S - C)) x in right - N_z [e]``: one plain linear solve, by
    the matrix inversion lemma with a q x q inverse. Where that inverse does not verify the contraction is skipped.

    Args:
        gains: K gains.
        right: box (K, n) of the right side without its psi term.
        form: affine bounds ``S x + [e]`` of T2 g on the current box.
        C: slopes the design chose (q, n).

    Returns:
        Box (K, n) of x[k] for every gain.

    Source: design 4.3, step 3.
    """
    N_z = gains.remainder
    difference = form.slope - C  # (q, n)
    small = jnp.eye(C.shape[0], dtype=difference.dtype) + _product(difference, N_z)
    inverse, verified = _verified_inverse(small)
    correction = _product(N_z, _product(inverse, difference))  # N_z (I + (S-C) N_z)^-1 (S-C)
    shifted = add(right, image(-N_z, form.offset))
    solved = image(jnp.eye(C.shape[1], dtype=difference.dtype) - correction, shifted)
    keep = verified[:, None]
    return Interval.unchecked(jnp.where(keep, solved.lower, -jnp.inf), jnp.where(keep, solved.upper, jnp.inf))


def _product(a: Any, b: Any) -> Any:
    """Matrix product of stacks of tiny matrices, written out: a batched dot of such sizes is slow."""
    return (a[..., :, :, None] * b[..., None, :, :]).sum(-2)


def _verified_inverse(matrix: Any) -> tuple[Any, Any]:
    """Inverse of a stack (K, q, q) of matrices near the identity, by elimination without LAPACK, and whether it
    verifies. A small pivot gives a wrong inverse, which the residual reveals; it is never trusted unverified."""
    q = matrix.shape[-1]
    identity = jnp.broadcast_to(jnp.eye(q, dtype=matrix.dtype), matrix.shape)
    work = jnp.concatenate([matrix, identity], axis=-1)
    for i in range(q):
        pivot = work[..., i : i + 1, i : i + 1]
        row = work[..., i : i + 1, :] / jnp.where(jnp.abs(pivot) > 1e-6, pivot, 1)
        work = work - work[..., :, i : i + 1] * row
        work = jnp.concatenate([work[..., :i, :], row, work[..., i + 1 :, :]], axis=-2)
    inverse = work[..., q:]
    error = jnp.abs(_product(inverse, matrix) - identity).sum(-1).max(-1) if q else jnp.zeros(matrix.shape[:-2])
    return inverse, error < _INVERSE_RESIDUAL * jnp.finfo(matrix.dtype).eps


def centred(right: Interval, N_z: Any, inverse: Any, remainder: Any, within: Interval, rounds: int = 3) -> Interval:
    """Bound x by its distance from one point c, where ``x + N_z psi(x) in right`` and x lies in `within`.

    With ``mid +- rad = right``, ``c <- clip(mid - N_z psi(c))`` a few times and r the last move, ``|x - c| <=
    (I - |N_z| R)^{-1} (rad + r)``. Clipping is nonexpansive, and keeps c where R bounds the derivative of psi.

    Args:
        right: box (n,).
        N_z: (n, q).
        inverse: ``(I - |N_z| R)^{-1}``, nonnegative, (n, n).
        remainder: the function psi.
        within: box (n,) on which R holds and in which x is known to lie.
        rounds: iterations of c.

    Source: design 4.3, steps 3 and 6.
    """

    def move(c: Any) -> Any:
        return _clip(middle - _vector(N_z, remainder(c)), within)

    middle = right.center
    c = _clip(middle, within)
    for _ in range(rounds):
        c = move(c)
    # The radius is taken from the centre that is really used, so that no side is lost where one is infinite.
    radius = larger(right.upper - middle, middle - right.lower)
    reach = image(inverse, Interval.unchecked(-radius, radius + jnp.abs(c - move(c)))).upper
    return Interval.unchecked(c - reach, c + reach)


def _clip(value: Any, box: Interval) -> Any:
    return smaller(larger(value, box.lower), box.upper)


def _vector(matrix: Any, vector: Any) -> Any:
    return (matrix * vector).sum(-1)
