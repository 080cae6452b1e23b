"""Angles that are wrapped: ``arctan2(sin h, cos h)`` is h, but for a number of turns."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.extend.core as jex
import jax.numpy as jnp

from gsisio_jax.inclusion.node import Node, is_node, normalised
from gsisio_jax.inclusion.rules.bilinear import pick
from gsisio_jax.inclusion.rules.linear import subtract
from gsisio_jax.inclusion.rules.makers import Makers, Match
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, entire_like
from gsisio_jax.interval.primitives import times


def wrapped(graph: Makers, eqn: Any) -> Match | None:
    if any(isinstance(atom, jex.Literal) for atom in eqn.invars):
        return None
    sine, cosine = (graph.made(graph.plain(atom), name) for atom, name in zip(eqn.invars, ("sin", "cos"), strict=True))
    if sine is None or cosine is None or not graph.same(sine.invars[0], cosine.invars[0]):
        return None
    return Match(lambda h: _wrap(h) if is_node(h) else None, [sine.invars[0]])


def _wrap(h: Node) -> Node:
    h = normalised(h)
    c = h.range.center
    turns = jax.lax.stop_gradient(jnp.round(jnp.where(abs(c) < 1e6, c, 0) / (2 * math.pi)))
    # 2 pi k, with k a whole number; none of it where k is 0.
    there = times(turns, jnp.asarray(2 * math.pi, h.dtype))
    moved = normalised(subtract(h, Node(Interval.unchecked(rounding.down(there, 4.0), rounding.up(there, 4.0)))))
    zero = turns == 0
    kept = normalised(pick(zero, h, moved))
    least = jnp.asarray(math.pi, h.dtype) * (1 - 4 * float(jnp.finfo(h.dtype).eps))
    inside = (kept.range.lower > -least) & (kept.range.upper < least)
    most = rounding.up(jnp.full(h.shape, math.pi, h.dtype), 4.0)
    jump = None if h.jac is None else entire_like(h.jac.lower)
    return pick(inside, kept, Node(Interval.unchecked(-most, most), None, jump))
