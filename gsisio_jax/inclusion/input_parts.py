"""Where a function is affine in its known inputs, ``f(x, u) = f(x, 0) + M u``: M, in fractions."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from gsisio_jax.scalar.graph import Graph, Number, is_constant
from gsisio_jax.scalar.unroll import collected, evaluate, numbers_in

Part = dict[int, Fraction]
"""``sum of factors[j] u_j``, without zeros."""

_MOST_NUMBERS = 100_000
_SAME = {"copy", "stop_gradient", "convert_element_type"}


def input_parts(function: Callable[..., Any], n: int, m: int, dtype: Any) -> list[Part] | None:
    """M of ``function(x, u) = function(x, 0) + M u``, row by row, for x (n,) and u (m,) of that type and any function
    of x; None where it is not seen to be of that form: a product of x and u, a bend, an operation that is not known.

    M is exact for the constants that the function has in that type.
    """
    dtype = np.dtype(dtype)
    closed = jax.make_jaxpr(function)(jax.ShapeDtypeStruct((n,), dtype), jax.ShapeDtypeStruct((m,), dtype))
    if numbers_in(closed.jaxpr) > _MOST_NUMBERS or any(isinstance(const, Tracer) for const in closed.consts):
        return None
    graph = Graph()
    x, u = (collected([graph.input(dtype) for _ in range(size)], (size,)) for size in (n, m))
    (out,) = evaluate(graph, closed.jaxpr, closed.consts, [x, u])
    reader = _Reader(x, u, dtype)
    found = [reader.part(value) for value in out]
    return None if any(part is None for part in found) else [part for part in found if part is not None]


class _Reader:
    """The part in u of every number, None where it is not affine in u."""

    def __init__(self, x: np.ndarray, u: np.ndarray, dtype: Any):
        self.least = dtype.itemsize
        self.read: dict[int, Part | None] = {id(number): {} for number in x}
        self.read |= {id(number): {j: Fraction(1)} for j, number in enumerate(u)}

    def part(self, value: Any) -> Part | None:
        if is_constant(value):
            return {}
        stack = [value]
        while stack:
            number = stack[-1]
            waiting = [v for v in number.operands if isinstance(v, Number) and id(v) not in self.read]
            if waiting:
                stack += waiting
            else:
                self.read[id(stack.pop())] = self._one(number)
        return self.read[id(value)]

    def _one(self, number: Number) -> Part | None:
        """Of an operation whose operands are read."""
        operands = [{} if is_constant(v) else self.read[id(v)] for v in number.operands]
        parts = [part for part in operands if part is not None]
        if len(parts) < len(operands):
            return None
        if not any(parts):
            return {}  # of x alone, whatever it is
        # Whole numbers, or a type that is narrower than that of u, would cut it.
        if getattr(number.dtype, "kind", "") != "f" or number.dtype.itemsize < self.least:
            return None
        if number.name in ("add", "sub"):
            return _plus(parts[0], parts[1], 1 if number.name == "add" else -1)
        if number.name == "neg":
            return _times(parts[0], Fraction(-1))
        if number.name in _SAME:
            return parts[0]
        if number.name == "mul":  # with a constant
            part, factor = parts[0] or parts[1], next(filter(is_constant, number.operands), None)
            return None if factor is None or not np.isfinite(factor) else _times(part, Fraction(float(factor)))
        if number.name == "div" and is_constant(number.operands[1]):
            factor = float(number.operands[1])
            return None if factor == 0 or not np.isfinite(factor) else _times(parts[0], 1 / Fraction(factor))
        return None


def _plus(a: Part, b: Part, sign: int) -> Part:
    total = dict(a)
    for j, factor in b.items():
        total[j] = total.get(j, Fraction(0)) + sign * factor
    return {j: factor for j, factor in total.items() if factor}


def _times(part: Part, factor: Fraction) -> Part:
    return {j: factor * v for j, v in part.items()} if factor else {}
