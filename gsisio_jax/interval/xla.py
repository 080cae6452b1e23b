"""Values that XLA is to compute once.

XLA's CPU backend fuses an elementwise operation into everything that uses its result, and computes it anew in each of
them, as often as it takes: it counts additions and multiplications as free, however long their chain. In a step of an
observer every bound is used many times, and 3,500 operations became 44,000, which cost compile time and run time alike.
Operations that it counts as expensive are never repeated, and a division is one of these.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.extend.core as jex
import numpy as np
from jax.interpreters import ad, batching, mlir

_SHORT = 16


# A primitive of its own, because it stands behind every bound: a function with a derivative rule would be traced anew
# each time, which was a third of the time that tracing a step took.
_once = jex.Primitive("once")
_once.def_impl(lambda x: x)
_once.def_abstract_eval(lambda x: x)
batching.defvectorized(_once)
ad.primitive_jvps[_once] = lambda primals, tangents: (_once.bind(*primals), tangents[0])


def _divided(x: Any) -> Any:
    """Exact for every x: a zero is divided by 2, all else by 1."""
    one = jax.lax.full_like(x, 1)
    return jax.lax.div(x, jax.lax.select(jax.lax.eq(x, jax.lax.full_like(x, 0)), jax.lax.full_like(x, 2), one))


mlir.register_lowering(_once, mlir.lower_fun(_divided, multiple_results=False))


def once(x: Any) -> Any:
    """x itself, computed once."""
    return x if isinstance(x, np.ndarray | np.generic) else _once.bind(x)


def add_up(values: Any, axis: int = -1) -> Any:
    """``values.sum(axis)``, written out for a short axis: in batches XLA's reductions of a few entries are slow."""
    count = values.shape[axis]
    if isinstance(values, np.ndarray) or not 0 < count <= _SHORT:
        return values.sum(axis)
    entries = [jax.lax.index_in_dim(values, i, axis, keepdims=False) for i in range(count)]
    return sum(entries[1:], entries[0])


def multiplied(a: Any, b: Any) -> Any:
    """``a @ b`` for stacks of small matrices, written out: a batched dot of such sizes is slow."""
    count = a.shape[-1]
    if not 0 < count <= _SHORT:
        return (a[..., :, :, None] * b[..., None, :, :]).sum(-2)
    terms = [a[..., :, i, None] * b[..., None, i, :] for i in range(count)]
    return sum(terms[1:], terms[0])
