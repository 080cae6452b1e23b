"""Powers with constant exponents that differ from entry to entry: Vandermonde matrices, ``x ** jnp.arange(k)``."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.node import is_node, normalised
from gsisio_jax.inclusion.rules.bilinear import integer_power, raise_to
from gsisio_jax.inclusion.rules.linear import move, structural
from gsisio_jax.interval.box import is_concrete

_MOST_EXPONENTS = 32


def power(eqn: Any, x: Any, p: Any) -> Any:
    """``x ** p``; every exponent that occurs is a function of one variable."""
    if is_node(p) or not is_concrete(p) or not is_node(x):
        return raise_to(x, p)
    shape = eqn.outvars[0].aval.shape
    exponents = np.broadcast_to(np.asarray(p, float), shape)
    different = np.unique(exponents)
    if not 1 < len(different) <= _MOST_EXPONENTS:
        return raise_to(x, p)  # an entry of a vector is raised by itself, with no shape
    x = normalised(move(lambda v: jnp.broadcast_to(v, shape), x))
    found = integer_power(x, float(different[0]))
    for exponent in different[1:]:
        mask, other = exponents == exponent, integer_power(x, float(exponent))
        found = structural(lambda a, b, mask=mask: jnp.where(mask, a, b), [normalised(other), normalised(found)])[0]
    return found
