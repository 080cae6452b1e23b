"""A scalar program: the numbers that its results need, in order, and how to trace them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from functools import reduce
from itertools import groupby
from operator import or_
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from gsisio_jax.interval import devices, minmax, primitives
from gsisio_jax.interval.primitives import fusion_barrier
from gsisio_jax.scalar.graph import Graph, Number, is_constant
from gsisio_jax.scalar.options import repeated
from gsisio_jax.scalar.unroll import collected, constants, evaluate, typed

# XLA counts these as expensive, and repeats none of them; nor what stays an operation on arrays.
_ONCE = {
    "div", "sqrt", "rsqrt", "exp", "log", "log1p", "expm1", "pow", "tan", "tanh", "sin", "cos", "atan2", "cbrt", "erf",
    "logistic", "array", "part",
}  # fmt: skip
_FREE = ("part", "stop_gradient", "wave", "falling_wave")  # of these nothing is left in the compiled program
# Simplification makes numbers that stand in no equation: those have no parameters.
_PLAIN = {
    "add": lax.add, "sub": lax.sub, "mul": lax.mul, "div": lax.div, "neg": lax.neg, "abs": lax.abs, "max": lax.max,
    "min": lax.min, "eq": lax.eq, "select_n": lax.select_n, "and": lax.bitwise_and, "or": lax.bitwise_or,
    "not": lax.bitwise_not, "sign": lax.sign, "stop_gradient": lax.stop_gradient,
    "scale": primitives.scale.primitive.bind, "times": primitives.times.primitive.bind,
    "smaller": minmax.smaller.primitive.bind, "larger": minmax.larger.primitive.bind,
    "raised": minmax.raised.primitive.bind, "cut": minmax.cut.primitive.bind,
}  # fmt: skip


class ScalarProgram:
    """A function of single numbers.

    Attributes:
        graph: of all numbers; a derivative adds to it.
        inputs: entries of all arguments, array by array.
        outputs: entries of all results, numbers and constants.
        operations: the numbers that the results need, in order.
        types: of the outputs.
        results: shapes and types of the arrays that the function over arrays returned.
    """

    def __init__(self, graph: Graph, inputs: list[np.ndarray], outputs: list[np.ndarray], dtypes: Sequence[Any]):
        self.graph = graph
        self.inputs = [value for array in inputs for value in array.ravel()]
        self.outputs = [value for array in outputs for value in array.ravel()]
        self.results = [jax.ShapeDtypeStruct(a.shape, dtype) for a, dtype in zip(outputs, dtypes, strict=True)]
        self.types = [dtype for array, dtype in zip(outputs, dtypes, strict=True) for _ in range(array.size)]
        self.operations = _needed(self.outputs)
        self._derived: dict[Any, ScalarProgram] = {}

    def __call__(self, args: Sequence[Any]) -> list[Any]:
        """Trace on 0-d values: entries of all results from entries of all arguments, array by array."""
        values: dict[int, Any] = {id(number): arg for number, arg in zip(self.inputs, args, strict=True)}

        def read(value: Any) -> Any:
            return values[id(value)] if isinstance(value, Number) else value

        fenced = self._fenced()
        axes = devices.union(args)  # of a mesh: constants, too, are to vary along them
        for stage, numbers in groupby(self.operations, stage_of):
            with jax.named_scope(stage):
                for number in numbers:
                    operands = [read(value) for value in number.operands]
                    if axes and number.name != "part":
                        operands = devices.cast(operands, axes)
                    value = bound(number, operands)
                    values[id(number)] = fusion_barrier(value) if id(number) in fenced else value
        return [typed(read(v), dtype) for v, dtype in zip(self.outputs, self.types, strict=True)]

    def derived(self, key: Any, make: Callable[[], ScalarProgram]) -> ScalarProgram:
        """A program that is made from this one, once."""
        if key not in self._derived:
            self._derived[key] = make()
        return self._derived[key]

    def sources(self) -> list[int]:
        """The inputs that each result depends on, as bits."""
        bits = {id(number): 1 << i for i, number in enumerate(self.inputs)}
        for number in self.operations:
            bits[id(number)] = reduce(or_, (bits.get(id(v), 0) for v in number.operands), 0)
        return [bits.get(id(value), 0) for value in self.outputs]

    def _fenced(self) -> set[int]:
        """Numbers to be computed once, so that no consumer of a number repeats more than `_REPEATED` operations."""
        uses: Counter[int] = Counter(id(v) for number in self.operations for v in number.operands)
        uses.update(id(v) for v in self.outputs)
        most = repeated()
        weight: dict[int, int] = {}
        fenced = set()
        for number in self.operations:
            own = number.name not in _FREE
            total = own + sum(weight.get(id(v), 0) for v in number.operands)
            if number.name in _ONCE or not jnp.issubdtype(number.dtype or np.bool_, jnp.floating):
                total = 0 if number.name in _ONCE else total
            elif uses[id(number)] > 1 and total >= most and own:
                fenced.add(id(number))
                total = 0
            weight[id(number)] = total
        return fenced

    def count(self, stages: bool = False) -> Counter[str]:
        """Operations by primitive, or by the outermost `jax.named_scope`."""
        real = [v for v in self.operations if v.name not in _FREE]
        return Counter(stage_of(v) if stages else v.name for v in real)


def stage_of(number: Number) -> str:
    """The outermost `jax.named_scope` that a number was first needed in; "other" outside of all."""
    return number.stage.split("/")[0] or "other"


def scalar_program(closed: Any, moving: Sequence[bool] = ()) -> ScalarProgram:
    """The program of a closed jaxpr over arrays; `moving` marks constants that are arguments, too."""
    graph = Graph()

    def arguments(variables: Sequence[Any]) -> list[np.ndarray]:
        return [
            collected([graph.input(v.aval.dtype) for _ in range(math.prod(v.aval.shape))], v.aval.shape)
            for v in variables
        ]

    marks = list(moving) or [False] * len(closed.consts)
    given = arguments([v for v, moves in zip(closed.jaxpr.constvars, marks, strict=True) if moves])
    rest = iter(given)
    consts = [next(rest) if moves else constants(c) for c, moves in zip(closed.consts, marks, strict=True)]
    inputs = arguments(closed.jaxpr.invars)
    outputs = evaluate(graph, closed.jaxpr, consts, inputs)
    dtypes = [v.aval.dtype for v in closed.jaxpr.outvars]
    return ScalarProgram(graph, [*given, *inputs], outputs, dtypes)


def _needed(outputs: Sequence[Any]) -> list[Number]:
    """All numbers behind the results, operands first."""
    seen: set[int] = set()
    order: list[Number] = []
    stack = [(value, False) for value in outputs if not is_constant(value)]
    while stack:
        number, ready = stack.pop()
        if ready:
            order.append(number)
        elif id(number) not in seen and number.name != "input":
            seen.add(id(number))
            stack.append((number, True))
            stack += [(value, False) for value in number.operands if not is_constant(value) and id(value) not in seen]
    return order


def bound(number: Number, operands: list[Any]) -> Any:
    """The number, traced."""
    if number.name == "part":
        return operands[0][number.equation]
    if number.name == "array":
        return number.equation(operands)
    if number.name == "convert_element_type":
        return lax.convert_element_type(operands[0], number.dtype)
    plain = _PLAIN.get(number.name)
    if plain is not None:
        return plain(*operands)
    return number.equation.primitive.bind(*operands, **number.equation.params)
