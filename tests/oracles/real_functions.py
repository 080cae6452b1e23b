"""Real functions and their partial derivatives, enclosed: what the bounds of the package are judged by.

Twice. In crival (module `ival`: CORE-MATH's correctly rounded functions, one thread, any number of points at once): a
float64 interval that certainly contains the value, the tightest one where the function is one of crival's own. A
float64 or float32 number lies at or below the value if it lies at or below the lower end, so tight intervals decide
without any margin. And in python-flint's balls of any precision, for the few points at which the first is not enough;
these two share no code. Points are floating numbers, so both are values at exactly known places."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import ival
import jax
import jax.numpy as jnp
import numpy as np
from flint import arb
from ival import Interval as I
from jax import lax

INF = np.inf
POSITIVE, UNIT, REALS = (0.0, INF), (-1.0, 1.0), (-INF, INF)
TURNS = tuple(np.pi / 2 * k for k in (*range(-12, 13), 1000, 4093, -100001, 1000001))


@dataclass(frozen=True)
class Real:
    """A function of n variables.

    Attributes:
        fn: of an array (n,), for JAX.
        value: of n crival intervals, points in practice.
        partials: n such functions; none where there is no derivative to check.
        ball: as `value`, of balls.
        ball_partials: as `partials`, of balls.
        domain: of the first argument, the others may be any number. Partials are looked at inside only.
        linear: coefficients of a linear function: what is left after a slope is taken off is then known exactly.
        special: points near which something happens (turning points, poles, ends of a range).
        arguments: n, where the signature of `value` does not say.
    """

    fn: Callable[[Any], Any]
    value: Callable[..., Any]
    partials: Sequence[Callable[..., Any]]
    ball: Callable[..., Any]
    ball_partials: Sequence[Callable[..., Any]]
    domain: tuple[float, float] = REALS
    special: Sequence[float] = (0.0, 1.0, -1.0)
    linear: Sequence[Any] | None = None
    arguments: int | None = None

    @property
    def size(self) -> int:
        return self.arguments or self.value.__code__.co_argcount


def _one(fn: Any, value: Any, slope: Any, ball: Any, ball_slope: Any, domain: Any = REALS, special: Any = ()) -> Real:
    slopes = ([slope], [ball_slope]) if slope else ([], [])
    special = (0.0, 1.0, -1.0, *special)
    return Real(lambda x: fn(x[0]), lambda t: value(t), slopes[0], lambda t: ball(t), slopes[1], domain, special)


def _linear(fn: Any, value: Any, ball: Any, *coefficients: Any) -> Real:
    """Coefficients are pairs of whole numbers, numerator and denominator."""
    partials = [lambda *t, p=p, q=q: I(float(p)) / q + 0 * t[0] for p, q in coefficients]
    balls = [lambda *t, p=p, q=q: arb(p) / q for p, q in coefficients]
    return Real(fn, value, partials, ball, balls, linear=[I(float(p)) / q for p, q in coefficients])


def _gauss(t: Any) -> Any:
    """``exp(-t^2)`` of a point: t^2 as the sum of two numbers, or its rounding would count t^2 times."""
    t = np.minimum(np.abs(t.lo), 40.0)
    square = t * t
    rest = ival.fma(I(t), I(t), I(-square))
    return ival.exp(I(-square)) * ival.exp(-rest)


def _logistic(t: Any) -> Any:
    return ival.recip(1 + ival.exp(-t))


def _ball_logistic(t: Any) -> Any:
    return 1 / (1 + (-t).exp())


def _softplus(t: Any) -> Any:
    return I(np.maximum(t.lo, 0), np.maximum(t.hi, 0)) + ival.log1p(ival.exp(-abs(t)))


def _ball_root(t: Any) -> Any:
    return t.root(3) if t > 0 else (-((-t).root(3)) if t < 0 else t)


def _ball_larger(x: Any, y: Any) -> Any:
    return x if x > y else y


def _whole(p: int) -> Real:
    return _one(lambda t: t**p, lambda t: ival.pown(t, p), lambda t: p * ival.pown(t, p - 1),
                lambda t: t**p, lambda t: p * t ** (p - 1))  # fmt: skip


def _broken(p: float) -> Real:
    return _one(
        lambda t: t**p,
        lambda t: ival.pow(t, I(p)),
        lambda t: p * ival.pow(t, I(p - 1)),
        lambda t: (t.log() * p).exp() if t > 0 else arb(0 if p > 0 else "inf"),
        lambda t: p * (t.log() * (p - 1)).exp(),
        POSITIVE,
    )


def _over(c: int) -> Real:
    return _linear(lambda x: x[0] / c, lambda t: t / c, lambda t: t / c, (1, c))


def _step(fn: Any, exact: Any, special: Any = ()) -> Real:
    """A function whose values at floating numbers are floating numbers: no ball is ever asked for."""
    return _one(fn, lambda t: I(exact(t.lo)), None, lambda t: t, None, special=special)


def _cube(t: Any) -> Any:
    """``(t - 1)^3`` multiplied out: near 1 nothing is left of the terms."""
    return ((t - 3) * t + 3) * t - 1


# One variable ---------------------------------------------------------------------------------------------------------
FUNCTIONS: dict[str, Real] = {
    "sin": _one(jnp.sin, ival.sin, ival.cos, lambda t: t.sin(), lambda t: t.cos(), special=TURNS),
    "cos": _one(jnp.cos, ival.cos, lambda t: -ival.sin(t), lambda t: t.cos(), lambda t: -t.sin(), special=TURNS),
    "tan": _one(
        jnp.tan, ival.tan, lambda t: 1 + ival.sqr(ival.tan(t)), lambda t: t.tan(), lambda t: 1 + t.tan() ** 2,
        special=TURNS,
    ),
    "exp": _one(jnp.exp, ival.exp, ival.exp, lambda t: t.exp(), lambda t: t.exp()),
    "exp2": _one(
        jnp.exp2, ival.exp2, lambda t: ival.log(I(2.0)) * ival.exp2(t),
        lambda t: (t * arb(2).log()).exp(), lambda t: arb(2).log() * (t * arb(2).log()).exp(),
    ),
    "expm1": _one(jnp.expm1, ival.expm1, ival.exp, lambda t: t.expm1(), lambda t: t.exp()),
    "log": _one(jnp.log, ival.log, ival.recip, lambda t: t.log(), lambda t: 1 / t, POSITIVE),
    "log1p": _one(
        jnp.log1p, ival.log1p, lambda t: ival.recip(1 + t), lambda t: t.log1p(), lambda t: 1 / (1 + t), (-1.0, INF)
    ),
    "sqrt": _one(jnp.sqrt, ival.sqrt, lambda t: 0.5 * ival.rsqrt(t), lambda t: t.sqrt(), lambda t: 0.5 / t.sqrt(),
                 POSITIVE),
    "rsqrt": _one(
        lax.rsqrt, ival.rsqrt, lambda t: -0.5 * ival.rsqrt(t) / t, lambda t: 1 / t.sqrt(),
        lambda t: -0.5 / (t * t.sqrt()), POSITIVE,
    ),
    "cbrt": _one(
        jnp.cbrt, ival.cbrt, lambda t: ival.recip(3 * ival.sqr(ival.cbrt(t))), _ball_root,
        lambda t: 1 / (3 * _ball_root(t) ** 2),
    ),
    "square": _one(jnp.square, ival.sqr, lambda t: 2 * t, lambda t: t * t, lambda t: 2 * t),
    "cube": _whole(3),
    "fifth": _whole(5),
    "eighth": _whole(8),
    "power 2.5": _broken(2.5),
    "power 0.25": _broken(0.25),
    "power -1.5": _broken(-1.5),
    "minus third": _whole(-3),
    "reciprocal": _whole(-1),
    "sinh": _one(jnp.sinh, ival.sinh, ival.cosh, lambda t: t.sinh(), lambda t: t.cosh()),
    "cosh": _one(jnp.cosh, ival.cosh, ival.sinh, lambda t: t.cosh(), lambda t: t.sinh()),
    "tanh": _one(
        jnp.tanh, ival.tanh, lambda t: ival.recip(ival.sqr(ival.cosh(t))), lambda t: t.tanh(),
        lambda t: 1 / t.cosh() ** 2,
    ),
    "logistic": _one(
        lax.logistic, _logistic, lambda t: _logistic(t) * _logistic(-t),
        _ball_logistic, lambda t: _ball_logistic(t) * _ball_logistic(-t),
    ),
    "softplus": _one(
        jax.nn.softplus, _softplus, _logistic, lambda t: _ball_larger(t, arb(0)) + (-abs(t)).exp().log1p(),
        _ball_logistic,
    ),
    "atan": _one(jnp.arctan, ival.atan, lambda t: ival.recip(1 + ival.sqr(t)), lambda t: t.atan(),
                 lambda t: 1 / (1 + t * t)),
    "asin": _one(
        jnp.arcsin, ival.asin, lambda t: ival.rsqrt(1 - t) * ival.rsqrt(1 + t),
        lambda t: t.asin(), lambda t: 1 / (1 - t * t).sqrt(), UNIT,
    ),
    "acos": _one(
        jnp.arccos, ival.acos, lambda t: -ival.rsqrt(1 - t) * ival.rsqrt(1 + t),
        lambda t: t.acos(), lambda t: -1 / (1 - t * t).sqrt(), UNIT,
    ),
    "asinh": _one(
        jnp.arcsinh, ival.asinh, lambda t: ival.recip(ival.hypot(t, I(1.0))),
        lambda t: t.asinh(), lambda t: 1 / (1 + t * t).sqrt(),
    ),
    "acosh": _one(
        jnp.arccosh, ival.acosh, lambda t: ival.rsqrt(t - 1) * ival.rsqrt(t + 1),
        lambda t: t.acosh(), lambda t: 1 / (t * t - 1).sqrt(), (1.0, INF),
    ),
    "atanh": _one(
        jnp.arctanh, ival.atanh, lambda t: ival.recip((1 - t) * (1 + t)),
        lambda t: t.atanh(), lambda t: 1 / ((1 - t) * (1 + t)), UNIT,
    ),
    "erf": _one(
        lax.erf, ival.erf, lambda t: 2 * ival.rsqrt(PI) * _gauss(t), lambda t: t.erf(),
        lambda t: 2 / arb.pi().sqrt() * (-t * t).exp(),
    ),
    "erfc": _one(
        lax.erfc, ival.erfc, lambda t: -2 * ival.rsqrt(PI) * _gauss(t), lambda t: t.erfc(),
        lambda t: -2 / arb.pi().sqrt() * (-t * t).exp(),
    ),
    "abs": _one(
        jnp.abs, abs, lambda t: I(np.where(t.lo == 0, np.nan, np.sign(t.lo))),
        lambda t: abs(t), lambda t: arb(1 if t > 0 else -1),
    ),
    "floor": _step(jnp.floor, np.floor, (2.0, -7.0, 1e6)),
    "ceil": _step(jnp.ceil, np.ceil),
    "round": _step(jnp.round, np.round),
    "sign": _step(jnp.sign, np.sign),
    "clip": _step(lambda t: jnp.clip(t, -0.5, 1.5), lambda t: np.clip(t, -0.5, 1.5), (-0.5, 1.5)),
    "over 49": _over(49),
    "over 103": _over(103),
    # Expressions in which digits cancel, or which a compiler would like to rearrange.
    "(t + 1) - 1": _linear(lambda x: (x[0] + 1) - 1, lambda t: t, lambda t: t, (1, 1)),
    "t 49 / 49": _linear(lambda x: x[0] * 49 / 49, lambda t: t, lambda t: t, (1, 1)),
    "1 - cos": _one(
        lambda t: 1 - jnp.cos(t), lambda t: 2 * ival.sqr(ival.sin(0.5 * t)), ival.sin,
        lambda t: 2 * (t / 2).sin() ** 2, lambda t: t.sin(), special=TURNS,
    ),
    "t^2 - t": _one(lambda t: t * t - t, lambda t: ival.fma(t, t, -t), lambda t: 2 * t - 1, lambda t: t * t - t,
                    lambda t: 2 * t - 1),
    "(t - 1)^3": _one(
        _cube, lambda t: ival.pown(t - 1, 3), lambda t: 3 * ival.sqr(t - 1),
        lambda t: (t - 1) ** 3, lambda t: 3 * (t - 1) ** 2,
    ),
}  # fmt: skip
PI = ival.acos(I(-1.0))


# Several variables ----------------------------------------------------------------------------------------------------
def _unscaled(over: Any, x: Any, y: Any) -> Any:
    """``over / (x^2 + y^2)`` without squares that overflow; over is x or y."""
    far = ival.hypot(x, y)
    return over / far / far


def _fmod(x: Any, y: Any) -> Any:
    """Exact, like every remainder of two floating numbers; not a number where y is 0."""
    return np.fmod(x, np.where(y == 0, np.nan, y))


def _modulo(x: Any, y: Any) -> Any:
    rest = _fmod(x.lo, y.lo)
    return I(rest) + I(np.where((rest != 0) & ((rest < 0) != (y.lo < 0)), y.lo, 0.0))


FUNCTIONS |= {
    "add": _linear(lambda x: x[0] + x[1], lambda x, y: x + y, lambda x, y: x + y, (1, 1), (1, 1)),
    "subtract": _linear(lambda x: x[0] - x[1], lambda x, y: x - y, lambda x, y: x - y, (1, 1), (-1, 1)),
    "multiply": Real(
        lambda x: x[0] * x[1], lambda x, y: x * y, [lambda x, y: y, lambda x, y: x],
        lambda x, y: x * y, [lambda x, y: y, lambda x, y: x],
    ),
    "divide": Real(
        lambda x: x[0] / x[1], lambda x, y: x / y, [lambda x, y: ival.recip(y), lambda x, y: -(x / y / y)],
        lambda x, y: x / y, [lambda x, y: 1 / y, lambda x, y: -x / (y * y)],
    ),
    "power": Real(
        lambda x: x[0] ** x[1], lambda x, y: ival.pow(x, y),
        [lambda x, y: y * ival.pow(x, y) / x, lambda x, y: ival.log(x) * ival.pow(x, y)],
        lambda x, y: (y * x.log()).exp(),
        [lambda x, y: y * (y * x.log()).exp() / x, lambda x, y: x.log() * (y * x.log()).exp()],
        domain=POSITIVE,
    ),
    "atan2": Real(
        lambda x: jnp.arctan2(x[0], x[1]), lambda x, y: ival.atan2(x, y),
        [lambda x, y: _unscaled(y, x, y), lambda x, y: -_unscaled(x, x, y)],
        lambda x, y: arb.atan2(x, y), [lambda x, y: y / (x * x + y * y), lambda x, y: -x / (x * x + y * y)],
    ),
    "hypotenuse": Real(
        lambda x: jnp.sqrt(x[0] ** 2 + x[1] ** 2), lambda x, y: ival.hypot(x, y),
        [lambda x, y: x / ival.hypot(x, y), lambda x, y: y / ival.hypot(x, y)],
        lambda x, y: (x * x + y * y).sqrt(),
        [lambda x, y: x / (x * x + y * y).sqrt(), lambda x, y: y / (x * x + y * y).sqrt()],
    ),
    "log add exp": Real(
        lambda x: jnp.logaddexp(x[0], x[1]), lambda x, y: ival.max(x, y) + ival.log1p(ival.exp(-abs(x - y))),
        [lambda x, y: _logistic(x - y), lambda x, y: _logistic(y - x)],
        lambda x, y: _ball_larger(x, y) + (-abs(x - y)).exp().log1p(),
        [lambda x, y: _ball_logistic(x - y), lambda x, y: _ball_logistic(y - x)],
    ),
    "maximum": Real(
        lambda x: jnp.maximum(x[0], x[1]), lambda x, y: ival.max(x, y), [], lambda x, y: x if x >= y else y, []
    ),
    "minimum": Real(
        lambda x: jnp.minimum(x[0], x[1]), lambda x, y: ival.min(x, y), [], lambda x, y: y if x >= y else x, []
    ),
    "remainder": Real(
        lambda x: lax.rem(x[0], x[1]), lambda x, y: I(_fmod(x.lo, y.lo)), [],
        lambda x, y: x - y * ((x / y).floor() if x / y >= 0 else (x / y).ceil()), [],
    ),
    "modulo": Real(
        lambda x: jnp.mod(x[0], x[1]), _modulo, [], lambda x, y: x - y * (x / y).floor(), []
    ),
    "x y - x": Real(
        lambda x: x[0] * x[1] - x[0], lambda x, y: ival.fma(x, y, -x), [lambda x, y: y - 1, lambda x, y: x],
        lambda x, y: x * y - x, [lambda x, y: y - 1, lambda x, y: x],
    ),
    "determinant": Real(
        lambda x: x[0] * x[1] - x[2] * x[3], lambda x, y, z, w: x * y - z * w,
        [lambda x, y, z, w: y, lambda x, y, z, w: x, lambda x, y, z, w: -w, lambda x, y, z, w: -z],
        lambda x, y, z, w: x * y - z * w,
        [lambda x, y, z, w: y, lambda x, y, z, w: x, lambda x, y, z, w: -w, lambda x, y, z, w: -z],
    ),
}  # fmt: skip
