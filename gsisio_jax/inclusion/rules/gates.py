"""Products of a variable with a function of that same variable: gelu, silu and mish as they are written out.

Which one it is, if any, is found by evaluating the expression at a few points while tracing.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax.extend.core as jex
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.node import is_node
from gsisio_jax.inclusion.rules.activations import GELU, GELU_TANH, MISH, SILU
from gsisio_jax.inclusion.rules.makers import Makers, Match
from gsisio_jax.inclusion.rules.univariate import apply
from gsisio_jax.scalar.numpy_program import numpy_function

_MOST_STEPS = 24
_BENT = {"tanh", "erf", "erfc", "logistic", "exp"}
_STEPS = {
    *_BENT, "add", "sub", "mul", "div", "neg", "integer_pow", "square", "log1p", "log", "jit", "pjit",
    "custom_jvp_call", "convert_element_type", "copy", "stop_gradient",
}  # fmt: skip
_POINTS = np.array([-2.5, -1.1, -0.3, 0.4, 0.9, 1.7, 3.1])


def _erf(t: np.ndarray) -> np.ndarray:
    return np.array([math.erf(v) for v in np.ravel(t)]).reshape(np.shape(t))


GATES: dict[str, tuple[Any, Callable[[np.ndarray], np.ndarray]]] = {
    "silu": (SILU, lambda t: t / (1 + np.exp(-t))),
    "gelu, approximate": (GELU_TANH, lambda t: 0.5 * t * (1 + np.tanh((2 / np.pi) ** 0.5 * (t + 0.044715 * t**3)))),
    "gelu": (GELU, lambda t: 0.5 * t * (1 + _erf(t / 2**0.5))),
    "mish": (MISH, lambda t: t * np.tanh(np.log1p(np.exp(t)))),
}


def product(graph: Makers, eqn: Any) -> Match | None:
    shape = eqn.outvars[0].aval.shape
    for leaf in _leaves(graph, eqn):
        if leaf.aval.shape != shape or 0 in shape or not jnp.issubdtype(leaf.aval.dtype, jnp.floating):
            continue
        steps = _steps(graph, eqn, leaf, [_MOST_STEPS])
        if steps is None or not steps & _BENT:
            continue
        tolerance = 1e-5 if leaf.aval.dtype == np.float32 else 1e-10
        first = numpy_function(partial(_first_value, graph, eqn, leaf), 0.0)
        found = np.array([first(float(t)) for t in _POINTS], float)
        for curve, exact in GATES.values():
            if np.allclose(found, exact(_POINTS), tolerance, tolerance):
                return Match(lambda x, curve=curve: apply(curve, x) if is_node(x) else None, [leaf])
    return None


def _leaves(graph: Makers, eqn: Any) -> list[Any]:
    """What the product may be a function of: its factors, and those of a factor that is a multiple."""
    found = []
    for atom in eqn.invars:
        inner = graph.made(atom, "mul")
        for leaf in (atom, *(inner.invars if inner is not None else ())):
            if not isinstance(leaf, jex.Literal):
                found.append(leaf)
    return found


def _inside(eqn: Any) -> set[str]:
    """Names of what a call does."""
    inner = eqn.params.get("jaxpr", eqn.params.get("call_jaxpr"))
    if inner is None:
        return {eqn.primitive.name}
    return set().union(*(_inside(e) for e in getattr(inner, "jaxpr", inner).eqns))


def _steps(graph: Makers, eqn: Any, leaf: Any, left: list[int]) -> set[str] | None:
    """Names of the operations between the leaf and the equation; None where it depends on anything else, or where they
    are more than are `left`."""
    left[0] -= 1
    if left[0] < 0 or eqn.primitive.name not in _STEPS or len(eqn.outvars) != 1:
        return None
    names = _inside(eqn)
    for atom in eqn.invars:
        if isinstance(atom, jex.Literal) or atom is leaf:
            continue
        maker = graph.maker.get(id(atom))
        below = None if maker is None else _steps(graph, maker, leaf, left)
        if below is None:
            return None
        names |= below
    return names


def _first_value(graph: Makers, eqn: Any, leaf: Any, t: Any) -> Any:
    return _value(graph, eqn, leaf, t).ravel()[0]


def _value(graph: Makers, eqn: Any, leaf: Any, t: Any) -> Any:
    """The expression where all entries of the leaf are t."""
    args = []
    for atom in eqn.invars:
        aval: Any = atom.aval
        if isinstance(atom, jex.Literal):
            args.append(jnp.asarray(atom.val, aval.dtype))
        elif atom is leaf:
            args.append(jnp.full(leaf.aval.shape, t, leaf.aval.dtype))
        else:
            args.append(_value(graph, graph.maker[id(atom)], leaf, t))
    inner = eqn.params.get("jaxpr", eqn.params.get("call_jaxpr"))
    if inner is not None:
        return jex.jaxpr_as_fun(inner)(*args)[0]
    return eqn.primitive.bind(*args, **eqn.params)
