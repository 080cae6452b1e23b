"""Bounds on a box whose numbers are known, outside of `jax.jit`: in NumPy.

JAX would compile a program for every operation and every shape, 20 ms for each: seconds for the first box of a function
whose bounds take NumPy milliseconds. So bounds are traced, as they are in `jax.jit`, and the program is run in NumPy.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import Tracer

from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.cast import as_array
from gsisio_jax.scalar.numpy_program import numpy_function

_TRACED: ContextVar[bool] = ContextVar("gsisio_jax_known_box_is_traced", default=False)


class UndecidedError(Exception):
    """A case could be chosen by the numbers of the box, which is traced although they are known."""


def case_is_open() -> None:
    """To be called where a case would be chosen, were the box not traced.

    Raises:
        UndecidedError: its numbers are known; whoever traces it has to look at them.
    """
    if _TRACED.get():
        raise UndecidedError


@contextmanager
def _traced() -> Iterator[None]:
    token = _TRACED.set(True)
    try:
        yield
    finally:
        _TRACED.reset(token)


def in_numpy(bounds: Callable[[Interval], Any], box: Interval, held: Any = ()) -> Any:
    """``bounds(box)``, arrays of JAX in any case; in NumPy where no number of the box and of `held` is traced.

    Args:
        bounds: of a box; what else it needs it holds.
        box: of a type that JAX knows; both sides may be one array, the box is known to be a point then.
        held: a tree of what `bounds` holds that may be traced.
    """
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((box.lower, box.upper, held))):
        return bounds(box)
    sides = (box.lower,) if box.lower is box.upper else (box.lower, box.upper)
    try:
        with _traced():
            program = numpy_function(lambda *given: bounds(Interval.unchecked(given[0], given[-1])), *sides)
    except (UndecidedError, jax.errors.TracerArrayConversionError):  # the latter: something else that is held is traced
        return bounds(box)
    return jax.tree.map(as_array, program(*sides))


def by_numpy(bounds: Callable[..., Any]) -> Callable[..., Any]:
    """Decorator of bounds of a box and of further arguments; see `in_numpy`."""

    @wraps(bounds)
    def run(box: Any, *args: Any) -> Any:
        if not isinstance(box, Interval) or not jnp.issubdtype(box.dtype, jnp.floating):
            return bounds(box, *args)  # which refuses it
        # In a type that JAX knows, rounded outward: JAX would round to nearest.
        return in_numpy(lambda given: bounds(given, *args), box.astype(box.dtype), args)

    return run
