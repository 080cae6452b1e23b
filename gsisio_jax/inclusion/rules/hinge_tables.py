"""Piecewise-linear functions with knots and values in fractions, by the table of floating numbers next to them.

``phi(t) = constant + slope t + sum_k jump_k max(t - k, 0)``. Its table psi has the knots rounded to floating numbers,
and there the values of phi rounded likewise; beyond them it goes on with the slopes of phi. Both are piecewise linear,
so ``|phi - psi|`` is largest at a knot of one of them, where it is computed in fractions; it widens every range.

Knots that differ by no more than rounding are one (`_ALIKE`): where one clip ends at ``a + h`` and the next begins at
b, the piece between them is an ulp wide, and its slope means nothing. So derivatives are those of psi, and of phi on
all other pieces. As with jumps of that size (`piecewise`), mean-value forms stay right: they start from a range at a
point, ``phi(b)`` lies in ``psi(b) +- error``, that in ``psi(a) + J (b - a) +- error``, and ``psi(a) +- error`` is that
range.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from typing import Any

import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.rules.tables import PiecewiseLinear, near, whole
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval

_ALIKE = 64.0  # in eps of the largest knot


@dataclass(frozen=True, eq=False)
class HingeTable:
    """A function of one variable (`univariate.apply`).

    Attributes:
        table: psi.
        error: ``|phi - psi|`` at most.
        low, high: (K + 1,) floating numbers around the slopes of phi and psi between the knots.
    """

    table: PiecewiseLinear
    error: Any
    low: np.ndarray
    high: np.ndarray

    def range(self, a: Any, b: Any) -> Interval:
        return self._wider(self.table.range(a, b))

    @whole
    def derivative(self, a: Any, b: Any) -> Interval:
        met = self.table.met(a, b)
        lower, upper = jnp.where(met, self.low, jnp.inf).min(-1), jnp.where(met, self.high, -jnp.inf).max(-1)
        return Interval.unchecked(lower, upper)

    def line(self, a: Any, b: Any, natural: Interval) -> tuple[Any, Interval]:
        s, rest = self.table.line(a, b, natural)
        return s, self._wider(rest)

    def _wider(self, found: Interval) -> Interval:
        if not self.error or not rounding.outward():
            return found
        return Interval.unchecked(rounding.down(found.lower - self.error), rounding.up(found.upper + self.error))


def hinge_table(slope: Fraction, constant: Fraction, jumps: dict[Fraction, Fraction], dtype: Any) -> HingeTable:
    """The function as a table in a floating type; it has a knot."""
    dtype = np.dtype(dtype)
    cuts = sorted(jumps)
    knots = _knots(cuts, dtype)
    places = [Fraction(float(t)) for t in knots]
    values = np.array([float(v) for v in _values(slope, constant, jumps, places)]).astype(dtype)
    heights = [Fraction(float(v)) for v in values]
    last = slope + sum(jumps.values())
    inner = [(w - v) / (t - s) for (s, t), (v, w) in zip(pairwise(places), pairwise(heights), strict=True)]
    slopes = [slope, *inner, last]
    # psi in the form of phi.
    turns = {t: after - before for t, (before, after) in zip(places, pairwise(slopes), strict=True)}
    union = sorted({*cuts, *places})
    both = (
        _values(slope, constant, jumps, union),
        _values(slope, heights[0] - slope * places[0], turns, union),
    )
    error = max(abs(v - w) for v, w in zip(*both, strict=True))
    low, high = _around(slopes, dtype)
    table = PiecewiseLinear(
        knots, values, (float(slope), float(last)), (float(values[0]), float(values[-1])), low, high
    )
    middles = [(s + t) / 2 for s, t in pairwise(places)]
    own = [slope, *_slopes(slope, jumps, middles), last]
    sides = _around(own, dtype)
    return HingeTable(
        table,
        near(error, 1, dtype) if error else dtype.type(0),
        np.minimum(low, sides[0]),
        np.maximum(high, sides[1]),
    )


def _knots(cuts: list[Fraction], dtype: Any) -> np.ndarray:
    """Floating numbers next to the knots, increasing; one for those that are alike."""
    found = np.unique(np.array([float(cut) for cut in cuts]).astype(dtype))
    alike = _ALIKE * np.finfo(dtype).eps * np.abs(found).max()
    kept = [found[0]]
    for knot in found[1:]:
        if knot - kept[-1] > alike:
            kept.append(knot)
    return np.array(kept, dtype)


def _values(
    slope: Fraction, constant: Fraction, jumps: dict[Fraction, Fraction], points: list[Fraction]
) -> list[Fraction]:
    """phi at points in increasing order."""
    found, waiting, offset = [], sorted(jumps.items(), reverse=True), constant
    for t in points:
        while waiting and waiting[-1][0] < t:
            knot, jump = waiting.pop()
            slope, offset = slope + jump, offset - jump * knot
        found.append(offset + slope * t)
    return found


def _slopes(slope: Fraction, jumps: dict[Fraction, Fraction], points: list[Fraction]) -> list[Fraction]:
    """The slope of phi at points in increasing order."""
    found, waiting = [], sorted(jumps.items(), reverse=True)
    for t in points:
        while waiting and waiting[-1][0] < t:
            slope += waiting.pop()[1]
        found.append(slope)
    return found


def _around(slopes: list[Fraction], dtype: Any) -> list[np.ndarray]:
    """The floating numbers below and above."""
    return [np.array([near(s, side, dtype) for s in slopes]) for side in (-1, 1)]
