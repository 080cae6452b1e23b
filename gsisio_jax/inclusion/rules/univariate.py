"""Exact ranges of functions of one variable, of their derivatives, and of what is left after a slope is taken off.

Every function here offers three things on an interval ``[a, b]`` (infinite ends allowed):

- ``range(a, b)``: the exact range;
- ``derivative(a, b)``: the exact range of the derivative;
- ``line(a, b)``: a slope s and the exact range of ``phi(t) - s t``.

The slope is always the derivative at some point m, so the critical points of ``phi(t) - s t`` are known without
solving anything: m itself and, where the derivative is an even function, -m. By the envelope theorem they can be held
fixed when a gradient is taken.

Rounding. Values of the function are padded by `ulps` of the table `functions`. For the rest, any slope is sound, so let
s be the number that was computed, and ``s + e`` the exact derivative at m, ``|e| <= ulps eps |s| + tiny``. The
extremes of ``phi(t) - (s + e) t`` over [a, b] lie among the points looked at, so those of ``phi(t) - s t`` differ from
the values there by at most ``|e| (b - a)``; that, the rounding of ``phi(t_i)`` and that of ``s t_i`` are what `_rest`
adds.

Source: theory 9 and 10.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.form_arithmetic import guard, scaled_slack, slope_reach
from gsisio_jax.inclusion.node import POINT_MODE, Node, best_form, chain, normalised
from gsisio_jax.inclusion.rules.sincos import LIMIT
from gsisio_jax.inclusion.rules.trig import Wave, crosses
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, choose, computed_once, entire_like
from gsisio_jax.interval.minmax import larger, smaller
from gsisio_jax.interval.primitives import fusion_barrier, times

INF = math.inf
# Below this relative width a secant is mostly rounding; the tangent at the middle is as good there.
_NARROW = 1e-3
_PLAIN = (-1.0, 0.0, 0.25, 1.0, 2.0)  # limits of functions that are numbers of any precision


def apply(curve: Any, x: Node) -> Node:
    """Apply a function of one variable to a node, in all domains."""
    x = normalised(x)
    a, b = x.range.lower, x.range.upper
    if getattr(curve, "steep", False):
        a, b = _calm(a), _calm(b)
    if isinstance(curve, Wave) and POINT_MODE.get():
        return Node(computed_once(curve.near(a, b)))
    # What range, line and derivative of a wave have in common is computed once.
    shared = (curve.parts(a, b),) if isinstance(curve, Wave) else ()
    natural = computed_once(guard(curve.range(a, b, *shared)))
    form = None
    if x.form is not None and not POINT_MODE.get():
        s, rest = curve.line(a, b, natural, *shared)
        s, rest = fusion_barrier(s), computed_once(rest)
        slope, offset = s * x.form.slope, x.form.offset
        up = s >= 0
        first, last = (times(s, jnp.where(mask, offset.lower, offset.upper)) for mask in (up, ~up))
        lower, upper, size, slack = first + rest.lower, last + rest.upper, 0, None
        if rounding.outward():
            lower = rounding.lowered(lower, abs(first) + abs(lower), 2.0)
            upper = rounding.raised(upper, abs(last) + abs(upper), 2.0)
            slack = scaled_slack(s, x.form.slope, slope, x.form.slack)
            size = slope_reach(slope, x.form.box)
        form = best_form(slope, computed_once(Interval.unchecked(lower, upper)), natural, x.form.box, slack, size)
    return Node(natural, form, None if x.jac is None else chain(guard(curve.derivative(a, b, *shared)), x.jac))


def _calm(t: Any) -> Any:
    """t, whose gradient next to 0 is 0, as it is at 0 itself: the derivative of a root is infinite there, and what
    rounding makes of a zero would come back as NaN from a product of a few of those."""
    return jnp.where(abs(t) < float(jnp.finfo(t.dtype).tiny) ** 0.25, jax.lax.stop_gradient(t), t)


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
        overflow: given the largest number of the floating type, from where on ``ends`` is used.
        ulps: bound of the error of `fn` in eps of its value, see `functions`.
        drift: what is to be added to `ulps` for an argument of that magnitude, nondecreasing.
        floor: bound of what is lost where intermediate results are flushed to zero, in smallest normal numbers.
    """

    fn: Callable[[Any], Any]
    trend: str
    ends: tuple[float, float]
    turn: float = 0.0
    domain: tuple[float, float] = (-INF, INF)
    inner: float = 0.5
    overflow: Callable[[float], float] | None = None
    ulps: float = 4.0
    drift: Callable[[Any], Any] | None = None
    floor: float = 16.0

    def at(self, t: Any) -> Any:
        """Value at t, the limit at and beyond the ends of the domain."""
        low, high = self.domain
        inside = (t > low) & (t < high)
        if self.overflow is not None:
            inside &= jnp.abs(t) < self.overflow(float(jnp.finfo(t.dtype).max))
        if self.turn == INF or self.turn == -INF:
            inside &= t != 0
        value = self.fn(jnp.where(inside, t, self.inner))
        limit = self.ends[0] if self.ends[0] == self.ends[1] else jnp.where(t < self.inner, *self.ends)
        if self.turn == INF or self.turn == -INF:
            limit = jnp.where(t == 0, self.turn, limit)
        return jnp.where(inside, value, limit)

    def range(self, a: Any, b: Any) -> Interval:
        """Exact range on ``[a, b]``, padded; everything where that interval misses the domain."""
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
        result = self._padded(result, self.ulps_on(a, b))
        low, high = self.domain
        if low > -INF or high < INF:
            result = choose((b < low) | (a > high), entire_like(pa), result)
        return result

    def ulps_on(self, a: Any, b: Any) -> Any:
        """Error of `fn` on [a, b], in eps of its value."""
        if self.drift is None:
            return self.ulps
        return jax.lax.stop_gradient(self.ulps + self.drift(jnp.maximum(abs(a), abs(b))))

    def _padded(self, exact: Interval, ulps: Any) -> Interval:
        """Outward by `ulps`, but not beyond the limits of the function where these are numbers of any precision."""
        if not rounding.outward():
            return exact
        limits = (*self.ends, self.turn) if self.trend in ("valley", "peak") else self.ends
        lowest, highest = min(limits), max(limits)
        lower, upper = exact.lower, exact.upper
        # What lies beyond the largest number is no better known than that.
        lower = rounding.overflowed(lower) if highest == INF else lower
        upper = -rounding.overflowed(-upper) if lowest == -INF else upper
        lower, upper = rounding.down(lower, ulps, self.floor), rounding.up(upper, ulps, self.floor)
        if lowest in _PLAIN:
            lower = jnp.maximum(lower, lowest)
        if highest in _PLAIN:
            upper = jnp.minimum(upper, highest)
        return Interval.unchecked(lower, upper)


