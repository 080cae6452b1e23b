"""Rules for two arguments that multiply: products, quotients, powers, matrix products, and the angle of a vector."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.form_arithmetic import (
    added_slack,
    box_sum,
    product,
    scaled,
    scaled_slack,
    sum_slack,
)
from gsisio_jax.inclusion.node import Node, as_node, best_form, chain, is_node, join, meet, normalised, parts, slope_of
from gsisio_jax.inclusion.rules.functions import CURVES, RECIPROCAL, SQUARE, power
from gsisio_jax.inclusion.rules.linear import add, move, multiple, structural, total
from gsisio_jax.inclusion.rules.univariate import apply, extremes
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, choose, entire_like, is_concrete
from gsisio_jax.interval.direct import where
from gsisio_jax.interval.minmax import larger, smaller
from gsisio_jax.interval.primitives import moderate, times


def multiply(x: Any, y: Any) -> Node:
    """Product; linear if one factor is a constant, else the bilinear envelope around the two centers.

    A product whose both sides overflow is ``[-inf, NaN]`` until it is normalised: the interpreter does so at once, the
    next rule where products follow each other inside of one (`jnp.cumprod`, a reduction).
    """
    if not is_node(x):
        return multiple(x, y)
    if not is_node(y):
        return multiple(y, x)
    x, y = normalised(x), normalised(y)
    natural = product(x.range, y.range)
    box, _ = parts([x, y])
    form = None
    if box is not None:
        # x y = cy x + cx y - cx cy + (x - cx)(y - cy), and the last term is the only one that is not linear.
        cx, cy = x.range.center, y.range.center
        largest = moderate(cx.dtype)
        tame = (jnp.abs(cx) < largest) & (jnp.abs(cy) < largest)
        cx, cy = where(tame, cx, 0), where(tame, cy, 0)
        spread = where(tame, times(_radius(x.range, cx), _radius(y.range, cy)), jnp.inf)
        form = _envelope(x, y, cx, cy, spread, natural, box)
    node = Node(natural, form, join(chain(y.range, x.jac), chain(x.range, y.jac)), unnormalised=True)
    return meet(node) if x.form is not None and y.form is not None else node


def bilinear_line(x: Interval, y: Interval, kappa: float) -> tuple[Any, Any, Any, Any, Interval]:
    """What `expansion` makes of a product: is there a line, the centers cx and cy, the product of the half-widths, and
    the range: ``|x y - (cy x + cx y - cx cy)| <= spread``.

    To nearest but for the range, which is padded by kappa more ulps. Centers are numbers like any others; what they
    leave of the half-widths is an ulp of ``|x|`` and ``|y|`` each: spread is off by 8 ulps of their product, the
    largest one on the box.
    """
    p, q = times(x.lower, y.lower), times(x.lower, y.upper)
    r, s = times(x.upper, y.lower), times(x.upper, y.upper)
    lower, upper = smaller(smaller(p, q), smaller(r, s)), larger(larger(p, q), larger(r, s))
    lower, upper = (
        rounding.unbounded(move(side, 2.0 + kappa, rounding.FLUSHED), end)
        for side, move, end in ((lower, rounding.down, -jnp.inf), (upper, rounding.up, jnp.inf))
    )
    largest = float(jnp.finfo(p.dtype).max) / 8
    usable = (x.lower > -largest) & (x.upper < largest) & (y.lower > -largest) & (y.upper < largest)
    cx, rx = (where(usable, 0.5 * (x.upper + side), 0) for side in (x.lower, -x.lower))
    cy, ry = (where(usable, 0.5 * (y.upper + side), 0) for side in (y.lower, -y.lower))
    return usable, cx, cy, rx * ry, Interval.unchecked(lower, upper)


def _radius(a: Interval, center: Any) -> Any:
    """Largest distance from the center; exactly 0 only on a box of width 0."""
    if not rounding.outward():
        return a.radius
    far = jnp.maximum(a.upper - center, center - a.lower)
    return where(far == 0, 0, rounding.up(far))


def _envelope(x: Node, y: Node, cx: Any, cy: Any, spread: Any, natural: Interval, box: Any) -> Any:
    """The form of a product: both factors' forms weighed with the centers, and `spread`."""
    slope, slack = _weighed([(cy, x), (cx, y)], box)
    with rounding.using("nearest"):
        a, b = scaled(cy, x.offset), scaled(cx, y.offset)
    lower = a.lower + b.lower - cx * cy - spread
    upper = a.upper + b.upper - cx * cy + spread
    # Five roundings at most pass through any of these terms.
    size = abs(cx * cy) + spread
    lower = rounding.lowered(lower, size + abs(a.lower) + abs(b.lower), 8.0, 8.0)
    upper = rounding.raised(upper, size + abs(a.upper) + abs(b.upper), 8.0, 8.0)
    return best_form(slope, Interval.unchecked(lower, upper), natural, box, slack, size)


