"""Constant indices that lie outside of what they index, where JAX would clamp, fill or drop without a word."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import jax.extend.core as jex
import numpy as np
from jax.lax import GatherScatterMode

_CALLS = ("jit", "pjit", "closed_call", "custom_jvp_call", "custom_vjp_call", "checkpoint", "remat2")
_MOST = 1_000_000  # entries of a constant that is followed


@dataclass(frozen=True)
class Known:
    """A constant that may be an index: its value, and as it was written (before the size was added to -1)."""

    value: np.ndarray
    written: np.ndarray


Beyond = tuple[int, tuple[int, ...]]
"""The index as it was written, and the shape of what it indexes."""


def beyond(closed: Any) -> Beyond | None:
    """The first constant index beyond the end of an array; None where there is none.

    JAX makes a plain slice of a constant index that is inside, and of others a `dynamic_slice` that clamps; of arrays
    of indices a gather or a scatter. Where f asks for clamping or for a value to fill in, it has what it asked for.
    """
    return _walk(closed.jaxpr, closed.consts, [None] * len(closed.jaxpr.invars))[0]


def _walk(jaxpr: Any, consts: Any, given: list[Known | None]) -> tuple[Beyond | None, list[Known | None]]:
    """What lies beyond in a jaxpr, and what is known of its results."""
    known: dict[Any, Known | None] = dict(zip(jaxpr.invars, given, strict=True))
    known |= {var: _constant(value) for var, value in zip(jaxpr.constvars, consts, strict=True)}

    def read(atom: Any) -> Known | None:
        return _constant(atom.val) if isinstance(atom, jex.Literal) else known.get(atom)

    for eqn in jaxpr.eqns:
        name, operands = eqn.primitive.name, [read(atom) for atom in eqn.invars]
        found = _outside(eqn, operands)
        results: list[Known | None] = []
        for inner in _inner(eqn):
            body, values = getattr(inner, "jaxpr", inner), getattr(inner, "consts", ())
            passed = name in _CALLS and len(body.invars) == len(operands)
            inside, results = _walk(body, values, operands if passed else [None] * len(body.invars))
            found, results = found or inside, results if passed else []
        if found:
            return found, []
        if name in _FOLDED and operands and all(operand is not None for operand in operands):
            results = [_FOLDED[name](eqn.params, *operands)]
        known |= zip(eqn.outvars, results, strict=False)
    return None, [read(atom) for atom in jaxpr.outvars]


def _inner(eqn: Any) -> list[Any]:
    parts = [part for v in eqn.params.values() for part in (v if isinstance(v, tuple | list) else (v,))]
    return [part for part in parts if hasattr(part, "eqns")]  # jaxprs, closed or open


def _constant(value: Any) -> Known | None:
    try:
        array = np.asarray(value)
    except Exception:  # a traced number, a key: not to be judged here
        return None
    return Known(array, array) if array.dtype.kind in "iub" and array.size <= _MOST else None


def _outside(eqn: Any, operands: list[Known | None]) -> Beyond | None:
    name, params = eqn.primitive.name, eqn.params
    shape = eqn.invars[0].aval.shape if eqn.invars else ()
    if name == "dynamic_slice":
        for size, taken, start in zip(shape, params["slice_sizes"], operands[1:], strict=True):
            if start is not None and (index := _first(start.value, start.written, size - taken)) is not None:
                return index, shape
    elif name == "gather" and operands[1] is not None and not _asked_for(params):
        numbers = params["dimension_numbers"]
        return _in_columns(operands[1], numbers.start_index_map, shape, params["slice_sizes"])
    elif name.startswith("scatter") and operands[1] is not None and params["mode"] != GatherScatterMode.CLIP:
        numbers = params["dimension_numbers"]
        return _in_columns(operands[1], numbers.scatter_dims_to_operand_dims, shape, (1,) * len(shape))
    return None


def _asked_for(params: Any) -> bool:
    """Does a gather clamp, or fill with a value, because f says so? (`vmap` makes clamping ones of plain indices.)"""
    if params["mode"] == GatherScatterMode.CLIP:
        return bool(params["dimension_numbers"].collapsed_slice_dims)
    fill = params["fill_value"]
    return fill is not None and not (isinstance(fill, float | np.floating) and math.isnan(fill))


def _in_columns(indices: Known, axes: Any, shape: Any, taken: Any) -> Beyond | None:
    for column, axis in enumerate(axes):
        index = _first(indices.value[..., column], indices.written[..., column], shape[axis] - taken[axis])
        if index is not None:
            return index, shape
    return None


def _first(value: np.ndarray, written: np.ndarray, last: int) -> int | None:
    wrong = (value < 0) | (value > last)
    return int(written[wrong].flat[0]) if wrong.any() else None


def _selected(params: Any, which: Known, *cases: Known) -> Known:
    chosen = np.choose(which.value.astype(int), [case.value for case in cases])
    return Known(chosen, np.broadcast_to(cases[0].written, chosen.shape))


def _broadcast(params: Any, operand: Known) -> Known:
    shape, axes = params["shape"], params["broadcast_dimensions"]
    aligned = [1] * len(shape)
    for axis, size in zip(axes, operand.value.shape, strict=True):
        aligned[axis] = size
    return Known(*(np.broadcast_to(v.reshape(aligned), shape) for v in (operand.value, operand.written)))


def _plain(value: np.ndarray) -> Known:
    return Known(value, value)


_FOLDED = {
    "lt": lambda params, a, b: _plain(np.asarray(a.value < b.value)),
    "add": lambda params, a, b: _plain(np.asarray(a.value + b.value)),
    "select_n": _selected,
    "convert_element_type": lambda params, a: a,
    "broadcast_in_dim": _broadcast,
    "reshape": lambda params, a: Known(a.value.reshape(params["new_sizes"]), a.written.reshape(params["new_sizes"])),
    "concatenate": lambda params, *parts: Known(
        *(np.concatenate([getattr(p, side) for p in parts], params["dimension"]) for side in ("value", "written"))
    ),
}
