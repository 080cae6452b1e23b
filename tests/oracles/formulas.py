"""One formula, three readings: crival's intervals at many points, balls at one, and the derivatives of either.

A formula is a function of a set of operations K and of numbers, so that no rule for derivatives is written by hand for
every function. Points are floating numbers, so arguments may be compared; what is computed from them may not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import ival
import numpy as np
from flint import arb
from ival import Interval as I
from oracles.real_functions import REALS, Real


class Intervals:
    """Operations on crival's intervals."""

    pi, nan = ival.acos(I(-1.0)), I(np.nan)

    def __getattr__(self, name: str) -> Any:
        return getattr(ival, name)

    @staticmethod
    def number(p: float, q: float = 1.0) -> Any:
        """``p / q`` of two floating numbers."""
        return I(float(p)) / I(float(q))

    @staticmethod
    def step(t: Any, cut: Any, below: Any, there: Any, above: Any) -> Any:
        """Below, at and above a cut; t and the cut are exact."""
        t, cut, below, there, above = (v if isinstance(v, I) else I(float(v)) for v in (t, cut, below, there, above))
        sides = [(below.lo, there.lo, above.lo), (below.hi, there.hi, above.hi)]
        return I(*(np.where(t.lo < cut.lo, a, np.where(t.lo > cut.lo, c, b)) for a, b, c in sides))

    @staticmethod
    def entry(values: Sequence[Any], index: Callable[[np.ndarray], Any], t: Any) -> Any:
        """The value with the index that belongs to an exact t."""
        shape, place = np.shape(t.lo), np.asarray(index(t.lo), int)
        sides = [[np.broadcast_to(side(v if isinstance(v, I) else I(float(v))), shape) for v in values] for side in
                 (lambda v: v.lo, lambda v: v.hi)]  # fmt: skip
        return I(*(np.choose(place, side) for side in sides))


class Balls:
    """The same on balls of python-flint."""

    nan = arb.nan()

    def __getattr__(self, name: str) -> Any:
        method = {"sinpi": "sin_pi", "cospi": "cos_pi"}.get(name, name)
        return lambda *t: getattr(arb, method)(*(arb(v) for v in t))

    @property
    def pi(self) -> Any:
        return arb.pi()

    @staticmethod
    def hypot(x: Any, y: Any) -> Any:
        return (x * x + y * y).sqrt()

    @staticmethod
    def number(p: float, q: float = 1.0) -> Any:
        return arb(float(p)) / arb(float(q))

    @staticmethod
    def step(t: Any, cut: Any, below: Any, there: Any, above: Any) -> Any:
        cut = arb(cut)
        return arb(below if t < cut else above if t > cut else there)

    @staticmethod
    def entry(values: Sequence[Any], index: Callable[[np.ndarray], Any], t: Any) -> Any:
        return arb(values[int(index(np.asarray(float(t))))])


INTERVALS, BALLS = Intervals(), Balls()


class Dual:
    """A number and its derivative by one argument; numbers without one stand on its right."""

    def __init__(self, K: Any, value: Any, slope: Any):
        self.K, self.value, self.slope = K, value, slope

    def _other(self, v: Any) -> Dual:
        return v if isinstance(v, Dual) else Dual(self.K, v, self.K.number(0.0))

    def __add__(self, v: Any) -> Dual:
        v = self._other(v)
        return Dual(self.K, self.value + v.value, self.slope + v.slope)

    def __neg__(self) -> Dual:
        return Dual(self.K, -self.value, -self.slope)

    def __mul__(self, v: Any) -> Dual:
        v = self._other(v)
        return Dual(self.K, self.value * v.value, self.slope * v.value + self.value * v.slope)

    def __truediv__(self, v: Any) -> Dual:
        v = self._other(v)
        quotient = self.value / v.value
        return Dual(self.K, quotient, (self.slope - quotient * v.slope) / v.value)

    def __sub__(self, v: Any) -> Dual:
        return self + -self._other(v)

    def __rsub__(self, v: Any) -> Dual:
        return -self + v

    def __rtruediv__(self, v: Any) -> Dual:
        return self._other(v) / self

    __radd__, __rmul__ = __add__, __mul__


class Derivatives:
    """The same on dual numbers over intervals or balls. At a cut of a step there is no derivative to check."""

    def __init__(self, K: Any):
        self.K, self.number, self.pi, self.nan = K, K.number, K.pi, K.nan
        self.rules: dict[str, Callable[[Any], Any]] = {
            "exp": K.exp, "expm1": K.exp, "sin": K.cos, "cos": lambda t: -K.sin(t),
            "log": lambda t: 1 / t, "log1p": lambda t: 1 / (1 + t), "sqrt": lambda t: 1 / (2 * K.sqrt(t)),
            "sinpi": lambda t: K.pi * K.cospi(t),
            "erfc": lambda t: -2 / K.sqrt(K.pi) * K.exp(-(t * t)),
        }  # fmt: skip

    def __getattr__(self, name: str) -> Any:
        K, rule, value = self.K, self.rules[name], getattr(self.K, name)
        return lambda t: Dual(K, value(t.value), rule(t.value) * t.slope) if isinstance(t, Dual) else value(t)

    def hypot(self, x: Dual, y: Any) -> Dual:
        y = x._other(y)
        far = self.K.hypot(x.value, y.value)
        return Dual(self.K, far, x.value / far * x.slope + y.value / far * y.slope)

    def atan2(self, y: Dual, x: Dual) -> Dual:
        square = x.value * x.value + y.value * y.value
        return Dual(self.K, self.K.atan2(y.value, x.value), (x.value * y.slope - y.value * x.slope) / square)

    def max(self, x: Any, y: Any) -> Dual:
        return self.step(x, y, y, x, x)

    def step(self, t: Dual, cut: Any, below: Any, there: Any, above: Any) -> Dual:
        below, there, above = (t._other(v) for v in (below, there, above))
        at = t.value, cut.value if isinstance(cut, Dual) else cut
        value = self.K.step(*at, below.value, there.value, above.value)
        return Dual(self.K, value, self.K.step(*at, below.slope, self.nan, above.slope))


def real(
    count: int, fn: Any, formula: Any, domain: tuple[float, float] = REALS, special: Any = (), slopes: bool = True
) -> Real:
    """A `Real` from a formula ``(K, *t)``; without derivatives where the function jumps."""

    def partials(K: Any) -> list[Any]:
        def by(k: int) -> Any:
            def partial(*t: Any) -> Any:
                one, zero = K.number(1.0), K.number(0.0)
                found = formula(Derivatives(K), *(Dual(K, v, one if i == k else zero) for i, v in enumerate(t)))
                return found.slope + 0 * t[0]

            return partial

        return [by(k) for k in range(count)] if slopes else []

    return Real(
        (lambda x: fn(x[0])) if count == 1 else fn,
        lambda *t: formula(INTERVALS, *t) + 0 * t[0],
        partials(INTERVALS),
        lambda *t: formula(BALLS, *t),
        partials(BALLS),
        domain,
        (0.0, 1.0, -1.0, *special),
        arguments=count,
    )
