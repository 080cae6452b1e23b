"""Elementwise operations of this library that JAX sees as one primitive each.

A primitive is one equation however often it is used, is traced and batched without looking inside, and is a name by
which `gsisio_jax.scalar` can simplify it. Each is an ordinary expression of `jax.lax` when it is compiled.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from typing import Any

import jax
import jax.extend.core as jex
import jax.numpy as jnp
import numpy as np
from jax.interpreters import ad, batching, mlir

from gsisio_jax.interval import devices
from gsisio_jax.interval.devices import agreeing, is_meshed, merged
from gsisio_jax.interval.direct import alike, common, entries, plus


def elementwise(name: str, body: Callable[..., Any], derivative: Callable[..., Any]) -> Callable[..., Any]:
    """A primitive for arguments of one shape and type, given as an expression and as its derivative.

    Args:
        name: shown in jaxprs.
        body: the expression, of `jax.lax` operations.
        derivative: takes primals, tangents (zeros where there are none) and the result; returns the result's tangent.

    Returns:
        The function of arrays: arguments are brought to one shape and type first.
    """
    primitive = jex.Primitive(name)
    primitive.def_impl(jax.jit(body))
    primitive.def_abstract_eval(_type)
    mlir.register_lowering(primitive, mlir.lower_fun(body, multiple_results=False))

    def batch(args: Any, dims: Any) -> tuple[Any, int]:
        first, axis = next((x, d) for x, d in zip(args, dims, strict=True) if d is not None)
        size, aval = first.shape[axis], jax.typeof(first)
        meshed = is_meshed(aval)

        def spread(x: Any, d: Any) -> Any:
            if d is None and meshed:
                return devices.spread(x, size, aval, axis)
            return alike(x, (size, *np.shape(x)), x.dtype) if d is None else x if d == 0 else jnp.moveaxis(x, d, 0)

        return primitive.bind(*map(spread, args, dims)), 0

    def jvp(primals: Any, tangents: Any) -> tuple[Any, Any]:
        out = primitive.bind(*primals)
        full = [ad.instantiate_zeros(t) for t in tangents]
        return out, derivative(primals, full, out)

    batching.primitive_batchers[primitive] = batch
    ad.primitive_jvps[primitive] = jvp

    def call(*args: Any) -> Any:
        shape, dtype = common(args)
        return primitive.bind(*agreeing([alike(arg, shape, dtype) for arg in args]))

    call.primitive = primitive  # type: ignore[attr-defined]
    return call


def _type(first: Any, *rest: Any) -> Any:
    if not any(map(is_meshed, (first, *rest))):
        return first.update(weak_type=False)
    return merged((first, *rest), first.shape, first.dtype, [range(first.ndim)] * (1 + len(rest)))


def _product_rule(partials: Callable[..., tuple[Any, Any]]) -> Callable[..., Any]:
    def derivative(primals: Any, tangents: Any, out: Any) -> Any:
        by_first, by_second = partials(*primals)
        return tangents[0] * by_first + by_second * tangents[1]

    return derivative


def _scale_partials(factor: Any, value: Any) -> tuple[Any, Any]:
    # The product rule with the infinite values left out: a cotangent of 0 times inf would be NaN.
    return jnp.where(jnp.isfinite(value), value, 0), factor


def _scale_body(factor: Any, value: Any) -> Any:
    zero = jax.lax.full_like(factor, 0)
    return jax.lax.select(jax.lax.eq(factor, zero), zero, jax.lax.mul(factor, value))


scale = elementwise("scale", _scale_body, _product_rule(_scale_partials))
"""``factor * value`` with ``0 * inf = 0``, for finite factors; finite gradients even where `value` is infinite."""


def moderate(dtype: Any) -> float:
    """Numbers above this one overflow as soon as a gradient weighs them."""
    info = jnp.finfo(dtype)
    return float(info.max) * float(info.eps) ** 2


def _times_partials(a: Any, b: Any) -> tuple[Any, Any]:
    largest = moderate(a.dtype)
    return jnp.where(jnp.abs(b) < largest, b, 0), jnp.where(jnp.abs(a) < largest, a, 0)


def _times_body(a: Any, b: Any) -> Any:
    product = jax.lax.mul(a, b)
    return jax.lax.select(jax.lax.ne(product, product), jax.lax.full_like(product, 0), product)


times = elementwise("times", _times_body, _product_rule(_times_partials))
"""``a * b`` with ``0 * inf = 0`` for numbers of any size; its derivative treats a factor near infinity as 0."""


PARTIALS = {"scale": _scale_partials, "times": _times_partials}
"""Derivatives of products, by name, as functions of both factors."""


def _divided(x: Any) -> Any:
    """Exact for every x: a zero is divided by 2, all else by 1."""
    one = jax.lax.full_like(x, 1)
    return jax.lax.div(x, jax.lax.select(jax.lax.eq(x, jax.lax.full_like(x, 0)), jax.lax.full_like(x, 2), one))


_barrier = elementwise("fusion_barrier", _divided, lambda primals, tangents, out: tangents[0])


def fusion_barrier(x: Any) -> Any:
    """x itself, computed once.

    XLA's CPU backend fuses an elementwise operation into everything that uses its result, and computes it anew in each
    of them. Operations that it counts as expensive are never repeated, and a division is one of these. Programs of
    single numbers (`gsisio_jax.scalar`) leave it out: there multi-output fusion does better.
    """
    return x if isinstance(x, np.ndarray | np.generic) else _barrier(x)


_SHORT = 16


def add_up(values: Any, axis: int = -1) -> Any:
    """``values.sum(axis)``, written out for a short axis: in batches XLA's reductions of a few entries are slow."""
    count = values.shape[axis]
    if isinstance(values, np.ndarray) or not 0 < count <= _SHORT:
        return values.sum(axis)
    return reduce(plus, entries(values, axis))


def multiplied(a: Any, b: Any) -> Any:
    """``a @ b`` for stacks of small matrices, written out: a batched dot of such sizes is slow."""
    count = a.shape[-1]
    if not 0 < count <= _SHORT:
        return (a[..., :, :, None] * b[..., None, :, :]).sum(-2)
    terms = [a[..., :, i, None] * b[..., None, i, :] for i in range(count)]
    return reduce(plus, terms)


def matmul(a: Any, b: Any) -> Any:
    """``a @ b`` in the full precision of its type, on every device."""
    return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)
