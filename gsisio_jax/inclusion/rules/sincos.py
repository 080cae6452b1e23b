"""Sine and cosine in plain arithmetic, with a proven error bound: no library's accuracy has to be believed.

``t = k pi/2 + y`` with the nearest integer k, then polynomials on ``|y| <= pi/4 + 2^-20``. With u the unit roundoff,
for ``|t| < LIMIT``:

- Reduction. pi/2 = P1 + P2 + P3 + rest with so few bits in P1 and P2 that ``k P1`` and ``k P2`` are exact; ``t - k P1``
  is then exact too (Sterbenz; k = 0 needs no subtraction). Two more subtractions round by ``u (|y| + 2^-20)`` each,
  ``k P3`` by ``u k P3``, and the rest of pi/2 is below ``2^-122`` (float32: ``2^-49``) times k: y is off by
  ``2 u (|y| + 2^-19)``. For k = 0 nothing is subtracted: y = t.
- Truncation. The polynomials are the best of their degree (found by exchange, in 60 digits), with coefficients rounded
  to the type. ``|sin y - S(y)| <= .1 u |y|`` and ``|cos y - C(y)| <= .01 u`` are proven by ball arithmetic
  (`tests/inclusion/test_expansion.py`).
- Evaluation, in any contraction. ``y + y z p`` with ``|z p| < 0.1``: a rounding of the result, and four of terms that
  are a tenth of it. ``1 + w``, ``w = z (-1/2 + z q)`` in [-.3, 0]: half a u for the result, which is below 1, and three
  roundings of w. With truncation, the sine is off by ``1.6 u`` of its value, and by ``.9 u``, as it is below .71;
  the cosine by ``1.5 u``.

Together ``4 u = 2 eps`` absolutely, and ``3 eps |t|`` for the sine (k = 0: relative; else ``|t| > 0.78``).
Only the contraction of ``a b + c`` and nothing else may be rearranged, which holds without fast-math.

Source: theory 10.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from gsisio_jax.interval.direct import where
from gsisio_jax.interval.primitives import elementwise, fusion_barrier

LIMIT = {"float64": 1.6e6, "float32": 8.0e3, "float16": 1.0, "bfloat16": 1.0}
"""Arguments at or beyond this are not reduced: bounds are those of the whole period there."""

SLOT = 2.0
"""The error bound in eps, see above."""

# pi/2 in parts: 33 bits, 33 bits and a float64; for float32 8 bits, 11 bits and a float32.
_PARTS = {
    "float64": (1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21),
    "float32": (1.5703125, 4.83751296997070312500e-04, 7.54978995489188216340e-08),
}
# Coefficients of z, z^2, ... in S(y) / y - 1, and of z^2, z^3, ... in C(y) - 1 + z / 2, where z = y^2.
_SINE = {
    "float64": (
        -0.16666666666666632, 0.008333333333322425, -0.00019841269829816853, 2.755731369519055e-06,
        -2.505075864732619e-08, 1.589682756772613e-10,
    ),
    "float32": (-0.16666655242443085, 0.008332177996635437, -0.00019517297914717346),
}  # fmt: skip
_COSINE = {
    "float64": (
        0.0416666666666666, -0.0013888888888874138, 2.4801587289491763e-05, -2.7557314355219067e-07,
        2.0875723680832977e-09, -1.135966965791945e-11,
    ),
    "float32": (0.04166664555668831, -0.001388736767694354, 2.443845005473122e-05),
}  # fmt: skip


def sin_cos(t: Any) -> tuple[Any, Any]:
    """Sine and cosine for ``|t| < LIMIT``, off by ``2 eps`` at most (the sine by ``3 eps |t|``)."""
    sine, cosine = _sin_cos(jax.lax.stop_gradient(t))
    return _wave(sine, t, cosine), _falling(cosine, t, sine)


# The derivative of a polynomial would be another polynomial; but the other of the two is at hand, up to its sign. It
# comes with a derivative of its own.
_wave = elementwise(
    "wave",
    lambda value, t, slope: value,
    lambda primals, tangents, out: tangents[1] * _falling(primals[2], primals[1], primals[0]),
)
_falling = elementwise(
    "falling_wave",
    lambda value, t, slope: value,
    lambda primals, tangents, out: -tangents[1] * _wave(primals[2], primals[1], primals[0]),
)


def half_sin_cos(r: Any) -> tuple[Any, Any]:
    """Sine and cosine of ``r / 2`` for ``0 <= r <= pi``, with the same error bounds.

    From a quarter of r, which needs no reduction: ``sin = 2 s c`` is off by ``2 (.71 .9 + .71 1.5) u`` and half a u for
    its rounding, and by ``(1.6 + 1.5 / .7 + 1) u`` of its value; ``cos = 1 - 2 s^2`` by ``4 .71 .9 u``, and half a u
    for the product.
    """
    kind = np.dtype(r.dtype).type
    sine, cosine = _polynomials(jax.lax.stop_gradient(r) * kind(0.25))
    sine, cosine = 2 * sine * cosine, 1 - 2 * sine * sine
    half = r * kind(0.5)
    return _wave(sine, half, cosine), _falling(cosine, half, sine)


def _traced_once(function: Callable[..., Any]) -> Callable[..., Any]:
    """What was traced for a type and shape serves all sines; numbers that are known are computed as they are."""
    inlined = jax.jit(function, inline=True)
    return lambda t: (inlined if isinstance(t, Tracer) else function)(t)


@_traced_once
def _polynomials(y: Any) -> tuple[Any, Any]:
    """Sine and cosine for ``|y| <= pi/4 + 2^-20``."""
    kind = np.dtype(y.dtype).type
    z, name = y * y, _name(y)
    p, q = kind(_SINE[name][-1]), kind(_COSINE[name][-1])
    for s, c in zip(_SINE[name][-2::-1], _COSINE[name][-2::-1], strict=True):
        p, q = kind(s) + z * p, kind(c) + z * q
    return y + y * (z * p), 1 + z * (kind(-0.5) + z * q)


def _name(t: Any) -> str:
    return "float32" if t.dtype == jnp.float32 else "float64"


@_traced_once
def _sin_cos(t: Any) -> tuple[Any, Any]:
    kind = np.dtype(t.dtype).type
    k = jnp.round(t * kind(2 / math.pi))
    y = t
    for part in _PARTS[_name(t)]:
        y = y - k * kind(part)
    sine, cosine = map(fusion_barrier, _polynomials(y))
    # k mod 4 in floating point, in quarters: k is small.
    quarter = k * kind(0.25)
    quarter = quarter - jnp.floor(quarter)
    odd = (quarter == 0.25) | (quarter == 0.75)
    first, second = where(odd, cosine, sine), where(odd, sine, cosine)
    sine = where(quarter >= 0.5, -first, first)
    cosine = where((quarter == 0.25) | (quarter == 0.5), -second, second)
    return fusion_barrier(sine), fusion_barrier(cosine)
