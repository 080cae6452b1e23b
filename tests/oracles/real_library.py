"""Functions that the package knows as a whole, with their oracles; together with those of `real_functions`."""

from __future__ import annotations

from typing import Any

import ival
import jax
import jax.numpy as jnp
import numpy as np
from flint import arb
from ival import Interval as I
from oracles import real_functions as real
from oracles.real_functions import Real

KNOTS, VALUES = np.array([-1.0, 0.0, 0.5, 2.0]), np.array([0.0, 1.0, 0.25, 3.0])


def _table(t: Any) -> Any:
    """The pieces, and the one that every point lies in."""
    x = t.lo
    pieces = [0 * t, t + 1, 1 - 1.5 * t, 0.25 + (t - 0.5) * 11 / 6, 3 + 0 * t]
    which = np.searchsorted(KNOTS, x)
    return I(np.choose(which, [p.lo for p in pieces]), np.choose(which, [p.hi for p in pieces]))


def _ball_table(t: Any) -> Any:
    if t <= -1:
        return arb(0)
    if t <= 0:
        return t + 1
    if t <= 0.5:
        return 1 - 3 * t / 2
    return arb("0.25") + (t - 0.5) * 11 / 6 if t <= 2 else arb(3)


def _silu_slope(t: Any) -> Any:
    return real._logistic(t) * (1 + t * real._logistic(-t))


def _ball_silu_slope(t: Any) -> Any:
    return real._ball_logistic(t) * (1 + t * real._ball_logistic(-t))


def _solution(x: Any) -> Any:
    """``[[4, x], [1, 3]] s = [y, 2]``, the first entry: ``(3 y - 2 x) / (12 - x)``."""
    matrix = jnp.array([[4.0, 0.0], [1.0, 3.0]], x.dtype).at[0, 1].set(x[0])
    return jnp.linalg.solve(matrix, jnp.array([0.0, 2.0], x.dtype).at[0].set(x[1]))[0]


def _largest(x: Any) -> Any:
    return jnp.sort(x)[-1]


FUNCTIONS: dict[str, Real] = real.FUNCTIONS | {
    "table": real._one(
        lambda t: jnp.interp(t, KNOTS.astype(t.dtype), VALUES.astype(t.dtype)), _table, None, _ball_table, None,
        special=tuple(KNOTS),
    ),
    "silu": real._one(
        jax.nn.silu, lambda t: t * real._logistic(t), _silu_slope, lambda t: t * real._ball_logistic(t),
        _ball_silu_slope, special=(-1.2784645427610738, 2.39935728051546767, -2.39935728051546767),
    ),
    "soft_sign": real._one(
        jax.nn.soft_sign, lambda t: t / (1 + abs(t)), lambda t: ival.recip(ival.sqr(1 + abs(t))),
        lambda t: t / (1 + abs(t)), lambda t: 1 / (1 + abs(t)) ** 2,
    ),
    "softmax": Real(
        lambda x: jax.nn.softmax(x)[0], lambda x, y: real._logistic(x - y),
        [lambda x, y: real._logistic(x - y) * real._logistic(y - x),
         lambda x, y: -(real._logistic(x - y) * real._logistic(y - x))],
        lambda x, y: real._ball_logistic(x - y),
        [lambda x, y: real._ball_logistic(x - y) * real._ball_logistic(y - x),
         lambda x, y: -real._ball_logistic(x - y) * real._ball_logistic(y - x)],
    ),
    "logsumexp": Real(
        jax.nn.logsumexp, lambda x, y: ival.max(x, y) + ival.log1p(ival.exp(-abs(x - y))),
        [lambda x, y: real._logistic(x - y), lambda x, y: real._logistic(y - x)],
        lambda x, y: real._ball_larger(x, y) + (-abs(x - y)).exp().log1p(),
        [lambda x, y: real._ball_logistic(x - y), lambda x, y: real._ball_logistic(y - x)],
    ),
    "log_softmax": Real(
        lambda x: jax.nn.log_softmax(x)[0], lambda x, y: -real._softplus(y - x),
        [lambda x, y: real._logistic(y - x), lambda x, y: -real._logistic(y - x)],
        lambda x, y: -(real._ball_larger(y - x, arb(0)) + (-abs(y - x)).exp().log1p()),
        [lambda x, y: real._ball_logistic(y - x), lambda x, y: -real._ball_logistic(y - x)],
    ),
    "largest": Real(_largest, lambda x, y: ival.max(x, y), [], lambda x, y: x if x >= y else y, []),
    "system": Real(
        _solution, lambda x, y: (3 * y - 2 * x) / (12 - x),
        [lambda x, y: (3 * y - 24) / ival.sqr(12 - x), lambda x, y: 3 / (12 - x)],
        lambda x, y: (3 * y - 2 * x) / (12 - x),
        [lambda x, y: (3 * y - 24) / (12 - x) ** 2, lambda x, y: 3 / (12 - x)], domain=(-8.0, 8.0),
    ),
}  # fmt: skip
