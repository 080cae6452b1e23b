"""Expressions of one variable as they are written, read while tracing: polynomials in the variable and in functions of
such polynomials.

Coefficients are the exact values of the floating numbers in the code. What cannot be read so, such as an operation
that is not done entry by entry or a constant that is an array, makes the whole expression unknown.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import jax.extend.core as jex
import numpy as np

from gsisio_jax.inclusion.rules.makers import library_function
from gsisio_jax.scalar.unroll import called_jaxpr

_MOST_TERMS = 8
_MOST_STEPS = 40
_FUNCTIONS = {"tanh", "erf", "erfc", "logistic", "exp", "log", "log1p"}
_CALLS = {"jit", "pjit", "closed_call", "custom_jvp_call"}
_KEEPS = {"copy", "stop_gradient"}


@dataclass(frozen=True)
class Function:
    """A function of a polynomial; ``inverse`` is one over it."""

    name: str
    of: Polynomial


@dataclass(frozen=True)
class Polynomial:
    """Coefficients of products; a product counts how often the variable ("t") and functions occur in it."""

    terms: frozenset[tuple[frozenset[tuple[Any, int]], Fraction]]

    @classmethod
    def of(cls, terms: Mapping[frozenset[tuple[Any, int]], Fraction]) -> Polynomial:
        return cls(frozenset((product, factor) for product, factor in terms.items() if factor))

    @property
    def constant(self) -> Fraction | None:
        """Its value, where nothing varies in it."""
        if any(product for product, _ in self.terms):
            return None
        return sum((factor for _, factor in self.terms), Fraction(0))

    def functions(self) -> set[str]:
        return {base.name for product, _ in self.terms for base, _ in product if isinstance(base, Function)}

    def __add__(self, other: Polynomial) -> Polynomial:
        found = dict(self.terms)
        for product, factor in other.terms:
            found[product] = found.get(product, Fraction(0)) + factor
        return Polynomial.of(found)

    def __mul__(self, other: Polynomial) -> Polynomial:
        found: dict[frozenset[tuple[Any, int]], Fraction] = {}
        for first, a in self.terms:
            for second, b in other.terms:
                count = dict(first)
                for base, power in second:
                    count[base] = count.get(base, 0) + power
                product = frozenset(count.items())
                found[product] = found.get(product, Fraction(0)) + a * b
        return Polynomial.of(found)

    def is_near(self, other: Polynomial, share: float) -> bool:
        """The same products, with coefficients that differ by that share of their size at most."""
        left = list(other.terms)
        for product, factor in self.terms:
            for term in left:
                if abs(factor - term[1]) <= share * abs(term[1]) and _near(product, term[0], share):
                    left.remove(term)
                    break
            else:
                return False
        return not left


def _near(first: frozenset[tuple[Any, int]], second: frozenset[tuple[Any, int]], share: float) -> bool:
    left = list(second)
    for base, power in first:
        for other in left:
            if power == other[1] and _same_base(base, other[0], share):
                left.remove(other)
                break
        else:
            return False
    return not left


def _same_base(first: Any, second: Any, share: float) -> bool:
    if isinstance(first, Function) and isinstance(second, Function):
        return first.name == second.name and first.of.is_near(second.of, share)
    return first == second


def number(value: Any) -> Polynomial:
    """A constant, exactly."""
    return Polynomial.of({frozenset(): Fraction(value)})


def single(base: Any) -> Polynomial:
    return Polynomial.of({frozenset([(base, 1)]): Fraction(1)})


def function(name: str, of: Polynomial) -> Polynomial:
    return single(Function(name, of))


VARIABLE = single("t")


class Unreadable(Exception):
    """The expression is none of those that can be read."""


def written(eqn: Any, maker: Callable[[Any], Any], leaf: Any) -> Polynomial | None:
    """The result of an equation as a polynomial in the leaf; None where it is none, or too long.

    `maker` gives the equation that made a variable, or None.
    """
    try:
        return _Reader(leaf.aval.shape, maker, {leaf: VARIABLE}, [_MOST_STEPS]).result(eqn)
    except Unreadable:
        return None


class _Reader:
    def __init__(self, shape: tuple[int, ...], maker: Callable[[Any], Any], known: dict[Any, Any], left: list[int]):
        self.shape, self.maker, self.known, self.left = shape, maker, known, left

    def value(self, atom: Any) -> Polynomial:
        if isinstance(atom, jex.Literal):
            return _literal(atom)
        if atom not in self.known:
            eqn = self.maker(atom)
            if eqn is None or len(eqn.outvars) != 1:
                raise Unreadable
            self.known[atom] = self.result(eqn)
        return self.known[atom]

    def result(self, eqn: Any) -> Polynomial:
        self.left[0] -= 1
        if self.left[0] < 0 or not eqn.invars:  # nothing is made from an iota
            raise Unreadable
        found = self.apply(eqn, [self.value(atom) for atom in eqn.invars])
        if len(found.terms) > _MOST_TERMS or (found.constant is None and eqn.outvars[0].aval.shape != self.shape):
            raise Unreadable
        return found

    def apply(self, eqn: Any, args: list[Polynomial]) -> Polynomial:
        name = eqn.primitive.name
        if name in _CALLS:
            return self.call(eqn, args)
        if name == "add":
            return args[0] + args[1]
        if name == "sub":
            return args[0] + number(-1) * args[1]
        if name == "neg":
            return number(-1) * args[0]
        if name == "mul":
            return args[0] * args[1]
        if name == "div":
            below = args[1].constant
            if below == 0:
                raise Unreadable
            return args[0] * (function("inverse", args[1]) if below is None else number(1 / below))
        if name == "square" or (name == "integer_pow" and 0 < eqn.params["y"] <= 4):
            found = args[0]
            for _ in range(1 if name == "square" else eqn.params["y"] - 1):
                found = found * args[0]
            return found
        if name in _FUNCTIONS and args[0].constant is None:
            return function(name, args[0])
        same_type = eqn.invars[0].aval.dtype == eqn.outvars[0].aval.dtype
        if name in _KEEPS or (name == "convert_element_type" and same_type):
            return args[0]
        if name == "broadcast_in_dim" and args[0].constant is not None:
            return args[0]
        raise Unreadable

    def call(self, eqn: Any, args: list[Polynomial]) -> Polynomial:
        try:
            jaxpr, consts = called_jaxpr(eqn)
        except LookupError:
            raise Unreadable from None
        if library_function(jaxpr) == "logaddexp" and len(args) == 2:
            # log(exp(a) + exp(b)) = b + log(1 + exp(a - b))
            return args[1] + function("softplus", args[0] + number(-1) * args[1])
        if consts or jaxpr.constvars or len(jaxpr.outvars) != 1:
            raise Unreadable
        makers = {out: inner for inner in jaxpr.eqns for out in inner.outvars}
        return _Reader(self.shape, makers.get, dict(zip(jaxpr.invars, args, strict=True)), self.left).value(
            jaxpr.outvars[0]
        )


def _literal(atom: Any) -> Polynomial:
    value = np.asarray(atom.val, atom.aval.dtype)
    if value.ndim or value.dtype.kind not in "fiu" or not np.isfinite(value):
        raise Unreadable
    return number(float(value))