def _rest(values: list[Any], ends: tuple[Any, Any], s: Any, far: Any, ulps: Any) -> Interval:
    """Extremes of ``phi(t_i) - s t_i``, padded: `ends` are phi(a) and phi(b), between which all phi(t_i) lie (or
    between 0 and them), `far` the largest of |a| and |b|."""
    rest = extremes(values)
    if not rounding.outward():
        return rest
    # 2 ulps for e (b - a) with b - a <= 2 far, two roundings, and as much again.
    size = jnp.maximum(abs(ends[0]), abs(ends[1])) + (3 * abs(s) + float(jnp.finfo(s.dtype).tiny)) * far
    return Interval.unchecked(
        rounding.lowered(rest.lower, size, ulps + 4, 32.0), rounding.raised(rest.upper, size, ulps + 4, 32.0)
    )


@dataclass(frozen=True)
class Curve:
    """A function with its derivative; ``contact`` turns a secant slope into the point of that derivative."""

    phi: Piece
    slope: Piece
    contact: Callable[[Any], Any] | None = None

    @property
    def ulps(self) -> float:
        return max(self.phi.ulps, self.slope.ulps)

    @property
    def steep(self) -> bool:
        """Has an infinite value or derivative at 0."""
        return self.phi.domain[0] == 0 or abs(self.slope.turn) == INF

    @property
    def drifts(self) -> bool:
        return self.phi.drift is not None or self.slope.drift is not None

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
            least = float(jnp.finfo(a.dtype).tiny) ** 0.25  # on shorter ones the derivative of a secant overflows
            wide = b - a > jnp.maximum(_NARROW * jnp.maximum(jnp.abs(a), jnp.abs(b)), least)
            wide &= jnp.isfinite(pa) & jnp.isfinite(pb)
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
        far = jnp.maximum(abs(a), abs(b))
        ulps = jnp.maximum(self.phi.ulps_on(a, b), self.slope.ulps_on(a, b)) if self.drifts else self.ulps
        rest = _rest(values, (pa, pb), s, far, ulps)
        return s, choose(usable, rest, natural)


