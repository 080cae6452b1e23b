"""Simulated runs whose noise lies in its bounds for certain: their truth is held against boxes without any slack.

A simulated sum ``f + B u + G d + w`` rounds, where the plant does not: what the next state holds as noise is that state
less the real sum without w, and of that an enclosure is known. Drawn noise is pulled in by so much where that leaves
room; the run is then, exactly, one of the plant as stated.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from gsisio_jax import inclusion
from gsisio_jax.interval.box import Interval
from gsisio_jax.plant.simulation import measured, moved, pulled_in
from gsisio_jax.plant.system import System


def next_state(system: System, x: Any, d: Any, u: Any, w: Any, bounds: Interval, strict: bool) -> tuple[Any, Any]:
    """x[k+1] (n,), and whether the noise that it holds lies within `bounds` for certain.

    Args:
        strict: look for that; else it is never certain, and nothing is enclosed.
    """
    if not strict:
        return moved(system, x, d, u, w, bounds)[0], False
    base = system.dynamics(x, u) + system.B @ u + system.G @ d
    return _inside(base, _enclosed(system.dynamics, x, u, d, system.B, system.G), w, bounds)


def measurement(system: System, x: Any, d: Any, u: Any, v: Any, bounds: Interval, strict: bool) -> tuple[Any, Any]:
    """y[k] (l,), and the same of its noise. Entries drawn outside of their bounds stay there, and are not looked at."""
    if not strict:
        return measured(system, x, d, u, v, bounds)[0], False
    base = system.measurement(x, u) + system.D @ u + system.H @ d
    return _inside(base, _enclosed(system.measurement, x, u, d, system.D, system.H), v, bounds)


def _enclosed(function: Any, x: Any, u: Any, d: Any, of_u: Any, of_d: Any) -> tuple[Any, Any]:
    """Sides of what the real sum without noise may be."""
    box = inclusion.natural(function)(Interval.unchecked(x, x), u)
    linear = of_u @ u + of_d @ d
    size = jnp.maximum(jnp.abs(box.lower), jnp.abs(box.upper)) + jnp.abs(of_u) @ jnp.abs(u) + jnp.abs(of_d) @ jnp.abs(d)
    # Products and their sum, the numbers of the matrices themselves (decimals), and the two sums here.
    finfo = jnp.finfo(size.dtype)
    off = (u.shape[0] + d.shape[0] + 4) * finfo.eps * size + finfo.tiny
    return (box.lower + linear) - off, (box.upper + linear) + off


def _inside(base: Any, enclosed: tuple[Any, Any], noise: Any, box: Interval) -> tuple[Any, Any]:
    """``base + noise``, the noise pulled inside of its box by what rounding may add, and whether it is in there."""
    eps, (low, high) = jnp.finfo(base.dtype).eps, enclosed
    largest = jnp.maximum(jnp.abs(box.lower), jnp.abs(box.upper))

    def certain(total: Any) -> Any:
        off = 4 * eps * (jnp.abs(total - base) + largest)  # differences round
        return (total - high - off >= box.lower) & (total - low + off <= box.upper)

    total = base + noise
    margin = (high - low) + 8 * eps * (jnp.abs(total) + largest)
    inner = pulled_in(noise, box, margin)
    legal = box.contains(noise)
    total = jnp.where(certain(total) | ~legal, total, base + inner)
    return total, (certain(total) | ~legal).all()
