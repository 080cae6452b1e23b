"""Operations of a jaxpr in NumPy; what is not written here is given to JAX (`numpy_library`).

So are transcendental functions: bounds stand on the accuracy of the library that the observer runs on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from gsisio_jax.scalar.numpy_library import given_to_jax
from gsisio_jax.scalar.numpy_source import FLOATING_ONLY


def numpy_operation(eqn: Any) -> Callable[..., Sequence[Any]]:
    """The operation of an equation: values of its arguments to those of its results."""
    found = operation_of(eqn.primitive.name, eqn.primitive, eqn.params, [v.aval for v in eqn.invars])
    assert found is not None
    return found


def operation_of(
    name: str, primitive: Any, params: dict[str, Any], given: Sequence[Any]
) -> Callable[..., Sequence[Any]] | None:
    """The same from the primitive (None where it is not known: then of NumPy's operations alone), its parameters, and
    shapes and types of its arguments."""
    if all(isinstance(kind.dtype, np.dtype) for kind in given):  # random keys are JAX's
        if (function := elementwise(name, given)) is not None:
            return lambda *args: (function(*args),)
        if name in _ARRAYS:
            rule = _ARRAYS[name]
            return lambda *args: (rule(params, *args),)
        if name in _SEVERAL:
            several = _SEVERAL[name]
            return lambda *args: several(params, *args)
        if name == "round" and int(params["rounding_method"]) == 1:  # to nearest, ties to even
            return lambda x: (np.rint(x),)
        if name == "sort" and params["num_keys"] == 1 and given[0].dtype.kind in "fiub":
            return lambda *args: _sort(params["dimension"], *args)
    return None if primitive is None else given_to_jax(primitive, params, given)


def elementwise(name: str, given: Sequence[Any]) -> Callable[..., Any] | None:
    """The operation without parameters, on arrays of one shape; None if it is not NumPy's."""
    floating = given and given[0].dtype.kind == "f"
    return _ELEMENTWISE.get(name) if floating or name not in FLOATING_ONLY else None


def _sign(x: Any) -> Any:
    """Of a zero, the zero itself."""
    return np.where(x == 0, x, np.sign(x))


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


def _extreme(function: np.ufunc, initial: float) -> Callable[..., Any]:
    def extreme(params: Any, x: Any) -> Any:
        first: dict[str, Any] = {"initial": initial} if x.dtype.kind == "f" else {}
        return function.reduce(x, tuple(params["axes"]), **first)

    return extreme


def _sort(axis: int, first: Any, *others: Any) -> Sequence[Any]:
    """By the first array; equal entries stay in order, NaN come last."""
    if not others:
        return (np.sort(first, axis, kind="stable"),)
    order = np.argsort(first, axis, kind="stable")
    return [np.take_along_axis(array, order, axis) for array in (first, *others)]


def _padded(params: Any, x: Any, value: Any) -> Any:
    """Negative padding leaves entries out."""
    config = params["padding_config"]
    inner = [max(0, size + (size - 1) * between) for size, (_, _, between) in zip(x.shape, config, strict=True)]
    wide = np.full(
        [size + max(low, 0) + max(high, 0) for size, (low, high, _) in zip(inner, config, strict=True)], value
    )
    at = [
        slice(max(low, 0), max(low, 0) + size, between + 1)
        for size, (low, _, between) in zip(inner, config, strict=True)
    ]
    wide[tuple(at)] = x
    ends = zip(wide.shape, config, strict=True)
    return wide[tuple(slice(max(-low, 0), size - max(-high, 0)) for size, (low, high, _) in ends)]


def _updated(params: Any, x: Any, update: Any, *starts: Any) -> Any:
    """As XLA does: what would leave the array begins earlier."""
    sizes = update.shape
    first = [min(max(int(i), 0), all_ - size) for i, all_, size in zip(starts, x.shape, sizes, strict=True)]
    out = np.array(x)
    out[tuple(slice(i, i + size) for i, size in zip(first, sizes, strict=True))] = update
    return out


def _index_of(function: Callable[..., Any]) -> Callable[..., Any]:
    """The first of equal ones, or the first NaN."""
    return lambda params, x: function(x, params["axes"][0]).astype(params["index_dtype"])


def _junction(of_bits: np.ufunc, of_truth: np.ufunc) -> Callable[..., Any]:
    return lambda params, x: (of_truth if x.dtype == bool else of_bits).reduce(x, tuple(params["axes"]))


# Exact, or correctly rounded.
_ELEMENTWISE: dict[str, Callable[..., Any]] = {
    "add": np.add, "add_any": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide, "neg": np.negative,
    "abs": np.abs,
    "max": np.maximum, "min": np.minimum, "larger": np.maximum, "smaller": np.minimum, "sign": _sign,
    "raised": lambda a, b: np.where(b > a, b, a), "cut": lambda a, b: np.where(b < a, b, a), "floor": np.floor,
    "ceil": np.ceil, "sqrt": np.sqrt, "square": np.square, "is_finite": np.isfinite, "scale": _scale, "times": _times,
    "lt": np.less, "le": np.less_equal, "gt": np.greater, "ge": np.greater_equal, "eq": np.equal, "ne": np.not_equal,
    "and": np.bitwise_and, "or": np.bitwise_or, "not": np.invert, "xor": np.bitwise_xor, "select_n": _select,
    "clamp": lambda low, x, high: np.minimum(np.maximum(x, low), high), "nextafter": np.nextafter,
    **dict.fromkeys(("stop_gradient", "fusion_barrier", "optimization_barrier", "copy"), lambda x: x),
    **dict.fromkeys(("wave", "falling_wave"), lambda value, t, slope: value),
}  # fmt: skip

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
    "reduce_sum": lambda params, x: np.add.reduce(x, tuple(params["axes"]), x.dtype),
    "reduce_prod": lambda params, x: np.multiply.reduce(x, tuple(params["axes"]), x.dtype),
    "reduce_and": _junction(np.bitwise_and, np.logical_and),
    "reduce_or": _junction(np.bitwise_or, np.logical_or),
    "reduce_max": _extreme(np.maximum, -np.inf),
    "reduce_min": _extreme(np.minimum, np.inf),
    "argmax": _index_of(np.argmax),
    "argmin": _index_of(np.argmin),
    "pad": _padded,
    "dynamic_update_slice": _updated,
    "dot_general": _dot,
}

_SEVERAL: dict[str, Callable[..., Sequence[Any]]] = {
    "split": lambda params, x: np.split(x, np.cumsum(params["sizes"])[:-1], axis=params["axis"]),
    "unstack": lambda params, x: list(np.moveaxis(x, params["axis"], 0)),
}