def _weighed(pairs: Sequence[tuple[Any, Node]], box: Any) -> tuple[Any, Any]:
    """Slope of a sum of two nodes times numbers, and its slack."""
    slopes = [slope_of(node, box) for _, node in pairs]
    products = [times(weight, slope) for (weight, _), slope in zip(pairs, slopes, strict=True)]
    slacks = [
        scaled_slack(weight, slope, product, None if node.form is None else node.form.slack)
        for (weight, node), slope, product in zip(pairs, slopes, products, strict=True)
    ]
    total = products[0] + products[1]
    return total, sum_slack(*slacks, added_slack(products[0], products[1], total))


def divide(x: Any, y: Any) -> Node:
    """Quotient; a divisor that may be 0 leaves nothing known."""
    if is_node(y):
        return multiply(x, apply(RECIPROCAL, y))
    y = jnp.asarray(y)
    if is_concrete(y):
        y = np.asarray(y)
        zero = y == 0
        with np.errstate(all="ignore"):
            inverse = 1 / np.where(zero, 1, y)
            plain = bool((np.frexp(inverse)[0] * np.sign(inverse) == 0.5).all())  # of a power of two: exact
        quotient = multiple(inverse, x, rounded=not plain)
        return _unknown_where(zero, quotient) if zero.any() else quotient
    zero = y == 0
    return _unknown_where(zero, multiple(1 / where(zero, 1, y), x, rounded=True))


def _unknown_where(mask: Any, x: Node) -> Node:
    return pick(mask, Node(entire_like(x.range.lower), None, None if x.jac is None else entire_like(x.jac.lower)), x)


def pick(mask: Any, x: Node, y: Node) -> Node:
    """Elementwise `x` where the mask (not a node) holds, else `y`."""
    return structural(lambda a, b: where(mask, a, b), [x, y], [mask])[0]


def raise_to(x: Any, p: Any) -> Node:
    """``x ** p`` with JAX's own domain: a negative base has a power only for an integer exponent."""
    if not is_node(p) and is_concrete(p) and np.size(p) > 0 and (np.asarray(p) == np.ravel(p)[0]).all():
        return integer_power(x, float(np.ravel(p)[0]))
    log, exp = CURVES["log"], CURVES["exp"]
    x, p = normalised(x), normalised(p)
    if not is_node(x):
        good = jnp.asarray(x) > 0
        base = as_node(where(good, x, 1), p.shape, p.dtype)
        return _unknown_where(~good, apply(exp, multiply(p, apply(log, base))))
    result = apply(exp, multiply(p, apply(log, x)))
    # Without knowing that the exponent is no integer, nothing can be said of negative bases.
    return _unknown_where(x.range.lower < 0, result)


def integer_power(x: Node, p: float) -> Node:
    """``x ** p`` for a number p known in advance."""
    if p == 0:
        return add(multiple(0, x), np.ones(x.shape, x.dtype))
    return x if p == 1 else apply(power(p), x)


