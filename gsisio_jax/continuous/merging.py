"""A function of which equal operations are done once.

Derivatives of derivatives repeat themselves: nested `jax.jvp`s of order k take some ``3^k`` times the operations of the
function, of which only some k^2 differ. Bounds are computed operation by operation, so that is the time they take.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.extend.core as jex
import numpy as np

from gsisio_jax.scalar.unroll import bind, called_jaxpr

_CALLS = ("jit", "pjit", "closed_call", "core_call")
_COMMUTE = ("add", "mul", "max", "min", "add_any")


def merged(function: Callable[..., Any], *example: Any) -> Callable[..., Any]:
    """`function`, traced once for arguments of the shapes of `example` (arrays), without what it does twice or in vain.

    Functions under ``jax.jit`` are dissolved: after differentiation their names would say what they no longer are.
    """
    closed = jax.make_jaxpr(function)(*example)
    program = _Program()
    inputs = [program.new() for _ in closed.jaxpr.invars]
    outputs = program.walk(closed.jaxpr, closed.consts, inputs)
    needed, kept = set(outputs), []
    for equation, operands, results in reversed(program.operations):
        if needed.intersection(results):
            needed.update(operands)
            kept.append((equation, operands, results))

    def run(*args: Any) -> Any:
        values = {**program.constants, **dict(zip(inputs, args, strict=True))}
        for equation, operands, results in reversed(kept):
            values.update(zip(results, bind(equation, [values[v] for v in operands]), strict=True))
        return values[outputs[0]]

    return run


class _Program:
    """Operations as (equation, numbers of its operands, numbers of its results), each once."""

    def __init__(self) -> None:
        self.operations: list[tuple[Any, list[int], list[int]]] = []
        self.constants: dict[int, Any] = {}
        self._found: dict[Any, Any] = {}
        self._made = 0

    def new(self) -> int:
        self._made += 1
        return self._made

    def constant(self, value: Any, dtype: Any) -> int:
        array = np.asarray(value, dtype)
        key = (array.dtype.str, array.shape, array.tobytes())
        if key not in self._found:
            self._found[key] = self.new()
            self.constants[self._found[key]] = array
        return self._found[key]

    def walk(self, jaxpr: Any, consts: Any, args: list[int]) -> list[int]:
        names = dict(zip(jaxpr.invars, args, strict=True))
        for var, value in zip(jaxpr.constvars, consts, strict=True):
            names[var] = self.constant(value, np.result_type(value))

        def read(atom: Any) -> int:
            if not isinstance(atom, jex.Literal):
                return names[atom]
            aval: Any = atom.aval
            return self.constant(atom.val, aval.dtype)

        for equation in jaxpr.eqns:
            operands = [read(atom) for atom in equation.invars]
            name = equation.primitive.name
            if name in _CALLS:
                results = self.walk(*called_jaxpr(equation), operands)
            else:
                results = self._operation(equation, sorted(operands) if name in _COMMUTE else operands)
            names.update(zip(equation.outvars, results, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def _operation(self, equation: Any, operands: list[int]) -> list[int]:
        try:
            key = (equation.primitive, tuple(sorted(equation.params.items())), tuple(operands))
            hash(key)
        except TypeError:  # parameters without a hash or an order: never equal
            key = object()
        if key not in self._found:
            self._found[key] = [self.new() for _ in equation.outvars]
            self.operations.append((equation, operands, self._found[key]))
        return self._found[key]
