"""Logarithms of sums of two exponentials."""

from __future__ import annotations

import math
from typing import Any

import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.node import Node, as_node, best_form, chain, is_node, join, meet, normalised
from gsisio_jax.inclusion.rules.functions import SOFTPLUS
from gsisio_jax.inclusion.rules.linear import add, multiple, subtract
from gsisio_jax.inclusion.rules.univariate import apply
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval

LOG_ADD_EXP_ULPS = 512.0


def log_add_exp(x: Any, y: Any) -> Node:
    """``log(exp x + exp y)``: smooth, so without the kink of the maximum that its body starts from."""
    if not is_node(x):
        x, y = y, x
    x, y = normalised(x), normalised(y) if is_node(y) else as_node(y, x.shape, x.dtype)
    low, high = x.range.lower, x.range.upper
    first, last = _log_add_exp(low, y.range.lower), _log_add_exp(high, y.range.upper)
    # max(x, y) + log1p(exp(-|x - y|)): the sum may cancel, so its error goes with the two terms.
    natural = Interval.unchecked(
        rounding.lowered(first, abs(first) + 1, LOG_ADD_EXP_ULPS),
        rounding.raised(last, abs(last) + 1, LOG_ADD_EXP_ULPS),
    )
    bend = apply(SOFTPLUS, subtract(Node(x.range, x.form), Node(y.range, y.form)))
    total = add(bend, Node(y.range, y.form))
    form = total.form
    form = form and best_form(form.slope, form.offset, natural, form.box, form.slack)
    gap = normalised(subtract(Node(x.range, x.form), Node(y.range, y.form))).range
    share = SOFTPLUS.derivative(gap.lower, gap.upper)
    rest = Interval.unchecked(
        jnp.maximum(rounding.lowered(1 - share.upper, jnp.ones_like(share.upper), 2.0), 0),
        jnp.minimum(rounding.raised(1 - share.lower, jnp.ones_like(share.lower), 2.0), 1),
    )
    return meet(Node(natural, form, join(chain(share, x.jac), chain(rest, y.jac))))


def log_add_exp2(x: Any, y: Any) -> Node:
    """``log2(2^x + 2^y)``, by natural logarithms."""
    like: Any = x if is_node(x) else y
    factor = np.asarray(math.log(2), like.dtype)
    x, y = (multiple(factor, v, rounded=True) if is_node(v) else as_node(v, like.shape, v.dtype) for v in (x, y))
    return multiple(1 / factor, log_add_exp(x, y), rounded=True)


def _log_add_exp(x: Any, y: Any) -> Any:
    plain = jnp.isfinite(x) & jnp.isfinite(y)
    smooth = jnp.logaddexp(jnp.where(plain, x, 0), jnp.where(plain, y, 0))
    return jnp.where(plain, smooth, jnp.maximum(x, y))
