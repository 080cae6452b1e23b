"""Which operation of a function has no bound, no bounded derivative or a jump on a box, and where it stands."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import jax.numpy as jnp

from gsisio_jax.inclusion.interpreter import WATCH
from gsisio_jax.inclusion.node import is_node
from gsisio_jax.inclusion.transforms import jacobian
from gsisio_jax.interval.box import Interval
from gsisio_jax.scalar.numpy_program import numpy_function

Fault = Literal["may jump", "has an unbounded derivative", "has no bound"]
# Results of these are constant between jumps, or choose between cases.
_JUMPING = {
    "sign", "floor", "ceil", "round", "rem", "select_n", "convert_element_type", "floor_divide", "remainder", "trunc",
    "atan2", "argmax", "argmin", "gather", "dynamic_slice", "is_finite",
}  # fmt: skip


@dataclass(frozen=True)
class Culprit:
    """An operation that spoils the bounds of a function.

    Attributes:
        operation: name of the primitive of JAX.
        fault: what is wrong with it on the box.
        place: file and line of the user's code, "an unknown place" where JAX does not tell.
    """

    operation: str
    fault: Fault
    place: str

    def __str__(self) -> str:
        return f"`{self.operation}`, used at {self.place}, {self.fault}"


def culprits(function: Callable[..., Any], box: Interval, *args: Any) -> list[Culprit]:
    """The operations where bounds of the value or of the derivative become infinite for the first time.

    Arguments are those of `jacobian`, with numbers that are known.
    """
    seen: list[tuple[str, str]] = []

    def judged(box: Interval) -> list[tuple[Any, Any]]:
        """Of every operation, in order: is the value unbounded, and the derivative, for the first time?"""
        lost: list[tuple[Any, Any]] = []

        def watch(name: str, places: Sequence[str], operands: Sequence[Any], results: Sequence[Any]) -> None:
            nodes = [v for v in operands if is_node(v) and v.dtype != bool]
            for result in results:
                if is_node(result) and result.dtype != bool:
                    slopes = [v.jac for v in nodes if v.jac is not None]
                    steep = False if result.jac is None else _loses(slopes, result.jac)
                    lost.append((_loses([v.range for v in nodes], result.range), steep))
                    seen.append((name, places[-1] if places else "an unknown place"))

        token = WATCH.set(watch)
        try:
            jacobian(function)(box, *args)
        finally:
            WATCH.reset(token)
        return lost

    found: list[Culprit] = []
    for (value, slope), (name, place) in zip(numpy_function(judged, box)(box), seen, strict=True):
        steep: Fault = "may jump" if name in _JUMPING else "has an unbounded derivative"
        # The first at a place is the reason; a call that holds it has it, too.
        if (value or slope) and all(c.place != place for c in found):
            found.append(Culprit(name, "has no bound" if value else steep, place))
    return found


def _loses(before: Sequence[Interval], after: Interval) -> Any:
    """Infinite after an operation whose operands all were finite."""
    return _finite(before) & ~_finite([after])


def _finite(boxes: Sequence[Interval]) -> Any:
    sides = [side for box in boxes for side in (box.lower, box.upper)]
    return jnp.array([jnp.isfinite(side).all() for side in sides], bool).all()
