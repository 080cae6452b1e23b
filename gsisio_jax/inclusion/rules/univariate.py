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
the values there by at most ``|e| (b - a)``; that, the rounding of ``phi(t_i)`` and that of ``s t_i`` are what `rest_of`
adds.

Source: theory 9 and 10.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from gsisio_jax.inclusion.form_arithmetic import guard, scaled_slack, slope_magnitude
from gsisio_jax.inclusion.node import POINT_MODE, Node, best_form, chain, normalised
from gsisio_jax.inclusion.rules.trig import Wave
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, choose, computed_once, entire_like
from gsisio_jax.interval.direct import where
from gsisio_jax.interval.minmax import larger, smaller
from gsisio_jax.interval.primitives import fusion_barrier, times

INF = math.inf
# Below this relative width a secant is mostly rounding; the tangent at the middle is as good there.
_NARROW = 1e-3
_PLAIN = (-1.0, 0.0, 0.25, 1.0, 2.0)  # limits of functions that are numbers of any precision


def apply(curve: Any, x: Node) -> Node:
    """Apply a function of one variable to a node, in all domains. The result needs no `normalise`."""
    wave = isinstance(curve, Wave)  # whatever comes in, NaN too, no bound of a wave is NaN: these are not looked at
    if not wave or x.form is not None:
        x = normalised(x)
    a, b = x.range.lower, x.range.upper
    if getattr(curve, "steep", False):
        a, b = calm(a), calm(b)
    if wave and POINT_MODE.get():
        return Node(computed_once(curve.near(a, b)))
    # What range, line and derivative of a wave have in common is computed once.
    shared = (curve.parts(a, b),) if wave else ()
    natural = curve.range(a, b, *shared)
    natural = computed_once(natural if wave else guard(natural))
    form = None
    if x.form is not None and not POINT_MODE.get():
        s, rest = curve.line(a, b, natural, *shared)
        s, rest = fusion_barrier(s), computed_once(rest)
        slope, offset = s * x.form.slope, x.form.offset
        up = s >= 0
        first, last = (times(s, where(mask, offset.lower, offset.upper)) for mask in (up, ~up))
        lower, upper, size, slack = first + rest.lower, last + rest.upper, 0, None
        if rounding.outward():
            lower = rounding.lowered(lower, abs(first) + abs(lower), 2.0)
            upper = rounding.raised(upper, abs(last) + abs(upper), 2.0)
            slack = scaled_slack(s, x.form.slope, slope, x.form.slack)
            size = slope_magnitude(slope, x.form.box)
        form = best_form(slope, computed_once(Interval.unchecked(lower, upper)), natural, x.form.box, slack, size)
    if x.jac is None:
        return Node(natural, form)
    derivative = curve.derivative(a, b, *shared)
    jac = chain(derivative if wave else guard(derivative), x.jac)
    return Node(natural, form, None if jac is None else guard(jac))


def calm(t: Any) -> Any:
    """t, whose gradient next to 0 is 0, as it is at 0 itself: the derivative of a root is infinite there, and what
    rounding makes of a zero would come back as NaN from a product of a few of those."""
    return where(abs(t) < float(jnp.finfo(t.dtype).tiny) ** 0.25, jax.lax.stop_gradient(t), t)


def extremes(values: list[Any]) -> Interval:
    """Smallest and largest of several arrays."""
    lower = upper = values[0]
    for value in values[1:]:
        lower, upper = smaller(lower, value), larger(upper, value)
    return Interval.unchecked(lower, upper)


def hull_of(boxes: list[Interval]) -> Interval:
    """The smallest box that contains several boxes."""
    return Interval.unchecked(
        extremes([box.lower for box in boxes]).lower, extremes([box.upper for box in boxes]).upper
    )


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
        value = self.fn(where(inside, t, self.inner))
        limit = self.ends[0] if self.ends[0] == self.ends[1] else where(t < self.inner, *self.ends)
        if self.turn == INF or self.turn == -INF:
            limit = where(t == 0, self.turn, limit)
        return where(inside, value, limit)

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
                result = Interval.unchecked(where(turns, self.turn, result.lower), result.upper)
            else:
                result = Interval.unchecked(result.lower, where(turns, self.turn, result.upper))
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


def rest_of(values: list[Any], ends: tuple[Any, Any], s: Any, far: Any, ulps: Any) -> Interval:
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
        a, b = where(finite, a, self.phi.inner), where(finite, b, self.phi.inner)
        pa, pb = self.phi.at(a), self.phi.at(b)
        m = 0.5 * a + 0.5 * b
        even = self.slope.trend in ("valley", "peak")
        if self.contact is not None:
            least = float(jnp.finfo(a.dtype).tiny) ** 0.25  # on shorter ones the derivative of a secant overflows
            wide = b - a > jnp.maximum(_NARROW * jnp.maximum(jnp.abs(a), jnp.abs(b)), least)
            wide &= jnp.isfinite(pa) & jnp.isfinite(pb)
            secant = where(wide, pb - pa, 1.0) / where(wide, b - a, 1.0)
            # Contacts are powers of the secant: where it is extreme, they or their gradients would overflow.
            largest = float(jnp.finfo(a.dtype).max) ** 0.25
            wide &= (jnp.abs(secant) < largest) & (jnp.abs(secant) > 1 / largest)
            touch = self.contact(where(wide, secant, 1.0))
            touch = where(m < 0, -touch, touch) if even else jnp.clip(touch, a, b)
            m = where(wide, touch, m)
        s = self.slope.at(m)
        usable = finite & jnp.isfinite(s)
        s = where(usable, s, 0)
        first = pa - s * a
        values = [first, pb - s * b]
        m = jax.lax.stop_gradient(m)
        for t in (m, -m) if even else (m,):
            values.append(where((a <= t) & (t <= b), jax.lax.stop_gradient(self.phi.at(t)) - s * t, first))
        far = jnp.maximum(abs(a), abs(b))
        ulps = jnp.maximum(self.phi.ulps_on(a, b), self.slope.ulps_on(a, b)) if self.drifts else self.ulps
        rest = rest_of(values, (pa, pb), s, far, ulps)
        return s, choose(usable, rest, natural)
