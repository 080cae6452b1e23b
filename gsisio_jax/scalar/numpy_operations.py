"""Operations of a jaxpr in NumPy; what is not written here is given to JAX, one operation at a time.

So are transcendental functions: bounds stand on the accuracy of the library that the observer runs on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.scalar.numpy_source import single_numbers


def numpy_operation(eqn: Any) -> Callable[..., Sequence[Any]]:
    """The operation of an equation: values of its arguments to those of its results."""
    name, params = eqn.primitive.name, eqn.params
    if any(_is_key(v.aval) for v in eqn.invars):
        return _given_to_jax(eqn)
    floating = np.issubdtype(eqn.invars[0].aval.dtype, np.floating) if eqn.invars else False
    if name in _ELEMENTWISE and (floating or name not in _FLOATING_ONLY):
        elementwise = _ELEMENTWISE[name]
        return lambda *args: (elementwise(*args),)
    if name in _ARRAYS:
        rule = _ARRAYS[name]
        return lambda *args: (rule(params, *args),)
    if name == "round" and int(params["rounding_method"]) == 1:  # to nearest, ties to even
        return lambda x: (np.rint(x),)
    if name == "split":
        ends = np.cumsum(params["sizes"])[:-1]
        return lambda x: np.split(x, ends, axis=params["axis"])
    return _given_to_jax(eqn)


def _given_to_jax(eqn: Any) -> Callable[..., Sequence[Any]]:
    by_jax = _by_jax(eqn.primitive, tuple(eqn.params.items()))

    def bound(*args: Any) -> Sequence[Any]:
        out = by_jax(*args)
        return [plain(value) for value in (out if eqn.primitive.multiple_results else [out])]

    return bound


def plain(value: Any, dtype: Any = None) -> Any:
    """As an array of NumPy, which has no random keys: those stay what they are."""
    return value if _is_key(value) else np.asarray(value, dtype)


def _is_key(value: Any) -> bool:
    return jnp.issubdtype(getattr(value, "dtype", np.float64), jax.dtypes.prng_key)


def _by_jax(primitive: Any, params: tuple[tuple[str, Any], ...]) -> Callable[..., Any]:
    try:
        return _jitted(primitive, params)
    except TypeError:  # parameters that have no hash
        return lambda *args: primitive.bind(*map(plain, args), **dict(params))


@lru_cache(512)
def _jitted(primitive: Any, params: tuple[tuple[str, Any], ...]) -> Callable[..., Any]:
    """One for equal operations: a third of what `bind` takes."""
    return jax.jit(lambda *args: primitive.bind(*args, **dict(params)))


def operator(eqn: Any) -> str | None:
    """The operation of single numbers as Python writes it."""
    name, kinds = eqn.primitive.name, [v.aval for v in (*eqn.invars, *eqn.outvars)]
    if any(kind.shape or _is_key(kind) for kind in kinds):
        return None
    if name in _FLOATING_ONLY and kinds[0].dtype.kind != "f":
        return None
    if name == "select_n" and kinds[0].dtype != bool:
        return None
    return single_numbers(name, kinds[0].dtype)


def _scale(factor: Any, value: Any) -> Any:
    return np.where(factor == 0, factor.dtype.type(0), factor * value)


def _times(a: Any, b: Any) -> Any:
    product = a * b
    return np.where(np.isnan(product), product.dtype.type(0), product)


def _integer_power(params: Any, x: Any) -> Any:
    """By squares, in the order in which JAX multiplies."""
    left, found = abs(params["y"]), None
    while left:
        if left & 1:
            found = x if found is None else found * x
        left >>= 1
        x = x * x if left else x
    found = np.ones_like(x) if found is None else found
    return 1 / found if params["y"] < 0 else found


def _select(which: Any, *cases: Any) -> Any:
    if which.dtype == bool:
        return np.where(which, cases[-1], cases[0])
    return np.choose(which, cases)


def _broadcast(params: Any, x: Any) -> Any:
    shape = params["shape"]
    wide = [1] * len(shape)
    for axis, size in zip(params["broadcast_dimensions"], np.shape(x), strict=True):
        wide[axis] = size
    return np.broadcast_to(np.reshape(x, wide), shape)


def _slice(params: Any, x: Any) -> Any:
    strides = params["strides"] or (1,) * x.ndim
    return x[tuple(map(slice, params["start_indices"], params["limit_indices"], strides))]


def _dynamic_slice(params: Any, x: Any, *starts: Any) -> Any:
    """As XLA does: a slice that would leave the array begins earlier."""
    sizes = params["slice_sizes"]
    first = [min(max(int(i), 0), all_ - size) for i, all_, size in zip(starts, x.shape, sizes, strict=True)]
    return x[tuple(slice(i, i + size) for i, size in zip(first, sizes, strict=True))]


def _iota(params: Any) -> Any:
    shape, axis = params["shape"], params["dimension"]
    along = np.arange(shape[axis]).astype(params["dtype"])
    return np.broadcast_to(along.reshape([-1 if i == axis else 1 for i in range(len(shape))]), shape)


def _dot(params: Any, a: Any, b: Any) -> Any:
    (over_a, over_b), (batch_a, batch_b) = params["dimension_numbers"]
    free_a = [i for i in range(a.ndim) if i not in (*over_a, *batch_a)]
    free_b = [i for i in range(b.ndim) if i not in (*over_b, *batch_b)]
    sizes = [a.shape[i] for i in (*batch_a, *free_a)] + [b.shape[i] for i in free_b]

    def rows(x: Any, axes: Sequence[Sequence[int]]) -> Any:
        order = [i for group in axes for i in group]
        return np.transpose(x, order).reshape([math.prod(x.shape[i] for i in group) for group in axes])

    return (rows(a, (batch_a, free_a, over_a)) @ rows(b, (batch_b, over_b, free_b))).reshape(sizes)


def _extreme(function: Callable[..., Any], initial: float) -> Callable[..., Any]:
    return lambda params, x: function(x, tuple(params["axes"]), initial=initial if x.dtype.kind == "f" else None)


# Exact, or correctly rounded.
_ELEMENTWISE: dict[str, Callable[..., Any]] = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide, "neg": np.negative, "abs": np.abs,
    "max": np.maximum, "min": np.minimum, "larger": np.maximum, "smaller": np.minimum, "sign": np.sign,
    "raised": lambda a, b: np.where(b > a, b, a), "cut": lambda a, b: np.where(b < a, b, a), "floor": np.floor,
    "ceil": np.ceil, "sqrt": np.sqrt, "square": np.square, "is_finite": np.isfinite, "scale": _scale, "times": _times,
    "lt": np.less, "le": np.less_equal, "gt": np.greater, "ge": np.greater_equal, "eq": np.equal, "ne": np.not_equal,
    "and": np.bitwise_and, "or": np.bitwise_or, "not": np.invert, "xor": np.bitwise_xor, "select_n": _select,
    "clamp": lambda low, x, high: np.minimum(np.maximum(x, low), high), "nextafter": np.nextafter,
    **dict.fromkeys(("stop_gradient", "fusion_barrier", "optimization_barrier", "copy"), lambda x: x),
    **dict.fromkeys(("wave", "falling_wave"), lambda value, t, slope: value),
}  # fmt: skip
_FLOATING_ONLY = {"div", "sign", "abs", "neg", "sqrt", "square", "floor", "ceil"}

_ARRAYS: dict[str, Callable[..., Any]] = {
    "convert_element_type": lambda params, x: x.astype(params["new_dtype"]),
    "broadcast_in_dim": _broadcast,
    "slice": _slice,
    "dynamic_slice": _dynamic_slice,
    "bitcast_convert_type": lambda params, x: np.asarray(x).view(params["new_dtype"]),
    "integer_pow": _integer_power,
    "iota": _iota,
    "reshape": lambda params, x: np.reshape(x, params["new_sizes"]),
    "squeeze": lambda params, x: np.squeeze(x, tuple(params["dimensions"])),
    "expand_dims": lambda params, x: np.expand_dims(x, tuple(params["dimensions"])),
    "transpose": lambda params, x: np.transpose(x, params["permutation"]),
    "concatenate": lambda params, *x: np.concatenate(x, axis=params["dimension"]),
    "stack": lambda params, *x: np.stack(x, axis=params["axis"]),
    "rev": lambda params, x: np.flip(x, tuple(params["dimensions"])),
    "reduce_sum": lambda params, x: x.sum(tuple(params["axes"])),
    "reduce_prod": lambda params, x: x.prod(tuple(params["axes"])),
    "reduce_and": lambda params, x: x.all(tuple(params["axes"])),
    "reduce_or": lambda params, x: x.any(tuple(params["axes"])),
    "reduce_max": _extreme(np.max, -np.inf),
    "reduce_min": _extreme(np.min, np.inf),
    "dot_general": _dot,
}
