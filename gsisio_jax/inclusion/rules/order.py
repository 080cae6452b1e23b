"""Order: sorting, largest entries and their places, counting.

The k-th smallest of several numbers is a monotone function of all of them, so its range is known from both ends; and
it is continuous: it is always one of the entries, and where it passes from one to the next they agree. So its slope and
its derivative are those of an entry that can be the k-th. Which ones can follows from the comparisons that are certain
(`comparison.less`, which looks at forms too). What is carried along (`argsort`, the places of `top_k`) may jump.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.node import Node, as_node, is_node, meet, normalised
from gsisio_jax.inclusion.rules.comparison import at_most, less, step
from gsisio_jax.inclusion.rules.linear import move, negative, structural
from gsisio_jax.inclusion.rules.possible import hull_of_rows
from gsisio_jax.interval.box import Interval


def _against(x: Node) -> tuple[Node, Node]:
    """Entry i of the first axis, and entry j, in the shape (i, j, *rest)."""
    n = x.shape[0]
    first = move(lambda v: jnp.broadcast_to(v[:, None], (n, n, *v.shape[1:])), x)
    second = move(lambda v: jnp.broadcast_to(v[None], (n, n, *v.shape[1:])), x)
    return first, second


def _ranks(x: Node) -> Any:
    """Can entry i have rank k? Shape (i, k, *rest); ties may go either way."""
    n = x.shape[0]
    first, second = _against(Node(x.range, x.form))
    below = less(first, second).range.lower  # certainly x_i < x_j
    smaller, larger = below.sum(0), below.sum(1)
    k = np.arange(n).reshape(1, n, *(1,) * (len(x.shape) - 1))
    return (smaller[:, None] <= k) & (k < n - larger[:, None])


def _spread(value: Any, n: int) -> Any:
    """Entry i in the shape (i, k, *rest)."""
    return move(lambda v: jnp.broadcast_to(v[:, None], (n, n, *v.shape[1:])), value)


def sort(eqn: Any, *operands: Any) -> list[Any]:
    """``lax.sort`` by its first operand, or by several constant ones; the others are carried along."""
    axis, keys = eqn.params["dimension"], eqn.params["num_keys"]
    if keys > 1 and any(is_node(v) for v in operands[1:keys]):
        raise NotImplementedError("by several keys of which later ones depend on the box")
    key = operands[0]
    if not is_node(key):
        # Only what is carried along depends on the box: places are known.
        places = jax.lax.broadcasted_iota(int, key.shape, axis)
        order = jax.lax.sort((*operands[:keys], places), dimension=axis, is_stable=True, num_keys=keys)[-1]
        return [
            structural(lambda v: jnp.take_along_axis(v, order, axis), [v], [order])[0]
            if is_node(v)
            else jnp.take_along_axis(v, order, axis)
            for v in operands
        ]
    return [_back(v, axis) for v in sorted_rows([_front(v, axis) for v in operands])]


def _front(value: Any, axis: int) -> Any:
    return move(lambda v: jnp.moveaxis(v, axis, 0), value)


def _back(value: Any, axis: int) -> Any:
    return move(lambda v: jnp.moveaxis(v, 0, axis), value)


def sorted_rows(operands: Sequence[Any]) -> list[Any]:
    """Along the first axis, by the first operand."""
    key = normalised(operands[0])
    n = key.shape[0]
    possible = _ranks(key)
    natural = Interval.unchecked(jnp.sort(key.range.lower, 0), jnp.sort(key.range.upper, 0))
    found = hull_of_rows(possible, _spread(key, n))
    results: list[Any] = [meet(Node(natural, found.form, found.jac))]
    for value in operands[1:]:
        node = value if is_node(value) else as_node(value, jnp.shape(value), key.dtype)
        rows = _spread(normalised(node), n)
        if rows.jac is None and key.jac is not None:
            flat = np.zeros((key.jac.lower.shape[0], *rows.shape), key.dtype)
            rows = Node(rows.range, rows.form, Interval.unchecked(flat, flat))
        results.append(hull_of_rows(possible, rows, possible.sum(0) > 1))
    return results


def top_k(eqn: Any, x: Node) -> list[Any]:
    """The k largest entries of the last axis and their places, largest first."""
    k, axis = eqn.params["k"], eqn.params.get("axis", len(x.shape) - 1) % len(x.shape)
    rows = _front(x, axis)
    n = rows.shape[0]
    places = np.broadcast_to(np.arange(n, dtype=float).reshape(n, *(1,) * (len(rows.shape) - 1)), rows.shape)
    return [_back(move(lambda v: v[::-1][:k], v), axis) for v in sorted_rows([rows, places])]


def argmax(eqn: Any, x: Node) -> Node:
    """The place of the largest entry; the first one of several."""
    return _place(eqn, _as_numbers(x))


def argmin(eqn: Any, x: Node) -> Node:
    return _place(eqn, negative(_as_numbers(x)))


def _as_numbers(x: Node) -> Node:
    """Truth values as 0 and 1."""
    x = normalised(x)
    if x.dtype != bool:
        return x
    kind = jnp.result_type(float)
    lower, upper = (jnp.asarray(side).astype(kind) for side in (x.range.lower, x.range.upper))
    return Node(Interval.unchecked(lower, upper), None, x.jac)


def _place(eqn: Any, x: Node) -> Node:
    (axis,) = eqn.params["axes"]
    rows = _front(x, axis)
    n = rows.shape[0]
    first, second = _against(Node(rows.range, rows.form))
    earlier = np.tri(n, k=-1, dtype=bool).reshape(n, n, *(1,) * (len(rows.shape) - 1))  # j before i
    beaten = less(first, second).range.lower | (at_most(first, second).range.lower & earlier)
    possible = ~beaten.any(1)
    k = np.arange(n).reshape(n, *(1,) * (len(rows.shape) - 1))
    lower, upper = jnp.where(possible, k, n).min(0), jnp.where(possible, k, -1).max(0)
    return step(Interval.unchecked(lower.astype(x.dtype), upper.astype(x.dtype)), [x])


def count_below(table: Any, query: Any, right: bool) -> Node:
    """``searchsorted``: how many entries of the table (N,) lie before the query, those that are equal with `right`."""
    n, shape = np.shape(table)[0] if not is_node(table) else table.shape[0], _shape(query)
    dtype = query.dtype if is_node(query) else table.dtype
    rows = move(lambda v: jnp.broadcast_to(v.reshape(n, *(1,) * len(shape)), (n, *shape)), table)
    wide = move(lambda v: jnp.broadcast_to(v, (n, *shape)), query)
    before = (at_most if right else less)(rows, wide).range
    outcome = Interval.unchecked(*(side.sum(0).astype(dtype) for side in (before.lower, before.upper)))
    return step(outcome, [v for v in (table, query) if is_node(v)])


def _shape(value: Any) -> tuple[int, ...]:
    return value.shape if is_node(value) else np.shape(value)
