"""Operations that move entries of arrays or reduce them, as expressions of Python.

NumPy's functions for them are written in Python and take some microseconds; methods and indices a tenth of that.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

_LARGE = 10_000  # entries: from here on a copy costs more than finding out that none is needed


def filled(shape: tuple[int, ...], dtype: Any, value: Any) -> np.ndarray:
    """An array of one number."""
    out = np.empty(shape, dtype)
    out.fill(value)
    return out


def spread(x: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """`numpy.broadcast_to`, as a copy."""
    out = np.empty(shape, x.dtype)
    out[...] = x
    return out


def layout_source(name: str, params: Any, given: Sequence[Any], out: Any) -> str | None:
    """The operation with its operands as {0}, {1}, ...; None if there is no expression for it."""
    x, shape = given[0], _plain(out.shape)
    if name in ("reshape", "expand_dims", "broadcast_in_dim") and not x.shape:
        return f"filled({shape}, {x.dtype.name}, {{0}})" if x.dtype.name in _TYPES else None
    if name in ("reshape", "squeeze", "expand_dims"):
        if not shape:
            return f"{{0}}[{', '.join('0' for _ in x.shape)}]"
        if name != "squeeze":
            return f"{{0}}.reshape({shape})"
        return _index("0" if i in params["dimensions"] else ":" for i in range(len(x.shape)))
    if name == "broadcast_in_dim":
        wide = [1] * len(shape)
        for axis, size in zip(params["broadcast_dimensions"], x.shape, strict=True):
            wide[axis] = size
        if math.prod(shape) == math.prod(x.shape):
            return f"{{0}}.reshape({shape})"
        return f"spread({{0}}.reshape({_plain(wide)}), {shape})" if math.prod(shape) < _LARGE else None
    if name == "slice":
        strides = params["strides"] or (1,) * len(x.shape)
        ends = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
        return _index(f"{start}:{stop}:{stride}" if stride != 1 else f"{start}:{stop}" for start, stop, stride in ends)
    if name == "rev":
        return _index("::-1" if i in params["dimensions"] else ":" for i in range(len(x.shape)))
    if name == "transpose":
        return f"{{0}}.transpose({_plain(params['permutation'])})"
    if name == "concatenate":
        return f"concatenate(({_all(given)}), {params['dimension']})"
    if name == "stack" and x.dtype.name in _TYPES:
        if not x.shape:
            return f"array([{_all(given)}], {x.dtype.name})"
        return f"concatenate(({_all(given)})).reshape({shape})" if params["axis"] == 0 else None
    if name == "convert_element_type" and params["new_dtype"].name in _TYPES:
        return f"{{0}}.astype({_TYPES[params['new_dtype'].name]})"
    if name == "dynamic_slice" and params["slice_sizes"]:
        # As XLA does: a slice that would leave the array begins earlier.
        sizes = enumerate(zip(x.shape, _plain(params["slice_sizes"]), strict=True))
        starts = ((f"(i{k} := min(max(int({{{k + 1}}}), 0), {all_ - size}))", k, size) for k, (all_, size) in sizes)
        return _index(f"{first}:i{k} + {size}" for first, k, size in starts)
    if name in _REDUCED and x.dtype.name in _TYPES and all(x.shape[axis] for axis in params["axes"]):
        return _reduced(name, x.dtype, _plain(params["axes"]))
    return _product(params, x, given[1], out) if name == "dot_general" else None


_TYPES = {"float64": "float64", "float32": "float32", "int32": "int32", "int64": "int64", "bool": "bool_"}


_REDUCED = {"reduce_sum": "add", "reduce_max": "maximum", "reduce_min": "minimum", "reduce_and": "", "reduce_or": ""}


def _reduced(name: str, dtype: Any, axes: tuple[int, ...]) -> str | None:
    """Of no entries, and of the bits of whole numbers: as NumPy's functions have it."""
    if name in ("reduce_and", "reduce_or"):
        return f"{{0}}.{'all' if name == 'reduce_and' else 'any'}({axes})" if dtype.kind == "b" else None
    wide = f", {dtype.name}" if name == "reduce_sum" and dtype.kind == "i" else ""
    return f"{_REDUCED[name]}.reduce({{0}}, {axes}{wide})" if dtype.kind in "fi" else None


def _plain(sizes: Any) -> tuple[int, ...]:
    """As Python writes them."""
    return tuple(map(int, sizes))


def _index(parts: Any) -> str:
    return f"{{0}}[{', '.join(parts)}]"


def _all(given: Sequence[Any]) -> str:
    return "".join(f"{{{i}}}, " for i in range(len(given)))


def _product(params: Any, a: Any, b: Any, out: Any) -> str | None:
    """The last axis of a with one of b."""
    (over_a, over_b), (batch, _) = params["dimension_numbers"]
    ranks = len(a.shape), len(b.shape)
    if (
        batch
        or not a.dtype == b.dtype == out.dtype
        or tuple(over_a) != (ranks[0] - 1,)
        or len(over_b) != 1
        or max(ranks) > 2
    ):
        return None
    return "{0} @ {1}" if tuple(over_b) == (0,) else "{0} @ {1}.T"
