"""Real functions of one variable and their derivatives, to more digits than what they judge.

In NumPy's long double (64 bits of mantissa, where the platform has it) for many points at once, and in python-flint's
balls of 256 bits, which bound their own error, for few. The first is checked with the second."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flint import arb, ctx
from jax import lax

ctx.prec = 256
LONG: Any = np.longdouble
ROOM = float(np.finfo(LONG).eps) * 64  # of the long double functions, relative to the largest number in them
INF = np.inf


@dataclass(frozen=True)
class Real:
    """A function: for JAX, in long double with its derivative, in balls with its derivative; its domain; how large an
    argument (in magnitude) may be for the long double values to be right."""

    fn: Callable[[Any], Any]
    value: Callable[[Any], Any]
    slope: Callable[[Any], Any]
    ball: Callable[[Any], Any]
    ball_slope: Callable[[Any], Any]
    domain: tuple[float, float] = (-INF, INF)
    largest: float = INF


def _exp(t: Any) -> Any:
    return np.exp(t)


def _logistic(t: Any) -> Any:
    return 1 / (1 + np.exp(-t))


def _ball_logistic(t: Any) -> Any:
    return 1 / (1 + (-t).exp())


def _ball_root(t: Any) -> Any:
    return t.root(3) if t > 0 else (-((-t).root(3)) if t < 0 else t)


def _power(p: float) -> Real:
    if p == int(p):
        k = int(p)
        return Real(
            lambda t: t**k, lambda t: t**k, lambda t: k * t ** (k - 1), lambda t: t**k, lambda t: k * t ** (k - 1)
        )  # fmt: skip
    return Real(
        lambda t: t**p,
        lambda t: t ** LONG(p),
        lambda t: LONG(p) * t ** (LONG(p) - 1),
        lambda t: (t.log() * arb(p)).exp(),
        lambda t: arb(p) * (t.log() * (arb(p) - 1)).exp(),
        (0.0, INF),
    )


def _divided(c: float) -> Real:
    return Real(
        lambda t: t / c, lambda t: t / LONG(c), lambda t: 1 / LONG(c) + 0 * t, lambda t: t / c, lambda t: arb(1) / c
    )


_LOG2 = np.log(LONG(2))
FUNCTIONS: dict[str, Real] = {
    "sin": Real(jnp.sin, np.sin, np.cos, lambda t: t.sin(), lambda t: t.cos(), largest=1e15),
    "cos": Real(jnp.cos, np.cos, lambda t: -np.sin(t), lambda t: t.cos(), lambda t: -t.sin(), largest=1e15),
    "tan": Real(
        jnp.tan, np.tan, lambda t: 1 + np.tan(t) ** 2, lambda t: t.tan(), lambda t: 1 / t.cos() ** 2, largest=50
    ),
    "exp": Real(jnp.exp, _exp, _exp, lambda t: t.exp(), lambda t: t.exp()),
    "exp2": Real(
        jnp.exp2, lambda t: np.exp2(t), lambda t: _LOG2 * np.exp2(t),
        lambda t: (t * arb.const_log2()).exp(), lambda t: arb.const_log2() * (t * arb.const_log2()).exp(),
    ),
    "expm1": Real(jnp.expm1, np.expm1, _exp, lambda t: t.expm1(), lambda t: t.exp()),
    "log": Real(jnp.log, np.log, lambda t: 1 / t, lambda t: t.log(), lambda t: 1 / t, (0.0, INF)),
    "log1p": Real(jnp.log1p, np.log1p, lambda t: 1 / (1 + t), lambda t: t.log1p(), lambda t: 1 / (1 + t), (-1.0, INF)),
    "sqrt": Real(
        jnp.sqrt, np.sqrt, lambda t: 0.5 / np.sqrt(t), lambda t: t.sqrt(), lambda t: 1 / (2 * t.sqrt()), (0.0, INF)
    ),
    "rsqrt": Real(
        lax.rsqrt, lambda t: 1 / np.sqrt(t), lambda t: -0.5 / (t * np.sqrt(t)),
        lambda t: 1 / t.sqrt(), lambda t: -1 / (2 * t * t.sqrt()), (0.0, INF),
    ),
    "cbrt": Real(
        jnp.cbrt, np.cbrt, lambda t: 1 / (3 * np.cbrt(t) ** 2), _ball_root, lambda t: 1 / (3 * _ball_root(t) ** 2)
    ),
    "square": _power(2.0),
    "cube": _power(3.0),
    "fifth": _power(5.0),
    "eighth": _power(8.0),
    "power 2.5": _power(2.5),
    "power 0.25": _power(0.25),
    "power -1.5": _power(-1.5),
    "minus third": _power(-3.0),
    "reciprocal": _power(-1.0),
    "sinh": Real(jnp.sinh, np.sinh, np.cosh, lambda t: t.sinh(), lambda t: t.cosh()),
    "cosh": Real(jnp.cosh, np.cosh, np.sinh, lambda t: t.cosh(), lambda t: t.sinh()),
    "tanh": Real(jnp.tanh, np.tanh, lambda t: 1 / np.cosh(t) ** 2, lambda t: t.tanh(), lambda t: 1 / t.cosh() ** 2),
    "logistic": Real(
        lax.logistic, _logistic, lambda t: _logistic(t) * _logistic(-t),
        _ball_logistic, lambda t: _ball_logistic(t) * _ball_logistic(-t),
    ),
    "softplus": Real(
        jax.nn.softplus, lambda t: np.maximum(t, 0) + np.log1p(np.exp(-np.abs(t))), _logistic,
        lambda t: t.exp().log1p(), _ball_logistic, largest=1e4,
    ),
    "atan": Real(jnp.arctan, np.arctan, lambda t: 1 / (1 + t * t), lambda t: t.atan(), lambda t: 1 / (1 + t * t)),
    "asin": Real(
        jnp.arcsin, np.arcsin, lambda t: 1 / np.sqrt((1 - t) * (1 + t)),
        lambda t: t.asin(), lambda t: 1 / (1 - t * t).sqrt(), (-1.0, 1.0),
    ),
    "acos": Real(
        jnp.arccos, np.arccos, lambda t: -1 / np.sqrt((1 - t) * (1 + t)),
        lambda t: t.acos(), lambda t: -1 / (1 - t * t).sqrt(), (-1.0, 1.0),
    ),
    "asinh": Real(
        jnp.arcsinh, np.arcsinh, lambda t: 1 / np.hypot(LONG(1), t),
        lambda t: t.asinh(), lambda t: 1 / (1 + t * t).sqrt(),
    ),
    "acosh": Real(
        jnp.arccosh, np.arccosh, lambda t: 1 / np.sqrt((t - 1) * (t + 1)),
        lambda t: t.acosh(), lambda t: 1 / (t * t - 1).sqrt(), (1.0, INF),
    ),
    "atanh": Real(
        jnp.arctanh, np.arctanh, lambda t: 1 / ((1 - t) * (1 + t)),
        lambda t: t.atanh(), lambda t: 1 / (1 - t * t), (-1.0, 1.0),
    ),
    "over 49": _divided(49.0),
    "over 103": _divided(103.0),
}  # fmt: skip
# No long double version: in balls only.
BALLS: dict[str, Real] = {
    "erf": Real(
        lax.erf, np.nan_to_num, np.nan_to_num, lambda t: t.erf(), lambda t: 2 / arb.pi().sqrt() * (-t * t).exp()
    ),
    "erfc": Real(
        lax.erfc, np.nan_to_num, np.nan_to_num, lambda t: t.erfc(), lambda t: -2 / arb.pi().sqrt() * (-t * t).exp()
    ),
}
