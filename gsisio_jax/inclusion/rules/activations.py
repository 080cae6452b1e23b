"""Functions of one variable that are written as sums, products or quotients, known as a whole: silu, gelu, mish,
soft_sign, sinc, celu, ``x log x``.

Such a function is given with its derivative and with the points at which either of them turns, so range and derivative
are exact but for rounding. What is left after a slope is taken off is enclosed piece by piece: on each of a few
pieces of [a, b], ``phi(t) - s t`` lies in ``phi(m) - s m + (phi' - s) (t - m)``.

Source of the points: zeros of the derivative and of the second derivative, found to 17 digits. The value at a zero of
the derivative does not depend on it to first order; ulps cover it.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.form_arithmetic import product
from gsisio_jax.inclusion.rules.univariate import INF, Curve, Piece, extremes
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, choose, entire_like
from gsisio_jax.scalar.numpy_program import numpy_function

PIECES = 8


@dataclass(frozen=True)
class Turning:
    """A smooth function that turns at known points.

    Attributes:
        fn, slope: the function and its derivative, errors below ``ulps eps (|value| + size)``.
        turns, bends: points at which the function, or its derivative, has an extreme; increasing.
        ends: limits of the function at minus and plus infinity.
        slopes: limits of the derivative there; there are no other extremes.
        size: what errors go with near a zero of the function or of the derivative.
        far, decay: beyond `far`, where there are more such points, function and derivative are below ``decay / |t|``.
    """

    fn: Callable[[Any], Any]
    slope: Callable[[Any], Any]
    turns: tuple[float, ...]
    bends: tuple[float, ...]
    ends: tuple[float, float]
    slopes: tuple[float, float]
    ulps: float = 64.0
    size: float = 1.0
    far: float = math.inf
    decay: tuple[float, float] = (0.0, 0.0)

    def _extremes(
        self, fn: Any, points: tuple[float, ...], limits: tuple[float, float], decay: float, a: Any, b: Any
    ) -> Interval:
        def at(t: Any) -> Any:
            finite = jnp.isfinite(t)
            return jnp.where(finite, fn(jnp.where(finite, t, 0)), jnp.where(t < 0, *limits))

        found = [at(a), at(b)]
        for point, value in zip(points, _known(fn, points, np.dtype(a.dtype)), strict=True):
            found.append(jnp.where((a <= point) & (point <= b), value, found[0]))
        if self.far < math.inf:
            for end, start in ((b, a), (-a, -b)):
                most = decay / jnp.maximum(start, self.far)
                found += [jnp.where(end > self.far, sign * most, found[0]) for sign in (1, -1)]
        bounds = extremes(found)
        # Next to a turning point that lies just outside by rounding, the function is flat.
        return Interval.unchecked(
            rounding.lowered(bounds.lower, abs(bounds.lower) + self.size, self.ulps),
            rounding.raised(bounds.upper, abs(bounds.upper) + self.size, self.ulps),
        )

    def range(self, a: Any, b: Any) -> Interval:
        return self._extremes(self.fn, self.turns, self.ends, self.decay[0], a, b)

    def derivative(self, a: Any, b: Any) -> Interval:
        return self._extremes(self.slope, self.bends, self.slopes, self.decay[1], a, b)

    def line(self, a: Any, b: Any, natural: Interval) -> tuple[Any, Interval]:
        finite = jnp.isfinite(a) & jnp.isfinite(b)
        a, b = jnp.where(finite, a, 0), jnp.where(finite, b, 0)
        wide = b - a > 1e-3 * jnp.maximum(abs(a), abs(b)) + 1e-6
        pa, pb = self.fn(a), self.fn(b)
        s = jnp.where(wide, pb - pa, self.slope(0.5 * a + 0.5 * b)) / jnp.where(wide, b - a, 1)
        usable = finite & jnp.isfinite(s)
        s = jnp.where(usable, s, 0)
        # All pieces at once. Ends of neighbours are the same numbers, so together they cover [a, b].
        ends = [a, *(a + (b - a) * (k / PIECES) for k in range(1, PIECES)), b]
        low, high = jnp.stack(ends[:-1]), jnp.stack(ends[1:])
        m = 0.5 * low + 0.5 * high
        left = self.derivative(low, high)
        left = Interval.unchecked(rounding.down(left.lower - s), rounding.up(left.upper - s))
        moved = product(left, Interval.unchecked(rounding.down(low - m), rounding.up(high - m)))
        value = self.fn(m) - s * m
        size = abs(value) + 2 * abs(s * m) + abs(moved.lower) + abs(moved.upper) + self.size
        lower = rounding.lowered(value + moved.lower, size, self.ulps + 8)
        upper = rounding.raised(value + moved.upper, size, self.ulps + 8)
        rest = Interval.unchecked(
            extremes([lower[k] for k in range(PIECES)]).lower, extremes([upper[k] for k in range(PIECES)]).upper
        )
        return s, choose(usable, rest, natural)


@functools.cache
def _known(fn: Callable[[Any], Any], points: tuple[float, ...], dtype: Any) -> np.ndarray:
    """Values at fixed points, computed once: written out, they were most of what is traced and compiled."""
    at = np.asarray(points, dtype)
    return numpy_function(fn, at)(at)


def _silu(t: Any) -> Any:
    return t * jax.nn.sigmoid(t)


def _silu_slope(t: Any) -> Any:
    return jax.nn.sigmoid(t) * (1 + t * jax.nn.sigmoid(-t))


def _gelu(t: Any) -> Any:
    return 0.5 * t * jax.lax.erfc(-t * 0.7071067811865476)


def _gelu_slope(t: Any) -> Any:
    return 0.5 * jax.lax.erfc(-t * 0.7071067811865476) + t * 0.3989422804014327 * jnp.exp(-0.5 * t * t)


def _gate(t: Any) -> tuple[Any, Any]:
    """The argument of the hyperbolic tangent in the approximation of gelu, and its derivative; bounded, as beyond 30
    the tangent is 1."""
    t = jnp.clip(t, -30.0, 30.0)
    root = 0.7978845608028654
    return root * (t + 0.044715 * t * t * t), root * (1 + 0.134145 * t * t)


def _gelu_tanh(t: Any) -> Any:
    # 1 + tanh(z) = 2 sigmoid(2 z), without the cancellation.
    return t * jax.nn.sigmoid(2 * _gate(t)[0])


def _gelu_tanh_slope(t: Any) -> Any:
    z, slope = _gate(t)
    p, q = jax.nn.sigmoid(2 * z), jax.nn.sigmoid(-2 * z)
    return p + jnp.clip(t, -30.0, 30.0) * 2 * p * q * slope


def _mish(t: Any) -> Any:
    return t * jnp.tanh(jax.nn.softplus(t))


def _mish_slope(t: Any) -> Any:
    gate = jnp.tanh(jax.nn.softplus(t))
    t = jnp.clip(t, -200.0, 200.0)
    return gate + t * (1 - gate) * (1 + gate) * jax.nn.sigmoid(t)


def _sinc(t: Any) -> Any:
    p = math.pi * t
    near = abs(p) < 1
    square = jnp.where(near, p, 0) ** 2
    series = sum((-1) ** k * square**k / float(math.factorial(2 * k + 1)) for k in range(10))
    return jnp.where(near, series, jnp.sin(p) / jnp.where(near, 1, p))


def _sinc_slope(t: Any) -> Any:
    p = math.pi * t
    near = abs(p) < 1
    inner = jnp.where(near, p, 0)
    square = inner**2
    series = sum((-1) ** k * 2 * k * square ** (k - 1) / float(math.factorial(2 * k + 1)) for k in range(1, 11))
    return math.pi * jnp.where(near, inner * series, (jnp.cos(p) - _sinc(t)) / jnp.where(near, 1, p))


_TURNS = (1.43029665312420276, 2.45902403295676138, 3.47088972434701977, 4.47740858343251549, 5.48153665060719617)
_BENDS = (
    0.662586212582192381, 1.89087849558880578, 2.93030992812434106, 3.9484574830947061, 4.95902496862071278,
    5.9659693828727791,
)  # fmt: skip


def _mirrored(points: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(-t for t in points[::-1]) + points


SILU = Turning(_silu, _silu_slope, (-1.2784645427610738,), _mirrored((2.39935728051546767,)), (0.0, INF), (0.0, 1.0))
GELU = Turning(_gelu, _gelu_slope, (-0.751791524693564457,), _mirrored((math.sqrt(2),)), (0.0, INF), (0.0, 1.0))
GELU_TANH = Turning(
    _gelu_tanh, _gelu_tanh_slope, (-0.752461422071016258,), _mirrored((1.41850400879082836,)), (0.0, INF), (0.0, 1.0)
)
MISH = Turning(
    _mish, _mish_slope, (-1.19243121451549521,), (-2.25637639636079312, 1.49057117948542846), (0.0, INF), (0.0, 1.0),
    ulps=2048.0,
)  # fmt: skip
SINC = Turning(
    _sinc, _sinc_slope, (*_mirrored(_TURNS)[:5], 0.0, *_TURNS), _mirrored(_BENDS), (0.0, 0.0), (0.0, 0.0),
    far=5.9, decay=(1 / math.pi, 1.06),
)  # fmt: skip
SOFT_SIGN = Curve(
    Piece(lambda t: t / (1 + abs(t)), "up", (-1.0, 1.0), ulps=8.0),
    Piece(lambda t: 1 / jnp.square(1 + abs(t)), "peak", (0.0, 0.0), 1.0, ulps=16.0),
    lambda s: jax.lax.rsqrt(jnp.maximum(s, 1e-30)) - 1,
)


@functools.cache
def celu(alpha: float) -> Curve:
    """``max(t, 0) + alpha expm1(min(t, 0) / alpha)`` for alpha > 0: smooth, and straight from 0 on."""
    return Curve(
        Piece(lambda t: jax.nn.celu(t, alpha), "up", (-alpha, INF), ulps=32.0),
        Piece(lambda t: jnp.exp(jnp.minimum(t, 0) / alpha), "up", (0.0, 1.0), ulps=8.0, drift=_exponent(alpha)),
        lambda s: alpha * jnp.log(jnp.clip(s, jnp.finfo(s.dtype).tiny, 1)),
    )


def _exponent(alpha: float) -> Callable[[Any], Any]:
    """What the rounding of ``t / alpha`` does to its exponential; beyond 1100 that is 0."""
    return lambda t: jnp.minimum(t / alpha, 1100.0)


def _x_log_x(t: Any) -> Any:
    return jnp.where(t > 0, t * jnp.log(jnp.where(t > 0, t, 1)), 0)


def _x_log_x_slope(t: Any) -> Any:
    return jnp.where(t > 0, 1 + jnp.log(jnp.where(t > 0, t, 1)), -INF)


@dataclass(frozen=True)
class Product(Turning):
    """``t log t``, 0 at 0 and nothing below."""

    def range(self, a: Any, b: Any) -> Interval:
        return choose(a < 0, entire_like(a), super().range(jnp.maximum(a, 0), jnp.maximum(b, 0)))

    def derivative(self, a: Any, b: Any) -> Interval:
        return choose(a < 0, entire_like(a), super().derivative(jnp.maximum(a, 0), jnp.maximum(b, 0)))

    def line(self, a: Any, b: Any, natural: Interval) -> tuple[Any, Interval]:
        s, rest = super().line(jnp.maximum(a, 0), jnp.maximum(b, 0), natural)
        return jnp.where(a < 0, 0, s), choose(a < 0, natural, rest)


X_LOG_X = Product(_x_log_x, _x_log_x_slope, (1 / math.e,), (), (0.0, INF), (-INF, INF))
