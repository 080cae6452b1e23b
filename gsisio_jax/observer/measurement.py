"""What a measurement says of the outputs and of the inputs that reach them at once; boxes of points."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from gsisio_jax import inclusion
from gsisio_jax.inclusion import AffineForm
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import (
    Interval,
    add,
    choose,
    entire_like,
    image,
    intersect,
    nan_to_unbounded,
    reach,
    slip,
    widen,
)
from gsisio_jax.interval.xla import multiplied, once
from gsisio_jax.plant.system import System


def value_at(function: Any, x: Any, *args: Any) -> Interval:
    """A function at a point, as a box."""
    if rounding.outward():
        return inclusion.natural(function)(point(x), *args)
    return point(function(x, *args).astype(x.dtype))


def current_input(current: Any, h: AffineForm, state: Interval, output: Interval) -> Interval:
    """Box of ``V1' d = current (y - g - D u - v)``, slopes combined before the box is applied (paper, Lemma 4)."""
    n, weights = state.shape[0], -current
    slope = once(multiplied(weights, h.slope[n:]))
    joint = add(image(slope, state), image(weights, h.offset[n:]))
    if rounding.outward():
        lost = slip(abs(weights), slip(abs(h.slope[n:]), reach(state)))  # of the slopes before they cancelled
        joint = widen(joint, rounding.error(lost, h.slope.shape[0] - n + 6.0))
    return nan_to_unbounded(add(intersect(joint, image(weights, h.range[n:]))[0], image(current, output)))


def output_box(system: System, y: Any, u: Any, v: Interval) -> Interval:
    """Box of ``y - D u - v``: of ``g(x) + H d``; all of R where y is NaN (or infinite: batches cannot refuse it)."""
    missing = ~jnp.isfinite(y)
    seen = jnp.where(missing, 0, y)
    known = add(point(seen), Interval.unchecked(-v.upper, -v.lower))
    if system.m:
        known = add(known, image(-system.D, point(u)))
    return choose(missing, entire_like(known), known)


def point(value: Any) -> Interval:
    return Interval.unchecked(value, value)


def inside(box: Interval, region: Interval) -> Any:
    """Does the whole box lie in the region?"""
    return ((region.lower <= box.lower) & (box.upper <= region.upper)).all()


def in_box(value: Any, box: Interval) -> Any:
    """For a known input: do the design's enclosures of the derivatives hold for it?"""
    return inside(point(value), box)
