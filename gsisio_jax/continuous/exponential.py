"""The exponential of a matrix, with a bound of its error: fixed-point numbers of any length, and no rounding to trust.

``exp(M) = (sum_k (M / 2^s)^k / k!)^(2^s)``, with s such that rows and columns of ``M / 2^s`` add up to 1/2 at most.
Numbers are integers times ``2^-P``. A product of two such matrices is exact before it is cut to P bits, which costs a
unit.

- Series: a term's error is at most half of that of the term before, plus what cutting and the error of ``M / 2^s`` (one
  unit in every entry) bring: fewer than ``n + 4`` units, so 41 terms have fewer than ``82 (n + 4)``. The rest of the
  series is below ``2 (1/2)^41 / 41! < 2^-200``. With P = 320 both together are below ``2^-190`` for ``n < 2^100``.
- Squaring: ``(E + e)^2 - E^2 = E e + e E + e e``, so an error of e in every entry becomes ``2 n |E| e + n e^2`` and a
  unit.

Source: theory 15.
"""

from __future__ import annotations

from fractions import Fraction

import numpy as np

_BITS = 320
_UNIT = Fraction(1, 2**_BITS)
_TERMS = 40
LARGEST = 1e4  # of rows and columns, beyond which a step is no step of a sampled plant


def exponential(matrix: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
    """``exp(h matrix)`` and a bound of the error, entry by entry.

    Args:
        matrix: (n, n), finite.
        h: a number.

    Raises:
        OverflowError: `h matrix` is so large that the exponential, or the work, is without sense.
    """
    n = len(matrix)
    if n == 0:
        return np.zeros((0, 0)), np.zeros((0, 0))
    exact = np.array([[Fraction(float(entry)) * Fraction(h) for entry in row] for row in matrix], object)
    size = max(abs(exact).sum(0).max(), abs(exact).sum(1).max())
    if size > LARGEST:
        raise OverflowError(f"its rows times the step add up to {float(size):.3g}, beyond {LARGEST:.0e}")
    halvings = 0
    while size > Fraction(2**halvings, 2):
        halvings += 1
    small = np.array([[round(entry * 2**_BITS / 2**halvings) for entry in row] for row in exact], object)
    term = np.array([[(i == j) << _BITS for j in range(n)] for i in range(n)], object)
    total = term.copy()
    for k in range(1, _TERMS + 1):
        term = (term.dot(small) >> _BITS) // k
        total += term
    error = Fraction(1, 2**190)
    for _ in range(halvings):
        largest = Fraction(int(abs(total).max()), 2**_BITS)
        error = 2 * n * largest * error + n * error**2 + _UNIT
        total = total.dot(total) >> _BITS
    value = np.array([[int(entry) / 2**_BITS for entry in row] for row in total])
    lost = [
        [abs(Fraction(v) - Fraction(int(t), 2**_BITS)) + error for v, t in zip(*rows, strict=True)]
        for rows in zip(value.tolist(), total, strict=True)
    ]
    return value, np.array([[np.nextafter(float(entry), np.inf) for entry in row] for row in lost])


def integral_upper(matrix: np.ndarray, radius: np.ndarray, h: float) -> np.ndarray:
    """Upper bound of ``integral of exp(s matrix) radius ds`` over [0, h]: an entry of a larger exponential."""
    n = len(matrix)
    larger = np.zeros((n + 1, n + 1))
    larger[:n, :n], larger[:n, n] = matrix, radius
    value, error = exponential(larger, h)
    return np.nextafter(value[:n, n] + error[:n, n], np.inf)
