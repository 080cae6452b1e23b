"""From a jaxpr over arrays to numbers: an array becomes a NumPy array of objects, numbers and constants."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.extend.core as jex
import jax.numpy as jnp
import numpy as np

from gsisio_jax.interval import devices
from gsisio_jax.interval.devices import agreeing
from gsisio_jax.scalar.graph import Graph, Number, is_constant

_CALLS = {"jit", "pjit", "closed_call", "core_call", "remat", "remat2", "checkpoint"}
_ELEMENTWISE = {
    "add", "sub", "mul", "div", "neg", "abs", "max", "min", "sign", "floor", "ceil", "round", "sqrt", "rsqrt", "cbrt",
    "square", "pow", "integer_pow", "exp", "exp2", "log", "log1p", "expm1", "sin", "cos", "tan", "asin", "acos", "atan",
    "atan2", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "logistic", "erf", "erfc", "erf_inv", "lgamma",
    "digamma", "rem", "lt", "le", "gt", "ge", "eq", "ne", "and", "or", "not", "xor", "select_n", "clamp", "is_finite",
    "nextafter", "bitcast_convert_type", "convert_element_type", "copy", "stop_gradient",
    "scale", "times", "smaller", "larger", "raised", "cut", "fusion_barrier", "wave", "falling_wave",
}  # fmt: skip
_REDUCTIONS = {
    "reduce_sum": ("add", 0), "reduce_prod": ("mul", 1), "reduce_max": ("max", -np.inf), "reduce_min": ("min", np.inf),
    "reduce_and": ("and", True), "reduce_or": ("or", False),
}  # fmt: skip


def plain_dtype(dtype: Any) -> Any:
    """A NumPy type; that of random keys is none, and stays what it is."""
    return dtype if jnp.issubdtype(dtype, jax.dtypes.extended) else np.dtype(dtype)


def typed(value: Any, dtype: Any) -> Any:
    """A traced value or a constant, as an array of that type."""
    return (
        value if getattr(value, "dtype", None) == dtype and isinstance(value, jax.Array) else jnp.asarray(value, dtype)
    )


def constants(value: Any) -> np.ndarray:
    """An array of constants."""
    value = np.asarray(value)
    return collected(value.ravel(), value.shape)


def collected(values: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Numbers and constants as an array of objects."""
    out = np.empty(math.prod(shape), object)
    for i, value in enumerate(values):
        out[i] = value
    return out.reshape(shape)


