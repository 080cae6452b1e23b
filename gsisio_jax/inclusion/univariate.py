"""Exact ranges of functions of one variable, of their derivatives, and of what is left after a slope is taken off.

Every function here offers three things on an interval ``[a, b]`` (infinite ends allowed):

- ``range(a, b)``: the exact range;
- ``derivative(a, b)``: the exact range of the derivative;
- ``line(a, b)``: a slope s and the exact range of ``phi(t) - s t``.

The slope is always the derivative at some point m, so the critical points of ``phi(t) - s t`` are known without
solving anything: m itself and, where the derivative is an even function, -m. By the envelope theorem they can be held
fixed when a gradient is taken.

Source: design 5.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.node import Node, best_form, product, shift, stretch
from gsisio_jax.interval import Interval, choose, entire_like
from gsisio_jax.ties import larger, smaller

INF = math.inf
# Below this relative width a secant is mostly rounding; the tangent at the middle is as good there.
_NARROW = 1e-3


def apply(curve: Any, x: Node) -> Node:
    """Apply a function of one variable to a node, in all domains."""
    a, b = x.range.lower, x.range.upper
    natural = curve.range(a, b)
    form = None
    if x.form is not None:
        slope, rest = curve.line(a, b, natural)
        offset = shift(stretch(slope, x.form.offset), rest)
        form = best_form(slope * x.form.slope, offset, natural, x.form.box)
    jac = None if x.jac is None else product(curve.derivative(a, b), x.jac)
    return Node(natural, form, jac)


def extremes(values: list[Any]) -> Interval:
    """Smallest and largest of several arrays."""
    lower = upper = values[0]
    for value in values[1:]:
        lower, upper = smaller(lower, value), larger(upper, value)
    return Interval.unchecked(lower, upper)


@dataclass(frozen=True)
class Piece:
    """A continuous function on an interval of the line, monotone or with one turning point at 0.

    Attributes:
        fn: the function.
        trend: "up", "down", "valley" (turns at 0, a minimum) or "peak".
        ends: limits at both ends of the domain.
        turn: value at 0, for a valley or a peak.
        domain: where the function is defined.
        inner: a point inside the domain, evaluated in place of points outside so that gradients stay finite.
        reach: given the largest number of the floating type, from where on ``ends`` is used.
    """

    fn: Callable[[Any], Any]
    trend: str
    ends: tuple[float, float]
    turn: float = 0.0
    domain: tuple[float, float] = (-INF, INF)
    inner: float = 0.5
    reach: Callable[[float], float] | None = None

    def at(self, t: Any) -> Any:
        """Value at t, the limit at and beyond the ends of the domain."""
        low, high = self.domain
        inside = (t > low) & (t < high)
        if self.reach is not None:
            inside &= jnp.abs(t) < self.reach(float(jnp.finfo(t.dtype).max))
        if self.turn == INF or self.turn == -INF:
            inside &= t != 0
        value = self.fn(jnp.where(inside, t, self.inner))
        limit = self.ends[0] if self.ends[0] == self.ends[1] else jnp.where(t < self.inner, *self.ends)
        if self.turn == INF or self.turn == -INF:
            limit = jnp.where(t == 0, self.turn, limit)
        return jnp.where(inside, value, limit)

    def range(self, a: Any, b: Any) -> Interval:
        """Exact range on ``[a, b]``; everything where that interval misses the domain."""
        pa, pb = self.at(a), self.at(b)
        if self.trend == "up":
            result = Interval.unchecked(pa, pb)
        elif self.trend == "down":
            result = Interval.unchecked(pb, pa)
        else:
            result, turns = extremes([pa, pb]), (a < 0) & (b > 0)
            if self.trend == "valley":
                result = Interval.unchecked(jnp.where(turns, self.turn, result.lower), result.upper)
            else:
                result = Interval.unchecked(result.lower, jnp.where(turns, self.turn, result.upper))
        low, high = self.domain
        if low > -INF or high < INF:
            result = choose((b < low) | (a > high), entire_like(pa), result)
        return result


@dataclass(frozen=True)
class Curve:
    """A function with its derivative; ``contact`` turns a secant slope into the point of that derivative."""

    phi: Piece
    slope: Piece
    contact: Callable[[Any], Any] | None = None

    def range(self, a: Any, b: Any) -> Interval:
        return self.phi.range(a, b)

    def derivative(self, a: Any, b: Any) -> Interval:
        return self.slope.range(a, b)

    def line(self, a: Any, b: Any, natural: Interval) -> tuple[Any, Interval]:
        low, high = self.phi.domain
        a, b = larger(a, low), smaller(b, high)
        finite = jnp.isfinite(a) & jnp.isfinite(b) & (a <= b)
        a, b = jnp.where(finite, a, self.phi.inner), jnp.where(finite, b, self.phi.inner)
        pa, pb = self.phi.at(a), self.phi.at(b)
        m = 0.5 * a + 0.5 * b
        even = self.slope.trend in ("valley", "peak")
        if self.contact is not None:
            wide = (b - a > _NARROW * jnp.maximum(jnp.abs(a), jnp.abs(b))) & jnp.isfinite(pa) & jnp.isfinite(pb)
            secant = jnp.where(wide, pb - pa, 1.0) / jnp.where(wide, b - a, 1.0)
            # Contacts are powers of the secant: where it is extreme, they or their gradients would overflow.
            largest = float(jnp.finfo(a.dtype).max) ** 0.25
            wide &= (jnp.abs(secant) < largest) & (jnp.abs(secant) > 1 / largest)
            touch = self.contact(jnp.where(wide, secant, 1.0))
            touch = jnp.where(m < 0, -touch, touch) if even else jnp.clip(touch, a, b)
            m = jnp.where(wide, touch, m)
        s = self.slope.at(m)
        usable = finite & jnp.isfinite(s)
        s = jnp.where(usable, s, 0)
        first = pa - s * a
        values = [first, pb - s * b]
        m = jax.lax.stop_gradient(m)
        for t in (m, -m) if even else (m,):
            values.append(jnp.where((a <= t) & (t <= b), jax.lax.stop_gradient(self.phi.at(t)) - s * t, first))
        return s, choose(usable, extremes(values), natural)


@dataclass(frozen=True)
class Wave:
    """``sin`` or ``cos``: crests at ``crest + 2 k pi``.

    Everything follows from the middle m and the half-width r alone: ``phi(m + h) = phi(m) cos h + phi'(m) sin h``.
    Range and line then share four sines and cosines, which are what a wave costs.
    """

    fn: Callable[[Any], Any]
    slope: Callable[[Any], Any]
    crest: float
    slope_crest: float

    def range(self, a: Any, b: Any) -> Interval:
        return _wave_range(self.fn, self.slope, self.crest, a, b)

    def derivative(self, a: Any, b: Any) -> Interval:
        return _wave_range(self.slope, lambda t: -self.fn(t), self.slope_crest, a, b)

    def line(self, a: Any, b: Any, natural: Interval) -> tuple[Any, Interval]:
        usable = b - a < 2 * np.pi
        m, r = _middle(usable, a, b)
        value, steepness = self.fn(m), self.slope(m)
        half_sin, half_cos = jnp.sin(0.5 * r), jnp.cos(0.5 * r)
        # With slope phi'(m) cos(r/2) the odd part of the rest, sin h - h cos(r/2), has its critical points at
        # +-r/2. It is then four times smaller than with the tangent, and no arccosine is needed.
        s = steepness * half_cos
        odd = jnp.abs(steepness) * larger(half_sin - 0.5 * r * half_cos, half_cos * (r - 2 * half_sin))
        even = value * (2 * half_cos**2 - 1)
        rest = Interval.unchecked(smaller(value, even) - odd - s * m, larger(value, even) + odd - s * m)
        return jnp.where(usable, s, 0), choose(usable, rest, natural)


def _middle(usable: Any, a: Any, b: Any) -> tuple[Any, Any]:
    """Middle and half-width, 0 where they are not usable."""
    a, b = jnp.where(usable, a, 0), jnp.where(usable, b, 0)
    return 0.5 * a + 0.5 * b, 0.5 * b - 0.5 * a


def _crosses(phase: float, period: float, a: Any, b: Any) -> Any:
    """Does ``[a, b]`` contain ``phase + k period``?"""
    return jnp.ceil((a - phase) / period) <= (b - phase) / period


def _wave_range(fn: Callable[[Any], Any], slope: Callable[[Any], Any], crest: float, a: Any, b: Any) -> Interval:
    usable = b - a < 2 * np.pi
    m, r = _middle(usable, a, b)
    half_sin, half_cos = jnp.sin(0.5 * r), jnp.cos(0.5 * r)
    even, odd = fn(m) * (2 * half_cos**2 - 1), jnp.abs(slope(m)) * 2 * half_sin * half_cos
    a, b = m - r, m + r
    top = ~usable | _crosses(crest, 2 * np.pi, a, b)
    bottom = ~usable | _crosses(crest + np.pi, 2 * np.pi, a, b)
    return Interval.unchecked(jnp.where(bottom, -1, even - odd), jnp.where(top, 1, even + odd))


@dataclass(frozen=True)
class Tangent:
    """``tan``, with its poles."""

    def _inside(self, a: Any, b: Any) -> tuple[Any, Any, Any]:
        whole = jnp.isfinite(a) & jnp.isfinite(b)
        a, b = jnp.where(whole, a, 0), jnp.where(whole, b, 0)
        whole &= ~_crosses(np.pi / 2, np.pi, a, b)
        return whole, jnp.where(whole, a, 0), jnp.where(whole, b, 0)

    def range(self, a: Any, b: Any) -> Interval:
        whole, a, b = self._inside(a, b)
        return choose(whole, Interval.unchecked(jnp.tan(a), jnp.tan(b)), entire_like(a))

    def derivative(self, a: Any, b: Any) -> Interval:
        whole, a, b = self._inside(a, b)
        flat = _crosses(0.0, np.pi, a, b)
        steep = extremes([1 + jnp.tan(a) ** 2, 1 + jnp.tan(b) ** 2])
        steep = Interval.unchecked(jnp.where(flat, 1, steep.lower), steep.upper)
        return choose(whole, steep, entire_like(a))

    def line(self, a: Any, b: Any, natural: Interval) -> tuple[Any, Interval]:
        whole, a, b = self._inside(a, b)
        m = 0.5 * a + 0.5 * b
        s = 1 + jnp.tan(m) ** 2
        m = jax.lax.stop_gradient(m)
        mirror = 2 * np.pi * jnp.round(m / np.pi) - m
        pm = jax.lax.stop_gradient(jnp.tan(m))
        first = jnp.tan(a) - s * a
        inside = (a <= mirror) & (mirror <= b)
        values = [first, jnp.tan(b) - s * b, pm - s * m, jnp.where(inside, -pm - s * mirror, first)]
        return jnp.where(whole, s, 0), choose(whole, extremes(values), natural)


@dataclass(frozen=True)
class Pole:
    """``t ** -k`` for a positive integer k."""

    k: int

    def _side(self, a: Any, b: Any) -> tuple[Any, Any, Any, Any]:
        """Is 0 strictly inside, are we on the left of 0, and the interval of |t| (of 1 where 0 is inside)."""
        split, left = (a < 0) & (b > 0), b <= 0
        near, far = jnp.where(left, -b, a), jnp.where(left, -a, b)
        return split, left, jnp.where(split, 1, near), jnp.where(split, 1, far)

    def _power(self, t: Any, k: int) -> Any:
        """``t ** -k`` for t >= 0, infinite at 0, 0 at infinity."""
        inside = (t > 0) & jnp.isfinite(t)
        return jnp.where(inside, jnp.where(inside, t, 1) ** -k, jnp.where(t > 0, 0, INF))

    def range(self, a: Any, b: Any) -> Interval:
        split, left, near, far = self._side(a, b)
        low, high = self._power(far, self.k), self._power(near, self.k)
        if self.k % 2:
            result = Interval.unchecked(jnp.where(left, -high, low), jnp.where(left, -low, high))
            return choose(split, entire_like(a), result)
        # An even pole inside: bounded below by the value at the end that is farther from 0.
        far = larger(-a, b)
        return Interval.unchecked(jnp.where(split, self._power(far, self.k), low), jnp.where(split, INF, high))

    def derivative(self, a: Any, b: Any) -> Interval:
        split, left, near, far = self._side(a, b)
        low, high = self.k * self._power(far, self.k + 1), self.k * self._power(near, self.k + 1)
        if self.k % 2:
            result = Interval.unchecked(-high, -low)
        else:
            result = Interval.unchecked(jnp.where(left, low, -high), jnp.where(left, high, -low))
        return choose(split, entire_like(a), result)

    def line(self, a: Any, b: Any, natural: Interval) -> tuple[Any, Interval]:
        usable = ((a > 0) | (b < 0)) & jnp.isfinite(a) & jnp.isfinite(b)
        a, b = jnp.where(usable, a, 1), jnp.where(usable, b, 1)
        m = jnp.sqrt(jnp.abs(a)) * jnp.sqrt(jnp.abs(b))  # touches where the secant of 1/t does
        m = jnp.where(b < 0, -m, m)
        s = -self.k * m ** (-self.k - 1)
        usable &= jnp.isfinite(s) & (m != 0)
        s = jnp.where(usable, s, 0)
        m = jax.lax.stop_gradient(m)
        values = [a**-self.k - s * a, b**-self.k - s * b, jax.lax.stop_gradient(m**-self.k) - s * m]
        return s, choose(usable, extremes(values), natural)


@dataclass(frozen=True)
class Hinge:
    """``max(t, 0)`` or, with `left` = -1, ``abs(t)``: slope `left` before 0, slope 1 after."""

    left: float

    def _at(self, t: Any) -> Any:
        return jnp.where(t < 0, -t if self.left else jnp.zeros_like(t), t)

    def range(self, a: Any, b: Any) -> Interval:
        if not self.left:
            return Interval.unchecked(self._at(a), self._at(b))
        ends = extremes([self._at(a), self._at(b)])
        return Interval.unchecked(jnp.where((a < 0) & (b > 0), 0, ends.lower), ends.upper)

    def derivative(self, a: Any, b: Any) -> Interval:
        # At 0 itself the function has no derivative: the Clarke hull.
        one = jnp.ones_like(a)
        return Interval.unchecked(jnp.where(a > 0, one, self.left), jnp.where(b < 0, self.left * one, one))

    def line(self, a: Any, b: Any, natural: Interval) -> tuple[Any, Interval]:
        low, high = jnp.isfinite(a), jnp.isfinite(b)
        bent = (a < 0) & (b > 0)
        cut = bent & low & high
        a0, b0 = jnp.where(cut, a, -1), jnp.where(cut, b, 1)
        s = (b0 - self.left * a0) / (b0 - a0)
        # With one end infinite the slope of the infinite side leaves a bounded rest; with both, nothing does.
        s = jnp.where(cut, s, jnp.where(high & ~low, self.left, 1.0))
        s = jnp.where(bent, s, jnp.where(b <= 0, self.left, 1.0))
        rest_a = jnp.where(low & bent, (self.left - s) * jnp.where(low, a, 0), 0)
        rest_b = jnp.where(high & bent, (1 - s) * jnp.where(high, b, 0), 0)
        rest = extremes([rest_a, rest_b, jnp.zeros_like(rest_a)])
        both = bent & ~low & ~high
        return jnp.where(both, 0, s), choose(both, natural, rest)
