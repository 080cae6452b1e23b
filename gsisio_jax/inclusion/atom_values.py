"""Atoms at a point, one after the other, and what is needed of an atom everywhere: its arguments and its rule."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.atoms import wider
from gsisio_jax.inclusion.linear_parts import Atom, Linear
from gsisio_jax.inclusion.node import POINT_MODE, Node
from gsisio_jax.inclusion.rules.bilinear import multiply
from gsisio_jax.inclusion.rules.functions import CURVES, RECIPROCAL, SQUARE
from gsisio_jax.inclusion.rules.registry import ELEMENTWISE
from gsisio_jax.inclusion.rules.trig import Wave, wave_point
from gsisio_jax.inclusion.rules.univariate import apply
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, center_and_radius, nan_to_unbounded
from gsisio_jax.interval.image import faint


def atom_value(atom: Atom, x: Any, thin: Interval, u: Any, found: Sequence[Any], terms: int) -> Any:
    """An atom at a point, as (value, radius), or on a thin box around it, as a box; widened for rows."""
    curve = CURVES.get(atom.name)
    if isinstance(curve, Wave) and is_plain(atom, len(x)):
        return wave_point(curve.cosine, *value_and_magnitude(atom.arguments[0], x, abs(x)), terms)
    found = [v if isinstance(v, Interval) else Interval.unchecked(v[0] - v[1], v[0] + v[1]) for v in found]
    if atom.source is not None:
        value = Interval.unchecked(u[atom.source], u[atom.source])
    else:
        token = POINT_MODE.set(True)
        try:
            nodes = [
                Node(argument_range(t, len(x), thin, found)) if t.coefficients else number(t, thin.lower.dtype)
                for t in atom.arguments
            ]
            value = nan_to_unbounded(rule(atom, nodes).range)
        finally:
            POINT_MODE.reset(token)
    extra = wider(jnp.maximum(abs(value.lower), abs(value.upper)), terms)
    return Interval.unchecked(value.lower - extra, value.upper + extra)


def thin_box(x: Any, terms: int) -> Interval:
    """A point, widened for rows."""
    error = wider(abs(x), terms)
    return Interval.unchecked(x - error, x + error)


def stacked_values(found: list[Any], dtype: Any) -> tuple[Any, Any]:
    """Middles and half-widths, of thin boxes or as they are; where one is infinite, its middle is 0."""
    if not found:
        return jnp.zeros(0, dtype), jnp.zeros(0, dtype)
    pairs = [center_and_radius(v) if isinstance(v, Interval) else v for v in found]
    value, error = (jnp.stack([jnp.asarray(pair[i], dtype) for pair in pairs]) for i in (0, 1))
    return value, error


def is_plain(atom: Atom, n: int) -> bool:
    """Its argument is a linear function of the states."""
    return all(k < n for k in atom.arguments[0].coefficients)


def value_and_magnitude(t: Linear, x: Any, magnitude: Any) -> tuple[Any, Any]:
    """A linear function of the states at a point, and the magnitude of its terms."""
    kind = np.dtype(x.dtype).type
    value: Any = kind(float(t.constant))
    size: Any = kind(abs(float(t.constant)))
    for k, weight in t.coefficients.items():
        value = value + kind(float(weight)) * x[k]
        size = size + kind(abs(float(weight))) * magnitude[k]
    return jnp.asarray(value), jnp.asarray(size)


def argument_range(t: Linear, n: int, wide: Interval, found: Sequence[Any]) -> Interval:
    """Range of an argument from ranges that were widened before."""
    dtype = wide.lower.dtype
    kind = np.dtype(dtype).type
    constant, error = kind(t.constant), abs(kind(t.constant)) * kind(16 * float(jnp.finfo(dtype).eps))
    error = error if rounding.outward() else kind(0)
    lower, upper = constant - error, constant + error
    for k, value in t.coefficients.items():
        weight = kind(value)
        side = wide[k] if k < n else found[k - n]
        first, last = (side.lower, side.upper) if value > 0 else (side.upper, side.lower)
        lower, upper = lower + weight * first, upper + weight * last
    floor = faint(np.array([kind(value) for value in t.coefficients.values()], dtype))
    lower, upper = lower - floor, upper + floor
    return Interval.unchecked(*(jnp.asarray(side, dtype) for side in (lower, upper)))


def number(t: Linear, dtype: Any) -> Any:
    """An argument that is a constant."""
    return np.asarray(float(t.constant), dtype)


def rule(atom: Atom, nodes: list[Any]) -> Node:
    """The atom by the rules of the engine over arrays."""
    if atom.name == "reciprocal":
        return apply(RECIPROCAL, nodes[0])
    if atom.name == "table":
        return apply(atom.equation, nodes[0])
    if atom.name == "mul":
        return apply(SQUARE, nodes[0]) if atom.arguments[0] is atom.arguments[1] else multiply(*nodes)
    return ELEMENTWISE[atom.name](atom.equation, *nodes)