def is_array_of_numbers(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.dtype == object


def known(array: np.ndarray, dtype: Any) -> np.ndarray | None:
    """The values of an array of constants, None where an entry is a number of the program."""
    values = list(array.ravel())
    return np.array(values, dtype).reshape(array.shape) if all(map(is_constant, values)) else None


def evaluate(graph: Graph, jaxpr: Any, consts: Sequence[Any], args: Sequence[Any], scope: str = "") -> list[Any]:
    """Arrays of numbers that a jaxpr returns for arrays of numbers."""
    fixed = [const if is_array_of_numbers(const) else constants(const) for const in consts]
    values: dict[Any, Any] = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*fixed, *args], strict=True))

    def read(atom: Any) -> Any:
        if not isinstance(atom, jex.Literal):
            return values[atom]
        aval: Any = atom.aval
        return constants(np.asarray(atom.val, aval.dtype))

    names, stage = None, scope
    for eqn in jaxpr.eqns:
        if eqn.source_info.name_stack is not names:
            names = eqn.source_info.name_stack
            stage = f"{scope}/{names}".strip("/")
        values.update(zip(eqn.outvars, applied(graph, eqn, [read(atom) for atom in eqn.invars], stage), strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def applied(graph: Graph, eqn: Any, args: list[Any], stage: str) -> Sequence[Any]:
    """Results of one equation for arrays of numbers."""
    name = eqn.primitive.name
    if name in _CALLS:
        return evaluate(graph, *called_jaxpr(eqn), args, stage)
    if name == "pvary":  # a number is the same wherever it is known: `devices.agreeing` says where
        return args
    graph.stage = stage
    if name in _MOVES:
        return _MOVES[name](eqn, *args)
    if name in _REDUCTIONS:
        operation, empty = _REDUCTIONS[name]
        return [_reduced(graph, eqn, operation, empty, args[0])]
    if name == "dot_general":
        return [_dot(graph, eqn, args[0], args[1])]
    if name in _ELEMENTWISE:
        return [_entries(graph, eqn, args)]
    fixed = [known(arg, atom.aval.dtype) for arg, atom in zip(args, eqn.invars, strict=True)]
    if all(value is not None for value in fixed):
        return [constants(value) for value in _of_constants(eqn, fixed)]
    return _parts(graph, eqn, args)


def bind(eqn: Any, args: Sequence[Any]) -> Sequence[Any]:
    """Results of an equation on arrays."""
    if "custom" not in eqn.primitive.name:
        out = eqn.primitive.bind(*agreeing(args), **eqn.params)
        return out if eqn.primitive.multiple_results else [out]
    # Functions with a derivative of their own: as a jaxpr of this equation alone, whatever its parameters are.
    given = dict(zip(map(id, eqn.invars), args, strict=True))
    first = {id(atom): atom for atom in eqn.invars if not isinstance(atom, jex.Literal)}
    names, results = ("",) * len(first), ("",) * len(eqn.outvars)
    info = called_jaxpr(eqn)[0].debug_info._replace(arg_names=names, result_paths=results)
    alone = jex.Jaxpr((), list(first.values()), eqn.outvars, [eqn], eqn.effects, info)
    return jex.jaxpr_as_fun(jex.ClosedJaxpr(alone, ()))(*(given[key] for key in first))


def _of_constants(eqn: Any, args: Sequence[Any]) -> Sequence[Any]:
    """Results of an equation on constants, in NumPy: JAX would compile each of its operations."""
    from gsisio_jax.scalar.numpy_program import numpy_function  # which needs this module

    return numpy_function(lambda *given: bind(eqn, given), *args)(*args)


def called_jaxpr(eqn: Any) -> tuple[Any, Sequence[Any]]:
    """The jaxpr that a call runs, and its constants; its parameter's name moves between primitives and JAX versions.

    Raises:
        LookupError: the equation has none of these parameters.
    """
    for key in ("jaxpr", "call_jaxpr", "fun_jaxpr"):
        if key in eqn.params:
            inner = eqn.params[key]
            return (inner.jaxpr, inner.consts) if isinstance(inner, jex.ClosedJaxpr) else (inner, ())
    raise LookupError(f"{eqn.primitive.name} has no body")


def _parts(graph: Graph, eqn: Any, args: Sequence[Any]) -> list[Any]:
    """An operation that has no counterpart on numbers (a loop, say): it stays one on arrays."""
    flat = tuple(value for arg in args for value in arg.ravel())
    whole = graph.make("array", flat, None, ArrayOperation(eqn, [arg.shape for arg in args]), id(eqn))
    out, start = [], 0
    for atom in eqn.outvars:
        shape, dtype = atom.aval.shape, plain_dtype(atom.aval.dtype)
        size = math.prod(shape)
        entries = [graph.make("part", (whole,), dtype, None, start + i) for i in range(size)]
        for i, entry in enumerate(entries):
            entry.equation = start + i
        out.append(collected(entries, shape))
        start += size
    return out


class ArrayOperation:
    """An equation over arrays, fed with numbers."""

    def __init__(self, eqn: Any, shapes: list[tuple[int, ...]]):
        self.eqn, self.shapes = eqn, shapes

    def __call__(self, flat: Sequence[Any]) -> list[Any]:
        """Entries of all results, from the entries of all arguments."""
        args, start = [], 0
        for shape, atom in zip(self.shapes, self.eqn.invars, strict=True):
            size = math.prod(shape)
            args.append(_stacked(flat[start : start + size], shape, atom.aval.dtype))
            start += size
        return [entry for out in bind(self.eqn, args) for entry in jnp.ravel(out)]


def _stacked(entries: Sequence[Any], shape: tuple[int, ...], dtype: Any) -> Any:
    """An array of the entries. A table of constants is one constant: stacked entry by entry it would take XLA longer
    than the whole step around it."""
    if shape and not any(isinstance(entry, jax.Array) for entry in entries):
        return jnp.asarray(np.array(list(entries), dtype).reshape(shape))
    numbers = [typed(value, dtype) for value in entries]
    return devices.stack(numbers).reshape(shape) if shape else numbers[0]


def _entries(graph: Graph, eqn: Any, args: list[Any]) -> np.ndarray:
    name, params, out = eqn.primitive.name, eqn.params, eqn.outvars[0].aval
    dtype, shape = plain_dtype(out.dtype), out.shape
    plain = name in ("convert_element_type", "copy", "stop_gradient") or not params
    key = None if plain else repr(sorted(params.items(), key=str))
    columns = [(arg if arg.shape == shape else np.broadcast_to(arg, shape)).ravel() for arg in args]
    found = []
    for operands in zip(*columns, strict=True):
        if name == "convert_element_type" and operands[0].dtype == dtype:
            found.append(operands[0])
            continue
        value = graph.apply(name, *operands, dtype=dtype, equation=eqn, key=key)
        if isinstance(value, Number) and value.name == name and all(map(is_constant, value.operands)):
            value = _of_constants(eqn, [np.asarray(v) for v in operands])[0][()]  # a library function
        found.append(value)
    return collected(found, shape)


def _reduced(graph: Graph, eqn: Any, name: str, empty: Any, x: np.ndarray) -> np.ndarray:
    axes, dtype = tuple(eqn.params["axes"]), plain_dtype(eqn.outvars[0].aval.dtype)
    keep = [i for i in range(x.ndim) if i not in axes]
    shape = tuple(x.shape[i] for i in keep)
    rows = np.transpose(x, (*keep, *axes)).reshape(math.prod(shape), math.prod(x.shape[i] for i in axes))
    return collected([graph.fold(name, row, dtype, empty) for row in rows], shape)


def _dot(graph: Graph, eqn: Any, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Terms with a constant 0 are left out: gains meet finite numbers in a matrix product."""
    (over_a, over_b), (batch_a, batch_b) = eqn.params["dimension_numbers"]
    out = eqn.outvars[0].aval
    dtype = plain_dtype(out.dtype)

    def rows(x: np.ndarray, over: Sequence[int], batch: Sequence[int]) -> np.ndarray:
        free = [i for i in range(x.ndim) if i not in (*over, *batch)]
        sizes = [math.prod(x.shape[i] for i in axes) for axes in (batch, free, over)]
        return np.transpose(x, (*batch, *free, *over)).reshape(sizes)

    left, right = rows(a, over_a, batch_a), rows(b, over_b, batch_b)
    found = []
    for i in range(len(left)):
        for x in left[i]:
            for y in right[i]:
                pairs = [(s, t) for s, t in zip(x, y, strict=True) if not (_zero(s) or _zero(t))]
                found.append(graph.fold("add", [graph.apply("mul", s, t, dtype=dtype) for s, t in pairs], dtype, 0))
    return collected(found, out.shape)


def _zero(value: Any) -> bool:
    return is_constant(value) and bool(value == 0)


def _broadcast(eqn: Any, x: np.ndarray, *_: Any) -> list[np.ndarray]:
    shape = eqn.params["shape"]
    wide = [1] * len(shape)
    for axis, size in zip(eqn.params["broadcast_dimensions"], x.shape, strict=True):
        wide[axis] = size
    return [np.broadcast_to(x.reshape(wide), shape)]


def _slice(eqn: Any, x: np.ndarray) -> list[np.ndarray]:
    start, stop = eqn.params["start_indices"], eqn.params["limit_indices"]
    strides = eqn.params["strides"] or (1,) * x.ndim
    return [x[tuple(map(slice, start, stop, strides))]]


def _iota(eqn: Any, *_: Any) -> list[np.ndarray]:
    shape, axis = eqn.params["shape"], eqn.params["dimension"]
    along = np.arange(shape[axis]).astype(eqn.params["dtype"])
    return [constants(np.broadcast_to(along.reshape([-1 if i == axis else 1 for i in range(len(shape))]), shape))]


def _reshaped(eqn: Any, x: np.ndarray, *_: Any) -> list[np.ndarray]:
    return [x.reshape(eqn.outvars[0].aval.shape)]


_MOVES: dict[str, Callable[..., Sequence[Any]]] = {
    "broadcast_in_dim": _broadcast, "slice": _slice, "iota": _iota,
    **dict.fromkeys(("reshape", "squeeze", "expand_dims"), _reshaped),
    "transpose": lambda eqn, x: [np.transpose(x, eqn.params["permutation"])],
    "concatenate": lambda eqn, *x: [np.concatenate(x, axis=eqn.params["dimension"])],
    "stack": lambda eqn, *x: [np.stack(x, axis=eqn.params["axis"])],
    "unstack": lambda eqn, x: [np.take(x, i, axis=eqn.params["axis"]) for i in range(x.shape[eqn.params["axis"]])],
    "rev": lambda eqn, x: [np.flip(x, eqn.params["dimensions"])],
    "split": lambda eqn, x: np.split(x, np.cumsum(eqn.params["sizes"])[:-1], axis=eqn.params["axis"]),
}  # fmt: skip


def numbers_in(jaxpr: Any) -> int:
    """Entries of everything that a jaxpr computes; loops count once."""
    total = 0
    for eqn in jaxpr.eqns:
        inner = [v for v in eqn.params.values() if hasattr(v, "jaxpr") or hasattr(v, "eqns")]
        if inner:
            total += sum(numbers_in(getattr(v, "jaxpr", v)) for v in inner)
        else:
            total += sum(math.prod(v.aval.shape) for v in eqn.outvars)
    return total
