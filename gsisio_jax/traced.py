"""What a trace of a user's map shows that JAX would pass over in silence."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jax.extend.core as jex
import numpy as np

from gsisio_jax.indices import beyond

_RANDOM = (
    "random_bits",
    "random_seed",
    "random_wrap",
    "random_fold_in",
    "random_split",
    "random_gamma",
    "threefry2x32",
)


def check_trace(name: str, first: Any, second: Any) -> None:
    """Refuse a map that draws random numbers, is another one at every call, or reads entries that are not there.

    Args:
        name: "f" or "g".
        first: its closed jaxpr.
        second: that of another call.

    Raises:
        ValueError: one of these, with the remedy.
    """
    refuse_trace(
        f"System: {name}",
        first,
        "Noise is w and v, which the Noise bounds; gx.simulate draws them",
        "x has one entry per row of G, u one per known input",
    )

    refuse_change(f"System: {name}", first, second, "; noise is w and v")


def refuse_change(function: str, first: Any, second: Any, besides: str = "") -> None:
    """Refuse a function whose constants differ from one trace to the next: numpy.random, the time, a counter."""
    if not _same(list(_numbers(first)), list(_numbers(second))):
        raise ValueError(
            f"{function} is another function every time it is called: its constants differ (numpy.random? the "
            f"time? a counter?). Compute them once, outside of it{besides}"
        )


def refuse_trace(function: str, closed: Any, random: str, entries: str) -> None:
    """Refuse a function that draws random numbers or reads entries that are not there.

    Args:
        function: what messages call it.
        closed: its closed jaxpr.
        random: what to do in the place of random numbers.
        entries: which entries there are.
    """
    drawn = sorted({eqn.primitive.name for eqn in equations(closed.jaxpr)}.intersection(_RANDOM))
    if drawn:
        raise ValueError(f"{function} draws random numbers (`{drawn[0]}`), so it is no function of x. {random}")
    if found := beyond(closed):
        index, shape = found
        raise ValueError(
            f"{function} reads index {index} of an array of shape {shape}, which ends before it (JAX would "
            f"take another entry, or none, without a word); {entries}"
        )


def equations(jaxpr: Any) -> Iterator[Any]:
    for eqn in jaxpr.eqns:
        yield eqn
        for inner in _inner(eqn):
            yield from equations(getattr(inner, "jaxpr", inner))


def _inner(eqn: Any) -> Iterator[Any]:
    for value in eqn.params.values():
        for part in value if isinstance(value, tuple | list) else (value,):
            if hasattr(part, "eqns"):  # a jaxpr, closed or open
                yield part


def _numbers(jaxpr: Any) -> Iterator[Any]:
    """Constants and literals, in order."""
    yield from getattr(jaxpr, "consts", ())
    for eqn in jaxpr.eqns:
        yield from (atom.val for atom in eqn.invars if isinstance(atom, jex.Literal))
        for inner in _inner(eqn):
            yield from _numbers(inner)


def _same(first: list[Any], second: list[Any]) -> bool:
    return len(first) == len(second) and all(map(_equal, first, second))


def _equal(a: Any, b: Any) -> bool:
    if a is b:
        return True
    try:
        a, b = np.asarray(a), np.asarray(b)
        return a.shape == b.shape and bool(np.array_equal(a, b, equal_nan=a.dtype.kind == "f"))
    except Exception:  # a traced number, a key: not to be judged here
        return True
