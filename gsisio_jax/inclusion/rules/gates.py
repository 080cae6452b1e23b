"""Products of a variable with a function of that same variable: gelu, silu and mish as they are written out.

An expression is one of them where it is written as one of the forms below, up to the order of terms and factors and to
the rounding of constants; values at some points would not tell it from a function that is only close.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax.extend.core as jex
import numpy as np

from gsisio_jax.inclusion.node import is_node
from gsisio_jax.inclusion.rules.activations import GELU, GELU_TANH, MISH, SILU
from gsisio_jax.inclusion.rules.makers import Makers, Match
from gsisio_jax.inclusion.rules.univariate import apply
from gsisio_jax.inclusion.rules.written import VARIABLE, Polynomial, function, number, written

_ROUNDING = 4.0  # of constants, in eps of their size: far below what the curves are widened by

# The functions in NumPy, for calls that are known as a whole (`library`).
GATES: dict[str, tuple[Any, Callable[[np.ndarray], np.ndarray]]] = {
    "silu": (SILU, lambda t: t / (1 + np.exp(-t))),
    "mish": (MISH, lambda t: t * np.tanh(np.log1p(np.exp(t)))),
}


def _forms() -> list[tuple[Any, Polynomial]]:
    t, half, one = VARIABLE, number(0.5), number(1)
    cubic = number(math.sqrt(2 / math.pi)) * (t + number(0.044715) * t * t * t)
    scaled, growth = number(math.sqrt(0.5)) * t, function("exp", t)
    return [
        (SILU, t * function("logistic", t)),
        (SILU, t * function("inverse", one + function("exp", number(-1) * t))),
        (SILU, half * t * (one + function("tanh", half * t))),
        (GELU_TANH, half * t * (one + function("tanh", cubic))),
        (GELU_TANH, t * function("logistic", number(2) * cubic)),
        (GELU, half * t * (one + function("erf", scaled))),
        (GELU, half * t * function("erfc", number(-1) * scaled)),
        *((MISH, t * function("tanh", soft)) for soft in (
            function("softplus", t), function("log1p", growth), function("log", one + growth),
        )),
    ]  # fmt: skip


_FORMS = _forms()
_BENT = {"tanh", "erf", "erfc", "logistic", "inverse"}


def product(graph: Makers, eqn: Any) -> Match | None:
    shape, dtype = eqn.outvars[0].aval.shape, eqn.outvars[0].aval.dtype
    if 0 in shape or dtype not in (np.float32, np.float64):
        return None
    for leaf in _leaves(graph, eqn):
        if leaf.aval.shape != shape or leaf.aval.dtype != dtype:
            continue
        found = written(eqn, lambda atom: graph.maker.get(id(atom)), leaf)
        if found is None or not found.functions() & _BENT:
            continue
        for curve, form in _FORMS:
            if found.is_near(form, _ROUNDING * float(np.finfo(dtype).eps)):
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
