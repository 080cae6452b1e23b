"""Square roots of sums of squares, in whatever way they are written: Euclidean norms."""

from __future__ import annotations

import math
from typing import Any

import jax.extend.core as jex
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.node import Node, is_node
from gsisio_jax.inclusion.rules import vectors
from gsisio_jax.inclusion.rules.linear import move, structural
from gsisio_jax.inclusion.rules.makers import MOST_TERMS, Makers, Match


def norm(graph: Makers, eqn: Any) -> Match | None:
    terms = _squares(graph, eqn.invars[0])
    if not terms or len(terms) > MOST_TERMS or all(constant for _, _, constant in terms):
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
    return isinstance(value, np.ndarray | np.generic) and not np.signbit(np.asarray(value, float)).any()


def _shape(value: Any) -> tuple[int, ...]:
    return value.shape if is_node(value) else np.shape(value)


def _squares(graph: Makers, atom: Any) -> list[tuple[Any, tuple[int, ...], bool]] | None:
    """An atom as a sum of squares: variables, the axes over which their squares are summed, and whether the variable is
    a constant that is itself the term."""
    atom = graph.plain(atom)
    if isinstance(atom, jex.Literal):
        return [(atom, (), True)]
    eqn = graph.maker.get(id(atom))
    if eqn is None:
        return None
    name, inner = eqn.primitive.name, eqn.invars[0]
    aval: Any = inner.aval
    if name == "square" or (name == "integer_pow" and eqn.params["y"] == 2):
        return [(inner, (), False)]
    if name == "mul" and not isinstance(inner, jex.Literal) and graph.same(*eqn.invars):
        return [(inner, (), False)]
    if name == "dot_general" and graph.same(*eqn.invars) and aval.ndim == 1:
        return [(inner, (0,), False)]
    if name == "reduce_sum":
        below = _squares(graph, inner)
        if below is None or any(axes or constant for _, axes, constant in below):
            return None
        if any(leaf.aval.shape != aval.shape for leaf, _, _ in below):
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