@dataclass(frozen=True)
class Tangent:
    """``tan``, with its poles. Padded by `ulps`, which holds away from poles by more than rounding can hide."""

    ulps: float = 64.0

    def _inside(self, a: Any, b: Any) -> tuple[Any, Any, Any]:
        limit = LIMIT[a.dtype.name]
        whole = (abs(a) < limit) & (abs(b) < limit)
        a, b = jnp.where(whole, a, 0), jnp.where(whole, b, 0)
        lower, upper = self._blurred(a, b)
        whole &= ~crosses(np.pi / 2, np.pi, lower, upper)
        return whole, jnp.where(whole, a, 0), jnp.where(whole, b, 0)

    def _blurred(self, a: Any, b: Any) -> tuple[Any, Any]:
        """A little more than [a, b]: multiples of pi are known to that accuracy only."""
        if not rounding.outward():
            return a, b
        margin = rounding.error(jnp.maximum(abs(a), abs(b)) + 1, 16.0)
        return a - margin, b + margin

    def range(self, a: Any, b: Any) -> Interval:
        whole, a, b = self._inside(a, b)
        lower, upper = rounding.down(jnp.tan(a), self.ulps), rounding.up(jnp.tan(b), self.ulps)
        return choose(whole, Interval.unchecked(lower, upper), entire_like(a))

    def derivative(self, a: Any, b: Any) -> Interval:
        whole, a, b = self._inside(a, b)
        flat = crosses(0.0, np.pi, *self._blurred(a, b))
        steep = extremes([1 + jnp.tan(a) ** 2, 1 + jnp.tan(b) ** 2])
        lower = jnp.maximum(rounding.down(steep.lower, 2 * self.ulps + 4), 1)
        steep = Interval.unchecked(jnp.where(flat, 1, lower), rounding.up(steep.upper, 2 * self.ulps + 4))
        return choose(whole, steep, entire_like(a))

    def line(self, a: Any, b: Any, natural: Interval) -> tuple[Any, Interval]:
        whole, a, b = self._inside(a, b)
        m = 0.5 * a + 0.5 * b
        s = 1 + jnp.tan(m) ** 2
        m = jax.lax.stop_gradient(m)
        mirror = 2 * np.pi * jnp.round(m / np.pi) - m
        pm = jax.lax.stop_gradient(jnp.tan(m))
        pa, pb = jnp.tan(a), jnp.tan(b)
        first = pa - s * a
        lower, upper = self._blurred(a, b)
        inside = (lower <= mirror) & (mirror <= upper)
        values = [first, pb - s * b, pm - s * m, jnp.where(inside, -pm - s * mirror, first)]
        # The mirror image of m is off by a few eps (|m| + 1), which counts s times.
        far = jnp.maximum(abs(a), abs(b)) + 1
        return jnp.where(whole, s, 0), choose(whole, _rest(values, (pa, pb), s, far, 2 * self.ulps + 16), natural)


