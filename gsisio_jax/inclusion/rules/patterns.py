"""Expressions that are recognised as a whole, within one jaxpr.

The equation at the end of such an expression is replaced by what is known of the whole; what leads to it is evaluated
too, and dropped by the compiler where nothing else needs it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from gsisio_jax.inclusion.rules import angles, exponentials, gates, square_sums
from gsisio_jax.inclusion.rules.makers import Makers, Match

_FINDERS: dict[str, Callable[[Makers, Any], Match | None]] = {
    "sqrt": square_sums.norm,
    "div": exponentials.softmax,
    "add": exponentials.log_sum_exp,
    "log": exponentials.bare_log_sum,
    "sub": exponentials.log_softmax,
    "mul": gates.product,
    "atan2": angles.wrapped,
}
# Without one of these in it, a jaxpr holds none of them.
_SIGNS = {"sqrt", "atan2", "exp", "tanh", "erfc", "erf", "logistic", "jit", "pjit"}


def find(jaxpr: Any) -> dict[int, Match]:
    """Known functions in a jaxpr, by the place of their equation."""
    if not _SIGNS & {eqn.primitive.name for eqn in jaxpr.eqns}:
        return {}
    graph, found = Makers(jaxpr), {}
    for i, eqn in enumerate(jaxpr.eqns):
        finder = _FINDERS.get(eqn.primitive.name)
        match = finder(graph, eqn) if finder else None
        if match is not None:
            found[i] = match
    return found
