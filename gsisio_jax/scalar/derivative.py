"""Derivatives of a scalar program, as scalar programs.

An operation on single numbers has one partial derivative by each operand, and a linear map of one number is its own
transpose. So tangents (forward) and cotangents (backward) are made of the same pieces, built in the graph of the
program: each once, simplified, and only where a derivative is asked for.

    tangent_program      tangents of the results from those of some arguments
    cotangent_program    cotangents of some arguments from those of some results
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.interval.minmax import TIES
from gsisio_jax.interval.primitives import PARTIALS
from gsisio_jax.scalar.graph import Graph, Number, is_constant
from gsisio_jax.scalar.program import ScalarProgram, bound
from gsisio_jax.scalar.unroll import collected, evaluate

Mask = tuple[bool, ...]


def reached(program: ScalarProgram, moving: Mask) -> Mask:
    """Which results have a derivative by the arguments that move."""
    active = _active(program, moving)
    return tuple(id(value) in active for value in program.outputs)


def tangent_program(program: ScalarProgram, moving: Mask) -> ScalarProgram:
    """From all arguments and the tangents of those that move: the tangents of the results that are reached."""
    return program.derived(("tangents", moving), lambda: _tangents(program, moving))


def cotangent_program(program: ScalarProgram, moving: Mask, wanted: Mask) -> ScalarProgram:
    """From all arguments and the cotangents of the results that are wanted: those of the arguments that move."""
    return program.derived(("cotangents", moving, wanted), lambda: _cotangents(program, moving, wanted))


def _picked(values: Sequence[Any], mask: Mask) -> list[Any]:
    return [value for value, wanted in zip(values, mask, strict=True) if wanted]


def _active(program: ScalarProgram, moving: Mask) -> set[int]:
    """Ids of the numbers that have a derivative by the arguments that move."""
    active = {id(number) for number in _picked(program.inputs, moving)}
    for number in program.operations:
        if (
            number.name != "stop_gradient"
            and (number.dtype is None or jnp.issubdtype(number.dtype, jnp.floating))
            and any(id(v) in active for v in number.operands)
        ):
            active.add(id(number))
    return active


def _derived(program: ScalarProgram, given: list[Number], outputs: list[Any], like: Sequence[Any]) -> ScalarProgram:
    def arrays(values: Sequence[Any]) -> list[np.ndarray]:
        return [collected([value], ()) for value in values]

    dtypes = [number.dtype for number in like]
    return ScalarProgram(program.graph, arrays([*program.inputs, *given]), arrays(outputs), dtypes)


def _tangents(program: ScalarProgram, moving: Mask) -> ScalarProgram:
    active, graph, partials = _active(program, moving), program.graph, _Partials(program.graph)
    inputs = _picked(program.inputs, moving)
    given = [graph.input(number.dtype) for number in inputs]
    found: dict[int, Any] = {id(number): tangent for number, tangent in zip(inputs, given, strict=True)}
    for number in program.operations:
        if id(number) not in active:
            continue
        if number.name == "array":
            moves = tuple(id(v) in active for v in number.operands)
            own = [found[id(v)] for v in _picked(number.operands, moves)]
            pushed, key = _Pushed(number.equation, moves), ("tangents", number.order, moves)
            found[id(number)] = graph.make("array", (*number.operands, *own), None, pushed, key)
        elif number.name == "part":
            whole, i = found[id(number.operands[0])], number.equation
            found[id(number)] = graph.make("part", (whole,), number.dtype, i, i)
        else:
            own = [(i, found[id(v)]) for i, v in enumerate(number.operands) if id(v) in found]
            if number.name in ("cut", "raised"):
                own = [(i, t if i == 0 else _unless_nan(graph, number.operands[1], t)) for i, t in own]
            terms = [partials.times(number, i, tangent, number.dtype) for i, tangent in own]
            found[id(number)] = _sum(graph, terms, number)
    outputs = [value for value in program.outputs if id(value) in active]
    return _derived(program, given, [found[id(v)] for v in outputs], outputs)


def _cotangents(program: ScalarProgram, moving: Mask, wanted: Mask) -> ScalarProgram:
    active, graph, partials = _active(program, moving), program.graph, _Partials(program.graph)
    outputs = _picked(program.outputs, wanted)
    given = [graph.input(value.dtype) for value in outputs]
    terms: dict[int, list[Any]] = {}
    parts: dict[int, dict[int, Any]] = {}
    for value, cotangent in zip(outputs, given, strict=True):
        terms.setdefault(id(value), []).append(cotangent)
    for number in reversed(program.operations):
        if id(number) not in active or (id(number) not in terms and id(number) not in parts):
            continue
        moves = [i for i, v in enumerate(number.operands) if id(v) in active]
        graph.stage = number.stage
        if number.name == "array":
            contributions = _pulled(graph, number, moves, parts[id(number)])
        else:
            total = _sum(graph, terms[id(number)], number)
            if number.name == "part":
                parts.setdefault(id(number.operands[0]), {})[number.equation] = total
                continue
            contributions = [(i, partials.times(number, i, total, number.operands[i].dtype)) for i in moves]
        for i, value in contributions:
            if not _is_zero(value):
                terms.setdefault(id(number.operands[i]), []).append(value)
    inputs = _picked(program.inputs, moving)
    return _derived(program, given, [_sum(graph, terms.get(id(v), []), v) for v in inputs], inputs)


def _pulled(graph: Graph, number: Number, moves: Sequence[int], parts: dict[int, Any]) -> list[tuple[int, Any]]:
    """Cotangents of the operands of an array operation, from those of its entries."""
    entries, mask = tuple(parts), tuple(i in moves for i in range(len(number.operands)))
    pulled, key = _Pulled(number.equation, mask, entries), ("cotangents", number.order, mask, entries)
    whole = graph.make("array", (*number.operands, *parts.values()), None, pulled, key)
    return [(i, graph.make("part", (whole,), number.operands[i].dtype, place, place)) for place, i in enumerate(moves)]


def _unless_nan(graph: Graph, value: Any, tangent: Any) -> Any:
    """The tangent of a bound that may be passed over."""
    same = graph.apply("eq", value, value, dtype=np.dtype(bool))
    return graph.apply("select_n", same, _zero(tangent), tangent, dtype=tangent.dtype)


def _zero(like: Any) -> Any:
    return np.asarray(0, like.dtype)[()]


def _is_zero(value: Any) -> bool:
    return is_constant(value) and bool(value == 0)


def _sum(graph: Graph, terms: Sequence[Any], like: Number) -> Any:
    return graph.fold("add", [term for term in terms if not _is_zero(term)], like.dtype, 0)


class _Partials:
    """Products with partial derivatives."""

    def __init__(self, graph: Graph):
        self.graph = graph
        self._traced: dict[Any, Any] = {}

    def times(self, number: Number, i: int, value: Any, dtype: Any) -> Any:
        """A tangent of operand i, or a cotangent of the number, by the derivative of the number by operand i."""
        apply, name, operands = self.graph.apply, number.name, number.operands
        self.graph.stage = number.stage
        if name == "add" or (name == "sub" and i == 0):
            return value
        if name == "neg" or name == "sub":
            return apply("neg", value)
        if name == "mul":
            return self._scaled(value, operands[1 - i])
        if name == "div":
            share = apply("div", value, operands[1])
            return share if i == 0 else apply("neg", apply("mul", share, number))
        if name == "abs":
            return self._scaled(value, apply("sign", operands[0]))
        if name == "select_n":
            cases = [value if i == case else _zero(value) for case in range(1, len(operands))]
            return apply("select_n", operands[0], *cases, dtype=value.dtype)
        if name == "convert_element_type":
            return value if value.dtype == dtype else apply(name, value, dtype=dtype)
        if name in TIES:
            # The other share is the rest, so the two add up to 1 however often they are computed.
            mine = apply("mul", value, self._traced_value(number, name, TIES[name]))
            return mine if i == 0 else apply("sub", value, mine)
        if name in PARTIALS:
            return self._scaled(value, self._traced_value(number, (name, i), lambda *at: PARTIALS[name](*at)[i]))

        def slope(*at: Any) -> Any:
            def along(x: Any) -> Any:
                return bound(number, [*at[:i], x, *at[i + 1 :]])

            return jax.jvp(along, (at[i],), (jnp.ones_like(at[i]),))[1]

        params = "" if number.equation is None else repr(sorted(number.equation.params.items(), key=str))
        return self._scaled(value, self._traced_value(number, (name, i, params), slope))

    def _scaled(self, value: Any, factor: Any) -> Any:
        """A product in which a constant 0 is the absence of a derivative."""
        if _is_zero(factor) or _is_zero(value):
            return _zero(value)
        if is_constant(factor) and isinstance(value, Number) and value.name == "mul" and is_constant(value.operands[1]):
            return self._scaled(value.operands[0], factor * value.operands[1])
        return self.graph.apply("mul", value, factor)

    def _traced_value(self, number: Number, key: Any, function: Any) -> Any:
        """What a function of the operands returns, as a number of the graph."""
        like = [jax.ShapeDtypeStruct((), v.dtype) for v in number.operands]
        key = key, tuple(str(one.dtype) for one in like)
        if key not in self._traced:
            self._traced[key] = jax.make_jaxpr(function)(*like)
        closed = self._traced[key]
        args = [collected([v], ()) for v in number.operands]
        [found] = evaluate(self.graph, closed.jaxpr, closed.consts, args, number.stage)
        self.graph.stage = number.stage
        return found[()]


class _Pushed:
    """Tangents of the entries of an array operation, from its arguments and the tangents of those that move."""

    def __init__(self, operation: Any, moves: Mask):
        self.operation, self.moves = operation, moves

    def __call__(self, flat: Sequence[Any]) -> list[Any]:
        primals, tangents = flat[: len(self.moves)], flat[len(self.moves) :]
        return list(jax.jvp(*_along(self.operation, primals, self.moves), tuple(tangents))[1])


class _Pulled:
    """Cotangents of the arguments of an array operation that move, from its arguments and those of some entries."""

    def __init__(self, operation: Any, moves: Mask, entries: tuple[int, ...]):
        self.operation, self.moves, self.entries = operation, moves, entries

    def __call__(self, flat: Sequence[Any]) -> list[Any]:
        primals, cotangents = flat[: len(self.moves)], flat[len(self.moves) :]
        function, at = _along(self.operation, primals, self.moves)
        return list(jax.vjp(lambda *x: [function(*x)[i] for i in self.entries], *at)[1](list(cotangents)))


def _along(operation: Any, primals: Sequence[Any], moves: Mask) -> tuple[Any, tuple[Any, ...]]:
    """An array operation as a function of the arguments that move, and these."""

    def function(*moving: Any) -> list[Any]:
        rest = iter(moving)
        return operation([next(rest) if moves_ else p for p, moves_ in zip(primals, moves, strict=True)])

    return function, tuple(jnp.asarray(p) for p in _picked(primals, moves))
