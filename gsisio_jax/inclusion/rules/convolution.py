"""Convolutions as the sums of products that they are."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.node import is_node
from gsisio_jax.inclusion.rules.bilinear import multiply
from gsisio_jax.inclusion.rules.linear import move, total


def convolve(eqn: Any, left: Any, right: Any) -> Any:
    """`lax.conv_general_dilated`: which entry of the left operand meets which of the right one is found by convolving
    the numbers of the entries with every unit kernel."""
    (a, b), out = (atom.aval.shape for atom in eqn.invars), eqn.outvars[0].aval
    count = math.prod(b)
    with jax.ensure_compile_time_eval():
        numbers = jnp.arange(1.0, math.prod(a) + 1, dtype=jnp.float32).reshape(a)
        units = jnp.eye(count, dtype=jnp.float32).reshape(count, *b)
        params = {**eqn.params, "preferred_element_type": None}
        met = np.asarray(jax.vmap(lambda unit: eqn.primitive.bind(numbers, unit, **params))(units))
    places = np.rint(met).astype(int).reshape(count, math.prod(out.shape))

    def entries(v: Any) -> Any:
        return jnp.concatenate([jnp.zeros(1, v.dtype), v.ravel()])[places]

    def weights(v: Any) -> Any:
        return jnp.broadcast_to(v.ravel()[:, None], places.shape)

    terms = multiply(_moved(entries, left), _moved(weights, right))
    return move(lambda v: v.reshape(out.shape), total(terms, [0]))


def _moved(fn: Any, value: Any) -> Any:
    return move(fn, value) if is_node(value) else fn(jnp.asarray(value))
