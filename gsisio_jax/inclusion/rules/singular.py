"""Functions of one variable with poles or kinks: the tangent, negative integer powers, ``max(t, 0)`` and ``abs(t)``.

They offer what `univariate.Curve` does: range, derivative and line on an interval.

Source: theory 9 and 10.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.rules.sincos import LIMIT
from gsisio_jax.inclusion.rules.trig import crosses
from gsisio_jax.inclusion.rules.univariate import INF, extremes, rest_of
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, choose, entire_like
from gsisio_jax.interval.direct import where
from gsisio_jax.interval.minmax import larger


@dataclass(frozen=True)
class Tangent:
    """``tan``, with its poles. Padded by `ulps`, which holds away from poles by more than rounding can hide."""

    ulps: float = 64.0

    def _inside(self, a: Any, b: Any) -> tuple[Any, Any, Any]:
        limit = LIMIT[a.dtype.name]
        whole = (abs(a) < limit) & (abs(b) < limit)
        a, b = where(whole, a, 0), where(whole, b, 0)
        lower, upper = self._blurred(a, b)
        whole &= ~crosses(np.pi / 2, np.pi, lower, upper)
        return whole, where(whole, a, 0), where(whole, b, 0)

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
        steep = Interval.unchecked(where(flat, 1, lower), rounding.up(steep.upper, 2 * self.ulps + 4))
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
        values = [first, pb - s * b, pm - s * m, where(inside, -pm - s * mirror, first)]
        # The mirror image of m is off by a few eps (|m| + 1), which counts s times.
        far = jnp.maximum(abs(a), abs(b)) + 1
        return where(whole, s, 0), choose(whole, rest_of(values, (pa, pb), s, far, 2 * self.ulps + 16), natural)


@dataclass(frozen=True)
class Pole:
    """``t ** -k`` for a positive integer k."""

    k: int
    steep = True

    def _side(self, a: Any, b: Any) -> tuple[Any, Any, Any, Any]:
        """Is 0 strictly inside (or all there is, as after a subnormal number was flushed), are we on the left of 0, and
        the interval of |t| (of 1 where 0 is inside)."""
        split, left = ((a < 0) & (b > 0)) | ((a == 0) & (b == 0)), b <= 0
        near, far = where(left, -b, a), where(left, -a, b)
        return split, left, where(split, 1, near), where(split, 1, far)

    def _power(self, t: Any, k: int) -> Any:
        """``t ** -k`` for t >= 0, infinite at 0, 0 at infinity."""
        inside = (t > 0) & jnp.isfinite(t)
        return where(inside, where(inside, t, 1) ** -k, where(t > 0, 0, INF))

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
            result = Interval.unchecked(where(left, -high, low), where(left, -low, high))
            return choose(split, entire_like(a), result)
        # An even pole inside: bounded below by the value at the end that is farther from 0.
        low = where(split, self._between(larger(-a, b), near, self.k)[0], low)
        return Interval.unchecked(low, where(split, INF, high))

    def derivative(self, a: Any, b: Any) -> Interval:
        split, left, near, far = self._side(a, b)
        low, high = (self.k * value for value in self._between(far, near, self.k + 1))
        if self.k % 2:
            result = Interval.unchecked(-high, -low)
        else:
            result = Interval.unchecked(where(left, low, -high), where(left, high, -low))
        return choose(split, entire_like(a), result)

    def line(self, a: Any, b: Any, natural: Interval) -> tuple[Any, Interval]:
        usable = ((a > 0) | (b < 0)) & jnp.isfinite(a) & jnp.isfinite(b)
        a, b = where(usable, a, 1), where(usable, b, 1)
        m = jnp.sqrt(jnp.abs(a)) * jnp.sqrt(jnp.abs(b))  # touches where the secant of 1/t does
        m = where(b < 0, -m, m)
        s = -self.k * m ** (-self.k - 1)
        usable &= jnp.isfinite(s) & (m != 0)
        s = where(usable, s, 0)
        m = jax.lax.stop_gradient(m)
        pa, pb = a**-self.k, b**-self.k
        values = [pa - s * a, pb - s * b, jax.lax.stop_gradient(m**-self.k) - s * m]
        rest = rest_of(values, (pa, pb), s, jnp.maximum(abs(a), abs(b)), 2.0 * self.k + 6)
        return s, choose(usable, rest, natural)


@dataclass(frozen=True)
class Hinge:
    """``max(t, 0)`` or, with `left` = -1, ``abs(t)``: slope `left` before 0, slope 1 after."""

    left: float

    def _at(self, t: Any) -> Any:
        return where(t < 0, -t if self.left else jnp.zeros_like(t), t)

    def range(self, a: Any, b: Any) -> Interval:
        if not self.left:
            return Interval.unchecked(self._at(a), self._at(b))
        ends = extremes([self._at(a), self._at(b)])
        return Interval.unchecked(where((a < 0) & (b > 0), 0, ends.lower), ends.upper)

    def derivative(self, a: Any, b: Any) -> Interval:
        # The Clarke hull at 0 itself; on a box that ends there every difference quotient is that of its side.
        one = jnp.ones_like(a)
        right, left = (a > 0) | ((a == 0) & (b > 0)), (b < 0) | ((b == 0) & (a < 0))
        return Interval.unchecked(where(right, one, self.left), where(left, self.left * one, one))

    def line(self, a: Any, b: Any, natural: Interval) -> tuple[Any, Interval]:
        low, high = jnp.isfinite(a), jnp.isfinite(b)
        bent = (a < 0) & (b > 0)
        # Narrower than this, a secant has no gradient; any slope is as good.
        cut = bent & low & high & (b - a > float(jnp.finfo(a.dtype).tiny) ** 0.25)
        a0, b0 = where(cut, a, -1), where(cut, b, 1)
        s = (b0 - self.left * a0) / (b0 - a0)
        # With one end infinite the slope of the infinite side leaves a bounded rest; with both, nothing does.
        s = where(cut, s, where(high & ~low, self.left, 1.0))
        s = where(bent, s, where(b <= 0, self.left, 1.0))
        rest_a = where(low & bent, (self.left - s) * where(low, a, 0), 0)
        rest_b = where(high & bent, (1 - s) * where(high, b, 0), 0)
        rest = extremes([rest_a, rest_b, jnp.zeros_like(rest_a)])
        if rounding.outward():
            # Linear on either side of 0, where it is 0, so only the two products round; and only where s is no integer.
            loss = where(cut, rounding.error(4 * jnp.maximum(abs(a0), abs(b0))), 0)
            rest = Interval.unchecked(rest.lower - loss, rest.upper + loss)
        both = bent & ~low & ~high
        return where(both, 0, s), choose(both, natural, rest)
