"""Bounds that users supply for primitives, or for jitted functions of their own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp

from gsisio_jax._calls import named_arguments
from gsisio_jax.inclusion.node import Node, as_node, chain, is_node, join
from gsisio_jax.interval.box import Interval


@dataclass(frozen=True)
class _ByHand:
    natural: Callable[..., Interval]
    derivative: Callable[..., Any] | None


BY_HAND: dict[str, _ByHand] = {}


@named_arguments
def register_bounds(name: str, natural: Callable[..., Interval], derivative: Callable[..., Any] | None = None) -> None:
    """Supply bounds by hand for a primitive, or for a function of your own under ``jax.jit``.

    Args:
        name: name of the primitive, or of the jitted function (its ``__name__``).
        natural: takes one `Interval` per argument and returns an `Interval` that contains every value.
        derivative: for elementwise functions; takes the same and returns one `Interval` per argument (or just one if
            there is one argument) that contains the derivatives by that argument. Without it the derivative is
            unknown, ``(-inf, inf)``.

    The affine domain takes slope 0. Registered names come before the built-in table.

    Source: theory 9.
    """
    if not isinstance(name, str):
        raise ValueError(
            f"register_bounds: `name` must be that of a primitive or of a jitted function, got {type(name).__name__}; "
            "f.__name__"
        )
    if not callable(natural) or not (derivative is None or callable(derivative)):
        raise ValueError(f"register_bounds: `natural` and `derivative` for {name!r} must be functions of intervals")
    BY_HAND[name] = _ByHand(natural, derivative)


def apply_by_hand(bounds: _ByHand, args: Sequence[Any]) -> Node:
    """Range and Jacobian of a registered operation of nodes and constants, at least one of them a node."""
    dtype = next(arg.dtype for arg in args if is_node(arg))
    nodes = [arg if is_node(arg) else as_node(arg, jnp.shape(arg), dtype) for arg in args]
    ranges = [node.range for node in nodes]
    natural = bounds.natural(*ranges)
    if all(node.jac is None for node in nodes):
        return Node(natural)
    if bounds.derivative is None:
        size = next(node.jac.lower.shape[0] for node in nodes if node.jac is not None)
        unknown = jnp.full((size, *natural.lower.shape), jnp.inf, natural.lower.dtype)
        return Node(natural, None, Interval.unchecked(-unknown, unknown))
    slopes = bounds.derivative(*ranges)
    slopes = [slopes] if isinstance(slopes, Interval) else list(slopes)
    jac = None
    for slope, node in zip(slopes, nodes, strict=True):
        jac = join(jac, chain(slope, node.jac))
    return Node(natural, None, jac)
