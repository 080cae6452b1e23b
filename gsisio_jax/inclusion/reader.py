"""Reads a function, number by number, into linear combinations of atoms."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from gsisio_jax.inclusion.expansion import Expansion
from gsisio_jax.inclusion.linear_parts import Atom, Linear
from gsisio_jax.inclusion.rules.functions import CURVES
from gsisio_jax.inclusion.rules.hinge_tables import hinge_table
from gsisio_jax.scalar.graph import Graph, Number, is_constant
from gsisio_jax.scalar.hinges import BENT, Bends, Bent, Direction
from gsisio_jax.scalar.unroll import collected, evaluate, numbers_in

_MOST_NUMBERS = 100_000  # that `affine_rows` reads
_MOST_OPERATIONS = 400  # of f and g together; beyond, bounds come from the engine over arrays


def expand(function: Callable[..., Any], n: int, m: int, dtype: Any) -> Expansion | None:
    """The expansion of ``function(x, u)``, x (n,) and u (m,); None where it is too large, or holds operations (loops,
    comparisons, library calls) that the engine over arrays knows better."""
    closed = jax.make_jaxpr(function)(jax.ShapeDtypeStruct((n,), dtype), jax.ShapeDtypeStruct((m,), dtype))
    if numbers_in(closed.jaxpr) > 4 * _MOST_OPERATIONS or len(closed.out_avals) != 1:
        return None
    graph = Graph()
    inputs = [collected([graph.input(dtype) for _ in range(size)], (size,)) for size in (n, m)]
    if any(isinstance(const, Tracer) for const in closed.consts):
        return None
    (out,) = evaluate(graph, closed.jaxpr, closed.consts, inputs)
    return _Reader(n, inputs, dtype, bends=Bends() if graph.count(BENT) > 1 else None).expansion(out)


@dataclass(frozen=True)
class AffineRow:
    """``states . x + inputs . u + constant``, exact: {index: coefficient} without zeros."""

    states: dict[int, Fraction]
    inputs: dict[int, Fraction]
    constant: Fraction


def affine_rows(function: Callable[..., Any], n: int, m: int, dtype: Any) -> list[AffineRow | None]:
    """Every component of ``function(x, u)`` that is affine in x and u, in fractions; None for the others."""
    closed = jax.make_jaxpr(function)(jax.ShapeDtypeStruct((n,), dtype), jax.ShapeDtypeStruct((m,), dtype))
    (shape,) = closed.out_avals
    if numbers_in(closed.jaxpr) > _MOST_NUMBERS or any(isinstance(const, Tracer) for const in closed.consts):
        return [None] * shape.shape[0]
    graph = Graph()
    inputs = [collected([graph.input(dtype) for _ in range(size)], (size,)) for size in (n, m)]
    (out,) = evaluate(graph, closed.jaxpr, closed.consts, inputs)
    reader = _Reader(n, inputs, dtype, np.float32, np.float64)
    return [reader.affine(value) for value in out]


_LINEAR = {"add", "sub", "neg", "copy", "stop_gradient", "convert_element_type"}
_KNOWN = {"mul", "div", "integer_pow", "square", "pow", "atan2", "max", "min", "abs", *CURVES}


class _Reader:
    """Reads numbers into linear combinations of atoms; with `bends`, what is piecewise linear in one of them as one
    table."""

    def __init__(self, n: int, inputs: list[np.ndarray], *dtypes: Any, bends: Bends | None = None):
        self.joins, self.bends, self.tables = bends is not None, bends or Bends(), dict[Any, Linear]()
        self.n, self.atoms, self.dtypes = n, [], [np.dtype(dtype) for dtype in dtypes]
        self.read: dict[int, Linear] = {id(x): Linear({i: Fraction(1)}) for i, x in enumerate(inputs[0])}
        for j, u in enumerate(inputs[1]):
            self.read[id(u)] = self._atom(Atom("input", None, (), j))

    def expansion(self, outputs: np.ndarray) -> Expansion | None:
        found = []
        for value in outputs:
            linear = self.linear(value)
            if linear is None:
                return None
            found.append(linear)
        return Expansion(self.n, self.atoms, found) if len(self.atoms) <= _MOST_OPERATIONS else None

    def affine(self, value: Any) -> AffineRow | None:
        """A number as an affine function of x and u; None where it is none, or not known here."""
        linear = self.linear(value) if is_constant(value) or value.dtype in self.dtypes else None
        if linear is None:
            return None
        inputs: dict[int, Fraction] = {}
        for k, factor in linear.coefficients.items():
            if k >= self.n:
                source = self.atoms[k - self.n].source
                if source is None:
                    return None
                inputs[source] = factor
        return AffineRow({k: v for k, v in linear.coefficients.items() if k < self.n}, inputs, linear.constant)

    def _atom(self, atom: Atom) -> Linear:
        self.atoms.append(atom)
        return Linear({self.n + len(self.atoms) - 1: Fraction(1)})

    def linear(self, value: Any) -> Linear | None:
        """A number as a linear combination; None where some operation behind it is not known here."""
        if is_constant(value):
            number = float(value)
            return Linear({}, Fraction(number)) if math.isfinite(number) and value.dtype != bool else None
        stack = [value]
        while stack:
            number = stack[-1]
            if id(number) in self.read:
                stack.pop()
                continue
            bent = self._joint(number)
            operands = number.operands if bent is None else [self.bends.numbers[b] for b in bent.bases()]
            waiting = [v for v in operands if isinstance(v, Number) and id(v) not in self.read]
            if waiting:
                stack += waiting
            else:
                found = self._one(number) if bent is None else self._of_tables(bent)
                if found is None:
                    return None
                self.read[id(number)] = found
        return self.read[id(value)]

    def _joint(self, number: Number) -> Bent | None:
        """A number that bends several times along one direction."""
        bent = self.bends.of(number) if self.joins else None
        return bent if bent is not None and bent.joint else None

    def _of_tables(self, bent: Bent) -> Linear:
        """Linear terms, and an atom for every direction along which a number bends."""
        rest, tables = bent.tables()
        total = self._combined(tuple(rest.linear.items())).plus(Linear({}, rest.constant))
        for direction, slope, constant, jumps in tables:
            key = direction, slope, constant, tuple(sorted(jumps.items()))
            if key not in self.tables:
                table = hinge_table(slope, constant, jumps, self.dtypes[0])
                self.tables[key] = self._atom(Atom("table", table, (self._combined(direction),)))
            total = total.plus(self.tables[key])
        return total

    def _combined(self, weights: Direction) -> Linear:
        total = Linear()
        for b, weight in weights:
            total = total.plus(self.read[id(self.bends.numbers[b])].times(weight))
        return total

    def _one(self, number: Number) -> Linear | None:
        name = number.name
        if number.dtype not in self.dtypes or name not in _LINEAR | _KNOWN:
            return None
        operands: list[Linear] = []
        for v in number.operands:
            linear = self.read[id(v)] if isinstance(v, Number) else self.linear(v)
            if linear is None:
                return None
            operands.append(linear)
        if name in ("add", "sub"):
            return operands[0].plus(operands[1], 1 if name == "add" else -1)
        if name == "neg":
            return operands[0].times(Fraction(-1))
        if name in _LINEAR:
            return operands[0]
        constant = [v.constant if not v.coefficients else None for v in operands]
        if name == "mul":
            for factor, other in zip(constant, operands[::-1], strict=True):
                if factor is not None:
                    return other.times(factor)
        if name == "div" and constant[1] is not None:
            return operands[0].times(1 / constant[1]) if constant[1] else None
        if name == "div":
            inverse = self._atom(Atom("reciprocal", None, (operands[1],)))
            return (
                inverse.times(constant[0])
                if constant[0] is not None
                else self._atom(Atom("mul", None, (operands[0], inverse)))
            )
        if name == "pow" and constant[1] is None:
            return None
        return self._atom(Atom(name, number.equation, tuple(operands)))
