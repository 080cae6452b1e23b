"""Sine and cosine on an interval: exact ranges, and what is left after a slope is taken off.

Source: theory 9 and 10.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.rules.sincos import LIMIT, SLOT, half_sin_cos, sin_cos
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, choose
from gsisio_jax.interval.direct import where
from gsisio_jax.interval.minmax import larger, smaller
from gsisio_jax.interval.primitives import fusion_barrier

_PERIOD = 6.28  # a little less than 2 pi


class _WaveParts(NamedTuple):
    """Is the interval usable; its middle m and half-width r; sine and cosine of m and of r / 2."""

    usable: Any
    m: Any
    r: Any
    sine: Any
    cosine: Any
    half_sin: Any
    half_cos: Any


@dataclass(frozen=True)
class Wave:
    """``sin`` or ``cos``.

    Everything follows from the middle m and the half-width r alone: ``phi(m + h) = phi(m) cos h + phi'(m) sin h``.
    Range and line then share four sines and cosines, which are what a wave costs.
    """

    cosine: bool

    def parts(self, a: Any, b: Any) -> _WaveParts:
        """What all three need."""
        usable, m, r = _middle(a, b)
        return _WaveParts(usable, m, r, *sin_cos(m), *half_sin_cos(r))

    def range(self, a: Any, b: Any, parts: _WaveParts | None = None) -> Interval:
        return _wave_range(self.cosine, 1.0, parts or self.parts(a, b))

    def near(self, a: Any, b: Any) -> Interval:
        """As good as `range` on thin boxes: slopes are at most 1, so no value is farther than r from that
        in the middle. What m, r and that value lose is part of what `_wave_padded` counts."""
        usable, m, r = _middle(a, b)
        value, radius = sin_cos(m)[self.cosine], r
        if rounding.outward():
            radius = r + rounding.error(abs(m) + r + (1.0 if self.cosine else 0.0), 8 * SLOT)
        radius = where(usable, radius, 2)
        return Interval.unchecked(larger(value - radius, -1), smaller(value + radius, 1))

    def derivative(self, a: Any, b: Any, parts: _WaveParts | None = None) -> Interval:
        return _wave_range(not self.cosine, -1.0 if self.cosine else 1.0, parts or self.parts(a, b))

    def line(self, a: Any, b: Any, natural: Interval, parts: _WaveParts | None = None) -> tuple[Any, Interval]:
        usable, m, r, sine, cosine, half_sin, half_cos = parts or self.parts(a, b)
        value, steepness = (cosine, -sine) if self.cosine else (sine, cosine)
        # With slope phi'(m) cos(r/2) the odd part of the rest, sin h - h cos(r/2), has its critical points at
        # +-r/2. It is then four times smaller than with the tangent, and no arccosine is needed.
        s = steepness * half_cos
        odd = jnp.abs(steepness) * larger(half_sin - 0.5 * r * half_cos, half_cos * (r - 2 * half_sin))
        even = value * (1 - 2 * half_sin**2)
        shift = s * m
        lower, upper = smaller(value, even) - odd - shift, larger(value, even) + odd - shift
        rest = _wave_padded(Interval.unchecked(lower, upper), self.cosine, m, r)
        return where(usable, s, 0), choose(usable, rest, natural)


def _middle(a: Any, b: Any) -> tuple[Any, Any, Any]:
    """Is [a, b] within less than a period and near enough for `sin_cos`; middle and half-width, 0 where it is not."""
    m, r = 0.5 * a + 0.5 * b, 0.5 * b - 0.5 * a
    usable = (r < 0.5 * _PERIOD) & (abs(m) + r < LIMIT[a.dtype.name])  # not where either is infinite or NaN
    return usable, fusion_barrier(where(usable, m, 0)), fusion_barrier(where(usable, r, 0))


def _wave_padded(exact: Interval, cosine: bool, m: Any, r: Any) -> Interval:
    """Outward by what the formulas of `Wave` lose."""
    radius = _wave_loss(cosine, m, r)
    return exact if radius is None else Interval.unchecked(exact.lower - radius, exact.upper + radius)


def _wave_loss(cosine: bool, m: Any, r: Any) -> Any:
    """What the formulas of `Wave` lose at most; None to nearest.

    With SLOT = 2, `sin_cos` is off by 2 eps at most, and by ``3 eps |t|`` in the sine. m and r are off by ``eps (|m| +
    r)`` together, and the derivative of every bound here by m or r is at most 2 in magnitude. Every product of two or
    three such values, and sum of three, stays below ``14 eps (k + |m| + r)``, k = 1 for a cosine and 0 for a sine,
    which vanishes with m and r. No crest is hidden by rounding: where there is one, the value in the middle is below
    ``cos r`` by less than this at most (for the sine ``|m| + r`` is at least pi/2 there).
    """
    if not rounding.outward():
        return None
    return rounding.error(abs(m) + r + (1.0 if cosine else 0.0), 8 * SLOT)


def crosses(phase: float, period: float, a: Any, b: Any) -> Any:
    """Does ``[a, b]`` contain ``phase + k period``?"""
    return jnp.ceil((a - phase) / period) <= (b - phase) / period


def _wave_range(cosine: bool, sign: float, parts: _WaveParts) -> Interval:
    """Range of ``sign`` times the sine or the cosine.

    A crest lies inside where its distance from m, in [0, pi], is at most r: where the value in m is at least ``cos r``.
    """
    usable, m, r, sine, other, half_sin, half_cos = parts
    value, steepness = (other, sine) if cosine else (sine, other)
    value = value if sign > 0 else -value
    turned = 1 - 2 * half_sin**2
    even, odd = value * turned, jnp.abs(steepness) * 2 * half_sin * half_cos
    pad = _wave_loss(cosine, m, r)
    limit, odd = (turned, odd) if pad is None else (turned - pad, odd + pad)
    lower = where(usable & (-value < limit), even - odd, -1)
    upper = where(usable & (value < limit), even + odd, 1)
    return Interval.unchecked(jnp.maximum(lower, -1), jnp.minimum(upper, 1))


def wave_atom(cosine: bool, m: Any, r: Any, size: Any, terms: int) -> tuple[Any, Any, Any, Interval, tuple[Any, Any]]:
    """Slope, center and radius of the offset, range, and value in the middle, of a sine or cosine of ``|t - m| <= r``,
    with ``|t| <= size``.

    As `Wave`, from the middle and the half-width alone, but in fewer operations. A crest lies inside where its distance
    from m is at most r, that is, where ``sin m >= cos r``. Radius and range are padded by what these formulas lose
    (`_wave_padded`), and by ``3 kappa`` times the size for rows of that many terms (`expansion`): offset and slope
    times argument are below ``3 size`` in magnitude, or ``1 + 2 size`` for a cosine.
    """
    kind = np.dtype(m.dtype).type
    usable = (r < 0.5 * _PERIOD) & (size < LIMIT[m.dtype.name])  # not where either is infinite or NaN
    m, r = where(usable, m, 0), where(usable, r, 0)
    (sine, other), (half_sin, half_cos) = sin_cos(m), half_sin_cos(r)
    value, steepness = (other, -sine) if cosine else (sine, other)
    pad: Any = kind(0)
    everything = kind(1)
    if rounding.outward():
        ulps = 8 * SLOT + 3 * (2 * terms + 16)
        pad = rounding.error(jax.lax.stop_gradient(size) + kind(cosine), ulps, rounding.FLUSHED)
        everything = kind(1 + ulps * float(jnp.finfo(m.dtype).eps))
    square = half_sin * half_sin
    slope, steep, turned, bent = steepness * half_cos, abs(steepness), 1 - 2 * square, value * square
    odd = steep * larger(half_sin - 0.5 * r * half_cos, half_cos * (r - 2 * half_sin))
    even = value * turned
    center = value - bent - slope * m  # halfway between value and even, which are 2 bent apart
    radius = abs(bent) + odd + pad
    half = 2 * steep * half_sin * half_cos + pad
    limit = turned - pad
    lower = where(usable & (-value < limit), even - half, -1)
    upper = where(usable & (value < limit), even + half, 1)
    natural = Interval.unchecked(larger(lower, -1), smaller(upper, 1))
    middle = where(usable, value, 0), where(usable, pad, 1)
    slope, center = where(usable, slope, 0), where(usable, center, 0)
    return slope, center, where(usable, radius, everything), natural, middle


def wave_point(cosine: bool, t: Any, size: Any, terms: int) -> tuple[Any, Any]:
    """A sine or cosine of a sum t of terms of the total magnitude `size`, and by how much it may be off: by what t is,
    by its own rounding, and for rows of that many terms."""
    kind = np.dtype(t.dtype).type
    usable = size < LIMIT[t.dtype.name]
    value = sin_cos(where(usable, t, 0))[cosine]
    pad: Any = kind(0)
    if rounding.outward():
        size = jax.lax.stop_gradient(where(usable, size, 0)) + kind(cosine)
        pad = rounding.error(size, 8 * SLOT + 3 * (2 * terms + 16), rounding.FLUSHED)
    return value, where(usable, pad, 2)
