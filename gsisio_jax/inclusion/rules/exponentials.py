"""Softmax and its relatives, as JAX and users write them out.

exp(a) / sum(exp(a))                               softmax; also of a minus anything that is common to all entries
log(sum(exp(a - m))) + m                           logsumexp
(a - m) - log(sum(exp(a - m)))                     log_softmax
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.extend.core as jex
import jax.numpy as jnp

from gsisio_jax.inclusion.node import Node, is_node
from gsisio_jax.inclusion.rules import vectors
from gsisio_jax.inclusion.rules.linear import move
from gsisio_jax.inclusion.rules.makers import MOST_TERMS, Makers, Match


def _exponents(graph: Makers, atom: Any) -> tuple[Any, tuple[int, ...]] | None:
    """``sum(exp(h))``: h and the axes."""
    total = graph.made(graph.resized(atom), "reduce_sum")
    if total is None:
        return None
    exp = graph.made(graph.plain(total.invars[0]), "exp")
    axes = tuple(total.params["axes"]) if total is not None else ()
    return (exp.invars[0], axes) if exp is not None and len(axes) == 1 else None


def _unshifted(graph: Makers, h: Any, axes: tuple[int, ...]) -> tuple[Any, Any]:
    """``h = a - m`` with an m that is common to all entries along the axes: a and m (without them), else h, None."""
    difference = graph.made(graph.plain(h), "sub")
    if difference is None:
        return h, None
    a, m = difference.invars
    if isinstance(m, jex.Literal) or a.aval.shape != h.aval.shape:
        return h, None
    common = graph.common(m, axes, h.aval.shape)
    return (a, common) if common is not None else (h, None)


def _over(rule: Callable[[Node], Node], axes: tuple[int, ...], eqn: Any, keeps: bool) -> Callable[..., Node | None]:
    (axis,), shape = axes, eqn.outvars[0].aval.shape

    def run(a: Any) -> Node | None:
        if not is_node(a) or a.shape[axis] > MOST_TERMS:
            return None
        found = rule(move(lambda v: jnp.moveaxis(v, axis, 0), a))
        return move(lambda v: (jnp.moveaxis(v, 0, axis) if keeps else v).reshape(shape), found)

    return run


def softmax(graph: Makers, eqn: Any) -> Match | None:
    top = graph.made(graph.plain(eqn.invars[0]), "exp")
    if top is None or isinstance(eqn.invars[1], jex.Literal):
        return None
    h, shape = top.invars[0], top.outvars[0].aval.shape
    for axis in range(len(shape)):
        below = graph.common(eqn.invars[1], (axis,), shape)
        sums = None if below is None else _exponents(graph, below)
        if sums is not None and sums[1] == (axis,) and graph.same(sums[0], h):
            a, _ = _unshifted(graph, h, (axis,))
            return Match(_over(vectors.softmax, (axis,), eqn, True), [a])
    return None


def _log_sum(graph: Makers, atom: Any) -> tuple[Any, tuple[int, ...]] | None:
    """``log(sum(exp(h)))``, the sum perhaps within ``abs`` (which does nothing to it)."""
    log = graph.made(graph.resized(atom), "log")
    if log is None:
        return None
    inner = graph.resized(log.invars[0])
    size = graph.made(inner, "abs")
    return _exponents(graph, size.invars[0] if size is not None else inner)


def log_sum_exp(graph: Makers, eqn: Any) -> Match | None:
    for first, second in (eqn.invars, eqn.invars[::-1]):
        sums = _log_sum(graph, first)
        if sums is None or isinstance(second, jex.Literal):
            continue
        a, m = _unshifted(graph, *sums)
        if m is not None and graph.resized(m) is graph.resized(second):
            return Match(_over(vectors.log_sum_exp, sums[1], eqn, False), [a])
    return None


def bare_log_sum(graph: Makers, eqn: Any) -> Match | None:
    """``log(sum(exp(a)))``, as it stands."""
    sums = _log_sum(graph, eqn.outvars[0])
    return Match(_over(vectors.log_sum_exp, sums[1], eqn, False), [sums[0]]) if sums is not None else None


def log_softmax(graph: Makers, eqn: Any) -> Match | None:
    h, right = eqn.invars
    if isinstance(right, jex.Literal) or isinstance(h, jex.Literal):
        return None
    for axis in range(h.aval.ndim):
        below = graph.common(right, (axis,), h.aval.shape)
        sums = None if below is None else _log_sum(graph, below)
        if sums is not None and sums[1] == (axis,) and graph.same(sums[0], h):
            a, _ = _unshifted(graph, h, (axis,))
            return Match(_over(vectors.log_softmax, (axis,), eqn, True), [a])
    return None
