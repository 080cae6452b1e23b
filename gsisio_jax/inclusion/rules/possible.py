"""One of several rows, where it is not known which: the hull of those that are possible.

What `comparison.select` is for a few cases, for many at once: entries of a table, places in a sorted array. Whether the
choice may jump is said by the caller: a sorted array does not, though its entries change places.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp

from gsisio_jax.inclusion.form_arithmetic import box_sum, slope_image
from gsisio_jax.inclusion.node import Node, best_form, normalised, parts, slack_of, slope_of
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, choose, entire_like
from gsisio_jax.interval.minmax import larger, smaller


def hull_of_rows(possible: Any, rows: Node, jumps: Any = None) -> Node:
    """A node of which every entry is that of one of the rows, one that is possible.

    Args:
        possible: truth values, shape (N, *shape); at least one of the N holds.
        rows: node of shape (N, *shape).
        jumps: where, in the result's shape, the choice may change inside the box between rows that need not agree
            there; None: nowhere.
    """
    rows = normalised(rows)
    count = jnp.maximum(possible.sum(0), 1).astype(rows.dtype)
    natural = _hull(possible, rows.range)
    box, jac = parts([rows])
    form = None
    if box is not None:
        # One slope for all: the mean of those that are possible, which is exact where only one is. What a row has more
        # or less of it goes to the offset.
        slopes = slope_of(rows, box)
        slope = jnp.where(possible, slopes, 0).sum(1) / count
        slope = jnp.where(jnp.isfinite(slope), slope, 0)
        offsets = box_sum(rows.offset, slope_image(slopes - slope[:, None], box))
        slack = jnp.where(possible, slack_of(rows, slopes), 0).max(1) if rounding.outward() else None
        form = best_form(slope, _hull(possible, offsets), natural, box, slack)
    if jac is not None:
        jac = _hull(possible, jac, 1)
        if jumps is not None:
            jac = choose(jumps, entire_like(jac.lower), jac)
    return Node(natural, form, jac)


def _hull(possible: Any, values: Interval, axis: int = 0) -> Interval:
    return Interval.unchecked(
        jnp.where(possible, values.lower, jnp.inf).min(axis), jnp.where(possible, values.upper, -jnp.inf).max(axis)
    )


def hull_of_cases(possible: Sequence[Any], cases: Sequence[Interval]) -> Interval:
    """Hull of the boxes of a few cases, entry by entry of those that are possible (masks)."""
    lower, upper = jnp.inf, -jnp.inf
    for mask, case in zip(possible, cases, strict=True):
        lower = smaller(lower, jnp.where(mask, case.lower, jnp.inf))
        upper = larger(upper, jnp.where(mask, case.upper, -jnp.inf))
    return Interval.unchecked(lower, upper)


def unknown(shape: tuple[int, ...], dtype: Any, inputs: Any) -> Node:
    """A node of which nothing is known, in the domains of the inputs."""
    _, jac = parts(inputs)
    natural = entire_like(jnp.zeros(shape, dtype))
    if jac is None:
        return Node(natural)
    return Node(natural, None, entire_like(jnp.zeros((jac.lower.shape[0], *shape), dtype)))


def formless(node: Node) -> Node:
    """The node without its Jacobian: for sums that are made for their form alone."""
    return Node(node.given, node.form, None, node.unnormalised)


def with_form(natural: Interval, like: Node | None, jac: Interval | None) -> Node:
    """A node with that range, the form of another node where it says more, and that Jacobian."""
    if like is None or like.form is None:
        return Node(natural, None, jac)
    form: Any = normalised(like).form
    return Node(natural, best_form(form.slope, form.offset, natural, form.box, form.slack), jac)
