"""Tables of numbers as what they are: piecewise-linear functions of one variable (`jnp.interp`).

``phi`` is given by its knots t_i (increasing) with values v_i, and by what it does beyond them. On an interval [a, b]
the extremes of ``phi(t) - s t`` lie at a, at b or at a knot between them, for every s: range and rest are minima and
maxima over the knots, exact but for rounding, and the derivative is the hull of the slopes of the segments that [a, b]
meets.

At two knots in the same place phi jumps: the value of the first is a limit from the left, that of the second is taken.

Rounding: knots and values are numbers as they stand. Slopes are computed in fractions while tracing and kept as the two
floating numbers around each. A value at a, ``v_i + m_i (a - t_i)``, is off by ``4 eps (|v_i| + |m_i (a - t_i)|)``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property, partial, wraps
from typing import Any

import jax
import jax.extend.core as jex
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.rules.univariate import hull_of
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, choose
from gsisio_jax.scalar.numpy_program import numpy_function


def whole(fn: Callable[..., Any]) -> Callable[..., Any]:
    """A method of arrays a and b that programs of single numbers (`gsisio_jax.scalar`) keep as an operation on arrays:
    they would write out every knot."""

    @wraps(fn)
    def run(self: Any, a: Any, b: Any) -> Any:
        plain = partial(fn, self)
        kept = jax.custom_jvp(plain)
        kept.defjvp(lambda primals, tangents: jax.jvp(plain, primals, tangents))
        return kept(a, b)

    return run


@dataclass(frozen=True, eq=False)
class PiecewiseLinear:
    """A piecewise-linear function.

    Attributes:
        knots: (K,), increasing but for pairs where it jumps; at either end there is none.
        values: (K,).
        tails: slope before the first knot and after the last one: 0, or that of the first and last segment.
        beyond: value next to the first and last knot, outside; where it is not that of the knot, the function jumps.
        low, high: (K + 1,), the floating numbers around the slope of every segment, tails included; 0 between a pair.
    """

    knots: np.ndarray
    values: np.ndarray
    tails: tuple[float, float]
    beyond: tuple[float, float]
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(
        cls, knots: Any, values: Any, beyond: tuple[float, float] | None = None, extrapolates: bool = False
    ) -> PiecewiseLinear:
        """From a table; beyond its ends the function keeps its values, or those of `beyond`, or goes on as it was."""
        knots, values = np.asarray(knots), np.asarray(values)
        t, v = [Fraction(float(x)) for x in knots], [Fraction(float(x)) for x in values]
        runs = [t[i + 1] - t[i] for i in range(len(t) - 1)]
        slopes = [(v[i + 1] - v[i]) / run if run else Fraction(0) for i, run in enumerate(runs)] or [Fraction(0)]
        exact = [slopes[0], *slopes, slopes[-1]] if extrapolates else [Fraction(0), *slopes, Fraction(0)]
        low, high = (np.array([near(slope, side, knots.dtype) for slope in exact]) for side in (-1, 1))
        tails = (float(exact[0]), float(exact[-1]))
        beyond = (float(values[0]), float(values[-1])) if beyond is None else beyond
        return cls(knots, values, tails, beyond, low, high)

    @property
    def jumps(self) -> tuple[bool, bool]:
        return bool(self.beyond[0] != self.values[0]), bool(self.beyond[1] != self.values[-1])

    @cached_property
    def _pairs(self) -> np.ndarray:
        """(K - 1,): is there a jump between a knot and the next one?"""
        return self.knots[1:] == self.knots[:-1]

    def _at(self, t: Any) -> tuple[Any, Any]:
        """Value at t, and what its error goes with."""
        # Segment i ends at knot i: 0 is the left tail.
        passed = t[..., None] > self.knots
        if self._pairs.any():  # where phi jumps it has the value on the right
            passed |= (t[..., None] == self.knots) & (np.append(self._pairs, False) | np.insert(self._pairs, 0, False))
        i = passed.sum(-1)
        # A knot is an end of its segment, whose value it has: t = t_0 lies in no tail that jumps.
        first = t == self.knots[0]
        i = jnp.where(first, min(1, len(self.knots) - 1), i)
        at = jnp.maximum(i - 1, 0)
        start = jnp.asarray(self.values)[at]
        outside = [(i == 0) & ~first, i == len(self.knots)]
        for where, value in zip(outside, self.beyond, strict=True):
            start = jnp.where(where, value, start)
        slope = jnp.asarray(0.5 * self.low + 0.5 * self.high)[jnp.where(first, 0, i)]
        finite = jnp.isfinite(t)
        step = jnp.where(finite, t, self.knots[0]) - jnp.asarray(self.knots)[at]
        rise = slope * step
        value, size = start + rise, abs(start) + abs(rise)
        for side, tail in zip((-jnp.inf, jnp.inf), self.tails, strict=True):
            if tail:
                value = jnp.where(t == side, float(side * np.sign(tail)), value)
        return value, jnp.where(finite, size, abs(start))

    def values_at(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values at known points, and what their errors go with."""
        with rounding.using("nearest"):
            return numpy_function(self._at, points)(points)

    def _points(self, a: Any, b: Any, s: Any) -> tuple[Any, Any, Any]:
        """``phi - s t`` at every knot, which of them lie between a and b, and what the error goes with."""
        knots, values = self.knots, self.values
        inside = met = (a[..., None] <= knots) & (knots <= b[..., None])
        if self._pairs.any():  # a limit from the left is one of the interval's own only if that reaches there
            inside = met & ((a[..., None] < knots) | ~np.append(self._pairs, False))
        reaches = a < self.knots[0], b > self.knots[-1]
        for k, jump in zip((0, -1), self.jumps, strict=True):
            if jump:
                # The limit from outside, where that is part of the interval.
                beyond = met[..., k] & reaches[k]
                inside = jnp.concatenate([inside, beyond[..., None]], -1)
                knots, values = np.append(knots, self.knots[k]), np.append(values, self.beyond[k])
        if s is None:
            return jnp.broadcast_to(values, inside.shape), inside, None
        products = s[..., None] * knots
        return values - products, inside, abs(values) + abs(products)

    def _extremes(self, a: Any, b: Any, s: Any) -> Interval:
        """Range of ``phi - s t`` on [a, b], of phi itself for None; sides of a and b are infinite only there."""
        ends = []
        for t in (a, b):
            value, size = self._at(t)
            if s is not None:
                value, size = value - s * t, size + abs(s * t)
            low, high = rounding.lowered(value, size, 8.0), rounding.raised(value, size, 8.0)
            ends.append(Interval.unchecked(low, high))
        bounds = hull_of(ends)
        values, inside, size = self._points(a, b, s)
        low, high = (values, values) if size is None else (
            rounding.lowered(values, size, 4.0), rounding.raised(values, size, 4.0)
        )  # fmt: skip
        lower = jnp.minimum(bounds.lower, jnp.where(inside, low, jnp.inf).min(-1))
        upper = jnp.maximum(bounds.upper, jnp.where(inside, high, -jnp.inf).max(-1))
        return Interval.unchecked(lower, upper)

    @whole
    def range(self, a: Any, b: Any) -> Interval:
        found = self._extremes(a, b, None)
        # Without tails that grow no value lies beyond those of the table.
        for k, side in ((0, jnp.maximum), (1, jnp.minimum)):
            if not any(self.tails):
                ends = np.append(self.values, self.beyond)
                end = float(ends.max() if k else ends.min())
                found = Interval.unchecked(
                    found.lower if k else side(found.lower, end), side(found.upper, end) if k else found.upper
                )
        return found

    def met(self, a: Any, b: Any) -> Any:
        """Which segments [a, b] reaches into, (..., K + 1)."""
        left = np.append(-np.inf, self.knots)
        right = np.append(self.knots, np.inf)
        a, b = a[..., None], b[..., None]
        return (left < b) & (a < right) | (a == b) & (left <= b) & (a <= right)

    @whole
    def derivative(self, a: Any, b: Any) -> Interval:
        met = self.met(a, b)
        lower = jnp.where(met, self.low, jnp.inf).min(-1)
        upper = jnp.where(met, self.high, -jnp.inf).max(-1)
        first, last = self.jumps
        jumped = [(a < self.knots[0]) & (b >= self.knots[0])] if first else []
        jumped += [(a <= self.knots[-1]) & (b > self.knots[-1])] if last else []
        if self._pairs.any():
            at = self.knots[1:][self._pairs]
            jumped.append(((a[..., None] < at) & (at <= b[..., None])).any(-1))
        for over in jumped:
            lower, upper = jnp.where(over, -jnp.inf, lower), jnp.where(over, jnp.inf, upper)
        return Interval.unchecked(lower, upper)

    def line(self, a: Any, b: Any, natural: Interval) -> tuple[Any, Interval]:
        s, rest, usable = self._line(a, b)
        return s, choose(usable, rest, natural)

    @whole
    def _line(self, a: Any, b: Any) -> tuple[Any, Interval, Any]:
        """The slope is that of the secant; next to an infinite end that of its tail, with which the rest is bounded."""
        low, high = jnp.isfinite(a), jnp.isfinite(b)
        both = low & high
        first, last = (jnp.where(both, end, other) for end, other in ((a, 0.0), (b, 1.0)))
        wide = last - first > 1e-3 * jnp.maximum(abs(first), abs(last))
        rise = self._at(last)[0] - self._at(first)[0]
        inner = self.derivative(a, b)
        middle = jnp.where(jnp.isfinite(inner.lower + inner.upper), 0.5 * inner.lower + 0.5 * inner.upper, 0)
        s = jnp.where(wide, rise, middle) / jnp.where(wide, last - first, 1)
        s = jnp.where(both, s, jnp.where(low, self.tails[1], self.tails[0])).astype(a.dtype)
        usable = jnp.isfinite(s) & (low | high | (self.tails[0] == self.tails[1]))
        s = jnp.where(usable, s, 0)
        # An infinite end adds nothing that the last knot has not, or a point beyond it where the function jumps there:
        # further out the rest does not change any more.
        first, last = (
            knot + side * jump for knot, side, jump in zip(self.knots[[0, -1]], (-1, 1), self.jumps, strict=True)
        )
        far = (jnp.where(low, a, jnp.minimum(first, b)), jnp.where(high, b, jnp.maximum(last, a)))
        rest = self._extremes(*far, s)
        for end, k in ((low, 0), (high, 1)):
            # The tail's slope is that of a segment, to within its rounding: times infinity, that is no bound.
            exact = self.low[-k] == self.high[-k] == self.tails[k]
            usable &= end | (exact or not rounding.outward())
        return jnp.where(usable, s, 0), rest, usable


