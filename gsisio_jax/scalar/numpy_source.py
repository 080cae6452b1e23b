"""A program of NumPy operations as one function of Python, for what runs more than a few times.

Calling a NumPy function on a single number takes fifty times as long as Python's own operator does on a `float`, with
the same result: both are IEEE doubles, rounded to nearest. Looking operations up one by one takes as long again.
So numbers of double precision and truth values are Python's here; all others are NumPy's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from gsisio_jax.scalar.numpy_layout import filled, layout_source, spread


class Operation(NamedTuple):
    """Values at `operands` to those at `results`, of these kinds (anything with `shape` and `dtype`); where it is a
    primitive, its name and parameters: Python may have an expression for it."""

    function: Callable[..., Sequence[Any]]
    operands: list[int]
    results: list[int]
    given: Sequence[Any]
    found: Sequence[Any]
    primitive: tuple[str, Any] | None = None


_NUMBERS = {
    "add": "{0} + {1}", "add_any": "{0} + {1}", "sub": "{0} - {1}", "mul": "{0} * {1}", "div": "{0} / {1}",
    "neg": "-{0}", "abs": "abs({0})", "square": "{0} * {0}", "lt": "{0} < {1}", "le": "{0} <= {1}",
    "gt": "{0} > {1}", "ge": "{0} >= {1}", "eq": "{0} == {1}", "ne": "{0} != {1}", "and": "{0} & {1}",
    "or": "{0} | {1}", "xor": "{0} ^ {1}", "max": "{0} if {0} >= {1} or {0} != {0} else {1}",
    "min": "{0} if {0} <= {1} or {0} != {0} else {1}", "raised": "{1} if {1} > {0} else {0}",
    "cut": "{1} if {1} < {0} else {0}", "scale": "{0} * {1} if {0} != 0 else abs({0})",
    "is_finite": "{0} - {0} == 0", "sqrt": "sqrt({0})",
}  # fmt: skip
_NUMBERS |= {"larger": _NUMBERS["max"], "smaller": _NUMBERS["min"]}
# Python's division and root raise exceptions.
_DOUBLES = {
    "div": "{0} / {1} if {1} else float(divide({0}, {1}))", "sqrt": "root({0}) if {0} >= 0 else nan",
    "times": "p if (p := {0} * {1}) == p else 0.0",
}  # fmt: skip
_ARRAYS = {name: _NUMBERS[name] for name in (
    "add", "add_any", "sub", "mul", "div", "neg", "abs", "lt", "le", "gt", "ge", "eq", "ne", "and", "or", "xor", "sqrt",
)} | {
    "square": "square({0})", "max": "maximum({0}, {1})", "min": "minimum({0}, {1})", "larger": "maximum({0}, {1})",
    "smaller": "minimum({0}, {1})", "raised": "where({1} > {0}, {1}, {0})", "cut": "where({1} < {0}, {1}, {0})",
    "is_finite": "isfinite({0})", "not": "~{0}", "floor": "floor({0})", "ceil": "ceil({0})",
    "scale": "where({0} == 0, {0}.dtype.type(0), {0} * {1})", "nextafter": "nextafter({0}, {1})",
}  # fmt: skip
_DOUBLE_ARRAYS = {"times": "where((p := {0} * {1}) == p, p, 0.0)"}
FLOATING_ONLY = {"div", "sign", "abs", "neg", "sqrt", "square", "floor", "ceil", "is_finite", "scale", "times"}
_WHOLE = {"add", "add_any", "sub", "mul"}  # of truth values Python's are counts
_NAMES: dict[str, Any] = {name: getattr(np, name) for name in (
    "add", "bool_", "concatenate", "array", "ceil", "divide", "floor", "float32", "float64", "int32", "int64",
    "isfinite", "maximum", "minimum", "nextafter", "sqrt", "square", "where",
)}  # fmt: skip
_NAMES |= {"root": math.sqrt, "nan": math.nan, "filled": filled, "spread": spread, "zero_float32": np.float32(0)}


def source(name: str, params: Any, given: Sequence[Any], found: Sequence[Any]) -> str | None:
    """The operation of this name as an expression with the operands' places as {0}, {1}, ...; NaN, zeros and infinities
    as NumPy has them. None if there is none."""
    if len(found) != 1 or not given or not all(isinstance(kind.dtype, np.dtype) for kind in (*given, *found)):
        return None
    first, (out,) = given[0].dtype, found
    if (name in FLOATING_ONLY and first.kind != "f") or (name in _WHOLE and first.kind == "b"):
        return None
    if name == "select_n" and first.kind == "b" and len(given) == 3:
        return "{2} if {0} else {1}" if given[0].shape == () else "where({0}, {2}, {1})"
    if name == "integer_pow" and first.kind == "f" and params["y"] in (2, 3):
        return "{0} * {0}" if params["y"] == 2 else "{0} * ({0} * {0})"
    if out.shape or any(kind.shape for kind in given):
        text = None
        if _spreads(given, out):
            text = _ARRAYS.get(name) if given[0].shape or name != "scale" else None
            text = _DOUBLE_ARRAYS.get(name, text) if first == np.float64 else text
        return text or _as_number(layout_source(name, params, given, out), out)
    if name == "convert_element_type":
        return _converted(first, out.dtype)
    if name == "not":
        return "not {0}" if first.kind == "b" else "~{0}"
    if name == "times" and first == np.float32:
        return "p if (p := {0} * {1}) == p else zero_float32"
    return (_DOUBLES.get(name) if first == np.float64 else None) or _NUMBERS.get(name)


def _spreads(given: Sequence[Any], out: Any) -> bool:
    """Whether NumPy's own spreading of numbers and short axes along arrays gives the result its shape and type."""
    try:
        return np.broadcast_shapes(*(kind.shape for kind in given)) == out.shape and len({k.dtype for k in given}) == 1
    except ValueError:
        return False


