"""What a measurement says of the outputs and of the inputs that reach them at once; boxes of points."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from gsisio_jax import inclusion
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, add, choose, entire_like
from gsisio_jax.interval.image import image
from gsisio_jax.plant.system import Noise, System


def value_at(function: Any, x: Any, *args: Any) -> Interval:
    """A function at a point, as a box."""
    if rounding.outward():
        return inclusion.natural(function)(point(x), *args)
    return point(function(x, *args).astype(x.dtype))


def output_box(system: System, y: Any, u: Any, v: Interval) -> Interval:
    """Box of ``y - D u - v``: of ``g(x) + H d``; all of R where y is NaN (or infinite: batches cannot refuse it). To be
    `widened_for_sums` before it is used."""
    missing = ~jnp.isfinite(y)
    seen = jnp.where(missing, 0, y)
    if system.m:
        known = add(point(seen), Interval.unchecked(-v.upper, -v.lower), image(-system.D, point(u)))
    else:  # one rounding, which `widened_for_sums` has room for
        known = Interval.unchecked(seen - v.upper, seen - v.lower)
    return choose(missing, entire_like(known), known)


def shift_box(system: System, y: Any, u: Any, noise: Noise) -> Interval:
    """Box (n + l,) of ``[B u + w; D u + v - y]``: what is known of a step besides f, g and d."""
    drift = add(image(system.B, point(u)), noise.w) if system.m else noise.w
    seen = output_box(system, y, u, noise.v)
    return Interval.unchecked(jnp.concatenate([drift.lower, -seen.upper]), jnp.concatenate([drift.upper, -seen.lower]))


def point(value: Any) -> Interval:
    return Interval.unchecked(value, value)


def inside(box: Interval, region: Interval) -> Any:
    """Does the whole box lie in the region?"""
    return ((region.lower <= box.lower) & (box.upper <= region.upper)).all()


def in_box(value: Any, box: Interval) -> Any:
    """For a known input: do the design's enclosures of the derivatives hold for it?"""
    return inside(point(value), box)


def typed(box: Interval, dtype: Any) -> Interval:
    """The box in that floating type; its numbers are of that type already, or of no precision."""
    return Interval.unchecked(jnp.asarray(box.lower, dtype), jnp.asarray(box.upper, dtype))


def everything_unless(mask: Any, box: Interval) -> Interval:
    """The box where the mask holds, else everything."""
    return choose(mask, box, entire_like(box))