@dataclass(frozen=True)
class Pole:
    """``t ** -k`` for a positive integer k."""

    k: int
    steep = True

    def _side(self, a: Any, b: Any) -> tuple[Any, Any, Any, Any]:
        """Is 0 strictly inside (or all there is, as after a subnormal number was flushed), are we on the left of 0, and
        the interval of |t| (of 1 where 0 is inside)."""
        split, left = ((a < 0) & (b > 0)) | ((a == 0) & (b == 0)), b <= 0
        near, far = jnp.where(left, -b, a), jnp.where(left, -a, b)
        return split, left, jnp.where(split, 1, near), jnp.where(split, 1, far)

    def _power(self, t: Any, k: int) -> Any:
        """``t ** -k`` for t >= 0, infinite at 0, 0 at infinity."""
        inside = (t > 0) & jnp.isfinite(t)
        return jnp.where(inside, jnp.where(inside, t, 1) ** -k, jnp.where(t > 0, 0, INF))

    def _between(self, far: Any, near: Any, k: int) -> tuple[Any, Any]:
        """``far ** -k`` rounded down and ``near ** -k`` rounded up; k multiplications and a division, and as many again
        for a multiple of them."""
        low = rounding.overflowed(self._power(far, k))
        low, high = rounding.down(low, 2.0 * k + 4), rounding.up(self._power(near, k), 2.0 * k + 4)
        return jnp.maximum(low, 0), high

    def range(self, a: Any, b: Any) -> Interval:
        split, left, near, far = self._side(a, b)
        low, high = self._between(far, near, self.k)
        if self.k % 2:
            result = Interval.unchecked(jnp.where(left, -high, low), jnp.where(left, -low, high))
            return choose(split, entire_like(a), result)
        # An even pole inside: bounded below by the value at the end that is farther from 0.
        low = jnp.where(split, self._between(larger(-a, b), near, self.k)[0], low)
        return Interval.unchecked(low, jnp.where(split, INF, high))

    def derivative(self, a: Any, b: Any) -> Interval:
        split, left, near, far = self._side(a, b)
        low, high = (self.k * value for value in self._between(far, near, self.k + 1))
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
        pa, pb = a**-self.k, b**-self.k
        values = [pa - s * a, pb - s * b, jax.lax.stop_gradient(m**-self.k) - s * m]
        rest = _rest(values, (pa, pb), s, jnp.maximum(abs(a), abs(b)), 2.0 * self.k + 6)
        return s, choose(usable, rest, natural)


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
        # Narrower than this, a secant has no gradient; any slope is as good.
        cut = bent & low & high & (b - a > float(jnp.finfo(a.dtype).tiny) ** 0.25)
        a0, b0 = jnp.where(cut, a, -1), jnp.where(cut, b, 1)
        s = (b0 - self.left * a0) / (b0 - a0)
        # With one end infinite the slope of the infinite side leaves a bounded rest; with both, nothing does.
        s = jnp.where(cut, s, jnp.where(high & ~low, self.left, 1.0))
        s = jnp.where(bent, s, jnp.where(b <= 0, self.left, 1.0))
        rest_a = jnp.where(low & bent, (self.left - s) * jnp.where(low, a, 0), 0)
        rest_b = jnp.where(high & bent, (1 - s) * jnp.where(high, b, 0), 0)
        rest = extremes([rest_a, rest_b, jnp.zeros_like(rest_a)])
        if rounding.outward():
            # Linear on either side of 0, where it is 0, so only the two products round; and only where s is no integer.
            loss = jnp.where(cut, rounding.error(4 * jnp.maximum(abs(a0), abs(b0))), 0)
            rest = Interval.unchecked(rest.lower - loss, rest.upper + loss)
        both = bent & ~low & ~high
        return jnp.where(both, 0, s), choose(both, natural, rest)


class Line(NamedTuple):
    """What a function does on an interval, for `expansion`: ``|phi(t) - slope t - middle| <= half``, up to rounding.

    Attributes:
        usable: the line says something; all its numbers are finite anyway, and so are their gradients.
        slope, middle, half: the line, to nearest. Off by at most ``ulps eps (size + |slope| |t|) + floor tiny``.
        size: at least ``|phi|`` where the line is usable.
        range: bounds of phi, rounded outward.
        ulps, floor: known while tracing.
    """

    usable: Any
    slope: Any
    middle: Any
    half: Any
    size: Any
    range: Interval
    ulps: Any = 16.0
    floor: float = rounding.FLUSHED


def line_of(curve: Any, a: Any, b: Any, kappa: float) -> Line:
    """The line of any function of this module; its rest is padded already. Ranges are padded by kappa more ulps.

    Middle and half-width of the rest are rounded twice each, relative to its sides, which are ``size + |slope| |t|`` at
    most.
    """
    if getattr(curve, "steep", False):
        a, b = _calm(a), _calm(b)
    natural = guard(curve.range(a, b))
    s, rest = curve.line(a, b, natural)
    usable = (rest.lower > -INF) & (rest.upper < INF)
    low, high = jnp.where(usable, rest.lower, 0), jnp.where(usable, rest.upper, 0)
    # phi = s t + rest is no larger than the rest and s t together, which is what this bound is used with.
    size = jnp.maximum(abs(low), abs(high))
    natural = Interval.unchecked(
        rounding.down(natural.lower, kappa, rounding.FLUSHED), rounding.up(natural.upper, kappa, rounding.FLUSHED)
    )
    natural = Interval.unchecked(rounding.unbounded(natural.lower, -INF), rounding.unbounded(natural.upper, INF))
    return Line(usable, s, 0.5 * low + 0.5 * high, 0.5 * high - 0.5 * low, size, natural, 4.0)