def dot(x: Any, y: Any, dimensions: Any, same: bool) -> Node:
    """Matrix product in the general form of ``lax.dot_general``, written as products and a sum.

    The factors are small and half of them are boxes; a real matrix product would meet ``0 * inf``.
    """
    (contract_x, contract_y), (batch_x, batch_y) = dimensions
    ndim_x, ndim_y = (v.range.lower.ndim if is_node(v) else jnp.ndim(v) for v in (x, y))
    free_x = [i for i in range(ndim_x) if i not in (*contract_x, *batch_x)]
    free_y = [i for i in range(ndim_y) if i not in (*contract_y, *batch_y)]

    def spread(batch: Sequence[int], free: Sequence[int], contract: Sequence[int], before: int, after: int) -> Any:
        """Axes in the order: batch, free of x, free of y, contracted."""

        def call(v: Any) -> Any:
            v = jnp.transpose(v, (*batch, *free, *contract))
            gap = len(batch) + (0 if before else len(free))
            return jnp.expand_dims(v, tuple(range(gap, gap + before + after)))

        return call

    wide_x = move(spread(batch_x, free_x, contract_x, 0, len(free_y)), x)
    wide_y = move(spread(batch_y, free_y, contract_y, len(free_x), 0), y)
    if same and not free_x and not free_y and tuple(contract_x) == tuple(contract_y):
        terms = apply(SQUARE, wide_x)
    else:
        shape = jnp.broadcast_shapes(*(v.shape for v in (wide_x, wide_y)))
        wide_x, wide_y = (move(lambda v: jnp.broadcast_to(v, shape), v) for v in (wide_x, wide_y))
        terms = multiply(wide_x, wide_y)
    rank = terms.range.lower.ndim
    return total(terms, range(rank - len(contract_x), rank))


def reduce_products(x: Node, axes: Sequence[int], rule: Any) -> Node:
    """Fold a rule of two nodes over axes, halving: for products, maxima and minima of entries."""
    axes = sorted(axes)
    rank = x.range.lower.ndim
    keep = [i for i in range(rank) if i not in axes]
    shape = [x.shape[i] for i in keep]
    x = move(lambda v: jnp.transpose(v, (*axes, *keep)).reshape(-1, *shape), x)
    while (count := x.shape[0]) > 1:
        half = count // 2
        folded = rule(move(lambda v, h=half: v[:h], x), move(lambda v, h=half: v[h : 2 * h], x))
        if count % 2:
            last = move(lambda v: v[-1:], x)
            folded = structural(lambda a, b: jnp.concatenate([a, b]), [folded, last])[0]
        x = folded
    return move(lambda v: v[0], x)


ANGLE_ULPS = 16.0  # of arctan2, see `functions`


def angle(y: Any, x: Any) -> Node:
    """``atan2(y, x)``: exact over all quadrants; across the cut (x < 0, y = 0) it is ``[-pi, pi]``.

    Away from origin and cut, the angle is a harmonic function of the point, and so is what is left after a slope is
    taken off: its extremes lie on the edges of the rectangle, where they are known in closed form.
    """
    shape, dtype = (y.shape, y.dtype) if is_node(y) else (x.shape, x.dtype)
    y, x = (normalised(v) if is_node(v) else as_node(v, shape, dtype) for v in (y, x))
    yl, yu, xl, xu = y.range.lower, y.range.upper, x.range.lower, x.range.upper
    cut = (xl < 0) & (yl < 0) & (yu >= 0)
    corners = extremes([_angle_at(b, a) for a in (xl, xu) for b in (yl, yu)])
    half_turn = jnp.full_like(xl, math.pi)
    natural = choose(cut, Interval.unchecked(-half_turn, half_turn), corners)
    natural = Interval.unchecked(rounding.down(natural.lower, ANGLE_ULPS), rounding.up(natural.upper, ANGLE_ULPS))
    box, jac = parts([y, x])
    smooth = ~cut & ~((xl <= 0) & (xu >= 0) & (yl <= 0) & (yu >= 0))
    form = None
    if box is not None:
        finite = smooth & jnp.isfinite(yl) & jnp.isfinite(yu) & jnp.isfinite(xl) & jnp.isfinite(xu)
        yl, yu, xl, xu = (where(finite, v, 1) for v in (yl, yu, xl, xu))
        cy, cx = 0.5 * yl + 0.5 * yu, 0.5 * xl + 0.5 * xu
        square = cx * cx + cy * cy
        sy, sx = cx / square, -cy / square
        points = [(b, a) for a in (xl, xu) for b in (yl, yu)]
        for edge in (xl, xu):
            t = _safe_root(edge, sy)
            points += [(jnp.clip(side * t, yl, yu), edge) for side in (1, -1)]
        for edge in (yl, yu):
            t = _safe_root(-edge, sx)
            points += [(edge, jnp.clip(side * t, xl, xu)) for side in (1, -1)]
        # A point clipped to the edge is a corner: still on the rectangle, so nothing is lost by looking at it.
        rest = extremes([_angle_at(b, a) - sy * b - sx * a for b, a in points])
        far_y, far_x = (jnp.maximum(abs(p), abs(q)) for p, q in ((yl, yu), (xl, xu)))
        # An angle is below 4. A point of contact solves its equation to a few ulps of the slope, which over the length
        # of its edge is as much as the products lose.
        size = 4 + abs(sy) * far_y + abs(sx) * far_x
        rest = Interval.unchecked(
            rounding.lowered(rest.lower, size, 4 * ANGLE_ULPS), rounding.raised(rest.upper, size, 4 * ANGLE_ULPS)
        )
        linear = box_sum(scaled(sy, y.offset), scaled(sx, x.offset))
        slope, slack = _weighed([(sy, y), (sx, x)], box)
        slack = None if slack is None else where(finite, slack, 0)
        offset = choose(finite, box_sum(linear, rest), natural)
        form = best_form(where(finite, slope, 0), offset, natural, box, slack, size)
    if jac is None:
        return Node(natural, form)
    over_y = _pull(x.range, y.range, smooth)
    over_x = _pull(y.range, x.range, smooth)
    jac_x = chain(Interval.unchecked(-over_x.upper, -over_x.lower), x.jac)
    return Node(natural, form, join(chain(over_y, y.jac), jac_x))


