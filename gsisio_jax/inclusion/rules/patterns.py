"""Expressions that are recognised as a whole: what JAX's softmax, logsumexp and user code write out.

    sqrt(x_1^2 + ... + x_k^2 (+ constants))            Euclidean norm
    exp(a) / sum(exp(a))                               softmax; also of a minus anything that is common to all entries
    log(sum(exp(a - m))) + m                           logsumexp
    (a - m) - log(sum(exp(a - m)))                     log_softmax

Only within one jaxpr. The equation at the end is replaced; what leads to it is evaluated too, and dropped by the
compiler where nothing else needs it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax.extend.core as jex
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.node import Node, is_node
from gsisio_jax.inclusion.rules import vectors
from gsisio_jax.inclusion.rules.linear import move, structural

_KEEPS = ("stop_gradient", "copy", "optimization_barrier")
_MOST_TERMS = 64


@dataclass
class Match:
    """An equation that stands for a known function of other variables."""

    rule: Callable[..., Node | None]
    operands: Sequence[Any]


class _Jaxpr:
    """Which equation made a variable."""

    def __init__(self, jaxpr: Any):
        self.maker = {id(out): eqn for eqn in jaxpr.eqns for out in eqn.outvars}

    def made(self, atom: Any, *names: str) -> Any:
        """The equation that made it, if it is one of these."""
        eqn = None if isinstance(atom, jex.Literal) else self.maker.get(id(atom))
        return eqn if eqn is not None and eqn.primitive.name in names else None

    def plain(self, atom: Any) -> Any:
        """The variable behind operations that change no number."""
        while (eqn := self.made(atom, *_KEEPS)) is not None and len(eqn.outvars) == 1:
            atom = eqn.invars[0]
        return atom

    def common(self, atom: Any, axes: Sequence[int], shape: tuple[int, ...]) -> Any:
        """The variable behind a broadcast along these axes, without them; None where it is none.

        A scalar operand counts as broadcast along all axes.
        """
        atom = self.plain(atom)
        rest = tuple(n for axis, n in enumerate(shape) if axis not in axes)
        kept = tuple(1 if axis in axes else n for axis, n in enumerate(shape))
        if atom.aval.shape == () and rest == ():
            return atom
        while True:
            eqn = self.made(atom, "broadcast_in_dim", "reshape", "squeeze", "expand_dims", *_KEEPS)
            if eqn is None:
                break
            name, inner = eqn.primitive.name, eqn.invars[0]
            if name == "broadcast_in_dim" and atom.aval.shape in (shape, kept):
                dims = eqn.params["broadcast_dimensions"]
                whole = {axis: inner.aval.shape[i] for i, axis in enumerate(dims)}
                if any(whole.get(axis, 1) != 1 for axis in axes):
                    return None
                if any(whole.get(axis, 1) != n for axis, n in enumerate(shape) if axis not in axes):
                    return None
            elif name != "broadcast_in_dim" and math.prod(inner.aval.shape) == math.prod(rest):
                pass
            elif name not in _KEEPS:
                return None
            atom = inner
            if atom.aval.shape == rest and name not in _KEEPS:
                return self.plain(atom)
        return self.plain(atom) if atom.aval.shape in (rest, kept) else None

    def same(self, a: Any, b: Any) -> bool:
        return not isinstance(a, jex.Literal) and self.plain(a) is self.plain(b)


def find(jaxpr: Any) -> dict[int, Match]:
    """Known functions in a jaxpr, by the place of their equation."""
    names = {eqn.primitive.name for eqn in jaxpr.eqns}
    if not ("sqrt" in names or {"exp", "reduce_sum"} <= names):
        return {}
    graph, found = _Jaxpr(jaxpr), {}
    for i, eqn in enumerate(jaxpr.eqns):
        finder = _FINDERS.get(eqn.primitive.name)
        match = finder(graph, eqn) if finder else None
        if match is not None:
            found[i] = match
    return found


# Norms ----------------------------------------------------------------------------------------------------------------
def _norm(graph: _Jaxpr, eqn: Any) -> Match | None:
    terms = _squares(graph, eqn.invars[0])
    if not terms or len(terms) > _MOST_TERMS or all(constant for _, _, constant in terms):
        return None
    operands = [atom for atom, _, _ in terms]
    if any(isinstance(atom, jex.Literal) and float(atom.val) < 0 for atom, _, constant in terms if constant):
        return None
    shape = eqn.outvars[0].aval.shape

    def rule(*values: Any) -> Node | None:
        rows: list[Any] = []
        for value, (_, axes, constant) in zip(values, terms, strict=True):
            if constant:
                # A number c >= 0 is the square of its root, which need not be exact: as a box.
                if is_node(value) or not _nonnegative(value):
                    return None
                value = vectors.root_of(value)
            keep = tuple(n for axis, n in enumerate(_shape(value)) if axis not in axes)
            if keep not in (shape, ()):
                return None
            lead = [_shape(value)[axis] for axis in axes]

            def call(v: Any, axes: Any = axes, lead: Any = lead, keep: Any = keep) -> Any:
                v = jnp.moveaxis(v, axes, range(len(axes))).reshape(math.prod(lead), *keep)
                return jnp.broadcast_to(v.reshape(math.prod(lead), *(keep or (1,) * len(shape))), (len(v), *shape))

            rows.append(move(call, value))
        return vectors.norm(rows[0] if len(rows) == 1 else structural(lambda *v: jnp.concatenate(v), rows)[0])

    return Match(rule, operands)


def _nonnegative(value: Any) -> bool:
    return isinstance(value, np.ndarray | np.generic) and bool((np.asarray(value, float) >= 0).all())


def _shape(value: Any) -> tuple[int, ...]:
    return value.shape if is_node(value) else np.shape(value)


def _squares(graph: _Jaxpr, atom: Any) -> list[tuple[Any, tuple[int, ...], bool]] | None:
    """An atom as a sum of squares: variables, the axes over which their squares are summed, and whether the variable is
    a constant that is itself the term."""
    atom = graph.plain(atom)
    if isinstance(atom, jex.Literal):
        return [(atom, (), True)]
    eqn = graph.maker.get(id(atom))
    if eqn is None:
        return None
    name, inner = eqn.primitive.name, eqn.invars[0]
    if name == "square" or (name == "integer_pow" and eqn.params["y"] == 2):
        return [(inner, (), False)]
    if name == "mul" and graph.same(*eqn.invars):
        return [(inner, (), False)]
    if name == "dot_general" and graph.same(*eqn.invars) and inner.aval.ndim == 1:
        return [(inner, (0,), False)]
    if name == "reduce_sum":
        below = _squares(graph, inner)
        if below is None or any(axes or constant for _, axes, constant in below):
            return None
        if any(leaf.aval.shape != inner.aval.shape for leaf, _, _ in below):
            return None
        return [(leaf, tuple(eqn.params["axes"]), False) for leaf, _, _ in below]
    if name in ("add", "add_any"):
        pair = [_squares(graph, operand) for operand in eqn.invars]
        if any(terms is None for terms in pair):
            return None
        return [term for terms in pair for term in terms]  # type: ignore[union-attr]
    if name in ("reshape", "squeeze") and eqn.outvars[0].aval.shape == ():
        below = _squares(graph, inner)
        if below is None or len(below) != 1 or below[0][2] or below[0][1]:
            return None
        return [(below[0][0], tuple(range(below[0][0].aval.ndim)), False)]
    return None


# Exponentials ---------------------------------------------------------------------------------------------------------
def _exponents(graph: _Jaxpr, atom: Any) -> tuple[Any, tuple[int, ...]] | None:
    """``sum(exp(h))``: h and the axes."""
    total = graph.made(graph.plain(atom), "reduce_sum")
    if total is None:
        return None
    exp = graph.made(graph.plain(total.invars[0]), "exp")
    axes = tuple(total.params["axes"]) if total is not None else ()
    return (exp.invars[0], axes) if exp is not None and len(axes) == 1 else None


def _unshifted(graph: _Jaxpr, h: Any, axes: tuple[int, ...]) -> tuple[Any, Any]:
    """``h = a - m`` with an m that is common to all entries along the axes: a and m (without them), else h, None."""
    difference = graph.made(graph.plain(h), "sub")
    if difference is None:
        return h, None
    a, m = difference.invars
    if isinstance(m, jex.Literal) or a.aval.shape != h.aval.shape:
        return h, None
    common = graph.common(m, axes, h.aval.shape)
    return (a, common) if common is not None else (h, None)


def _over(rule: Callable[[Node], Node], axes: tuple[int, ...], keeps: bool) -> Callable[..., Node]:
    (axis,) = axes

    def run(a: Any) -> Node | None:
        if not is_node(a) or a.shape[axis] > _MOST_TERMS:
            return None
        found = rule(move(lambda v: jnp.moveaxis(v, axis, 0), a))
        return move(lambda v: jnp.moveaxis(v, 0, axis), found) if keeps else found

    return run  # type: ignore[return-value]


def _softmax(graph: _Jaxpr, eqn: Any) -> Match | None:
    top = graph.made(graph.plain(eqn.invars[0]), "exp")
    if top is None or isinstance(eqn.invars[1], jex.Literal):
        return None
    h, shape = top.invars[0], top.outvars[0].aval.shape
    for axis in range(len(shape)):
        below = graph.common(eqn.invars[1], (axis,), shape)
        sums = None if below is None else _exponents(graph, below)
        if sums is not None and sums[1] == (axis,) and graph.same(sums[0], h):
            a, _ = _unshifted(graph, h, (axis,))
            return Match(_over(vectors.softmax, (axis,), True), [a])
    return None


def _log_sum(graph: _Jaxpr, atom: Any) -> tuple[Any, tuple[int, ...]] | None:
    """``log(sum(exp(h)))``, the sum perhaps within ``abs`` (which does nothing to it)."""
    log = graph.made(graph.plain(atom), "log")
    if log is None:
        return None
    inner = graph.plain(log.invars[0])
    size = graph.made(inner, "abs")
    return _exponents(graph, size.invars[0] if size is not None else inner)


def _log_sum_exp(graph: _Jaxpr, eqn: Any) -> Match | None:
    for first, second in (eqn.invars, eqn.invars[::-1]):
        sums = _log_sum(graph, first)
        if sums is None or isinstance(second, jex.Literal):
            continue
        a, m = _unshifted(graph, *sums)
        if m is not None and graph.same(m, second):
            return Match(_over(vectors.log_sum_exp, sums[1], False), [a])
    return None


def _bare_log_sum(graph: _Jaxpr, eqn: Any) -> Match | None:
    """``log(sum(exp(a)))``, as it stands."""
    sums = _log_sum(graph, eqn.outvars[0])
    return Match(_over(vectors.log_sum_exp, sums[1], False), [sums[0]]) if sums is not None else None


def _log_softmax(graph: _Jaxpr, eqn: Any) -> Match | None:
    h, right = eqn.invars
    if isinstance(right, jex.Literal) or isinstance(h, jex.Literal):
        return None
    for axis in range(h.aval.ndim):
        below = graph.common(right, (axis,), h.aval.shape)
        sums = None if below is None else _log_sum(graph, below)
        if sums is not None and sums[1] == (axis,) and graph.same(sums[0], h):
            a, _ = _unshifted(graph, h, (axis,))
            return Match(_over(vectors.log_softmax, (axis,), True), [a])
    return None


_FINDERS: dict[str, Callable[[_Jaxpr, Any], Match | None]] = {
    "sqrt": _norm,
    "div": _softmax,
    "add": _log_sum_exp,
    "log": _bare_log_sum,
    "sub": _log_softmax,
}
