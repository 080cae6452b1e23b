"""What a trace of a user's map shows that JAX would pass over in silence."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jax.extend.core as jex
import numpy as np

_RANDOM = (
    "random_bits",
    "random_seed",
    "random_wrap",
    "random_fold_in",
    "random_split",
    "random_gamma",
    "threefry2x32",
)
_JITTED = ("jit", "pjit")


def check_trace(name: str, first: Any, second: Any) -> None:
    """Refuse a map that draws random numbers, is another one at every call, or reads entries that are not there.

    Args:
        name: "f" or "g".
        first: its closed jaxpr.
        second: that of another call.

    Raises:
        ValueError: one of these, with the remedy.
    """
    random = sorted({eqn.primitive.name for eqn in equations(first.jaxpr)}.intersection(_RANDOM))
    if random:
        raise ValueError(
            f"System: {name} draws random numbers (`{random[0]}`), so it is no function of x. Noise is w and v, which "
            "the Noise bounds; gx.simulate draws them"
        )
    if not _same(list(_numbers(first)), list(_numbers(second))):
        raise ValueError(
            f"System: {name} is another function every time it is called: its constants differ (numpy.random? the "
            "time? a counter?). Compute them once, outside of it; noise is w and v"
        )
    if found := _beyond(first.jaxpr):
        index, shape = found
        raise ValueError(
            f"System: {name} reads index {index} of an array of shape {shape}, which ends before it (JAX would "
            "take the nearest entry without a word); x has one entry per row of G, u one per known input"
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


def _beyond(jaxpr: Any) -> tuple[int, tuple[int, ...]] | None:
    """A constant index beyond the end of an array, as it was written, and the shape; None where there is none.

    JAX makes a plain slice of a constant index that is inside, and of others a `dynamic_slice` that clamps.
    """
    known: dict[Any, Any] = {}
    written: dict[Any, Any] = {}  # before the size was added to negative ones

    def value(atom: Any) -> Any:
        return atom.val if isinstance(atom, jex.Literal) else known.get(atom)

    for eqn in jaxpr.eqns:
        name, given = eqn.primitive.name, [value(atom) for atom in eqn.invars]
        if name in _JITTED and (found := _beyond(eqn.params["jaxpr"].jaxpr)):
            return found
        if name == "dynamic_slice":
            shape = eqn.invars[0].aval.shape
            starts = zip(shape, eqn.params["slice_sizes"], given[1:], eqn.invars[1:], strict=True)
            for size, taken, start, atom in starts:
                if start is not None and not 0 <= int(start) <= size - taken:
                    return int(start if isinstance(atom, jex.Literal) else written.get(atom, start)), shape
        if name in _FOLDED and all(part is not None and np.ndim(part) == 0 for part in given):
            known[eqn.outvars[0]] = _FOLDED[name](*given)
            if name == "select_n":
                written[eqn.outvars[0]] = given[1]
    return None


_FOLDED = {
    "lt": lambda a, b: a < b,
    "add": lambda a, b: a + b,
    "select_n": lambda which, *cases: cases[int(which)],
    "convert_element_type": lambda a: a,
}