def _as_number(text: str | None, out: Any) -> str | None:
    return f"{_PYTHON[out.dtype.name]}({text})" if text and not out.shape and out.dtype.name in _PYTHON else text


_PYTHON = {"float64": "float", "bool": "bool"}
"""What numbers of these types are in the code."""


def _converted(before: np.dtype, after: np.dtype) -> str | None:
    """None where NumPy would complain of what does not fit."""
    if after.kind == "b":
        return "{0} != 0"
    if after.kind == "f" and after.name in ("float32", "float64") and before.kind in "fiub":
        return "float({0})" if after == np.float64 else "float32({0})"
    return f"{after.name}({{0}})" if before.kind == "b" and after.name in ("int32", "int64") else None


def as_code(
    operations: Sequence[Operation], values: Sequence[Any], inputs: Sequence[int], kinds: Sequence[Any],
    outputs: Sequence[int],
) -> Callable[..., Sequence[Any]]:  # fmt: skip
    """The function of the values at `inputs`, of these kinds, to those at `outputs`; `values` are the constants, None
    elsewhere."""
    known: dict[str, Any] = dict(_NAMES)
    for place, value in enumerate(values):
        if isinstance(value, np.ndarray | np.generic):
            known[f"v{place}"] = value if value.shape else _PLAIN.get(value.dtype.name, lambda x: x[()])(value)
        elif value is not None:
            known[f"v{place}"] = value  # random keys stay with JAX
    lines = [f"def program({', '.join(f'v{place}' for place in inputs)}):"]
    lines += [f" v{i} = {name}(v{i})" for i, kind in zip(inputs, kinds, strict=True) if (name := _python(kind))]
    for i, (function, operands, results, given, found, primitive) in enumerate(operations):
        names = [f"v{place}" for place in operands]
        text = source(*primitive, given, found) if primitive else None
        if text:
            lines.append(f" v{results[0]} = {text.format(*names)}")
            continue
        known[f"f{i}"] = function
        # As NumPy's own types, which know how wide they are.
        names = [f"{_NUMPY[wide]}({v})" if (wide := _python(k)) else v for v, k in zip(names, given, strict=True)]
        lines.append(f" {''.join(f'v{place}, ' for place in results)} = f{i}({', '.join(names)})")
        for place, kind in zip(results, found, strict=True):
            if wide := _python(kind):
                lines.append(f" v{place} = {wide}(v{place})")
            elif not kind.shape and isinstance(kind.dtype, np.dtype):
                lines.append(f" v{place} = v{place}[()]")
    lines.append(f" return [{', '.join(f'v{place}' for place in outputs)}]")
    exec(compile("\n".join(lines), "<numpy program>", "exec"), known)
    return known["program"]


_PLAIN: dict[str, Callable[[Any], Any]] = {"float64": float, "bool": bool}
_NUMPY = {"float": "float64", "bool": "bool_"}


def _python(kind: Any) -> str | None:
    """Python's type of values of this kind, None where they are NumPy's."""
    return None if kind.shape or not isinstance(kind.dtype, np.dtype) else _PYTHON.get(kind.dtype.name)
