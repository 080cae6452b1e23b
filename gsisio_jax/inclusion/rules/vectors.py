"""Functions of a vector that are known as a whole: Euclidean norm, softmax, logsumexp.

All are smooth (the norm but for the origin), and monotone in every entry or in its magnitude, so ranges are exact.
Derivatives are enclosed entry by entry:

- norm: ``x_i / |x|`` grows with x_i and shrinks in magnitude with the other entries, so its extremes are known too; it
  lies in [-1, 1], at the origin as well, where every difference quotient does.
- logsumexp: the derivatives are the softmax p, nonnegative and with sum 1.
- softmax: ``dp_i / da_j = p_i (delta_ij - p_j)``; of log p_i it is ``delta_ij - p_j``.

Slope and offset are a mean-value form around the center c of the argument: with s in the middle of the derivatives D,
``f(a) - s a`` lies in ``f(c) - s c + (D - s) (a - c)``.

Rounding: sums of up to k positive terms are off by k eps, an exponential of a difference d by ``(8 + |d|) eps`` (d
itself is rounded; beyond 1100 it is 0 or infinite).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.form_arithmetic import box_sum, product
from gsisio_jax.inclusion.node import POINT_MODE, Node, meet, normalised, sparse
from gsisio_jax.inclusion.rules.linear import add, move, multiple, structural, subtract, total
from gsisio_jax.inclusion.rules.possible import formless, with_form
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, choose, magnitude


def composed(a: Node, natural: Interval, derivative: Interval, at_center: Interval) -> Node:
    """A node of a function of a (k, *rest), from its range, from enclosures of its derivatives (k, *rest) and of its
    value at the center of a."""
    jac = None
    if a.jac is not None:
        parts = product(derivative, a.jac)
        jac = Interval.unchecked(rounding.sum_down(parts.lower, 1), rounding.sum_up(parts.upper, 1))
        first = Interval.unchecked(abs(a.jac.lower).max(1), abs(a.jac.upper).max(1))
        jac = sparse(jac, first)
    if a.form is None or POINT_MODE.get():
        return Node(natural, None, jac)
    c, finite = a.range.center, jnp.isfinite(a.range.lower) & jnp.isfinite(a.range.upper)
    c = jnp.where(finite, c, 0)
    s = jnp.where(finite.all(0), 0.5 * derivative.lower + 0.5 * derivative.upper, 0)
    away = Interval.unchecked(rounding.down(a.range.lower - c), rounding.up(a.range.upper - c))
    left = Interval.unchecked(rounding.down(derivative.lower - s), rounding.up(derivative.upper - s))
    moved = product(left, away)
    known = jnp.where(finite, s * c, 0)
    # ``f(c) - s c + (D - s) (a - c)``, a sum of 2 k + 1 terms.
    lower, upper = at_center.lower - known.sum(0), at_center.upper - known.sum(0)
    size = abs(known).sum(0)
    k = 4.0 + len(c)
    rest = box_sum(
        Interval.unchecked(
            rounding.lowered(lower, size + abs(at_center.lower), k),
            rounding.raised(upper, size + abs(at_center.upper), k),
        ),
        Interval.unchecked(rounding.sum_down(moved.lower, 0), rounding.sum_up(moved.upper, 0)),
    )
    whole = finite.all(0)
    rest = choose(whole & jnp.isfinite(rest.lower) & jnp.isfinite(rest.upper), rest, natural)
    linear = total(multiple(s, formless(a)), [0])
    return meet(with_form(natural, normalised(add(linear, Node(rest))), jac))


# Euclidean norm -------------------------------------------------------------------------------------------------------
def _unit(large: Any) -> Any:
    """A power of two that brings a number >= 0 into the middle of the exponents: XLA divides by multiplying with the
    reciprocal, and that of a huge number is flushed to zero."""
    half = 256 if large.dtype == jnp.float64 else 32
    up, down = 2.0 ** (2 * half), 2.0 ** (-2 * half)
    return jax.lax.stop_gradient(jnp.where(large > 2.0**half, down, jnp.where(large < 2.0**-half, up, 1.0)))


def _length(x: Any) -> Any:
    """Over the first axis, for numbers >= 0: scaled, so that nothing overflows or vanishes."""
    large = jax.lax.stop_gradient(x.max(0))
    usual = (large > 0) & (large < jnp.inf)
    unit = _unit(large)
    scale = jnp.where(usual, large, 1) * unit
    share = jnp.where(usual, x, 1) * unit / scale
    return jnp.where(usual, scale * jnp.sqrt((share * share).sum(0)) * (1 / unit), large)


def norm(a: Node) -> Node:
    """Euclidean norm over the first axis."""
    a = normalised(a)
    low, high = a.range.lower, a.range.upper
    far = magnitude(a.range)
    near = jnp.where((low <= 0) & (high >= 0), 0, jnp.minimum(abs(low), abs(high)))
    ulps = 8.0 + len(low)
    natural = Interval.unchecked(jnp.maximum(rounding.down(_length(near), ulps), 0), rounding.up(_length(far), ulps))
    least, most = _others(near), _others(far)
    # x / sqrt(x^2 + r^2): for x > 0 the smallest r is largest, for x < 0 the largest.
    upper = _share(high, jnp.where(high > 0, least, most), ulps, 1.0)
    lower = _share(low, jnp.where(low < 0, least, most), ulps, -1.0)
    c = jnp.where(jnp.isfinite(low) & jnp.isfinite(high), a.range.center, 0)
    center = _length(abs(c))
    at = Interval.unchecked(rounding.down(center, ulps), rounding.up(center, ulps))
    return composed(a, natural, Interval.unchecked(lower, upper), at)


def _others(x: Any) -> Any:
    """The norm without entry i, for every i."""
    k = len(x)
    rows = [_length(jnp.concatenate([x[:i], x[i + 1 :], jnp.zeros_like(x[:1])])) for i in range(k)]
    return jnp.stack(rows)


def _share(x: Any, rest: Any, ulps: float, side: float) -> Any:
    """``x / sqrt(x^2 + rest^2)``, rounded to that side; 0/0 is that side of the difference quotients, if x may be on
    it at all."""
    size = _length(jnp.stack([abs(x), rest]))
    usual = (size > 0) & (size < jnp.inf)
    unit = _unit(jnp.where(usual, size, 1))
    # Small ones are made larger before they are divided, large ones smaller afterwards: an x far below its size would
    # be flushed to zero before it is divided.
    value = jnp.where(usual, x, 0) * jnp.maximum(unit, 1) / (jnp.where(usual, size, 1) * unit) * jnp.minimum(unit, 1)
    value = jnp.where(size == jnp.inf, jnp.where(jnp.isfinite(x), jnp.where(x * side > 0, side, 0), jnp.sign(x)), value)
    value = rounding.up(value, ulps + 8) if side > 0 else rounding.down(value, ulps + 8)
    return jnp.clip(value, -1, 1)


def root_of(value: Any) -> Any:
    """A constant whose square is that number >= 0: a thin box, as roots are rounded."""
    value = np.asarray(value)
    root = np.sqrt(value)
    return Node(Interval.unchecked(rounding.down(root), rounding.up(root)))


def hypot(x: Any, y: Any) -> Node:
    return norm(structural(lambda p, q: jnp.stack([p, q]), [x, y])[0])


# Exponentials ---------------------------------------------------------------------------------------------------------
def _gaps(a: Node) -> Interval:
    """``a_j - a_i`` (j, i, *rest), with what the forms of both know."""
    plain = formless(a)
    first = move(lambda v: jnp.broadcast_to(v[:, None], (len(v), *v.shape)), plain)
    second = move(lambda v: jnp.broadcast_to(v[None], (len(v), *v.shape)), plain)
    gap = normalised(subtract(first, second)).range
    same = jnp.eye(a.shape[0], dtype=bool).reshape(a.shape[0], a.shape[0], *(1,) * (len(a.shape) - 1))
    return choose(same, Interval.unchecked(0.0, 0.0), gap)


def _shares(gap: Any, side: float) -> Any:
    """``1 / sum_j exp(gap_j)``, rounded to that side and within [0, 1]."""
    value = 1 / jnp.exp(jnp.where(gap == jnp.inf, jnp.inf, gap)).sum(0)
    drift = jnp.minimum(jnp.where(jnp.isfinite(gap), abs(gap), 0).max(0), 1100.0)
    ulps = jax.lax.stop_gradient(32.0 + len(gap) + 2 * drift)
    return jnp.clip(rounding.up(value, ulps) if side > 0 else rounding.down(value, ulps), 0, 1)


def _log_shares(gap: Any, side: float) -> Any:
    """``-log sum_j exp(gap_j)``, rounded to that side; not above 0, as one gap is 0."""
    top = gap.max(0)
    finite = jnp.isfinite(top)
    top = jnp.where(finite, top, 0)
    size = jnp.log(jnp.exp(gap - top).sum(0))
    value = jnp.where(finite, -(size + top), -jnp.inf)
    size = abs(size) + abs(top) + 1
    ulps = 64.0 + len(gap)
    value = rounding.raised(value, size, ulps) if side > 0 else rounding.lowered(value, size, ulps)
    return jnp.minimum(value, 0) if side > 0 else value


def _probabilities(a: Node) -> tuple[Interval, Interval]:
    gap = _gaps(a)
    return gap, Interval.unchecked(_shares(gap.upper, -1), _shares(gap.lower, 1))


def _center(a: Node) -> Any:
    finite = jnp.isfinite(a.range.lower) & jnp.isfinite(a.range.upper)
    return jnp.where(finite, a.range.center, 0)


def _each(a: Node) -> Node:
    """a for every one of as many results: (k, k, *rest)."""
    return move(lambda v: jnp.broadcast_to(v[:, None], (len(v), *v.shape)), a)


def softmax(a: Node) -> Node:
    """Over the first axis."""
    a = normalised(a)
    _, p = _probabilities(a)
    c = _center(a)
    gap = c[:, None] - c[None]
    at = Interval.unchecked(_shares(gap, -1), _shares(gap, 1))
    # p (1 - p) is a parabola; its largest value is 1/4 at 1/2.
    ends = (
        [rounding.down(v * (1 - v), 4.0) for v in (p.lower, p.upper)],
        [rounding.up(v * (1 - v), 4.0) for v in (p.lower, p.upper)],
    )
    top = jnp.where((p.lower <= 0.5) & (p.upper >= 0.5), 0.25, jnp.maximum(*ends[1]))
    own = Interval.unchecked(jnp.maximum(jnp.minimum(*ends[0]), 0), top)
    # -p_i p_j with p_i + p_j <= 1, so neither exceeds what it is of its own; of two entries it is that.
    other = Interval.unchecked(
        jnp.maximum(rounding.down(-p.upper[:, None] * p.upper[None], 4.0), -jnp.minimum(top[:, None], top[None])),
        jnp.minimum(rounding.up(-p.lower[:, None] * p.lower[None], 4.0), 0),
    )
    if a.shape[0] == 2:
        other = Interval.unchecked(other.lower, -jnp.maximum(own.lower[:, None], own.lower[None]))
    same = jnp.eye(a.shape[0], dtype=bool).reshape(a.shape[0], a.shape[0], *(1,) * (len(a.shape) - 1))
    derivative = choose(same, Interval.unchecked(own.lower[None], own.upper[None]), other)
    return composed(_each(a), p, derivative, at)


def log_softmax(a: Node) -> Node:
    """Over the first axis."""
    a = normalised(a)
    gap, p = _probabilities(a)
    natural = Interval.unchecked(_log_shares(gap.upper, -1), _log_shares(gap.lower, 1))
    c = _center(a)
    middle = c[:, None] - c[None]
    at = Interval.unchecked(_log_shares(middle, -1), _log_shares(middle, 1))
    same = jnp.eye(a.shape[0], dtype=bool).reshape(a.shape[0], a.shape[0], *(1,) * (len(a.shape) - 1))
    rest = Interval.unchecked(-p.upper[:, None], -p.lower[:, None])
    own = Interval.unchecked(
        jnp.maximum(rounding.down(1 - p.upper, 4.0), 0), jnp.minimum(rounding.up(1 - p.lower, 4.0), 1)
    )
    derivative = choose(same, Interval.unchecked(own.lower[:, None], own.upper[:, None]), rest)
    return composed(_each(a), natural, derivative, at)


def _log_sum(a: Any, side: float) -> Any:
    top = a.max(0)
    finite = jnp.isfinite(top)
    shift = jnp.where(finite, top, 0)
    part = jnp.log(jnp.exp(a - shift).sum(0))
    value = jnp.where(finite, part + shift, top)
    size, ulps = abs(part) + abs(shift) + 1, 64.0 + len(a)
    return rounding.raised(value, size, ulps) if side > 0 else rounding.lowered(value, size, ulps)


def log_sum_exp(a: Node) -> Node:
    """Over the first axis."""
    a = normalised(a)
    _, p = _probabilities(a)
    natural = Interval.unchecked(_log_sum(a.range.lower, -1), _log_sum(a.range.upper, 1))
    c = _center(a)
    return composed(a, natural, p, Interval.unchecked(_log_sum(c, -1), _log_sum(c, 1)))
