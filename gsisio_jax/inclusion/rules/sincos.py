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

Source: design 6 and 12.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.interval.xla import once

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


@jax.custom_jvp
def sin_cos(t: Any) -> tuple[Any, Any]:
    """Sine and cosine for ``|t| < LIMIT``, off by ``2 eps`` at most (the sine by ``2 eps |t|``)."""
    return _sin_cos(t)


@partial(jax.jit, inline=True)  # traced once for every shape
def _sin_cos(t: Any) -> tuple[Any, Any]:
    name = "float32" if t.dtype == jnp.float32 else "float64"
    kind = np.dtype(t.dtype).type
    k = jnp.round(t * kind(2 / math.pi))
    y = t
    for part in _PARTS[name]:
        y = y - k * kind(part)
    z = y * y
    count = _TERMS[name]
    p = q = None
    for i in range(count, 0, -1):
        s, c = kind((-1) ** i / math.factorial(2 * i + 1)), kind((-1) ** (i + 1) / math.factorial(2 * i + 2))
        p, q = (s, c) if p is None else (s + z * p, c + z * q)
    sine, cosine = once(y + y * (z * p)), once(1 + z * (kind(-0.5) + z * q))
    # k mod 4 in floating point: k is small.
    quarter = k - 4 * jnp.floor(k * kind(0.25))
    odd = (quarter == 1) | (quarter == 3)
    first, second = jnp.where(odd, cosine, sine), jnp.where(odd, sine, cosine)
    sine, cosine = jnp.where(quarter >= 2, -first, first), jnp.where((quarter == 1) | (quarter == 2), -second, second)
    return once(sine), once(cosine)


@sin_cos.defjvp
def _sin_cos_jvp(primals: tuple[Any], tangents: tuple[Any]) -> tuple[Any, Any]:
    sine, cosine = sin_cos(*primals)
    return (sine, cosine), (cosine * tangents[0], -sine * tangents[0])
