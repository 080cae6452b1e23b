"""The functions of one variable, each with its derivative and the limits of both at the ends of the domain.

The last entry of a curve, its contact, inverts the derivative: the secant slope of an interval gives the point where
a parallel line touches the curve, and the slope there makes the rest smallest. Where it is missing, or the interval
is too narrow for a secant, the middle of the interval serves.

**Accuracy.** XLA promises none, so what a library function may be off by is known by sampling only: each value and each
derivative below was compared with ball arithmetic (python-flint, 256 bits) at random points of all magnitudes, ends of
domains and turning points, in both precisions and with two settings of XLA's optimizer (`tests/rounding/`, repeated at
every release of JAX). The largest errors seen on CPU with jax 0.10, in eps of the value (float64, float32), and `ulps`:

    function       value         derivative   ulps   |  function       value         derivative   ulps
    exp            1.1  0.7      1.1  0.7     8      |  logistic       1.1  1.1      1.9  1.9     8
    log            0.5  0.9      0.5  0.5     8      |  erf            0.7  1.8      .42 t^2      8 (derivative 8 + t^2)
    sqrt, rsqrt    0.5  0.5      0.6  0.6     4      |  erfc           .42 t^2       .42 t^2      16 + t^2
    exp2           .43 |t|       .43 |t|      8 + |t| |  atan           0.5  0.6      0.8  0.8     8
    expm1          2.6  2.5      1.1  0.7     16     |  asin, acos     1.1  1.3      0.9  1.0     8
    log1p          126  1.6      0.8  0.8     512    |  asinh, acosh   1.7  1.9      1.5  1.5     8
    sinh, cosh     .41 |t|       .45 |t|      16 + |t| |  atanh          66   1.3      1.3  1.3     512
    tanh           3.6  2.0      1.9  1.8     16     |  cbrt           33   0.8      70   2.3     128 (512)
    t^k            k/2           k/2          k + 4  |  t^p            0.5  0.7      1.1  1.0     16 (p < 1/2: 1024)
    softplus       1.5  1.9      1.2  1.0     512    |  sine, cosine   proved, see `sincos`

The margin is a factor of two where an error grows with the argument and is understood (a rounded factor of the
exponent), and four or more elsewhere. sqrt is IEEE's. tan, arctan2 and logaddexp have 64, 16 and 512.

Source: theory 9 and 10.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from gsisio_jax.inclusion.rules.trig import Wave
from gsisio_jax.inclusion.rules.univariate import INF, Curve, Hinge, Line, Piece, Pole, Tangent
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.minmax import larger, smaller


def _root(t: Any) -> Any:
    """Square root, 0 with derivative 0 at and below 0."""
    return jnp.where(t > 0, jnp.sqrt(jnp.where(t > 0, t, 1)), 0)


def _cube_root(t: Any) -> Any:
    """Cube root, with derivative 0 at 0 where it is infinite."""
    return jnp.where(t == 0, 0, jnp.cbrt(jnp.where(t == 0, 1, t)))


def _log(t: Any) -> Any:
    """Logarithm of a slope that cannot be negative but may have underflowed or overflowed."""
    tiny = jnp.finfo(t.dtype).tiny
    return jnp.log(jnp.clip(t, tiny, 1 / tiny))


def _over(t: Any) -> Any:
    """``1 / t``, finite."""
    tiny = jnp.finfo(t.dtype).tiny
    return 1 / jnp.where(jnp.abs(t) > tiny, t, tiny)


def _logit_contact(s: Any) -> Any:
    q = 0.5 * (1 + _root(1 - 4 * s))
    return _log(q) - _log(1 - q)


_LOG2 = math.log(2)
_HALF_PI = math.pi / 2
_ERF = 2 / math.sqrt(math.pi)


def _log_max(largest: float) -> float:
    return math.log(largest)


def _linear_drift(t: Any) -> Any:
    """Of exponentials of a rounded multiple of t; beyond 1100 they are 0 or infinite in either precision."""
    return jnp.minimum(t, 1100.0)


def _square_drift(t: Any) -> Any:
    """Of ``exp(-t^2)``, where t^2 is rounded."""
    return jnp.minimum(jnp.square(jnp.minimum(t, 30.0)), 800.0)


def _inverse_root(t: Any, square: Any) -> Any:
    """``1 / sqrt(square)`` for ``square = t^2 +- 1``, which overflows long before its inverse root vanishes."""
    far = abs(t) > (2.0**30 if t.dtype == jnp.float64 else 2.0**15)
    return jnp.where(far, 1 / jnp.where(far, abs(t), 1), jax.lax.rsqrt(jnp.where(far, 1, square)))


POSITIVE, UNIT = (0.0, INF), (-1.0, 1.0)
RELU, ABS, RECIPROCAL = Hinge(0.0), Hinge(-1.0), Pole(1)
SIN, COS = Wave(False), Wave(True)
TAN = Tangent()

SQUARE = Curve(Piece(jnp.square, "valley", (INF, INF)), Piece(lambda t: 2 * t, "up", (-INF, INF)))
_GROWTH = Piece(jnp.exp, "up", (0.0, INF), overflow=_log_max, ulps=8.0)
EXP = Curve(_GROWTH, _GROWTH, _log)
LOG = Curve(
    Piece(jnp.log, "up", (-INF, INF), domain=POSITIVE, ulps=8.0),
    Piece(lambda t: 1 / t, "down", (INF, 0.0), domain=POSITIVE),
    _over,
)
SQRT = Curve(
    Piece(jnp.sqrt, "up", (0.0, INF), domain=POSITIVE),
    Piece(lambda t: 0.5 * jax.lax.rsqrt(t), "down", (INF, 0.0), domain=POSITIVE),
    lambda s: 0.25 * _over(s) * _over(s),
)

SOFTPLUS = Curve(
    Piece(jax.nn.softplus, "up", (0.0, INF), ulps=512.0),
    Piece(jax.nn.sigmoid, "up", (0.0, 1.0), ulps=8.0),
    lambda s: _log(s) - _log(1 - s),
)


@functools.cache
def power(p: float) -> Any:
    """``t ** p``: all t for an integer p, t >= 0 otherwise."""
    if p == int(p) and p < 0:
        return Pole(int(-p))
    if p == 2:
        return SQUARE

    q = p - 1.0

    def overflow(largest: float) -> float:
        return largest ** (1 / p) if p > 1 else INF

    def slope_overflow(largest: float) -> float:
        return (largest / p) ** (1 / q) if q > 0 else INF

    if p == int(p):
        p, q = int(p), int(p) - 1
        even = p % 2 == 0
        phi = Piece(
            lambda t: jax.lax.integer_pow(t, p),
            "valley" if even else "up",
            (INF if even else -INF, INF),
            overflow=overflow,
            ulps=p + 4.0,
        )
        slope = Piece(
            lambda t: p * jax.lax.integer_pow(t, q),
            "up" if even else "valley",
            (-INF if even else INF, INF),
            overflow=slope_overflow,
            ulps=p + 4.0,
            floor=p + 16.0,
        )

        def contact(s: Any) -> Any:
            size = jnp.exp(_log(jnp.abs(s) / p) / q)
            return jnp.sign(s) * size if even else size

        return Curve(phi, slope, contact)

    # Where p - 1 is no floating number, its rounding counts as often as log t is large.
    ulps = 16.0 if p >= 0.5 else 1024.0
    ends = (0.0, INF) if p > 0 else (INF, 0.0)
    phi = Piece(lambda t: t**p, "up" if p > 0 else "down", ends, domain=POSITIVE, overflow=overflow, ulps=16.0)
    bend = (0.0, INF) if q > 0 else ((INF, 0.0) if p > 0 else (-INF, 0.0))
    trend = "up" if q > 0 or p < 0 else "down"
    slope = Piece(lambda t: p * t**q, trend, bend, domain=POSITIVE, overflow=slope_overflow, ulps=ulps)
    return Curve(phi, slope, lambda s: jnp.exp(_log(s / p) / q))


CUBE = power(3.0)
_SINH = Piece(jnp.sinh, "up", (-INF, INF), overflow=_log_max, ulps=16.0, drift=_linear_drift)
_COSH = Piece(jnp.cosh, "valley", (INF, INF), 1.0, overflow=_log_max, ulps=16.0, drift=_linear_drift)

CURVES: dict[str, Any] = {
    "sin": SIN,
    "cos": COS,
    "tan": TAN,
    "abs": ABS,
    "square": SQUARE,
    "exp": EXP,
    "log": LOG,
    "sqrt": SQRT,
    "rsqrt": power(-0.5),
    "exp2": Curve(
        Piece(jnp.exp2, "up", (0.0, INF), overflow=math.log2, ulps=8.0, drift=_linear_drift),
        Piece(lambda t: _LOG2 * jnp.exp2(t), "up", (0.0, INF), overflow=math.log2, ulps=8.0, drift=_linear_drift),
        lambda s: _log(s / _LOG2) / _LOG2,
    ),
    "expm1": Curve(Piece(jnp.expm1, "up", (-1.0, INF), overflow=_log_max, ulps=16.0), _GROWTH, _log),
    "log1p": Curve(
        Piece(jnp.log1p, "up", (-INF, INF), domain=(-1.0, INF), ulps=512.0),
        Piece(lambda t: 1 / (1 + t), "down", (INF, 0.0), domain=(-1.0, INF)),
        lambda s: _over(s) - 1,
    ),
    "sinh": Curve(
        _SINH,
        _COSH,
        lambda s: jnp.arcsinh(_root(s * s - 1)),
    ),
    "cosh": Curve(
        _COSH,
        _SINH,
        jnp.arcsinh,
    ),
    "tanh": Curve(
        Piece(jnp.tanh, "up", (-1.0, 1.0), ulps=16.0),
        # 1 - tanh^2, without the cancellation.
        Piece(lambda t: 4 * jax.nn.sigmoid(2 * t) * jax.nn.sigmoid(-2 * t), "peak", (0.0, 0.0), 1.0, ulps=16.0),
        lambda s: 0.5 * (_log(1 + _root(1 - s)) - _log(1 - _root(1 - s))),
    ),
    "logistic": Curve(
        Piece(jax.nn.sigmoid, "up", (0.0, 1.0), ulps=8.0),
        Piece(lambda t: jax.nn.sigmoid(t) * jax.nn.sigmoid(-t), "peak", (0.0, 0.0), 0.25, ulps=16.0),
        _logit_contact,
    ),
    "erf": Curve(
        Piece(jax.lax.erf, "up", (-1.0, 1.0), ulps=8.0),
        Piece(lambda t: _ERF * jnp.exp(-t * t), "peak", (0.0, 0.0), _ERF, ulps=16.0, drift=_square_drift),
        lambda s: _root(-_log(s / _ERF)),
    ),
    "erfc": Curve(
        Piece(jax.lax.erfc, "down", (2.0, 0.0), ulps=16.0, drift=_square_drift),
        Piece(lambda t: -_ERF * jnp.exp(-t * t), "valley", (0.0, 0.0), -_ERF, ulps=16.0, drift=_square_drift),
        lambda s: _root(-_log(-s / _ERF)),
    ),
    "atan": Curve(
        Piece(jnp.arctan, "up", (-_HALF_PI, _HALF_PI), ulps=8.0),
        Piece(lambda t: 1 / (1 + t * t), "peak", (0.0, 0.0), 1.0, ulps=8.0),
        lambda s: _root(_over(s) - 1),
    ),
    "asin": Curve(
        Piece(jnp.arcsin, "up", (-_HALF_PI, _HALF_PI), domain=UNIT, ulps=8.0),
        Piece(lambda t: jax.lax.rsqrt((1 - t) * (1 + t)), "valley", (INF, INF), 1.0, domain=UNIT, ulps=8.0),
        lambda s: _root(1 - _over(s) ** 2),
    ),
    "acos": Curve(
        Piece(jnp.arccos, "down", (math.pi, 0.0), domain=UNIT, ulps=8.0),
        Piece(lambda t: -jax.lax.rsqrt((1 - t) * (1 + t)), "peak", (-INF, -INF), -1.0, domain=UNIT, ulps=8.0),
        lambda s: _root(1 - _over(s) ** 2),
    ),
    "asinh": Curve(
        Piece(jnp.arcsinh, "up", (-INF, INF), ulps=8.0),
        Piece(lambda t: _inverse_root(t, 1 + t * t), "peak", (0.0, 0.0), 1.0, ulps=8.0),
        lambda s: _root(_over(s) ** 2 - 1),
    ),
    "acosh": Curve(
        Piece(jnp.arccosh, "up", (0.0, INF), domain=(1.0, INF), inner=2.0, ulps=8.0),
        Piece(
            lambda t: _inverse_root(t, (t - 1) * (t + 1)),
            "down",
            (INF, 0.0),
            domain=(1.0, INF),
            inner=2.0,
            ulps=8.0,
        ),
        lambda s: _root(_over(s) ** 2 + 1),
    ),
    "atanh": Curve(
        Piece(jnp.arctanh, "up", (-INF, INF), domain=UNIT, ulps=512.0),
        Piece(lambda t: 1 / ((1 - t) * (1 + t)), "valley", (INF, INF), 1.0, domain=UNIT, ulps=8.0),
        lambda s: _root(1 - _over(s)),
    ),
    "cbrt": Curve(
        Piece(_cube_root, "up", (-INF, INF), ulps=128.0),
        Piece(lambda t: 1 / (3 * jnp.square(jnp.cbrt(t))), "peak", (0.0, 0.0), INF, ulps=512.0),
        lambda s: _over(3 * s) * _root(_over(3 * s)),
    ),
}


# Lines in closed form -----------------------------------------------------------------------------------------------
# The slope s is that of the secant, as in `Curve.line`. It is a number like any other: for a concave phi, ``phi - s t``
# is at least what it is at one of the ends, and at most ``g(s)``, its largest value anywhere, wherever rounding has put
# the point of contact. So a slope that is known badly makes a rest wider, never wrong; where the secant of a narrow
# interval is badly known, a mean of the derivatives takes its place.


def _limits(t: Any) -> tuple[float, float]:
    """Smallest normal number, and what gradients count as 0 (see `univariate._calm`)."""
    tiny = float(jnp.finfo(t.dtype).tiny)
    return tiny, tiny**0.25


def _positive(t: Any) -> Any:
    """t where it is positive, the smallest normal number elsewhere; a constant for gradients where it is nearly 0."""
    tiny, calm = _limits(t)
    return jnp.where(t > calm, t, jnp.maximum(jax.lax.stop_gradient(t), tiny))


def _root_line(a: Any, b: Any, kappa: float) -> Line:
    """With u and v the roots of the ends: ``s = 1 / (u + v)``, the rest is ``u v s`` at both ends and ``(u + v) / 4``
    at the point of contact. Five roundings at most, of numbers below u + v; where t is not positive the root taken is
    that of the smallest normal number, which is in the floor."""
    u, v = jnp.sqrt(_positive(a)), jnp.sqrt(_positive(b))
    below = float(jnp.finfo(a.dtype).tiny) ** -0.5
    floor = rounding.FLUSHED + 4 * below
    inside = b >= 0
    lower = jnp.maximum(rounding.down(u, 4.0 + kappa, floor), 0)
    natural = Interval.unchecked(
        jnp.where(inside, lower, -INF), jnp.where(inside, rounding.up(v, 4.0 + kappa, floor), INF)
    )
    usable = inside & (v < INF)
    v = jnp.where(usable, v, 1)
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
    natural = Interval.unchecked(lower, jnp.where(above, INF, rounding.up(v, 8.0 + kappa, rounding.FLUSHED)))
    u, v = jnp.where(usable, u, 1), jnp.where(usable, v, 1)
    d = b - a
    wide = d > _narrow(a)
    s = jnp.where(wide, v - u, 0.5 * (u + v)) / jnp.where(wide, d, 1)
    s = jnp.maximum(s, float(info.tiny))
    low, high = s - s * jnp.log(s), larger(u - s * a, v - s * b)
    return Line(usable, s, 0.5 * (high + low), 0.5 * (high - low), v, natural, 32.0)


def _log_line(a: Any, b: Any, kappa: float) -> Line:
    """``log t - s t`` is at most ``-1 - log s``, and at least what it is at one of the ends: 8 ulps of the logarithms,
    which are ``|phi|`` at most, and five roundings."""
    tiny, far = float(jnp.finfo(a.dtype).tiny), float(jnp.finfo(a.dtype).max) / 4
    above, known = b < far, a >= tiny
    missed, usable = b < 0, known & above
    a, b = _positive(a), _positive(jnp.where(above, b, 1))
    u, v = jnp.log(a), jnp.log(b)
    natural = Interval.unchecked(
        jnp.where(known & ~missed, rounding.down(u, 8.0 + kappa, rounding.FLUSHED), -INF),
        jnp.where(above & ~missed, rounding.up(v, 8.0 + kappa, rounding.FLUSHED), INF),
    )
    d = b - a
    wide = d > _narrow(a) * b
    s = jnp.where(wide, v - u, 1) / jnp.where(wide, d, 0.5 * (a + b))
    low, high = smaller(u - s * a, v - s * b), -1 - jnp.log(s)
    return Line(usable, s, 0.5 * (high + low), 0.5 * (high - low), abs(u) + abs(v) + 1, natural, 32.0)


def _reciprocal_line(a: Any, b: Any, kappa: float) -> Line:
    """``s = -1 / (a b)``; on the right of 0 the rest is ``1 / a + 1 / b`` at both ends and ``2 / sqrt(a b)`` at the
    point of contact. Quotients are off by an ulp and roots halve that; where they are extreme (reciprocals beyond
    ``tiny^-0.45``, or below its inverse) no line is used, so nothing underflows."""
    tiny = float(jnp.finfo(a.dtype).tiny)
    split, left = ((a < 0) & (b > 0)) | ((a == 0) & (b == 0)), b <= 0
    near, far = jnp.where(left, -b, a), jnp.where(left, -a, b)
    p, q = 1 / _positive(near), 1 / _positive(far)
    low = jnp.maximum(rounding.down(q, 4.0 + kappa, rounding.FLUSHED), 0)
    high = jnp.where(near >= tiny, rounding.up(p, 4.0 + kappa, rounding.FLUSHED), INF)
    natural = Interval.unchecked(
        jnp.where(split, -INF, jnp.where(left, -high, low)), jnp.where(split, INF, jnp.where(left, -low, high))
    )
    usable = ~split & (near > tiny**0.45) & (far < tiny**-0.45)
    p, q = jnp.where(usable, p, 1), jnp.where(usable, q, 1)
    total, touch = p + q, 2 * (jnp.sqrt(p) * jnp.sqrt(q))
    middle = 0.5 * (total + touch)
    return Line(usable, -(p * q), jnp.where(left, -middle, middle), 0.5 * (total - touch), total, natural)


def _square_line(a: Any, b: Any, kappa: float) -> Line:
    """``t^2 = 2 m t - m^2 + (t - m)^2`` around the middle. m and the half-width are off by an ulp of ``|a| + |b|``
    together: ten ulps of the larger square."""
    far = float(jnp.finfo(a.dtype).max) ** 0.5 / 4
    finite, inside = (a > -far) & (b < far), (a < 0) & (b > 0)
    a, b = jnp.maximum(a, -far), jnp.minimum(b, far)
    a, b = jnp.minimum(a, far), jnp.maximum(b, -far)
    p, q = a * a, b * b
    least, most = jnp.where(inside, 0, smaller(p, q)), larger(p, q)
    lower = jnp.maximum(rounding.down(least, 4.0 + kappa, rounding.FLUSHED), 0)
    natural = Interval.unchecked(lower, jnp.where(finite, rounding.up(most, 4.0 + kappa, rounding.FLUSHED), INF))
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
        jnp.where(low, rounding.down(p, 6.0 + kappa, rounding.FLUSHED), -INF),
        jnp.where(high, rounding.up(q, 6.0 + kappa, rounding.FLUSHED), INF),
    )
    both = a * b
    s = a * a + b * b + both
    m = jnp.sqrt(jax.lax.stop_gradient(s) * (1 / 3))
    ends, touch = -(both * (a + b)), m * (m * m - s)
    low = jnp.where((a <= m) & (m <= b), smaller(ends, touch), ends)
    high = jnp.where((a <= -m) & (-m <= b), larger(ends, -touch), ends)
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
        secant = jnp.where(wide, v - u, 1) / jnp.where(wide, d, 1)
        m = jnp.where(wide, contact(jnp.maximum(secant, 1 / far)), abs(0.5 * (a + b)))
        s = curve.slope.fn(m)
        m = jax.lax.stop_gradient(m)
        touch = jax.lax.stop_gradient(curve.phi.fn(m)) - s * m
        first, last = u - s * a, v - s * b
        low, high = smaller(first, last), larger(first, last)
        low = jnp.where((a <= -m) & (-m <= b), smaller(low, 2 * center - touch), low)
        high = jnp.where((a <= m) & (m <= b), larger(high, touch), high)
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
