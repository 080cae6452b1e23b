"""Scatters with indices that are known while tracing: sums, products or extremes of the entries that meet in one place.

Which update meets which entry is found by scattering numbers. What is compiled then holds no scatter, which XLA's CPU
backend does not survive in every program (with multi-output fusion it may abort the process).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.form_arithmetic import known_if_concrete
from gsisio_jax.inclusion.node import Node, is_node, normalised
from gsisio_jax.inclusion.rules.linear import move, negative, structural
from gsisio_jax.interval.box import is_concrete
from gsisio_jax.scalar.numpy_program import numpy_function

_MOST = 1 << 20
_UNKNOWN = "with indices that are not known while tracing"


def meets(eqn: Any, indices: Any) -> np.ndarray | None:
    """How often update j lands on entry i: (entries, updates); None where indices are not known, or too many."""
    operand, updates = eqn.invars[0].aval, eqn.invars[2].aval
    count = math.prod(updates.shape)
    if is_node(indices) or not is_concrete(indices) or count * math.prod(operand.shape) > _MOST or not count:
        return None
    params = {key: eqn.params[key] for key in ("dimension_numbers", "indices_are_sorted", "mode")}
    units = np.eye(count, dtype=np.float32).reshape(count, *updates.shape)
    zeros = np.zeros(operand.shape, np.float32)

    def landed(at: Any) -> Any:
        return jax.vmap(lambda unit: jax.lax.scatter_add(jnp.asarray(zeros), at, unit, **params))(units)

    found = numpy_function(landed, np.asarray(indices))(np.asarray(indices))
    return np.rint(np.asarray(found)).astype(int).reshape(count, -1).T


def scatter_add(eqn: Any, operand: Any, indices: Any, updates: Any) -> Node | None:
    met = meets(eqn, indices)
    if met is None:
        return None
    shape = eqn.outvars[0].aval.shape

    def call(old: Any, new: Any) -> Any:
        return old + jnp.where(met > 0, new.ravel(), 0).sum(-1).reshape(shape)

    return structural(call, [operand, updates], terms=1 + int(met.sum(1).max(initial=0)))[0]


def scatter_sub(eqn: Any, operand: Any, indices: Any, updates: Any) -> Node:
    turned = negative(updates) if is_node(updates) else -known_if_concrete(updates)
    found = scatter_add(eqn, operand, indices, turned)
    if found is None:
        raise NotImplementedError(_UNKNOWN)
    return found


def scatter(eqn: Any, operand: Any, indices: Any, updates: Any) -> Node | None:
    """The last update of a place is the one that stays; several for one place are not known to be in order."""
    if eqn.params.get("update_jaxpr") is not None:  # what it updates with is nothing
        raise NotImplementedError("that applies a function (for `x.at[i].apply(h)` write `x.at[i].set(h(x[i]))`)")
    met = meets(eqn, indices)
    if met is None or (met.sum(1) > 1).any():
        return None
    place, hit = met.argmax(1), met.any(1).reshape(eqn.outvars[0].aval.shape)

    def call(old: Any, new: Any) -> Any:
        return jnp.where(hit, new.ravel()[place].reshape(old.shape), old)

    return structural(call, [operand, updates])[0]


def combined(rule: Callable[[Any, Any], Any], neutral: float) -> Callable[..., Any]:
    """Scatter that multiplies, or takes the larger or smaller: one update of every place after the other.

    `neutral` is the number that leaves any other as it is; it may be infinite.
    """

    def run(eqn: Any, operand: Any, indices: Any, updates: Any) -> Any:
        met = meets(eqn, indices)
        if met is None:
            raise NotImplementedError(_UNKNOWN)
        shape, result = eqn.outvars[0].aval.shape, operand
        lists = [np.flatnonzero(row) for row in met]
        for k in range(max(map(len, lists), default=0)):
            hit = np.array([len(row) > k for row in lists]).reshape(shape)
            place = np.array([row[k] if len(row) > k else 0 for row in lists])
            row = _entries(updates, place, shape)
            if k == 0 and not is_node(operand) and is_concrete(operand) and (np.asarray(operand) == neutral).all():
                changed = row
            else:
                changed = rule(result, row)
            result = structural(lambda p, q, hit=hit: jnp.where(hit, p, q), [normalised(changed), result])[0]
        return result

    return run


def _entries(updates: Any, place: np.ndarray, shape: tuple[int, ...]) -> Any:
    if is_node(updates):
        return move(lambda v: v.ravel()[place].reshape(shape), updates)
    return known_if_concrete(jnp.asarray(updates).ravel()[place].reshape(shape))