def _kept(knots: np.ndarray) -> np.ndarray:
    """A mask of increasing knots: of those in the same place the first and the last one; at either end of the table the
    inner one, as a tail has the value beyond."""
    places = np.arange(len(knots))
    first, last = np.searchsorted(knots, knots) == places, np.searchsorted(knots, knots, "right") == places + 1
    return (first & (knots != knots[0])) | (last & (knots != knots[-1])) | (len(knots) == 1)


def near(slope: Fraction, side: int, dtype: Any) -> Any:
    """The next floating number on that side of a fraction; itself where it is one. Tables outlive the kind of rounding
    that they were made under, so it does not matter here."""
    number = np.asarray(float(slope), dtype)[()]
    if Fraction(float(number)) == slope:
        return number
    wrong = Fraction(float(number)) > slope if side < 0 else Fraction(float(number)) < slope
    return np.nextafter(number, np.asarray(side * np.inf, dtype)) if wrong else number


def interpolation(eqn: Any, knots: Any, values: Any, others: Any) -> PiecewiseLinear | None:
    """The function that a call of ``jnp.interp`` stands for, None where the table is not what it needs to be.

    What the call does beyond the ends is in its body; it is found by looking at values there, and the whole is compared
    with the body at and around all knots, so whatever else an option may do (`period`), it is not taken for a table.
    """
    knots, values = np.asarray(knots), np.asarray(values)
    if knots.ndim != 1 or not (np.diff(knots) >= 0).all() or not np.isfinite([knots, values]).all():
        return None
    kept = _kept(knots)
    if not kept.any():
        return None
    span = float(knots[-1] - knots[0]) or 1.0
    steps = np.array([2.0, 1.0, 1e-3]) * span
    middles = 0.5 * knots[1:] + 0.5 * knots[:-1]
    beside = [np.nextafter(knots, side).astype(knots.dtype) for side in (-np.inf, np.inf)]
    points = np.concatenate([knots, middles, *beside, knots[0] - steps, knots[-1] + steps])
    points, theirs = looked_up(eqn, knots, values, others, points)
    left, right = theirs[-6:-3], theirs[-3:]
    flat = [bool((side == side[0]).all()) for side in (left, right)]
    knots, values = knots[kept], values[kept]
    if all(flat):
        found = PiecewiseLinear.of(knots, values, (float(left[0]), float(right[0])))
    elif not any(flat):
        found = PiecewiseLinear.of(knots, values, extrapolates=True)
    else:
        return None
    return found if agree(found.values_at(points)[0], theirs, values, points.dtype) else None


def looked_up(eqn: Any, knots: Any, values: Any, others: Any, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points in the type of the argument of a call of ``jnp.interp``, and what the call says there."""
    body, aval = jex.jaxpr_as_fun(eqn.params["jaxpr"]), eqn.invars[0].aval
    # A table in float32 (made where that is all JAX has) stays one in the program, also where x is in float64.
    table = [
        np.asarray(part, to.dtype) for part, to in zip((knots, values), eqn.params["jaxpr"].in_avals[1:3], strict=True)
    ]

    @jax.vmap
    def at(t: Any) -> Any:
        return body(jnp.full(aval.shape, t, aval.dtype), *table, *others)[0].ravel()[0]

    points = points.astype(aval.dtype)
    return points, np.asarray(numpy_function(at, points)(points))


def agree(ours: np.ndarray, theirs: np.ndarray, values: np.ndarray, dtype: Any) -> bool:
    """Are these values of one function, at points of this type?"""
    scale = 1e-5 if dtype == np.float32 else 1e-11
    return bool(np.allclose(ours, theirs, rtol=scale, atol=scale * (np.abs(values).max() + 1)))
