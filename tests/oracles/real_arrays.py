"""Functions of arrays: sums, products, order, places, linear algebra of small matrices, with formulas for an entry."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from oracles.formulas import real
from oracles.real_functions import POSITIVE, _linear
from oracles.real_library import KNOTS, VALUES

SMALL = (-8.0, 8.0)


def _matrix(rows: Any) -> Any:
    return jnp.stack([jnp.stack([jnp.asarray(v) for v in row]) for row in rows])


def _two(x: Any) -> Any:
    """``[[4, x], [y, 3]]``, with determinant ``12 - x y``."""
    one = jnp.ones((), x.dtype)
    return _matrix([[4 * one, x[0]], [x[1], 3 * one]])


def _three(x: Any) -> Any:
    """``[[5, x, 1], [0, 6, y], [1, 0, 7]]``, with determinant ``204 + x y``."""
    one = jnp.ones((), x.dtype)
    return _matrix([[5 * one, x[0], one], [0 * one, 6 * one, x[1]], [one, 0 * one, 7 * one]])


def _symmetric(x: Any) -> Any:
    """``[[x, 1], [1, y]]``"""
    one = jnp.ones((), x.dtype)
    return _matrix([[x[0], one], [one, x[1]]])


def _right(x: Any) -> Any:
    return jnp.stack([jnp.ones((), x.dtype), x[1], x[0]])


def _ordered(K: Any, values: Any, use: Any) -> Any:
    """``use(smallest, middle, largest)`` of three exact numbers."""
    x, y, z = values

    def third(low: Any, high: Any) -> Any:
        inner = K.step(z, high, use(low, z, high), use(low, z, high), use(low, high, z))
        return K.step(z, low, use(z, low, high), use(low, z, high), inner)

    return K.step(x, y, third(x, y), third(x, y), third(y, x))


def _smallest(K: Any, x: Any, y: Any) -> Any:
    return K.step(x, y, 0.0, 0.0, 1.0)


def _median(K: Any, x: Any, y: Any, z: Any) -> Any:
    return _ordered(K, (x, y, z), lambda a, b, c: b)


def _log_add_exp2(K: Any, x: Any, y: Any) -> Any:
    two = K.log(K.number(2.0))

    def way(high: Any, low: Any) -> Any:
        return high + K.log1p(K.exp((low - high) * two)) / two

    return K.step(x, y, way(y, x), x + 1, way(x, y))


def _table(x: Any) -> Any:
    return jnp.asarray(VALUES, x.dtype) * x[0] + x[1]


FUNCTIONS = {
    "hypot": real(2, lambda x: jnp.hypot(x[0], x[1]), lambda K, x, y: K.hypot(x, y)),
    "norm of three": real(3, jnp.linalg.norm, lambda K, x, y, z: K.hypot(K.hypot(x, y), z)),
    "largest size": real(
        2, lambda x: jnp.linalg.norm(x, jnp.inf), lambda K, x, y: K.max(K.max(x, -x), K.max(y, -y)), slopes=False
    ),
    "log2 add exp2": real(2, lambda x: jnp.logaddexp2(x[0], x[1]), _log_add_exp2),
    "x log y": real(
        2, lambda x: jax.scipy.special.xlogy(x[1], x[0]),
        lambda K, x, y: K.step(y, 0.0, y * K.log(x), 0.0, y * K.log(x)), POSITIVE,
    ),
    "softmax of three": real(
        3, lambda x: jax.nn.softmax(x)[0], lambda K, x, y, z: 1 / (1 + K.exp(y - x) + K.exp(z - x))
    ),
    "copysign": real(
        2, lambda x: jnp.copysign(x[0], x[1]),
        lambda K, x, y: K.step(y, 0.0, -K.max(x, -x), K.max(x, -x), K.max(x, -x)), slopes=False,
    ),
    "floor of a quotient": real(
        1, lambda t: jnp.floor_divide(t, 0.5), lambda K, t: K.floor(2 * t), special=(0.5, -3.5), slopes=False
    ),
    # Order.
    "median": real(3, jnp.median, _median),
    "second of the sorted": real(3, lambda x: jnp.sort(x)[1], _median),
    "second of the largest": real(3, lambda x: lax.top_k(x, 2)[0][1], _median),
    "spread": real(3, jnp.ptp, lambda K, x, y, z: _ordered(K, (x, y, z), lambda a, b, c: c - a)),
    "entry of argmax": real(2, lambda x: x[jnp.argmax(x)], lambda K, x, y: K.max(x, y), slopes=False),
    "table by argmin": real(
        2, lambda x: jnp.asarray([1.5, -2.0], x.dtype)[jnp.argmin(x)], lambda K, x, y: K.step(x, y, 1.5, 1.5, -2.0),
        slopes=False,
    ),
    "argmin": real(2, lambda x: jnp.argmin(x) * jnp.ones((), x.dtype), _smallest, slopes=False),
    "argsort": real(2, lambda x: jnp.argsort(x)[0] * jnp.ones((), x.dtype), _smallest, slopes=False),
    "place of the largest": real(
        2, lambda x: lax.top_k(x, 1)[1][0] * jnp.ones((), x.dtype), lambda K, x, y: K.step(x, y, 1.0, 0.0, 0.0),
        slopes=False,
    ),
    "running maximum": real(2, lambda x: lax.cummax(x)[1], lambda K, x, y: K.max(x, y)),
    # Places.
    "row by a place": real(
        2, lambda x: jnp.stack([x[1], x[0] * x[1], x[0] / 49])[jnp.clip(x[0], 0, 2).astype(int)],
        lambda K, x, y: K.entry([y, x * y, x / 49], lambda v: np.floor(np.clip(v, 0, 2)), x), special=(2.0,),
        slopes=False,
    ),
    "table of arguments": _linear(
        lambda x: jnp.interp(jnp.asarray(0.375, x.dtype), jnp.asarray(KNOTS, x.dtype), _table(x)),
        lambda x, y: 0.4375 * x + y, lambda x, y: x * 7 / 16 + y, (7, 16), (1, 1),
    ),
    # Sums and products.
    "cumsum": _linear(lambda x: jnp.cumsum(x)[2], lambda x, y, z: x + y + z, lambda x, y, z: x + y + z,
                      (1, 1), (1, 1), (1, 1)),
    "differences": _linear(lambda x: jnp.diff(x, 2)[0], lambda x, y, z: x - 2 * y + z,
                           lambda x, y, z: x - 2 * y + z, (1, 1), (-2, 1), (1, 1)),
    "mean": _linear(jnp.mean, lambda x, y, z: (x + y + z) / 3, lambda x, y, z: (x + y + z) / 3,
                    (1, 3), (1, 3), (1, 3)),
    "convolution": _linear(
        lambda x: jnp.convolve(x, jnp.asarray([0.25, -0.5, 1.0], x.dtype))[2],
        lambda x, y: x - 0.5 * y, lambda x, y: x - y / 2, (1, 1), (-1, 2),
    ),
    "convolution of both": real(
        2, lambda x: jnp.convolve(x, x + jnp.asarray([0.0, 1.0], x.dtype))[1], lambda K, x, y: 2 * x * y + x
    ),
    "cumprod": real(3, lambda x: jnp.cumprod(x)[2], lambda K, x, y, z: x * y * z),
    "variance": real(2, jnp.var, lambda K, x, y: (x - y) * (x - y) / 4),
    "cross product": real(3, lambda x: jnp.cross(x, x[::-1])[0], lambda K, x, y, z: x * y - y * z),
    "quadratic form": real(
        2, lambda x: jnp.einsum("i,ij,j->", x, jnp.asarray([[2.0, 1.0], [1.0, 3.0]], x.dtype), x),
        lambda K, x, y: 2 * x * x + 2 * x * y + 3 * y * y,
    ),
    "segment_sum": real(
        2, lambda x: jax.ops.segment_sum(jnp.concatenate([x, x * x]), jnp.array([0, 1, 1, 2]), 3)[1],
        lambda K, x, y: y + x * x,
    ),
    "segment_max": real(
        2, lambda x: jax.ops.segment_max(jnp.concatenate([x, x]), jnp.array([0, 1, 1, 2]), 3)[1],
        lambda K, x, y: K.max(x, y),
    ),
    "scan": _linear(
        lambda x: lax.scan(lambda c, t: (c / 2 + t, c), x[0], x[1:])[0],
        lambda x, y, z: x / 4 + y / 2 + z, lambda x, y, z: x / 4 + y / 2 + z, (1, 4), (1, 2), (1, 1),
    ),
    # Linear algebra.
    "det": real(4, lambda x: jnp.linalg.det(x.reshape(2, 2)), lambda K, a, b, c, d: a * d - b * c),
    "det of three rows": real(2, lambda x: jnp.linalg.det(_three(x)), lambda K, x, y: 204 + x * y),
    "logdet": real(2, lambda x: jnp.linalg.slogdet(_two(x))[1], lambda K, x, y: K.log(K.max(12 - x * y, x * y - 12)),
                   SMALL, slopes=False),
    "logdet, positive": real(2, lambda x: jnp.linalg.slogdet(_three(x))[1], lambda K, x, y: K.log(204 + x * y),
                             SMALL),
    "inv": real(2, lambda x: jnp.linalg.inv(_two(x))[0, 1], lambda K, x, y: -x / (12 - x * y), SMALL),
    "solve": real(
        2, lambda x: jnp.linalg.solve(_three(x), _right(x))[0],
        lambda K, x, y: (42 - 7 * x * y + x * x * y - 6 * x) / (204 + x * y), SMALL,
    ),
    "solve, positive": real(
        2, lambda x: jax.scipy.linalg.solve(_symmetric(x), jnp.asarray([0.0, 1.0], x.dtype), assume_a="pos")[1],
        lambda K, x, y: x / (x * y - 1), POSITIVE,
    ),
    "solve, triangular": real(
        2, lambda x: jax.scipy.linalg.solve_triangular(_symmetric(x), jnp.ones(2, x.dtype), lower=True)[1],
        lambda K, x, y: (1 - 1 / x) / y, POSITIVE,
    ),
    "cholesky": real(
        2, lambda x: jnp.linalg.cholesky(_symmetric(x))[1, 0], lambda K, x, y: 1 / K.sqrt(x), POSITIVE, slopes=False
    ),
    "cholesky, last": real(
        2, lambda x: jnp.linalg.cholesky(_symmetric(x))[1, 1], lambda K, x, y: K.sqrt(y - 1 / x), POSITIVE
    ),
    "matrix power": real(
        2, lambda x: jnp.linalg.matrix_power(_two(x), 2)[0, 0], lambda K, x, y: 16 + x * y
    ),
}  # fmt: skip
