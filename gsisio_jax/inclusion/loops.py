"""Loops that stay loops: a long scan over nodes, and the rows of a short one put together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from gsisio_jax.inclusion.nan_flags import flag, may_be_nan, pass_on
from gsisio_jax.inclusion.node import POINT_MODE, Form, Node, as_node, is_node, jac_of, normalised, parts, slope_of
from gsisio_jax.inclusion.rules import linear


def stack(rows: list[Any]) -> Any:
    """The results of all turns along a new first axis."""
    if any(is_node(row) for row in rows):
        stacked = linear.structural(lambda *v: jnp.stack(v), rows)[0]
        pass_on(rows, [stacked])
        return stacked
    return jnp.stack(rows)


def kept_loop(turn: Callable[..., Any], carry: list[Any], xs: Sequence[Any], length: int, reverse: bool) -> list[Any]:
    """A long scan as a scan over nodes: all its turns must have the same tiers, the fullest that any of them needs."""
    box, jac = parts([*carry, *xs])

    def promote(value: Any, like: Any) -> Any:
        """`value` with every tier that `like` has."""
        if not is_node(like):
            return value
        node = value if is_node(value) else as_node(value, jnp.shape(value), like.dtype)
        form = node.form
        if like.form is not None and form is None:
            form = Form(slope_of(node, box), node.range, box)
        return Node(node.range, form, jac_of(node, jac.lower.shape[0]) if like.jac is not None else node.jac)

    def outward(x: Any) -> Any:
        """Entries of the scanned axis first, also in slopes and Jacobians."""
        if not is_node(x):
            return x
        x = normalised(x)
        form = _form(x)
        form = None if form is None else (jnp.swapaxes(form.slope, 0, 1), form.folded())
        return x.range, form, jax.tree.map(lambda v: jnp.swapaxes(v, 0, 1), x.jac)

    def inward(x: Any) -> Any:
        if not isinstance(x, tuple):
            return x
        return Node(x[0], None if x[1] is None else Form(x[1][0], x[1][1], box), x[2])

    def stacked(x: Any) -> Any:
        return Node(x[0], *_unstack(x[1], x[2], box)) if isinstance(x, tuple) else x

    def run(carry: list[Any], rows: list[Any], unsure: Any) -> tuple[list[Any], list[Any], Any]:
        """A turn, and whether something may be NaN in this one or was before; None: certainly not."""
        given = [inward(v) for v in (*carry, *rows)]
        flag(given, () if unsure is None else (unsure,))
        new, out = turn(given[: len(carry)], given[len(carry) :])
        now = may_be_nan([*new, *out])
        return new, out, unsure if now is None else now if unsure is None else unsure | now

    def step(state: tuple[list[Any], Any], rows: list[Any]) -> tuple[tuple[list[Any], Any], list[Any]]:
        carry, unsure = state
        new, out, unsure = run(carry, rows, unsure)
        new = [promote(value, inward(like)) for value, like in zip(new, carry, strict=True)]
        return ([_bare(value) for value in new], unsure), [_bare(value) for value in out]

    unsure = may_be_nan([*carry, *xs])
    unsure = None if unsure is None else jnp.asarray(unsure)
    rows = [outward(x) for x in xs]
    first = jax.tree.map(lambda v: v[0], rows)

    def once(carry: list[Any], row: list[Any], before: Any) -> tuple[list[Any], Any]:
        new, _, after = run(carry, row, before)
        return [_bare(v) for v in new], after

    while True:
        new, after = jax.eval_shape(once, [_bare(c) for c in carry], first, unsure)
        fuller = [promote(c, inward(like)) for c, like in zip(carry, new, strict=True)]
        settled = (after is None) == (unsure is None)
        unsure = unsure if settled else jnp.zeros((), bool)
        if settled and jax.tree.structure(fuller) == jax.tree.structure(carry):
            break
        carry = fuller
    state = [_bare(c) for c in carry], unsure
    (last, unsure), ys = jax.lax.scan(step, state, rows, length=length, reverse=reverse)
    results = [*(inward(c) for c in last), *(stacked(y) for y in ys)]
    flag(results, () if unsure is None else (unsure,))
    return results


def _bare(value: Any) -> Any:
    """A node without the box, which is the same in every turn."""
    if not is_node(value):
        return value
    value = normalised(value)
    form = _form(value)
    return value.range, None if form is None else (form.slope, form.folded()), value.jac


def _form(node: Node) -> Form | None:
    """The form of a node; none where only ranges were asked for."""
    return None if POINT_MODE.get() else node.form


def _unstack(form: Any, jac: Any, box: Any) -> tuple[Any, Any]:
    swap = jax.tree.map(lambda v: jnp.swapaxes(v, 0, 1), jac)
    return None if form is None else Form(jnp.swapaxes(form[0], 0, 1), form[1], box), swap
