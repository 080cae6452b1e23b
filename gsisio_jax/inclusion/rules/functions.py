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
from typing import Any

import jax
import jax.numpy as jnp

from gsisio_jax.inclusion.rules.singular import Hinge, Pole, Tangent
from gsisio_jax.inclusion.rules.trig import Wave
from gsisio_jax.inclusion.rules.univariate import INF, Curve, Piece


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
        return (largest / p) ** (1 / q) if q >= 1 else INF  # slower than t it does not overflow

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
