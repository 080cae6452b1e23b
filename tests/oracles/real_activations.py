"""Activations, functions in pieces and other functions of one variable, as JAX writes them, with formulas for them."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from oracles.formulas import real
from oracles.real_functions import POSITIVE, TURNS

UNIT = (0.0, 1.0)
STEPS = np.array([1.5, -2.0, 4.0, 0.25])  # floating numbers of either precision
KNOTS = np.array([-1.0, 0.0, 0.5, 2.0])


def _exponential(scale: float) -> Any:
    """ELU, and CELU with another scale: that of the argument."""
    return lambda K, t: K.step(t, 0.0, scale * K.expm1(t / scale), 0.0, t)


def _gelu_tanh(K: Any, t: Any) -> Any:
    inner = (t + t * t * t * K.number(44715, 1e6)) * K.sqrt(2 / K.pi)
    return t / (1 + K.exp(-2 * inner))


def _mish(K: Any, t: Any) -> Any:
    """With ``u = exp(-|t|)``, ``tanh(log(1 + e))`` being ``(e^2 + 2 e) / (e^2 + 2 e + 2)``."""
    up, down = K.exp(-t), K.exp(t)
    above, below = 1 + 2 * up, down * down + 2 * down
    return K.step(t, 0.0, t * below / (below + 2), 0.0, t * above / (above + 2 * up * up))


def _sinc(K: Any, t: Any) -> Any:
    return K.step(t, 0.0, K.sinpi(t) / (t * K.pi), 1.0, K.sinpi(t) / (t * K.pi))


def _ends(low: float, high: float, of: Any = lambda K, t: t) -> Any:
    """Constant beyond two cuts."""
    return lambda K, t: K.step(t, low, K.number(low), K.number(low), K.step(t, high, of(K, t), high, high))


def _dry_friction(K: Any, t: Any) -> Any:
    """At 0, where it is written with a jump, on a box of that one point any derivative will do."""
    return K.step(t, 0.0, _ends(-2.0, 2.0)(K, t), 0.0, _ends(-2.0, 2.0)(K, t))


def _log_sigmoid(K: Any, t: Any) -> Any:
    return K.step(t, 0.0, t - K.log1p(K.exp(t)), -K.log(K.number(2.0)), -K.log1p(K.exp(-t)))


def _hard_silu(K: Any, t: Any) -> Any:
    return K.step(t, -3.0, 0.0, 0.0, K.step(t, 3.0, t * (t + 3) / 6, t, t))


def _squareplus(K: Any, t: Any) -> Any:
    root = K.hypot(t, K.number(2.0))
    return K.step(t, 0.0, 2 / (root - t), 1.0, (t + root) / 2)


def _dead_zone(t: Any) -> Any:
    return jnp.where(t > 1, t - 1, jnp.where(t < -1, t + 1, 0.0))


def _two_wheres(t: Any) -> Any:
    """``expm1(t) / t`` with 1 near 0, as one keeps a division from 0."""
    small = abs(t) < 2.0**-40
    return jnp.where(small, 1.0, jnp.expm1(t) / jnp.where(small, 1.0, t))


def _two_wheres_formula(K: Any, t: Any) -> Any:
    quotient, e = K.expm1(t) / t, 2.0**-40
    return K.step(t, -e, quotient, quotient, K.step(t, e, 1.0, quotient, quotient))


def _squares(t: Any) -> Any:
    return lax.fori_loop(0, 3, lambda i, v: v * v / 4, t)


FUNCTIONS = {
    "gelu": real(1, jax.nn.gelu, _gelu_tanh, special=(-0.752461422071016258, 1.41850400879082836)),
    "gelu by erfc": real(
        1, lambda t: jax.nn.gelu(t, approximate=False), lambda K, t: t / 2 * K.erfc(-t / K.sqrt(K.number(2.0))),
        special=(-0.751791524693564457, 1.4142135623730951, -1.4142135623730951),
    ),
    "mish": real(1, jax.nn.mish, _mish, special=(-1.19243121451549521, -2.25637639636079312, 1.49057117948542846)),
    "sinc": real(1, jnp.sinc, _sinc, special=(1.43029665312420276, 0.662586212582192381, 5.9659693828727791)),
    "elu": real(1, jax.nn.elu, _exponential(1.0)),
    "celu": real(1, jax.nn.celu, _exponential(1.0)),
    "celu, scaled": real(1, lambda t: jax.nn.celu(t, 0.25), _exponential(0.25)),
    "leaky_relu": real(1, lambda t: jax.nn.leaky_relu(t, 0.25), lambda K, t: K.step(t, 0.0, t / 4, 0.0, t)),
    "relu": real(1, jax.nn.relu, lambda K, t: K.step(t, 0.0, 0.0, 0.0, t)),
    "relu6": real(1, jax.nn.relu6, _ends(0.0, 6.0), special=(6.0,)),
    "hard_tanh": real(1, jax.nn.hard_tanh, _ends(-1.0, 1.0)),
    "hard_sigmoid": real(
        1, jax.nn.hard_sigmoid,
        lambda K, t: K.step(t, -3.0, 0.0, 0.0, K.step(t, 3.0, (t + 3) / 6, 1.0, 1.0)), special=(3.0, -3.0),
    ),
    "hard_silu": real(1, jax.nn.hard_silu, _hard_silu, special=(3.0, -3.0, -1.5)),
    "log_sigmoid": real(1, jax.nn.log_sigmoid, _log_sigmoid),
    "squareplus": real(1, jax.nn.squareplus, _squareplus),
    "normal distribution": real(
        1, jax.scipy.special.ndtr, lambda K, t: K.erfc(-t / K.sqrt(K.number(2.0))) / 2
    ),
    "logit": real(1, jax.scipy.special.logit, lambda K, t: K.log(t) - K.log1p(-t), UNIT),
    "entropy": real(1, jax.scipy.special.entr, lambda K, t: -t * K.log(t), POSITIVE, (0.36787944117144233,)),
    "log2": real(1, jnp.log2, lambda K, t: K.log(t) / K.log(K.number(2.0)), POSITIVE),
    "log10": real(1, jnp.log10, lambda K, t: K.log(t) / K.log(K.number(10.0)), POSITIVE),
    # In pieces.
    "dead zone": real(1, _dead_zone, lambda K, t: K.step(t, -1.0, t + 1, 0.0, K.step(t, 1.0, 0.0, 0.0, t - 1))),
    "dry friction": real(
        1, lambda t: jnp.sign(t) * jnp.minimum(abs(t), 2.0), _dry_friction, special=(2.0, -2.0)
    ),
    "two wheres": real(1, _two_wheres, _two_wheres_formula, special=(2.0**-40, -(2.0**-40)), slopes=False),
    "a jump": real(1, lambda t: jnp.where(t > 0.5, t * t, -t), lambda K, t: K.step(t, 0.5, -t, -t, t * t),
                   special=(0.5,), slopes=False),
    "select": real(
        1, lambda t: jnp.select([t > 1, t > -1], [t * t, t], -1.0),
        lambda K, t: K.step(t, -1.0, -1.0, -1.0, K.step(t, 1.0, t, 1.0, t * t)),
    ),
    "piecewise": real(
        1, lambda t: jnp.piecewise(t, [t < -1, t > 1], [lambda v: v + 1, lambda v: v * v, 0.5]),
        lambda K, t: K.step(t, -1.0, t + 1, 0.5, K.step(t, 1.0, 0.5, 0.5, t * t)), slopes=False,
    ),
    "cond": real(
        1, lambda t: lax.cond(t > 0.5, jnp.exp, lambda v: v / 49, t),
        lambda K, t: K.step(t, 0.5, t / 49, t / 49, K.exp(t)), special=(0.5,), slopes=False,
    ),
    "switch": real(
        1, lambda t: lax.switch(jnp.clip(t, 0, 2).astype(int), [jnp.sin, jnp.cos, lambda v: v / 49], t),
        lambda K, t: K.entry([K.sin(t), K.cos(t), t / 49], lambda v: np.floor(np.clip(v, 0, 2)), t),
        special=(2.0,), slopes=False,
    ),
    "wrapped angle": real(
        1, lambda t: jnp.arctan2(jnp.sin(t), jnp.cos(t)), lambda K, t: K.atan2(K.sin(t), K.cos(t)), (-100.0, 100.0),
        TURNS,
    ),
    # Places that depend on the argument.
    "entry of a table": real(
        1, lambda t: jnp.asarray(STEPS, t.dtype)[jnp.clip(t, 0, 3).astype(int)],
        lambda K, t: K.entry(list(STEPS), lambda v: np.floor(np.clip(v, 0, 3)), t), special=(2.0, 3.0), slopes=False,
    ),
    "slice of a table": real(
        1, lambda t: lax.dynamic_slice(jnp.asarray(STEPS, t.dtype), (jnp.clip(t, 0, 2).astype(int),), (2,))[1],
        lambda K, t: K.entry(list(STEPS), lambda v: 1 + np.floor(np.clip(v, 0, 2)), t), special=(2.0,), slopes=False,
    ),
    "searchsorted": real(
        1, lambda t: jnp.searchsorted(jnp.asarray(KNOTS, t.dtype), t) * jnp.ones((), t.dtype),
        lambda K, t: K.entry(range(5), lambda v: np.searchsorted(KNOTS, v), t), special=KNOTS, slopes=False,
    ),
    "digitize": real(
        1, lambda t: jnp.digitize(t, jnp.asarray(KNOTS, t.dtype)) * jnp.ones((), t.dtype),
        lambda K, t: K.entry(range(5), lambda v: np.searchsorted(KNOTS, v, "right"), t), special=KNOTS, slopes=False,
    ),
    "table with ends": real(
        1, lambda t: jnp.interp(t, jnp.asarray([0.0, 1.0]), jnp.asarray([0.0, 2.0]), left=-1.0, right=3.0),
        lambda K, t: K.step(t, 0.0, -1.0, 0.0, K.step(t, 1.0, 2 * t, 2.0, 3.0)), slopes=False,
    ),
    # Powers, and loops of products.
    "powers": real(
        1, lambda t: jnp.vander(t[None], 4)[0] @ jnp.asarray([1.0, -3.0, 3.0, -1.0], t.dtype),
        lambda K, t: (t - 1) * (t - 1) * (t - 1),
    ),
    "power of arange": real(1, lambda t: (t ** jnp.arange(4))[3], lambda K, t: t * t * t),
    "polynomial": real(
        1, lambda t: jnp.polyval(jnp.asarray([1.0, -2.0, 1.0], t.dtype), t), lambda K, t: (t - 1) * (t - 1)
    ),
    "squares in a loop": real(
        1, _squares, lambda K, t: (t * t) * (t * t) * ((t * t) * (t * t)) / 2.0**14, (-64.0, 64.0)
    ),
}  # fmt: skip
