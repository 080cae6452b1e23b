"""A JAX function as a program of NumPy operations: for what runs a few times only, compiling takes all of the time.

Operations that are not written here are given to JAX one at a time. So are transcendental functions: bounds stand on
the accuracy of the library that the observer runs on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.extend.core as jex
import numpy as np

from gsisio_jax._collector import rare_collection
from gsisio_jax.scalar.primitive import written
from gsisio_jax.scalar.unroll import called_jaxpr

_CALLS = {
    "jit", "pjit", "closed_call", "core_call", "remat", "remat2", "checkpoint", "custom_jvp_call", "custom_vjp_call",
    "custom_vjp_call_jaxpr",
}  # fmt: skip
_MOST_TURNS = 128  # of a loop: a longer one is worth compiling


@rare_collection()
def numpy_function(function: Callable[..., Any], *example: Any) -> Callable[..., Any]:
    """`function` of pytrees of arrays, traced once for the shapes and types of `example`.

    What depends on constants alone is computed once. Arithmetic is IEEE (nothing is flushed or contracted); a sum or a
    matrix product may be taken in any order.
    """
    closed, shape = jax.make_jaxpr(function, return_shape=True)(*example)
    program, structure = _flat(closed), jax.tree.structure(shape)
    return lambda *args: jax.tree.unflatten(structure, program(*jax.tree.leaves(args)))


def _flat(closed: Any) -> Callable[..., list[Any]]:
    """The program of a jaxpr: its arguments to its results, arrays all."""
    program = _Program()
    inputs = [program.place() for _ in closed.jaxpr.invars]
    with np.errstate(all="ignore"):
        outputs = program.add(closed.jaxpr, closed.consts, inputs)
    program.drop_unused(outputs)
    given, found = ([v.aval.dtype for v in group] for group in (closed.jaxpr.invars, closed.jaxpr.outvars))

    def run(*args: Any) -> list[Any]:
        values = list(program.values)
        for place, leaf, dtype in zip(inputs, args, given, strict=True):
            values[place] = np.asarray(leaf, dtype)
        with np.errstate(all="ignore"):
            for operation, operands, places in program.operations:
                for place, value in zip(places, operation(*(values[i] for i in operands)), strict=True):
                    values[place] = value
        return [np.asarray(values[i], dtype) for i, dtype in zip(outputs, found, strict=True)]

    return run


class _Program:
    """Values by their places, None where they are not known yet, and the operations that compute these, in order."""

    def __init__(self) -> None:
        self.values: list[Any] = []
        self.operations: list[tuple[Callable[..., Sequence[Any]], list[int], list[int]]] = []

    def place(self, value: Any = None) -> int:
        self.values.append(value)
        return len(self.values) - 1

    def add(self, jaxpr: Any, consts: Sequence[Any], inputs: list[int]) -> list[int]:
        """Append the operations of a jaxpr; places of its results."""
        fixed = [self.place(np.asarray(const)) for const in consts]
        places: dict[Any, int] = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*fixed, *inputs], strict=True))

        def of(atom: Any) -> int:
            if not isinstance(atom, jex.Literal):
                return places[atom]
            kind: Any = atom.aval
            return self.place(np.asarray(atom.val, kind.dtype))

        for eqn in jaxpr.eqns:
            operands = [of(atom) for atom in eqn.invars]
            if (function := written(eqn)) is not None:
                body = jax.make_jaxpr(function)(*(atom.aval for atom in eqn.invars))
                found = self.add(body.jaxpr, body.consts, operands)
            elif eqn.primitive.name in _CALLS:
                found = self.add(*called_jaxpr(eqn), operands)
            else:
                found = self._append(_operation(eqn), operands, len(eqn.outvars))
            places.update(zip(eqn.outvars, found, strict=True))
        return [of(atom) for atom in jaxpr.outvars]

    def drop_unused(self, outputs: Sequence[int]) -> None:
        """Leave operations out whose results nothing needs."""
        needed, kept = set(outputs), []
        for operation in reversed(self.operations):
            if not needed.isdisjoint(operation[2]):
                needed.update(operation[1])
                kept.append(operation)
        self.operations = kept[::-1]

    def _append(self, operation: Callable[..., Sequence[Any]], operands: list[int], count: int) -> list[int]:
        known = [self.values[i] for i in operands]
        if all(value is not None for value in known):
            return [self.place(value) for value in operation(*known)]
        found = [self.place() for _ in range(count)]
        self.operations.append((operation, operands, found))
        return found


def _operation(eqn: Any) -> Callable[..., Sequence[Any]]:
    """The operation of an equation: values of its arguments to those of its results."""
    name, params = eqn.primitive.name, eqn.params
    floating = np.issubdtype(eqn.invars[0].aval.dtype, np.floating) if eqn.invars else False
    if name in _ELEMENTWISE and (floating or name not in _FLOATING_ONLY):
        plain = _ELEMENTWISE[name]
        return lambda *args: (plain(*args),)
    if name in _ARRAYS:
        rule = _ARRAYS[name]
        return lambda *args: (rule(params, *args),)
    if name == "round" and int(params["rounding_method"]) == 1:  # to nearest, ties to even
        return lambda x: (np.rint(x),)
    if name == "split":
        ends = np.cumsum(params["sizes"])[:-1]
        return lambda x: np.split(x, ends, axis=params["axis"])
    if name == "scan" and params["length"] <= _MOST_TURNS:
        return _scan(eqn)

    def bound(*args: Any) -> Sequence[Any]:
        with jax.ensure_compile_time_eval():
            out = eqn.primitive.bind(*map(np.asarray, args), **params)
        return [np.asarray(value) for value in (out if eqn.primitive.multiple_results else [out])]

    return bound


def _scan(eqn: Any) -> Callable[..., Sequence[Any]]:
    """Turn by turn: compiled it would be one large program."""
    params = eqn.params
    turn, length = _flat(params["jaxpr"]), params["length"]
    first, kept = params["num_consts"], params["num_carry"]
    order = range(length)[::-1] if params["reverse"] else range(length)

    def run(*args: Any) -> Sequence[Any]:
        fixed, carry, rows = args[:first], args[first : first + kept], args[first + kept :]
        stacked = [np.zeros(v.aval.shape, v.aval.dtype) for v in eqn.outvars[kept:]]
        for i in order:
            found = turn(*fixed, *carry, *(row[i] for row in rows))
            carry = found[:kept]
            for column, value in zip(stacked, found[kept:], strict=True):
                column[i] = value
        return [*carry, *stacked]

    return run


def _scale(factor: Any, value: Any) -> Any:
    return np.where(factor == 0, factor.dtype.type(0), factor * value)


def _times(a: Any, b: Any) -> Any:
    product = a * b
    return np.where(np.isnan(product), product.dtype.type(0), product)


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
    "bitcast_convert_type": lambda params, x: np.asarray(x).view(params["new_dtype"]),
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
