"""Entries at places that depend on the box: the hull over all places that can be reached.

Every place is tried while tracing, so the number of places is limited; an operand that is a table of numbers costs two
masked minima. Between places the result may jump.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from gsisio_jax.inclusion.node import Node, as_node, is_node, normalised
from gsisio_jax.inclusion.rules.linear import structural
from gsisio_jax.inclusion.rules.possible import hull_of_rows
from gsisio_jax.interval.box import Interval, choose, entire_like

MOST_PLACES = 4096


class TooManyPlacesError(ValueError):
    """There are more places than are worth trying."""


def _ends(index: Any) -> tuple[Any, Any]:
    """Smallest and largest value of an index, as integers; those of an unbounded one are far out."""
    if not is_node(index):
        return jnp.asarray(index), jnp.asarray(index)
    far = 2.0**31 - 1
    index = normalised(index)
    ends = (jnp.clip(end, -far, far) for end in (index.range.lower, index.range.upper))
    low, high = (end.astype(jnp.int64 if jax.config.jax_enable_x64 else jnp.int32) for end in ends)  # type: ignore[attr-defined]
    return low, high


def _moves(index: Any) -> bool:
    """May it change with x?"""
    return is_node(index) and index.jac is not None


def _places(counts: Sequence[int], name: str) -> np.ndarray:
    if math.prod(counts) > MOST_PLACES:
        raise TooManyPlacesError(f"with indices that depend on the box and may be any of {math.prod(counts)} places")
    return np.array(list(itertools.product(*map(range, counts))), np.int32).reshape(-1, len(counts))


def _rows(pick: Callable[..., Any], places: np.ndarray, values: Sequence[Any]) -> Node:
    """`pick` at every place, stacked, as a node."""

    def call(*operands: Any) -> Any:
        return jax.vmap(lambda place: pick(place, *operands))(places)

    if any(map(is_node, values)):
        return structural(call, values)[0]
    stacked = call(*values)
    return as_node(stacked, stacked.shape, stacked.dtype if stacked.dtype != bool else bool)


def _reached(possible: Any, rows: Node, moves: bool, outside: Any = None) -> Node:
    """The hull; where the place may lie `outside`, nothing is known."""
    if rows.dtype == bool:
        lower, upper = (~possible | rows.range.lower).all(0), (possible & rows.range.upper).any(0)
        if outside is not None:
            lower, upper = lower & ~outside, upper | outside
        return Node(Interval.unchecked(lower, upper))
    if not jnp.issubdtype(rows.dtype, jnp.floating):
        rows = Node(Interval.unchecked(*(side.astype(float) for side in (rows.range.lower, rows.range.upper))))
    undecided = possible.sum(0) > 1
    found = hull_of_rows(possible, rows, undecided if moves else None)
    if outside is None:
        return found
    natural = choose(outside, entire_like(found.range.lower), found.range)
    jac = found.jac and choose(outside, entire_like(found.jac.lower), found.jac)
    return Node(natural, found.form, jac)


def _jumping(node: Node, index: Any) -> Node:
    """A result without Jacobian whose place moves with x: 0 where the place is decided, else unknown."""
    if node.jac is not None or not _moves(index):
        return node
    decided = node.range.lower == node.range.upper
    flat = jnp.zeros((index.jac.lower.shape[0], *node.shape), index.jac.lower.dtype)
    return Node(node.range, node.form, choose(decided, Interval.unchecked(flat, flat), entire_like(flat)))


def gather(eqn: Any, operand: Any, indices: Any) -> Node:
    """`lax.gather` with indices (..., k) that are nodes."""
    numbers, sizes, mode = (eqn.params[key] for key in ("dimension_numbers", "slice_sizes", "mode"))
    if numbers.operand_batching_dims:
        raise TooManyPlacesError("with indices that depend on the box, one for every entry of a batch")
    shape = operand.shape if is_node(operand) else jnp.shape(operand)
    counts = [shape[axis] - sizes[axis] + 1 for axis in numbers.start_index_map]
    places = _places(counts, "gather")
    low, high = _ends(indices)

    def pick(place: Any, values: Any) -> Any:
        at = jnp.broadcast_to(place.astype(eqn.invars[1].aval.dtype), low.shape)
        return lax.gather(values, at, numbers, sizes, mode="clip")

    last = np.array(counts) - 1
    fills = mode == lax.GatherScatterMode.FILL_OR_DROP
    outside = ((low < 0) | (high > last)).any(-1) if fills else None
    low, high = jnp.clip(low, 0, last), jnp.clip(high, 0, last)
    steps = places.reshape(-1, *(1,) * (low.ndim - 1), len(counts))
    possible = ((low <= steps) & (steps <= high)).all(-1)
    # Batch axes of the indices are all axes of the result but those of the slices.
    rank, offsets = len(eqn.outvars[0].aval.shape), tuple(numbers.offset_dims)
    out = eqn.outvars[0].aval.shape
    possible = jnp.broadcast_to(jnp.expand_dims(possible, tuple(1 + axis for axis in offsets)), (len(places), *out))
    if outside is not None:
        outside = jnp.broadcast_to(jnp.expand_dims(outside, offsets), out)
    assert possible.ndim == rank + 1
    rows = _rows(pick, places, [operand])
    return _jumping(_reached(possible, rows, _moves(indices), outside), indices)


def _of_starts(starts: Sequence[Any], counts: Sequence[int], name: str) -> tuple[np.ndarray, Any, Any]:
    """Places of a slice, which of them are possible, and an index that is a node."""
    places = _places(counts, name)
    possible = jnp.ones(len(places), bool)
    for k, (start, count) in enumerate(zip(starts, counts, strict=True)):
        low, high = (jnp.clip(end, 0, count - 1) for end in _ends(start))
        possible &= (low <= places[:, k]) & (places[:, k] <= high)
    moving = [start for start in starts if _moves(start)]
    return places, possible, moving[0] if moving else next(filter(is_node, starts))


def dynamic_slice(eqn: Any, operand: Any, *starts: Any) -> Node:
    sizes, shape = eqn.params["slice_sizes"], eqn.invars[0].aval.shape
    counts = [n - size + 1 for n, size in zip(shape, sizes, strict=True)]
    places, possible, index = _of_starts(starts, counts, "dynamic_slice")

    def pick(place: Any, values: Any) -> Any:
        return lax.dynamic_slice(values, tuple(place), sizes)

    rows = _rows(pick, places, [operand])
    possible = jnp.broadcast_to(possible.reshape(-1, *(1,) * len(sizes)), rows.shape)
    return _jumping(_reached(possible, rows, _moves(index)), index)


def dynamic_update_slice(eqn: Any, operand: Any, update: Any, *starts: Any) -> Node:
    shape, sizes = (atom.aval.shape for atom in eqn.invars[:2])
    counts = [n - size + 1 for n, size in zip(shape, sizes, strict=True)]
    places, possible, index = _of_starts(starts, counts, "dynamic_update_slice")

    def pick(place: Any, values: Any, new: Any) -> Any:
        return lax.dynamic_update_slice(values, new, tuple(place))

    rows = _rows(pick, places, [operand, update])
    possible = jnp.broadcast_to(possible.reshape(-1, *(1,) * len(sizes)), rows.shape)
    return _jumping(_reached(possible, rows, _moves(index)), index)
