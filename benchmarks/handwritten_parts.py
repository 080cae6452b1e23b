"""Bounds for the handwritten step: a box is a pair of 0-d values, and a linear image has one error bound."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp

EPS, TINY = 2.0**-52, 2.3e-308
_HALF_PI = (1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
Box = tuple[Any, Any]
Boxes = Sequence[Box]
least, most = jnp.minimum, jnp.maximum


def sin_cos(t: Any) -> Box:
    """Sine and cosine of a number of moderate size."""
    k = jnp.round(t * (2 / math.pi))
    y = ((t - k * _HALF_PI[0]) - k * _HALF_PI[1]) - k * _HALF_PI[2]
    z = y * y
    p = q = None
    for i in range(7, 0, -1):
        s, c = (-1) ** i / math.factorial(2 * i + 1), (-1) ** (i + 1) / math.factorial(2 * i + 2)
        p, q = (s, c) if p is None else (s + z * p, c + z * q)
    sine, cosine = y + y * (z * p), 1 + z * (-0.5 + z * q)
    quarter = k - 4 * jnp.floor(k * 0.25)
    odd = (quarter == 1) | (quarter == 3)
    a, b = jnp.where(odd, cosine, sine), jnp.where(odd, sine, cosine)
    return jnp.where(quarter >= 2, -a, a), jnp.where((quarter == 1) | (quarter == 2), -b, b)


def magnitude(box: Box) -> Any:
    return most(abs(box[0]), abs(box[1]))


def middle(boxes: Boxes, wider: float = 0.0) -> tuple[list[Any], list[Any]]:
    """Centres and radii."""
    radii = [0.5 * (high - low) for low, high in boxes]
    return [0.5 * (low + high) for low, high in boxes], [r * (1 + wider) for r in radii] if wider else radii


def negative(box: Box) -> Box:
    return -box[1], -box[0]


def linear(weights: Any, boxes: Boxes, sizes: Sequence[Any] | None = None) -> Box:
    """``sum weights[i] boxes[i]`` for constants."""
    low: Any = None
    high = error = low
    for i, (weight, box) in enumerate(zip(map(float, weights), boxes, strict=True)):
        if weight == 0:
            continue
        a, b = (weight * box[0], weight * box[1]) if weight > 0 else (weight * box[1], weight * box[0])
        size = abs(weight) * (magnitude(box) if sizes is None else sizes[i])
        low, high, error = (a, b, size) if low is None else (low + a, high + b, error + size)
    if low is None:
        return jnp.zeros(()), jnp.zeros(())
    error = error * ((len(boxes) + 3) * EPS) + 64 * TINY
    return low - error, high + error


def combined(weights: Any, values: Sequence[Any]) -> Any:
    """``sum weights[i] values[i]`` of constants and numbers; None where no term is left."""
    terms = [float(w) * v for w, v in zip(weights, values, strict=True) if float(w) != 0 and not _zero(v)]
    return sum(terms[1:], terms[0]) if terms else None


def _zero(value: Any) -> bool:
    return isinstance(value, float) and value == 0


def add(*boxes: Box) -> Box:
    low, high = boxes[0]
    for box in boxes[1:]:
        low, high = low + box[0], high + box[1]
    error = (abs(low) + abs(high)) * (len(boxes) * EPS) + 8 * TINY
    return low - error, high + error


def meet(first: Box, *boxes: Box) -> Box:
    low, high = first
    for box in boxes:
        low, high = most(low, box[0]), least(high, box[1])
    return low, high


def where(mask: Any, box: Box) -> Box:
    """The box where the mask holds, else everything."""
    return jnp.where(mask, box[0], -jnp.inf), jnp.where(mask, box[1], jnp.inf)


def row_times(row: Sequence[Any], centred: tuple[list[Any], list[Any]]) -> Box:
    """``row . x`` for slopes that are numbers, from centres and radii of x."""
    used = [(slope, c, r) for slope, c, r in zip(row, *centred, strict=True) if slope is not None]
    value = sum(slope * c for slope, c, _ in used)
    width = sum(abs(slope) * r for slope, _, r in used)
    width = width + (abs(value) + width) * (8 * EPS) + 64 * TINY
    return value - width, value + width


def wave(box: Box) -> tuple[Any, Box, Box]:
    """Slope, box of what is left of the sine, and its range, on a box."""
    m, r = 0.5 * (box[0] + box[1]), 0.5 * (box[1] - box[0])
    ok = r < 3.14
    m, r = jnp.where(ok, m, 0.0), jnp.where(ok, r, 0.0)
    sine, cosine = sin_cos(m)
    half_sine, half_cosine = sin_cos(0.5 * r)
    slope, size = cosine * half_cosine, abs(cosine)
    odd = size * most(half_sine - 0.5 * r * half_cosine, half_cosine * (r - 2 * half_sine))
    even = sine * (1 - 2 * half_sine * half_sine)
    shift, swing = slope * m, size * 2 * half_sine * half_cosine
    error = (abs(m) + r) * (16 * EPS)
    low, high = least(sine, even) - odd - shift - error, most(sine, even) + odd - shift + error
    top, bottom = (~ok | _turns(m - r, m + r, side * math.pi / 2) for side in (1, -1))
    floor = most(jnp.where(bottom, -1, even - swing) - error, -1.0)
    ceiling = least(jnp.where(top, 1, even + swing) + error, 1.0)
    slope = jnp.where(ok, slope, 0.0)
    return slope, (jnp.where(ok, low, floor), jnp.where(ok, high, ceiling)), (floor, ceiling)


def _turns(low: Any, high: Any, at: float) -> Any:
    """Does the sine turn at ``at + 2 pi k`` between these?"""
    period = 2 * math.pi
    return jnp.ceil((low - at) / period) <= (high - at) / period
