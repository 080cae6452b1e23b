"""The functions of one variable, each with its derivative and the limits of both at the ends of the domain.

The last entry of a curve, its contact, inverts the derivative: the secant slope of an interval gives the point where
a parallel line touches the curve, and the slope there makes the rest smallest. Where it is missing, or the interval
is too narrow for a secant, the middle of the interval serves.

Source: design 5.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.univariate import INF, Curve, Hinge, Piece, Pole, Tangent, Wave


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


POSITIVE, UNIT = (0.0, INF), (-1.0, 1.0)
RELU, ABS, RECIPROCAL = Hinge(0.0), Hinge(-1.0), Pole(1)
SIN = Wave(jnp.sin, jnp.cos, np.pi / 2, 0.0)
COS = Wave(jnp.cos, lambda t: -jnp.sin(t), 0.0, -np.pi / 2)
TAN = Tangent()

SQUARE = Curve(Piece(jnp.square, "valley", (INF, INF)), Piece(lambda t: 2 * t, "up", (-INF, INF)))
EXP = Curve(Piece(jnp.exp, "up", (0.0, INF), reach=_log_max), Piece(jnp.exp, "up", (0.0, INF), reach=_log_max), _log)
LOG = Curve(
    Piece(jnp.log, "up", (-INF, INF), domain=POSITIVE),
    Piece(lambda t: 1 / t, "down", (INF, 0.0), domain=POSITIVE),
    _over,
)
SQRT = Curve(
    Piece(jnp.sqrt, "up", (0.0, INF), domain=POSITIVE),
    Piece(lambda t: 0.5 * jax.lax.rsqrt(t), "down", (INF, 0.0), domain=POSITIVE),
    lambda s: 0.25 * _over(s) * _over(s),
)

SOFTPLUS = Curve(
    Piece(jax.nn.softplus, "up", (0.0, INF)),
    Piece(jax.nn.sigmoid, "up", (0.0, 1.0)),
    lambda s: _log(s) - _log(1 - s),
)


def power(p: float) -> Any:
    """``t ** p``: all t for an integer p, t >= 0 otherwise."""
    if p == int(p) and p < 0:
        return Pole(int(-p))
    if p == 2:
        return SQUARE

    def reach(largest: float) -> float:
        return largest ** (1 / p) if p > 1 else INF

    q = p - 1.0
    if p == int(p):
        p, q = int(p), int(p) - 1
        even = p % 2 == 0
        phi = Piece(
            lambda t: jax.lax.integer_pow(t, p),
            "valley" if even else "up",
            (INF if even else -INF, INF),
            reach=reach,
        )
        slope = Piece(
            lambda t: p * jax.lax.integer_pow(t, q),
            "up" if even else "valley",
            (-INF if even else INF, INF),
            reach=reach,
        )

        def contact(s: Any) -> Any:
            size = jnp.exp(_log(jnp.abs(s) / p) / q)
            return jnp.sign(s) * size if even else size

        return Curve(phi, slope, contact)

    phi = Piece(
        lambda t: t**p, "up" if p > 0 else "down", (0.0, INF) if p > 0 else (INF, 0.0), domain=POSITIVE, reach=reach
    )
    bend = (0.0, INF) if q > 0 else ((INF, 0.0) if p > 0 else (-INF, 0.0))
    slope = Piece(lambda t: p * t**q, "up" if q > 0 or p < 0 else "down", bend, domain=POSITIVE, reach=reach)
    return Curve(phi, slope, lambda s: jnp.exp(_log(s / p) / q))


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
        Piece(jnp.exp2, "up", (0.0, INF), reach=math.log2),
        Piece(lambda t: _LOG2 * jnp.exp2(t), "up", (0.0, INF), reach=math.log2),
        lambda s: _log(s / _LOG2) / _LOG2,
    ),
    "expm1": Curve(
        Piece(jnp.expm1, "up", (-1.0, INF), reach=_log_max), Piece(jnp.exp, "up", (0.0, INF), reach=_log_max), _log
    ),
    "log1p": Curve(
        Piece(jnp.log1p, "up", (-INF, INF), domain=(-1.0, INF)),
        Piece(lambda t: 1 / (1 + t), "down", (INF, 0.0), domain=(-1.0, INF)),
        lambda s: _over(s) - 1,
    ),
    "sinh": Curve(
        Piece(jnp.sinh, "up", (-INF, INF), reach=_log_max),
        Piece(jnp.cosh, "valley", (INF, INF), 1.0, reach=_log_max),
        lambda s: jnp.arcsinh(_root(s * s - 1)),
    ),
    "cosh": Curve(
        Piece(jnp.cosh, "valley", (INF, INF), 1.0, reach=_log_max),
        Piece(jnp.sinh, "up", (-INF, INF), reach=_log_max),
        jnp.arcsinh,
    ),
    "tanh": Curve(
        Piece(jnp.tanh, "up", (-1.0, 1.0)),
        # 1 - tanh^2, without the cancellation.
        Piece(lambda t: 4 * jax.nn.sigmoid(2 * t) * jax.nn.sigmoid(-2 * t), "peak", (0.0, 0.0), 1.0),
        lambda s: 0.5 * (_log(1 + _root(1 - s)) - _log(1 - _root(1 - s))),
    ),
    "logistic": Curve(
        Piece(jax.nn.sigmoid, "up", (0.0, 1.0)),
        Piece(lambda t: jax.nn.sigmoid(t) * jax.nn.sigmoid(-t), "peak", (0.0, 0.0), 0.25),
        _logit_contact,
    ),
    "erf": Curve(
        Piece(jax.lax.erf, "up", (-1.0, 1.0)),
        Piece(lambda t: _ERF * jnp.exp(-t * t), "peak", (0.0, 0.0), _ERF),
        lambda s: _root(-_log(s / _ERF)),
    ),
    "erfc": Curve(
        Piece(jax.lax.erfc, "down", (2.0, 0.0)),
        Piece(lambda t: -_ERF * jnp.exp(-t * t), "valley", (0.0, 0.0), -_ERF),
        lambda s: _root(-_log(-s / _ERF)),
    ),
    "atan": Curve(
        Piece(jnp.arctan, "up", (-_HALF_PI, _HALF_PI)),
        Piece(lambda t: 1 / (1 + t * t), "peak", (0.0, 0.0), 1.0),
        lambda s: _root(_over(s) - 1),
    ),
    "asin": Curve(
        Piece(jnp.arcsin, "up", (-_HALF_PI, _HALF_PI), domain=UNIT),
        Piece(lambda t: jax.lax.rsqrt((1 - t) * (1 + t)), "valley", (INF, INF), 1.0, domain=UNIT),
        lambda s: _root(1 - _over(s) ** 2),
    ),
    "acos": Curve(
        Piece(jnp.arccos, "down", (math.pi, 0.0), domain=UNIT),
        Piece(lambda t: -jax.lax.rsqrt((1 - t) * (1 + t)), "peak", (-INF, -INF), -1.0, domain=UNIT),
        lambda s: _root(1 - _over(s) ** 2),
    ),
    "asinh": Curve(
        Piece(jnp.arcsinh, "up", (-INF, INF)),
        Piece(lambda t: jax.lax.rsqrt(1 + t * t), "peak", (0.0, 0.0), 1.0),
        lambda s: _root(_over(s) ** 2 - 1),
    ),
    "acosh": Curve(
        Piece(jnp.arccosh, "up", (0.0, INF), domain=(1.0, INF), inner=2.0),
        Piece(lambda t: jax.lax.rsqrt((t - 1) * (t + 1)), "down", (INF, 0.0), domain=(1.0, INF), inner=2.0),
        lambda s: _root(_over(s) ** 2 + 1),
    ),
    "atanh": Curve(
        Piece(jnp.arctanh, "up", (-INF, INF), domain=UNIT),
        Piece(lambda t: 1 / ((1 - t) * (1 + t)), "valley", (INF, INF), 1.0, domain=UNIT),
        lambda s: _root(1 - _over(s)),
    ),
    "cbrt": Curve(
        Piece(_cube_root, "up", (-INF, INF)),
        Piece(lambda t: 1 / (3 * jnp.square(jnp.cbrt(t))), "peak", (0.0, 0.0), INF),
        lambda s: _over(3 * s) * _root(_over(3 * s)),
    ),
}