def _safe_root(edge: Any, slope: Any) -> Any:
    """Where the derivative ``edge / (edge^2 + t^2)`` along an edge equals the slope: t >= 0, or 0 if nowhere."""
    edge, slope = jax.lax.stop_gradient(edge), jax.lax.stop_gradient(slope)
    # The square of t is edge * rest; it would vanish where t itself does not.
    rest = 1 / where(slope == 0, 1, slope) - edge
    there = (slope != 0) & (edge != 0) & ((rest > 0) == (edge > 0))
    return where(there, jnp.sqrt(where(there, abs(edge), 1)) * jnp.sqrt(where(there, abs(rest), 1)), 0)


def _angle_at(y: Any, x: Any) -> Any:
    """``atan2`` at a corner, which may lie at infinity or at the origin; ``-0`` counts as 0."""
    y = y + 0.0
    plain = jnp.isfinite(x) & jnp.isfinite(y) & ((x != 0) | (y != 0))
    smooth = jnp.arctan2(where(plain, y, 0), where(plain, x, 1))
    return where(plain, smooth, jax.lax.stop_gradient(jnp.arctan2(y, x)))


def _pull(a: Interval, b: Interval, smooth: Any) -> Interval:
    """Exact range of ``a / (a^2 + b^2)`` over a rectangle without the origin: harmonic, so look at its edges."""

    def at(p: Any, q: Any) -> Any:
        good = smooth & jnp.isfinite(p) & jnp.isfinite(q) & ((p != 0) | (q != 0))
        p, q = where(good, p, 0), where(good, q, 1)
        # Over the larger one first: squares of the numbers themselves would overflow or vanish. By its reciprocal, as
        # XLA makes one quotient of two, with the square in it that is to be avoided.
        over = 1 / jax.lax.stop_gradient(where(abs(p) > abs(q), p, q))
        p, q = p * over, q * over
        return p / jnp.maximum(p * p + q * q, 1) * over

    values = [at(p, q) for p in (a.lower, a.upper) for q in (b.lower, b.upper)]
    zero = jnp.clip(jnp.zeros_like(b.lower), b.lower, b.upper)
    values += [at(p, zero) for p in (a.lower, a.upper)]
    for q in (b.lower, b.upper):
        values += [at(jnp.clip(side * q, a.lower, a.upper), q) for side in (1, -1)]
    pull = extremes(values)
    lower, upper = rounding.overflowed(pull.lower), -rounding.overflowed(-pull.upper)
    pull = Interval.unchecked(rounding.down(lower, 16.0), rounding.up(upper, 16.0))
    return choose(smooth, pull, entire_like(a.lower))
