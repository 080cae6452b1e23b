"""Sums, multiples, and everything that only moves entries about: exact in all domains but for rounding.

A structural primitive (slice, reshape, sum, cumsum, ...) has nonnegative weights, so it is applied to lower and upper
bounds as it stands, and to slopes and Jacobians once per entry of ``x``. Where it adds entries, the magnitudes of these
go through it as well, and what comes out bounds its rounding, in whatever order it adds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion import combinations
from gsisio_jax.inclusion.form_arithmetic import (
    Along,
    added_slack,
    box_sum,
    fold,
    is_exact,
    is_known,
    is_point,
    is_zero,
    known_if_concrete,
    product,
    scaled,
    scaled_slack,
    sum_slack,
)
from gsisio_jax.inclusion.node import (
    POINT_MODE,
    Form,
    Node,
    as_node,
    chain,
    is_node,
    join,
    meet,
    normalised,
    parts,
    slack_of,
    slope_of,
    sparse,
    unnormalised_node,
)
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, is_concrete
from gsisio_jax.interval.direct import where


def structural(fn: Callable[..., Any], values: Sequence[Any], fixed: Sequence[Any] = (), terms: int = 1) -> list[Node]:
    """Apply `fn`, linear with nonnegative weights and no offset, to a list of constants and nodes.

    `fn` takes as many arrays as there are values and returns one array or a list of them (one, where it adds). `fixed`
    are the arrays that it holds besides (masks, indices): if they are not known while tracing, nothing that comes out
    is. `terms` is the largest number of entries that it adds up; 1 for what only moves them about.
    """
    dtype = next(v.dtype for v in values if is_node(v))
    nodes = [v if is_node(v) else as_node(v, jnp.shape(v), dtype) for v in values]
    box, jac = parts(nodes)
    known = all(is_concrete(v) for v in fixed)
    run = fold if known else _call
    # Of linear functions: the form says all, and its image is the range.
    linear = known and any(v.form is not None for v in nodes) and all(v.is_static_affine for v in nodes)
    box = next(v.form.box for v in nodes if v.form is not None) if linear else box
    share = None if box is not None or jac is not None else combinations.together([v.share for v in nodes], terms)
    adds = terms > 1 and rounding.outward() and share is None

    def as_list(result: Any) -> list[Any]:
        return list(result) if isinstance(result, list | tuple) else [result]

    def side(values: Sequence[Any], call: Callable[..., Any], sign: float) -> Any:
        result = run(call, *values)
        if not adds or is_zeros(values):
            return result
        size = run(call, *map(abs, values))
        if is_known(result):
            # Where at most one of the terms is not 0, nothing was rounded.
            size = np.where(run(call, *((v != 0).astype(v.dtype) for v in values)) > 1, size, 0)
            return np.where(size == 0, result, result + sign * rounding.error(size, terms))
        return rounding.lowered(result, size, terms) if sign < 0 else rounding.raised(result, size, terms)

    def both(pairs: Sequence[Interval], call: Callable[..., Any]) -> list[Interval]:
        lower = side([p.lower for p in pairs], call, -1)
        points = all(is_point(p) for p in pairs)
        same = points and (not adds or is_zeros([p.lower for p in pairs]))
        upper = lower if same else side([p.upper for p in pairs], call, 1)
        if points and is_known(lower) and is_known(upper) and np.array_equal(lower, upper):
            upper = lower
        return [Interval.unchecked(a, b) for a, b in zip(as_list(lower), as_list(upper), strict=True)]

    along = Along(fn)
    ranges: list[Any] = [] if linear else both([v.range for v in nodes], fn)
    forms: list[Any] = [None] * len(ranges)
    if box is not None:
        given = [slope_of(v, box) for v in nodes]
        slopes = as_list(run(along, *given))
        offsets = both([v.offset for v in nodes], fn)
        slacks: list[Any] = [None] * len(slopes)
        if any(v.form is not None and v.form.slack is not None for v in nodes):
            slacks = as_list(run(along, *(slack_of(v, slope) for v, slope in zip(nodes, given, strict=True))))
        if adds:
            slacks[0] = sum_slack(slacks[0], _lost(run, along, given, terms))
        forms = [Form(s, o, box, e) for s, o, e in zip(slopes, offsets, slacks, strict=True)]
    ranges = ranges or [None] * len(forms)
    jacs: list[Any] = [None] * len(forms)
    if jac is not None:
        parts_of = [_jac_like(v, jac) for v in nodes]
        jacs = both(parts_of, along)
        if adds:
            entering = run(along, *(((v.lower != 0) | (v.upper != 0)).astype(dtype) for v in parts_of))
            jacs = [sparse(found, Interval.unchecked(entering, entering)) for found in jacs]
    unnormalised = rounding.outward() and (adds or any(v.unnormalised for v in nodes))
    return [Node(*triple, unnormalised, share) for triple in zip(ranges, forms, jacs, strict=True)]


def _jac_like(node: Node, jac: Interval) -> Interval:
    """The Jacobian of a node in the type of another one; truth values and whole numbers have none of their own."""
    if node.jac is not None:
        return node.jac
    zero = np.zeros((jac.lower.shape[0], *node.shape), jac.lower.dtype)
    return Interval.unchecked(zero, zero)


def is_zeros(values: Sequence[Any]) -> bool:
    """Arrays that are known to hold nothing but zeros."""
    return all(is_known(v) and not v.any() for v in values)


def _lost(run: Any, along: Any, slopes: Sequence[Any], terms: int) -> Any:
    """What adding the slopes loses. A sum of which one term is not zero is exact, as in a product with the identity."""
    size = run(along, *map(abs, slopes))
    several = run(along, *((s != 0).astype(s.dtype) for s in slopes)) > 1
    lost = size * np.dtype(size.dtype).type((terms + 1) * float(jnp.finfo(size.dtype).eps))
    return np.where(several, lost, 0) if is_known(lost) else jax.lax.stop_gradient(where(several, lost, 0))


def _call(fn: Callable[..., Any], *values: Any) -> Any:
    return fn(*values)


def move(fn: Callable[[Any], Any], value: Any) -> Any:
    """`structural` for one value and one result; constants pass through."""
    return structural(fn, [value])[0] if is_node(value) else fold(fn, known_if_concrete(value))


def multiple(factor: Any, x: Node, rounded: bool = False) -> Node:
    """``factor * x`` for a constant factor; `rounded` where the factor itself is the result of one operation."""
    factor = known_if_concrete(factor, x.dtype)
    if is_known(factor) and ((factor != 0) & (np.abs(factor) < np.finfo(x.dtype).tiny)).any():
        # Compiled code would take it for zero: a thin box, without form.
        thin = as_node(factor, np.broadcast_shapes(np.shape(factor), x.shape), x.dtype).range
        x = normalised(x)
        return Node(product(thin, x.range), None, chain(thin, x.jac))
    ulps = 4.0 if rounded else 2.0
    if not (is_known(factor) and np.isfinite(factor).all()):
        x = normalised(x)  # 0 times NaN would count as 0
    form, jac = x.form, None if x.jac is None else sparse(scaled(factor, x.jac, ulps), x.jac)
    if form is not None:
        slope = factor * form.slope
        slack = scaled_slack(factor, form.slope, slope, form.slack, ulps)
        form = Form(slope, scaled(factor, form.offset, ulps), form.box, slack)
        if form.is_static_affine():
            return unnormalised_node(None, form, jac)
        form = None if POINT_MODE.get() else form
    if form is None and (found := _combination(factor, x, ulps)) is not None:
        return unnormalised_node(*found[:1], None, jac, found[1])
    return unnormalised_node(scaled(factor, x.range, ulps), form, jac)


def _combination(factor: Any, x: Node, ulps: float) -> tuple[Interval, combinations.Share | None] | None:
    """Range of ``factor * x`` as part of a linear combination; None where it has a widening of its own."""
    if not (rounding.outward() and is_known(factor) and np.isfinite(factor).all()) or is_point(x.range):
        return None
    if ulps == 2.0 and is_exact(factor):
        return (combinations.scaled(factor, x.range), combinations.times(factor, x.share, ulps)) if x.share else None
    share = combinations.times(np.asarray(factor), x.share, ulps)
    if share is None:
        return None
    return combinations.scaled(factor, x.range if x.share else combinations.widened(x.range)), share


def negative(x: Node) -> Node:
    def flip(a: Interval) -> Interval:
        lower = -a.upper
        return Interval.unchecked(lower, lower if is_point(a) else -a.lower)

    form = None if x.form is None else Form(-x.form.slope, flip(x.form.offset), x.form.box, x.form.slack)
    jac = None if x.jac is None else flip(x.jac)
    return Node(None if x.given is None else flip(x.given), form, jac, x.unnormalised, x.share)


def add(x: Any, y: Any) -> Node:
    """Sum of two nodes, or of a node and a constant."""
    if not is_node(x):
        x, y = y, x
    if not is_node(y):
        y = as_node(y, np.broadcast_shapes(x.shape, np.shape(y)), x.dtype)
    form, jac = x.form if y.form is None else y.form, join(x.jac, y.jac)
    if form is not None and x.is_static_affine and y.is_static_affine:
        return _known_sum(x, y, form.box, jac)
    if form is None and (share := _shares(x, y)) is not None:
        one, other = (v.range if v.share else combinations.widened(v.range) for v in (x, y))
        return unnormalised_node(combinations.added(one, other), None, jac, share)
    total = box_sum(x.range, y.range)
    if form is None or POINT_MODE.get():
        return unnormalised_node(total, None, jac)
    offset = box_sum(x.offset, y.offset)
    if x.form is None or y.form is None:
        # With one form only there is nothing to cancel, and the range is what it was, moved.
        return unnormalised_node(total, Form(form.slope, offset, form.box, form.slack), jac)
    slope = x.form.slope + y.form.slope
    slack = sum_slack(x.form.slack, y.form.slack, added_slack(x.form.slope, y.form.slope, slope))
    return meet(unnormalised_node(total, Form(slope, offset, form.box, slack), jac))


def _shares(x: Node, y: Node) -> combinations.Share | None:
    """Of the sum as a linear combination, if one of its terms is one."""
    if (x.share is None and y.share is None) or is_zero(x.range) or is_zero(y.range):
        return None
    return combinations.plus(x.share or combinations.OPERAND, y.share or combinations.OPERAND)


def _known_sum(x: Node, y: Node, box: Any, jac: Any) -> Node:
    """Sum of linear functions."""
    a, b = (slope_of(v, box) for v in (x, y))
    slope = a + b
    slack = sum_slack(*(v.form.slack for v in (x, y) if v.form is not None), added_slack(a, b, slope))
    offset = box_sum(
        *(Interval.unchecked(*(np.broadcast_to(side, slope.shape[1:]) for side in _sides(v.offset))) for v in (x, y))
    )
    return unnormalised_node(None, Form(slope, offset, box, slack), jac)


def _sides(a: Interval) -> tuple[Any, Any]:
    return a.lower, a.upper


def subtract(x: Any, y: Any) -> Node:
    return add(x, negative(y)) if is_node(y) else add(x, -known_if_concrete(y))


def total(node: Node, axes: Sequence[int]) -> Node:
    """Sum over axes."""
    axes = tuple(axes)
    terms = int(np.prod([node.shape[axis] for axis in axes]))
    return meet(structural(lambda v: v.sum(axes), [node], terms=terms)[0])


def elementwise(x: Node, natural: Interval, derivative: Interval | None) -> Node:
    """An elementwise function of which only the range and the derivative are known."""
    return Node(natural, None, None if derivative is None else chain(derivative, x.jac))
