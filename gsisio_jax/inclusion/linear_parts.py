"""Linear combinations with coefficients in fractions, and the atoms that they are of."""

from __future__ import annotations

from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any


@dataclass
class Linear:
    """``sum coefficients[k] variable_k + constant``: variables 0..n-1 are states, the others atoms."""

    coefficients: dict[int, Fraction] = field(default_factory=dict)
    constant: Fraction = Fraction(0)

    def plus(self, other: Linear, sign: int = 1) -> Linear:
        merged = dict(self.coefficients)
        for k, value in other.coefficients.items():
            merged[k] = merged.get(k, Fraction(0)) + sign * value
        return Linear({k: v for k, v in merged.items() if v}, self.constant + sign * other.constant)

    def times(self, factor: Fraction) -> Linear:
        if not factor:
            return Linear()
        return Linear({k: factor * v for k, v in self.coefficients.items()}, factor * self.constant)


@dataclass
class Atom:
    """An operation that is not linear: its primitive and arguments; or the entry `source` of the known input.

    A "table" is a piecewise-linear function of its argument; it stands in the place of the equation.
    """

    name: str
    equation: Any
    arguments: tuple[Linear, ...]
    source: int | None = None
