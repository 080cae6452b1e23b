"""What a function of one variable is as an atom (`expansion`): a line, and how far the function is from it.

`line_of` takes the line of any curve. For the functions that most plants are made of there are lines in closed form,
with fewer operations.

**Lines in closed form.** The slope s is that of the secant, as in `Curve.line`. It is a number like any other: for a
concave phi, ``phi - s t`` is at least what it is at one of the ends, and at most ``g(s)``, its largest value anywhere,
wherever rounding has put the point of contact. So a slope that is known badly makes a rest wider, never wrong; where
the secant of a narrow interval is badly known, a mean of the derivatives takes its place.

Source: theory 9 and 10.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gsisio_jax.inclusion.form_arithmetic import guard
from gsisio_jax.inclusion.rules.functions import CUBE, CURVES, EXP, LOG, RECIPROCAL, SQRT, SQUARE
from gsisio_jax.inclusion.rules.univariate import INF, Curve, calm
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.direct import where
from gsisio_jax.interval.minmax import larger, smaller


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
        a, b = calm(a), calm(b)
    natural = guard(curve.range(a, b))
    s, rest = curve.line(a, b, natural)
    usable = (rest.lower > -INF) & (rest.upper < INF)
    low, high = where(usable, rest.lower, 0), where(usable, rest.upper, 0)
    # phi = s t + rest is no larger than the rest and s t together, which is what this bound is used with.
    size = jnp.maximum(abs(low), abs(high))
    natural = Interval.unchecked(
        rounding.down(natural.lower, kappa, rounding.FLUSHED), rounding.up(natural.upper, kappa, rounding.FLUSHED)
    )
    natural = Interval.unchecked(rounding.unbounded(natural.lower, -INF), rounding.unbounded(natural.upper, INF))
    return Line(usable, s, 0.5 * low + 0.5 * high, 0.5 * high - 0.5 * low, size, natural, 4.0)


def _limits(t: Any) -> tuple[float, float]:
    """Smallest normal number, and what gradients count as 0 (see `univariate.calm`)."""
    tiny = float(jnp.finfo(t.dtype).tiny)
    return tiny, tiny**0.25


def _positive(t: Any) -> Any:
    """t where it is positive, the smallest normal number elsewhere; a constant for gradients where it is nearly 0."""
    tiny, calm = _limits(t)
    return where(t > calm, t, jnp.maximum(jax.lax.stop_gradient(t), tiny))


def _root_line(a: Any, b: Any, kappa: float) -> Line:
    """With u and v the roots of the ends: ``s = 1 / (u + v)``, the rest is ``u v s`` at both ends and ``(u + v) / 4``
    at the point of contact. Five roundings at most, of numbers below u + v; where t is not positive the root taken is
    that of the smallest normal number, which is in the floor."""
    u, v = jnp.sqrt(_positive(a)), jnp.sqrt(_positive(b))
    below = float(jnp.finfo(a.dtype).tiny) ** -0.5
    floor = rounding.FLUSHED + 4 * below
    inside = b >= 0
    lower = jnp.maximum(rounding.down(u, 4.0 + kappa, floor), 0)
    natural = Interval.unchecked(where(inside, lower, -INF), where(inside, rounding.up(v, 4.0 + kappa, floor), INF))
    usable = inside & (v < INF)
    v = where(usable, v, 1)
    total = u + v
    s = 1 / total
    low, high = s * u * v, 0.25 * total
    return Line(usable, s, 0.5 * (high + low), 0.5 * (high - low), total, natural, 8.0, floor)


def _narrow(t: Any) -> float:
    """Below this (relative) width a secant is mostly rounding; a mean of derivatives misses it by the third power."""
    return float(jnp.finfo(t.dtype).eps) ** (1 / 3)


def _exp_line(a: Any, b: Any, kappa: float) -> Line:
    """``exp(t) - s t`` is at least ``s - s log s``, and at most what it is at one of the ends. exp and log are known to
    8 ulps: ``8 |exp| + 8 |s log s|`` and five roundings."""
    info = jnp.finfo(a.dtype)
    top, far = math.log(float(info.max)) - 1, float(info.max) ** 0.25
    usable = (a > -far) & (b < top - 29)  # then its slope does not overflow either
    a, above = jnp.minimum(jnp.maximum(a, -far), top), b >= top
    b = jnp.minimum(b, top)
    u, v = jnp.exp(a), jnp.exp(b)
    lower = jnp.maximum(rounding.down(u, 8.0 + kappa, rounding.FLUSHED), 0)
    natural = Interval.unchecked(lower, where(above, INF, rounding.up(v, 8.0 + kappa, rounding.FLUSHED)))
    u, v = where(usable, u, 1), where(usable, v, 1)
    d = b - a
    wide = d > _narrow(a)
    s = where(wide, v - u, 0.5 * (u + v)) / where(wide, d, 1)
    s = jnp.maximum(s, float(info.tiny))
    low, high = s - s * jnp.log(s), larger(u - s * a, v - s * b)
    return Line(usable, s, 0.5 * (high + low), 0.5 * (high - low), v, natural, 32.0)


def _log_line(a: Any, b: Any, kappa: float) -> Line:
    """``log t - s t`` is at most ``-1 - log s``, and at least what it is at one of the ends: 8 ulps of the logarithms,
    which are ``|phi|`` at most, and five roundings."""
    tiny, far = float(jnp.finfo(a.dtype).tiny), float(jnp.finfo(a.dtype).max) / 4
    above, known = b < far, a >= tiny
    missed, usable = b < 0, known & above
    a, b = _positive(a), _positive(where(above, b, 1))
    u, v = jnp.log(a), jnp.log(b)
    natural = Interval.unchecked(
        where(known & ~missed, rounding.down(u, 8.0 + kappa, rounding.FLUSHED), -INF),
        where(above & ~missed, rounding.up(v, 8.0 + kappa, rounding.FLUSHED), INF),
    )
    d = b - a
    wide = d > _narrow(a) * b
    s = where(wide, v - u, 1) / where(wide, d, 0.5 * (a + b))
    low, high = smaller(u - s * a, v - s * b), -1 - jnp.log(s)
    return Line(usable, s, 0.5 * (high + low), 0.5 * (high - low), abs(u) + abs(v) + 1, natural, 32.0)


def _reciprocal_line(a: Any, b: Any, kappa: float) -> Line:
    """``s = -1 / (a b)``; on the right of 0 the rest is ``1 / a + 1 / b`` at both ends and ``2 / sqrt(a b)`` at the
    point of contact. Quotients are off by an ulp and roots halve that; where they are extreme (reciprocals beyond
    ``tiny^-0.45``, or below its inverse) no line is used, so nothing underflows."""
    tiny = float(jnp.finfo(a.dtype).tiny)
    split, left = ((a < 0) & (b > 0)) | ((a == 0) & (b == 0)), b <= 0
    near, far = where(left, -b, a), where(left, -a, b)
    p, q = 1 / _positive(near), 1 / _positive(far)
    low = jnp.maximum(rounding.down(q, 4.0 + kappa, rounding.FLUSHED), 0)
    high = where(near >= tiny, rounding.up(p, 4.0 + kappa, rounding.FLUSHED), INF)
    natural = Interval.unchecked(
        where(split, -INF, where(left, -high, low)), where(split, INF, where(left, -low, high))
    )
    usable = ~split & (near > tiny**0.45) & (far < tiny**-0.45)
    p, q = where(usable, p, 1), where(usable, q, 1)
    total, touch = p + q, 2 * (jnp.sqrt(p) * jnp.sqrt(q))
    middle = 0.5 * (total + touch)
    return Line(usable, -(p * q), where(left, -middle, middle), 0.5 * (total - touch), total, natural)


def _square_line(a: Any, b: Any, kappa: float) -> Line:
    """``t^2 = 2 m t - m^2 + (t - m)^2`` around the middle. m and the half-width are off by an ulp of ``|a| + |b|``
    together: ten ulps of the larger square."""
    far = float(jnp.finfo(a.dtype).max) ** 0.5 / 4
    finite, inside = (a > -far) & (b < far), (a < 0) & (b > 0)
    a, b = jnp.maximum(a, -far), jnp.minimum(b, far)
    a, b = jnp.minimum(a, far), jnp.maximum(b, -far)
    p, q = a * a, b * b
    least, most = where(inside, 0, smaller(p, q)), larger(p, q)
    lower = jnp.maximum(rounding.down(least, 4.0 + kappa, rounding.FLUSHED), 0)
    natural = Interval.unchecked(lower, where(finite, rounding.up(most, 4.0 + kappa, rounding.FLUSHED), INF))
    m, r = 0.5 * (a + b), 0.5 * (b - a)
    half = 0.5 * (r * r)
    return Line(finite, 2 * m, half - m * m, half, most, natural, 32.0)


def _cube_line(a: Any, b: Any, kappa: float) -> Line:
    """``s = a^2 + a b + b^2``; the rest is ``-a b (a + b)`` at both ends and ``-+2 m^3`` where ``3 m^2 = s``, at m a
    minimum and at -m a maximum. Ten roundings of numbers that are three times the largest cube at most; where rounding
    takes m from one side of an end to the other, the value at the end misses that at m by the square of that."""
    far = float(jnp.finfo(a.dtype).max) ** 0.25
    low, high = a > -far, b < far
    usable = low & high
    a, b = jnp.minimum(jnp.maximum(a, -far), far), jnp.minimum(jnp.maximum(b, -far), far)
    p, q = a * a * a, b * b * b
    natural = Interval.unchecked(
        where(low, rounding.down(p, 6.0 + kappa, rounding.FLUSHED), -INF),
        where(high, rounding.up(q, 6.0 + kappa, rounding.FLUSHED), INF),
    )
    both = a * b
    s = a * a + b * b + both
    m = jnp.sqrt(jax.lax.stop_gradient(s) * (1 / 3))
    ends, touch = -(both * (a + b)), m * (m * m - s)
    low = where((a <= m) & (m <= b), smaller(ends, touch), ends)
    high = where((a <= -m) & (-m <= b), larger(ends, -touch), ends)
    return Line(usable, s, 0.5 * (high + low), 0.5 * (high - low), jnp.maximum(abs(p), abs(q)), natural, 64.0)


def _bend_line(curve: Curve) -> Callable[[Any, Any, float], Line]:
    """As `Curve.line`, of a function that rises between two numbers and bends at 0, where it is ``center``.

    ``phi - s t`` has a maximum at m and a minimum at -m. s is the derivative at m but for some ulps, so the extremes
    are off by ``ulps eps s (b - a)`` and the ulps of phi, and by six roundings.
    """
    center = 0.5 * (curve.phi.ends[0] + curve.phi.ends[1])
    ulps, contact = curve.phi.ulps + 4 * curve.slope.ulps + 16, curve.contact
    assert contact is not None

    def line(a: Any, b: Any, kappa: float) -> Line:
        far = float(jnp.finfo(a.dtype).max) ** 0.25  # values do not change any more from there on
        usable = (a > -far) & (b < far)
        a, b = jnp.minimum(jnp.maximum(a, -far), far), jnp.minimum(jnp.maximum(b, -far), far)
        u, v = curve.phi.fn(a), curve.phi.fn(b)
        share = curve.phi.ulps + kappa
        lower, upper = rounding.down(u, share, rounding.FLUSHED), rounding.up(v, share, rounding.FLUSHED)
        if curve.phi.ends[0] == 0:
            lower = jnp.maximum(lower, 0)
        natural = Interval.unchecked(lower, upper)
        d = b - a
        wide = d > jnp.maximum(1e-3 * jnp.maximum(abs(a), abs(b)), 1 / far)  # else its derivative overflows
        secant = where(wide, v - u, 1) / where(wide, d, 1)
        m = where(wide, contact(jnp.maximum(secant, 1 / far)), abs(0.5 * (a + b)))
        s = curve.slope.fn(m)
        m = jax.lax.stop_gradient(m)
        touch = jax.lax.stop_gradient(curve.phi.fn(m)) - s * m
        first, last = u - s * a, v - s * b
        low, high = smaller(first, last), larger(first, last)
        low = where((a <= -m) & (-m <= b), smaller(low, 2 * center - touch), low)
        high = where((a <= m) & (m <= b), larger(high, touch), high)
        size = jnp.maximum(abs(u), abs(v))
        return Line(usable, s, 0.5 * (high + low), 0.5 * (high - low), size, natural, ulps)

    return line


LINES: dict[Any, Callable[[Any, Any, float], Line]] = {
    SQRT: _root_line,
    EXP: _exp_line,
    LOG: _log_line,
    RECIPROCAL: _reciprocal_line,
    SQUARE: _square_line,
    CUBE: _cube_line,
    **{CURVES[name]: _bend_line(CURVES[name]) for name in ("atan", "tanh", "logistic")},
}
# Where these have no line, on a box that is infinite or misses the domain, they have no bound either.
UNBOUNDED = (SQRT, LOG, SQUARE, CUBE)
