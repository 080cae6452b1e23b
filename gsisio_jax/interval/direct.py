"""Arithmetic of arrays that are alike, handed to `jax.lax`.

`jax.numpy` first brings its arguments to one shape and type, in a function of its own that is traced and staged for
every operation: two to four times the work, for thousands of operations of a step. Here that is left out where it
changes nothing; all else goes the usual way.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

_FEW = 1024  # entries: so many are a constant, more are filled in by the program


def are_alike(a: Any, b: Any) -> bool:
    """Arrays of JAX of one shape and type."""
    return isinstance(a, jax.Array) and isinstance(b, jax.Array) and a.shape == b.shape and a.dtype == b.dtype


def plus(a: Any, b: Any) -> Any:
    """``a + b``."""
    return lax.add(a, b) if are_alike(a, b) else a + b


def minus(a: Any, b: Any) -> Any:
    """``a - b``."""
    return lax.sub(a, b) if are_alike(a, b) else a - b


def absolute(x: Any) -> Any:
    """``abs(x)``."""
    return lax.abs(x) if isinstance(x, jax.Array) else abs(x)


def where(mask: Any, a: Any, b: Any) -> Any:
    """``jnp.where(mask, a, b)``."""
    types = [value.dtype for value in (a, b) if hasattr(value, "dtype")]
    agree = len(set(types)) == 1 and (len(types) == 2 or types[0].kind == "f")  # a plain number is of any such type
    if not agree or not any(isinstance(value, jax.Array) for value in (mask, a, b)):
        return jnp.where(mask, a, b)
    dtype = jax.dtypes.canonicalize_dtype(types[0])
    shape = common_shape(mask, a, b)
    return lax.select(alike(mask, shape, np.dtype(bool)), alike(a, shape, dtype), alike(b, shape, dtype))


def multiple_and_more(x: Any, factor: Any, least: Any) -> Any:
    """``x * factor + least``, for numbers of NumPy of the type of x."""
    quick = isinstance(x, jax.Array) and all(isinstance(number, np.generic) for number in (factor, least))
    return lax.add(lax.mul(x, factor), least) if quick else x * factor + least


def entries(x: Any, axis: int = 0) -> list[Any]:
    """What lies along an axis, ``list(x)`` for the first."""
    if not isinstance(x, jax.Array):
        return list(np.moveaxis(x, axis, 0))
    return [lax.index_in_dim(x, i, axis, keepdims=False) for i in range(x.shape[axis])]


def common_shape(*values: Any) -> tuple[int, ...]:
    """`numpy.broadcast_shapes` of these, which mostly have one shape."""
    shapes = {np.shape(value) for value in values}
    return shapes.pop() if len(shapes) == 1 else jnp.broadcast_shapes(*shapes)


def is_symbolic(shape: Sequence[Any]) -> bool:
    """A size is no number, but a symbol (`jax.export.symbolic_shape`)."""
    return not all(isinstance(size, int) for size in shape)


def common(values: Sequence[Any]) -> tuple[tuple[int, ...], Any]:
    """Shape and type that operands are brought to."""
    types = {getattr(value, "dtype", None) for value in values}
    alone = len(types) == 1 and None not in types and isinstance(values[0], jax.Array)
    return common_shape(*values), types.pop() if alone else jnp.result_type(*values)


def alike(value: Any, shape: tuple[int, ...], dtype: Any) -> Any:
    """An operand in that shape and type; a constant of few entries stays an array of NumPy."""
    if not isinstance(value, jax.Array):
        value = np.asarray(value, dtype)
        if value.shape == shape:
            return value
        few = not is_symbolic(shape) and math.prod(shape) <= _FEW
        return np.broadcast_to(value, shape) if few else jnp.broadcast_to(value, shape)
    if value.dtype != dtype:
        value = lax.convert_element_type(value, dtype)
    if value.shape == shape:
        return value
    return lax.broadcast_in_dim(value, shape, tuple(range(len(shape) - value.ndim, len(shape))))
