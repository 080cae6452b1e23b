"""Bounds on many boxes in one compiled loop over chunks of them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax._calls import named_arguments
from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.reading import is_whole
from gsisio_jax.interval.rounding import outward
from gsisio_jax.scalar import call

CHUNK = 256
"""Boxes at a time: all numbers of one chunk stay in the first cache, where those of 10^4 boxes stay in none."""


@named_arguments
def batched(bounds: Callable[..., Any], shared: bool = True, chunk: int = CHUNK) -> Callable[..., Any]:
    """Bounds on many boxes at once, compiled: as ``jax.vmap(bounds)``, up to the last digits, and faster.

    The function is written out number by number, without small arrays, and runs over 256 boxes at a time in one loop,
    with all that is computed on the way in the cache. With XLA's flags as the command line sets them
    (`gsisio_jax.scalar.options.use_flags`) that loop is one function. It keeps one core busy; give every thread a part.

    Args:
        bounds: a function of a box (n,) and of further arguments, as `natural`, `affine`, ... return it. What it
            returns is kept for every box: ask for the range alone where slopes are not wanted.
        shared: the further arguments are the same for all boxes; False: each has the axis of the boxes in front.
        chunk: boxes at a time.

    Returns:
        A function of boxes (N, n) and of the further arguments that returns what `bounds` returns, every array of it
        with an axis of N in front. It is compiled for every N that it meets.

    Raises:
        ValueError: `chunk` is no whole number of at least 1; the first argument is no box of shape (N, n); a further
            argument lacks the axis of the boxes.

    >>> from gsisio_jax.inclusion import natural
    >>> ranges = batched(natural(lambda x: x[0] * x[1], rounding="nearest"))
    >>> ranges(Interval([[0.0, 1.0], [2.0, 3.0]], [[1.0, 2.0], [3.0, 4.0]]))
    Interval([0. 6.], [ 2. 12.])

    Source: theory 9.
    """
    if not callable(bounds):
        raise ValueError(
            f"inclusion.batched: `bounds` must be a function of a box, as inclusion.natural(f) is, got "
            f"{type(bounds).__name__}"
        )
    if not is_whole(chunk) or chunk < 1:
        raise ValueError(f"inclusion.batched: `chunk` must be a whole number of boxes of at least 1, got {chunk!r}")

    @partial(jax.jit, static_argnames="rounded_outward")
    def compiled(boxes: Interval, args: tuple[Any, ...], rounded_outward: bool) -> Any:
        """`rounded_outward`: what is in force while this is traced."""
        axes = (0, *([None if shared else 0] * len(args)))
        # A function of its own at every trace: JAX keeps what it traced of one, whatever rounding is in force.
        every = jax.vmap(lambda *given: call(lambda *one: bounds(*one), *given), axes)
        number = boxes.shape[0]
        if number <= chunk:
            return every(boxes, *args)

        def at(start: Any) -> Any:
            def part(value: Any) -> Any:
                return jax.lax.dynamic_slice_in_dim(value, start, chunk)

            return every(jax.tree.map(part, boxes), *(args if shared else jax.tree.map(part, args)))

        def turn(i: Any, found: Any) -> Any:
            start = jnp.minimum(i * chunk, number - chunk)  # the last chunk goes over some boxes again
            return jax.tree.map(
                lambda whole, part: jax.lax.dynamic_update_slice_in_dim(whole, part, start, 0), found, at(start)
            )

        shapes = jax.eval_shape(at, 0)
        empty = jax.tree.map(lambda leaf: jnp.zeros((number, *leaf.shape[1:]), leaf.dtype), shapes)
        return jax.lax.fori_loop(0, -(-number // chunk), turn, empty)

    def many(boxes: Interval, *args: Any) -> Any:
        if not isinstance(boxes, Interval) or len(boxes.shape) != 2:
            got = f"a box of shape {boxes.shape}" if isinstance(boxes, Interval) else type(boxes).__name__
            remedy = "; for one box call the bounds themselves" if isinstance(boxes, Interval) else ""
            raise ValueError(f"inclusion.batched: needs an Interval of shape (N, n), got {got}{remedy}")
        for leaf in [] if shared else jax.tree.leaves(args):
            if np.shape(leaf)[:1] != boxes.shape[:1]:
                raise ValueError(
                    f"inclusion.batched: with shared=False a further argument has {boxes.shape[0]} rows, one a box; "
                    f"got one of shape {np.shape(leaf)}; what holds for all boxes goes with shared=True"
                )
        return compiled(boxes, args, rounded_outward=outward())

    return many
