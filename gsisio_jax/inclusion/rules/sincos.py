"""Sine and cosine in plain arithmetic, with a proven error bound: no library's accuracy has to be believed.

``t = k pi/2 + y`` with the nearest integer k, then Taylor's polynomials on ``|y| <= pi/4 + 2^-20``. With u the unit
roundoff, for ``|t| < LIMIT``:

- Reduction. pi/2 = P1 + P2 + P3 + rest with so few bits in P1 and P2 that ``k P1`` and ``k P2`` are exact; ``t - k P1``
  is then exact too (Sterbenz; k = 0 needs no subtraction). Two more subtractions round by ``u (|y| + 2^-20)`` each,
  ``k P3`` by ``u k P3``, and the rest of pi/2 is below ``2^-122`` (float32: ``2^-49``) times k: y is off by ``2 u``.
  For k = 0 nothing is subtracted: y = t.
- Truncation. The series alternate with falling terms, so each errs by less than its first missing term: ``y^17 / 17!``
  and ``y^18 / 18!`` (float32: ``y^11 / 11!`` and ``y^12 / 12!``), at most ``0.55 u`` (float32: ``0.1 u``), relative to
  ``|y|`` for the sine.
- Evaluation. ``y + y z p`` with ``|z p| < 0.11`` and ``1 - z / 2 + z^2 q`` with ``|z^2 q| < 0.016``: one rounding of
  the result, and one or two of terms that are an eighth of it or less, in any contraction: ``1.5 u``.

Together ``4 u = 2 eps`` absolutely, and ``3 eps |t|`` for the sine (k = 0: relative; else ``|t| > 0.78``).
Only the contraction of ``a b + c`` and nothing else may be rearranged, which holds without fast-math.

Source: theory 10.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

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
_TERMS = {"float64": 7, "float32": 4}


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
    """Sine and cosine of ``r / 2`` for ``0 <= r <= 3.2``, with the same error bounds.

    From a quarter of r, which needs no reduction: ``sin = 2 s c`` is off by ``(1.5 + 1.5 + 1) u`` of its value, and
    ``cos = 1 - 2 s^2`` by ``2 s^2 (2 1.5 + 1) u`` and a rounding of what is left, at most ``4 u`` where s^2 = 1/2.
    """
    kind = np.dtype(r.dtype).type
    sine, cosine = _polynomials(jax.lax.stop_gradient(r) * kind(0.25))
    sine, cosine = 2 * sine * cosine, 1 - 2 * sine * sine
    half = r * kind(0.5)
    return _wave(sine, half, cosine), _falling(cosine, half, sine)


def _polynomials(y: Any) -> tuple[Any, Any]:
    """Sine and cosine for ``|y| <= pi/4 + 2^-20``."""
    kind = np.dtype(y.dtype).type
    z = y * y
    p = q = None
    for i in range(_TERMS[_name(y)], 0, -1):
        s, c = kind((-1) ** i / math.factorial(2 * i + 1)), kind((-1) ** (i + 1) / math.factorial(2 * i + 2))
        p, q = (s, c) if p is None else (s + z * p, c + z * q)
    return y + y * (z * p), 1 + z * (kind(-0.5) + z * q)


def _name(t: Any) -> str:
    return "float32" if t.dtype == jnp.float32 else "float64"


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
    first, second = jnp.where(odd, cosine, sine), jnp.where(odd, sine, cosine)
    sine = jnp.where(quarter >= 0.5, -first, first)
    cosine = jnp.where((quarter == 0.25) | (quarter == 0.5), -second, second)
    return fusion_barrier(sine), fusion_barrier(cosine)
