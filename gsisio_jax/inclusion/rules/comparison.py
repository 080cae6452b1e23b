"""Comparisons in three values, selection, steps, and maxima.

A truth value that is not a constant is a node whose range is a pair of booleans: certainly true, possibly true.
Its Jacobian, like that of every step function, is 0 where the value is decided on the whole box and all of R where it
is not, because there the function may jump.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp

from gsisio_jax.inclusion.form_arithmetic import box_sum, slope_image, sum_slack
from gsisio_jax.inclusion.node import (
    POINT_MODE,
    Form,
    Node,
    as_node,
    best_form,
    is_node,
    jac_of,
    meet,
    normalised,
    parts,
    slack_of,
    slope_of,
)
from gsisio_jax.inclusion.rules.bilinear import divide, multiply, pick
from gsisio_jax.inclusion.rules.functions import RELU
from gsisio_jax.inclusion.rules.linear import add, negative, structural, subtract
from gsisio_jax.inclusion.rules.possible import hull_of_cases
from gsisio_jax.inclusion.rules.univariate import apply
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, choose, entire_like, hull
from gsisio_jax.interval.minmax import larger


def step(outcome: Interval, inputs: Sequence[Any]) -> Node:
    """A node of a function that is constant between its jumps."""
    _, jac = parts(inputs)
    if jac is not None:
        decided = outcome.lower == outcome.upper
        flat = jnp.zeros((jac.lower.shape[0], *decided.shape), jac.lower.dtype)
        jac = choose(decided, Interval.unchecked(flat, flat), entire_like(flat))
    return Node(outcome, None, jac)


def compare(certain: Callable[[Any, Any], Any], possible: Callable[[Any, Any], Any]) -> Callable[..., Node]:
    """A rule for an order relation, from its truth on ``(x.upper, y.lower)`` and on ``(x.lower, y.upper)``."""

    def rule(x: Any, y: Any) -> Node:
        shape = jnp.broadcast_shapes(jnp.shape(_low(x)), jnp.shape(_low(y)))
        dtype = x.dtype if is_node(x) else y.dtype
        nodes = [normalised(v) if is_node(v) else as_node(v, shape, dtype) for v in (x, y)]
        a, b = nodes[0].range, nodes[1].range
        if a.lower.dtype == bool:
            return step(Interval.unchecked(certain(a.upper, b.lower), possible(a.lower, b.upper)), [x, y])
        sure, maybe = certain(a.upper, b.lower), possible(a.lower, b.upper)
        if all(v.form is not None for v in nodes):
            gap = normalised(subtract(*nodes)).range
            sure |= certain(gap.upper, jnp.zeros_like(gap.upper))
            maybe &= possible(gap.lower, jnp.zeros_like(gap.lower))
        return step(Interval.unchecked(sure, sure | maybe), [x, y])

    return rule


def _low(value: Any) -> Any:
    return value.range.lower if is_node(value) else value


def invert(x: Any) -> Node:
    return Node(Interval.unchecked(~x.range.upper, ~x.range.lower), None, x.jac)


less = compare(jnp.less, jnp.less)
at_most = compare(jnp.less_equal, jnp.less_equal)


def equal(x: Any, y: Any) -> Node:
    below, above = at_most(x, y), at_most(y, x)
    return step(
        Interval.unchecked(below.range.lower & above.range.lower, below.range.upper & above.range.upper), [x, y]
    )


def junction(fn: Callable[[Any, Any], Any]) -> Callable[..., Node]:
    """``and`` and ``or``: monotone, so evaluated at both ends."""

    def rule(x: Any, y: Any) -> Node:
        (xl, xu), (yl, yu) = ((v.range.lower, v.range.upper) if is_node(v) else (v, v) for v in (x, y))
        return step(Interval.unchecked(fn(xl, yl), fn(xu, yu)), [x, y])

    return rule


def exclusive(x: Any, y: Any) -> Node:
    """``xor``: decided where both arguments are."""
    (xl, xu), (yl, yu) = ((v.range.lower, v.range.upper) if is_node(v) else (v, v) for v in (x, y))
    open_ = (xl != xu) | (yl != yu)
    return step(Interval.unchecked((xl ^ yl) & ~open_, (xl ^ yl) | open_), [x, y])


def finite(x: Node) -> Node:
    """``is_finite``: certain where the range is bounded."""
    bounded = jnp.isfinite(x.range.lower) & jnp.isfinite(x.range.upper)
    return step(Interval.unchecked(bounded, jnp.ones_like(bounded)), [x])


def staircase(fn: Callable[[Any], Any], below: float, above: float) -> Callable[..., Node]:
    """Rule for rounding: ``fn`` is nondecreasing and ``fn(t) - t`` lies in ``[below, above]``."""

    def rule(x: Node) -> Node:
        x = normalised(x)
        natural = Interval.unchecked(fn(x.range.lower), fn(x.range.upper))
        node = step(natural, [x])
        if x.form is None or POINT_MODE.get():
            return node
        before = x.form.offset
        offset = Interval.unchecked(rounding.down(before.lower + below), rounding.up(before.upper + above))
        return Node(natural, best_form(x.form.slope, offset, natural, x.form.box, x.form.slack), node.jac)

    return rule


def truncate(x: Node) -> Node:
    return staircase(jnp.trunc, -1.0, 1.0)(x)


def sign(x: Node) -> Node:
    return step(Interval.unchecked(jnp.sign(x.range.lower), jnp.sign(x.range.upper)), [x])


def _remainder(rounding: Callable[[Any], Any], x: Any, y: Any) -> Node:
    """``x - y k`` with k the rounded quotient; linear where k is one number on the whole box."""
    shape, dtype = (x.shape, x.dtype) if is_node(x) else (y.shape, y.dtype)
    x, y = normalised(x), normalised(y)
    a, b = (v.range if is_node(v) else as_node(v, shape, dtype).range for v in (x, y))
    quotient = normalised(divide(x, y)).range
    low, high = rounding(quotient.lower), rounding(quotient.upper)
    known = (low == high) & jnp.isfinite(low)
    count = jnp.where(known, low, 0)
    exact = subtract(x, multiply(count, y if is_node(y) else as_node(y, shape, dtype)))
    if rounding is jnp.floor:
        bounds = Interval.unchecked(jnp.minimum(b.lower, 0), jnp.maximum(b.upper, 0))
    else:
        largest = jnp.maximum(jnp.abs(b.lower), jnp.abs(b.upper))
        bounds = Interval.unchecked(jnp.clip(a.lower, -largest, 0), jnp.clip(a.upper, 0, largest))
    jump = None if exact.jac is None else entire_like(exact.jac.lower)
    return pick(known, exact, Node(bounds, None, jump))


def truncated_remainder(x: Any, y: Any) -> Node:
    """``lax.rem`` and ``jnp.fmod``: the sign of the dividend."""
    return _remainder(jnp.trunc, x, y)


def floored_remainder(x: Any, y: Any) -> Node:
    """``jnp.mod``: the sign of the divisor."""
    return _remainder(jnp.floor, x, y)


def maximum(x: Any, y: Any) -> Node:
    """Larger of two: ``y + max(x - y, 0)`` as a form, the hull of both derivatives where undecided."""
    if not is_node(x):
        x, y = y, x
    if not is_node(y):
        y = as_node(y, x.shape, x.dtype)
    x, y = normalised(x), normalised(y)
    a, b = x.range, y.range
    natural = Interval.unchecked(larger(a.lower, b.lower), larger(a.upper, b.upper))
    box, jac = parts([x, y])
    gap = normalised(subtract(Node(x.range, x.form), Node(y.range, y.form)))
    first, second = gap.range.lower >= 0, gap.range.upper <= 0
    form = None
    if box is not None:
        part = add(apply(RELU, gap), Node(y.range, y.form))
        form = best_form(slope_of(part, box), part.offset, natural, box, None if part.form is None else part.form.slack)
        for mask, node in ((second, y), (first, x)):
            slope, slack = jnp.where(mask, slope_of(node, box), form.slope), form.slack
            if rounding.outward():
                slack = jnp.where(mask, slack_of(node, slope), 0 if slack is None else slack)
            form = Form(slope, choose(mask, node.offset, form.offset), box, slack)
    if jac is not None:
        size = jac.lower.shape[0]
        jx, jy = jac_of(x, size), jac_of(y, size)
        # Where the gap ends at 0 every difference quotient is that of one side; at a point it may be any.
        low, high = gap.range.lower, gap.range.upper
        left, right = (low > 0) | ((low == 0) & (high > 0)), (high < 0) | ((high == 0) & (low < 0))
        jac = choose(left, jx, choose(right, jy, hull(jx, jy)))
    return meet(Node(natural, form, jac))


def minimum(x: Any, y: Any) -> Node:
    def flip(v: Any) -> Any:
        return negative(v) if is_node(v) else -jnp.asarray(v)

    return negative(maximum(flip(x), flip(y)))


def clamp(low: Any, x: Any, high: Any) -> Any:
    nodes = any(is_node(v) for v in (low, x))
    inner = maximum(low, x) if nodes else jnp.maximum(low, x)
    return minimum(inner, high)


def select(which: Any, *cases: Any) -> Any:
    """``lax.select_n``: the decided case, or the hull of the cases that are possible."""
    if not is_node(which):
        if any(is_node(case) for case in cases):
            return structural(lambda *values: _select_plain(which, *values), cases, [which])[0]
        return _select_plain(which, *cases)
    low, high = which.range.lower, which.range.upper
    if low.dtype == bool:
        possible, single = [~low, high], [~high, low]
    else:
        possible = [(low <= i) & (i <= high) for i in range(len(cases))]
        single = [(low == i) & (high == i) for i in range(len(cases))]
    shape = next((v.shape for v in cases if is_node(v)), jnp.shape(cases[0]))
    typed = jnp.result_type(*([v.dtype for v in cases if is_node(v)] or cases))
    nodes = [normalised(v) if is_node(v) else as_node(v, shape, typed) for v in cases]
    if nodes[0].range.lower.dtype == bool:
        lower = jnp.stack([~p | v.range.lower for p, v in zip(possible, nodes, strict=True)]).all(0)
        upper = jnp.stack([p & v.range.upper for p, v in zip(possible, nodes, strict=True)]).any(0)
        return step(Interval.unchecked(lower, upper), [which, *cases])
    box, jac = parts([which, *nodes])
    natural = hull_of_cases(possible, [v.range for v in nodes])
    form = None
    if box is not None:
        # One slope for all cases: the mean, or that of the case that is decided. What a case has more or less of it
        # goes to the offset.
        slopes = [slope_of(v, box) for v in nodes]
        slope = sum(slopes[1:], slopes[0]) / len(slopes)
        for mask, own in zip(single, slopes, strict=True):
            slope = jnp.where(mask, own, slope)
        offsets = [box_sum(v.offset, slope_image(own - slope, box)) for v, own in zip(nodes, slopes, strict=True)]
        slack = None
        if rounding.outward():
            # What every case lost; the rounding of ``own - slope`` is in the image above.
            slack = sum_slack(*(v.form.slack for v in nodes if v.form is not None))
        form = best_form(slope, hull_of_cases(possible, offsets), natural, box, slack)
    if jac is not None:
        size = jac.lower.shape[0]
        jac = hull_of_cases(possible, [jac_of(v, size) for v in nodes])
        if which.jac is not None:
            # The selection may change inside the box, and the cases need not agree where it does.
            decided = sum(single[1:], single[0].astype(int)) > 0
            jac = choose(decided, jac, entire_like(jac.lower))
    return Node(natural, form, jac)


def _select_plain(which: Any, *cases: Any) -> Any:
    result = cases[0]
    for i, case in enumerate(cases[1:], 1):
        result = jnp.where(which if jnp.asarray(which).dtype == bool else which == i, case, result)
    return result
