"""Sums, multiples, and everything that only moves entries about: exact in all domains.

A structural primitive (slice, reshape, sum, cumsum, ...) has nonnegative weights, so it is applied to lower and upper
bounds as it stands, and to slopes and Jacobians once per entry of ``x``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.node import (
    Form,
    Node,
    as_node,
    chain,
    fold,
    is_node,
    is_point,
    jac_of,
    join,
    known_if_concrete,
    meet,
    parts,
    shift,
    slope_of,
    stretch,
)
from gsisio_jax.interval import Interval, is_concrete


def structural(fn: Callable[..., Any], values: Sequence[Any], fixed: Sequence[Any] = ()) -> list[Node]:
    """Apply `fn`, linear with nonnegative weights and no offset, to a list of constants and nodes.

    `fn` takes as many arrays as there are values and returns one array or a list of them. `fixed` are the arrays that
    it holds besides (masks, indices): if they are not known while tracing, nothing that comes out is.
    """
    dtype = next(v.dtype for v in values if is_node(v))
    nodes = [v if is_node(v) else as_node(v, jnp.shape(v), dtype) for v in values]
    box, jac = parts(nodes)
    run = fold if all(is_concrete(v) for v in fixed) else _call

    def both(pairs: Sequence[Interval], call: Callable[..., Any]) -> list[Interval]:
        lower = run(call, *[p.lower for p in pairs])
        upper = lower if all(is_point(p) for p in pairs) else run(call, *[p.upper for p in pairs])
        as_list = list if isinstance(lower, list | tuple) else lambda v: [v]
        return [Interval.unchecked(a, b) for a, b in zip(as_list(lower), as_list(upper), strict=True)]

    along = jax.vmap(fn)
    ranges = both([v.range for v in nodes], fn)
    forms: list[Any] = [None] * len(ranges)
    jacs: list[Any] = [None] * len(ranges)
    if box is not None:
        slopes = run(along, *[slope_of(v, box) for v in nodes])
        slopes = list(slopes) if isinstance(slopes, list | tuple) else [slopes]
        offsets = both([v.offset for v in nodes], fn)
        forms = [Form(s, o, box) for s, o in zip(slopes, offsets, strict=True)]
    if jac is not None:
        jacs = both([jac_of(v, jac.lower.shape[0]) for v in nodes], along)
    return [Node(*triple) for triple in zip(ranges, forms, jacs, strict=True)]


def _call(fn: Callable[..., Any], *values: Any) -> Any:
    return fn(*values)


def move(fn: Callable[[Any], Any], value: Any) -> Any:
    """`structural` for one value and one result; constants pass through."""
    return structural(fn, [value])[0] if is_node(value) else fold(fn, known_if_concrete(value))


def multiple(factor: Any, x: Node) -> Node:
    """``factor * x`` for a constant factor."""
    factor = known_if_concrete(factor, x.dtype)
    form = x.form
    if form is not None:
        form = Form(factor * form.slope, stretch(factor, form.offset), form.box)
    return Node(stretch(factor, x.range), form, None if x.jac is None else stretch(factor, x.jac))


def negative(x: Node) -> Node:
    def flip(a: Interval) -> Interval:
        lower = -a.upper
        return Interval.unchecked(lower, lower if is_point(a) else -a.lower)

    form = None if x.form is None else Form(-x.form.slope, flip(x.form.offset), x.form.box)
    return Node(flip(x.range), form, None if x.jac is None else flip(x.jac))


def add(x: Any, y: Any) -> Node:
    """Sum of two nodes, or of a node and a constant."""
    if not is_node(x):
        x, y = y, x
    if not is_node(y):
        y = as_node(y, np.broadcast_shapes(x.shape, np.shape(y)), x.dtype)
    form = x.form if y.form is None else y.form
    total = shift(x.range, y.range)
    if form is None:
        return Node(total, None, join(x.jac, y.jac))
    both = x.form is not None and y.form is not None
    slope = x.form.slope + y.form.slope if x.form is not None and y.form is not None else form.slope
    node = Node(total, Form(slope, shift(x.offset, y.offset), form.box), join(x.jac, y.jac))
    # With one form only there is nothing to cancel, and the range is what it was, moved.
    return meet(node) if both else node


def subtract(x: Any, y: Any) -> Node:
    return add(x, negative(y)) if is_node(y) else add(x, -known_if_concrete(y))


def total(node: Node, axes: Sequence[int]) -> Node:
    """Sum over axes."""
    axes = tuple(axes)
    return meet(move(lambda v: v.sum(axes), node))


def elementwise(x: Node, natural: Interval, derivative: Interval | None) -> Node:
    """An elementwise function of which only the range and the derivative are known."""
    return Node(natural, None, None if derivative is None else chain(derivative, x.jac))
