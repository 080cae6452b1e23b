"""Derivatives with forms: how a node changes with x, as a node of its own that is again a function of x.

The Jacobian of a node is a box for every entry, which forgets that derivatives of two nodes change together. Where
terms of a derivative cancel, as in ``db - dA x`` of a linear system, that makes the result many times too wide. So
where it matters, derivatives are built once more by the rules of differentiation from where a node comes from
(`origin`), with forms. What has no rule here enters with its Jacobian: a box without a form, sound for every function.
Of functions with kinks that is the hull of both sides, so the change along a segment still lies in the tangent times
the segment.

A tangent has the axis over the entries of x first, as Jacobians have.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.form_arithmetic import is_known, is_point
from gsisio_jax.inclusion.node import Node, is_node, jac_of, normalised
from gsisio_jax.inclusion.origin import Origin, origin
from gsisio_jax.inclusion.rules.bilinear import divide, dot, integer_power, multiply
from gsisio_jax.inclusion.rules.functions import CURVES
from gsisio_jax.inclusion.rules.linear import add, move, multiple, negative, structural, subtract
from gsisio_jax.inclusion.rules.possible import formless
from gsisio_jax.inclusion.rules.univariate import apply
from gsisio_jax.interval.devices import agreeing

MOST_OPERATIONS = 100  # that the derivatives of one node may take
# Primitives that move or add entries, and which of their operands are values; none: all of them.
_MOVES = {
    **dict.fromkeys(
        (
            "broadcast_in_dim", "reshape", "squeeze", "expand_dims", "transpose", "rev", "slice", "gather",
            "dynamic_slice", "copy", "reduce_sum",
        ),
        (0,),
    ),
    **dict.fromkeys(("concatenate", "stack"), ()),
    "pad": (0, 1),
}  # fmt: skip
_SLOPES: dict[str, Callable[[Node], Node]] = {
    "sin": lambda x: apply(CURVES["cos"], x),
    "cos": lambda x: negative(apply(CURVES["sin"], x)),
    "exp": lambda x: apply(CURVES["exp"], x),
    "square": lambda x: multiple(2.0, x),
}


class Tangents:
    """Tangents of nodes that one expression needs, each built once.

    Args:
        size: number of entries of x.
    """

    def __init__(self, size: int):
        self.size = size
        self._memo: dict[int, Any] = {}
        self._left = MOST_OPERATIONS

    def __call__(self, node: Node) -> Node:
        """The tangent of a node, of shape (size, *shape)."""
        if id(node) not in self._memo:
            self._memo[id(node)] = (self._build(node), node)  # which keeps the node's id its own
        return self._memo[id(node)][0]

    def _build(self, node: Node) -> Node:
        plain = Node(jac_of(node, self.size))
        found = origin(node)
        known = is_known(plain.range.lower) and (
            is_point(plain.range) or np.array_equal(plain.range.lower, plain.range.upper)
        )
        if node.jac is None or found is None or found.rule is not None or known or self._left <= 0:
            return plain
        self._left -= 1
        better = self._rule(found)
        return normalised(better) if is_node(better) else plain

    def _rule(self, found: Origin) -> Any:
        """The tangent by the rule of the primitive, None where there is none."""
        name, operands = found.name, [formless(v) if is_node(v) else v for v in found.operands]
        tangents: list[Any] = [self(v) if is_node(v) else None for v in found.operands]
        if name in _MOVES:
            return self._moved(found, tangents)
        if name in ("add", "add_any", "sub"):
            return self._sum(found, *tangents, sign=-1 if name == "sub" else 1)
        if name == "neg":
            return negative(tangents[0])
        if name in _SLOPES:
            return self._times(normalised(_SLOPES[name](normalised(operands[0]))), tangents[0])
        if name == "integer_pow" and (power := found.equation.params["y"]) > 1:
            factor = multiple(float(power), integer_power(normalised(operands[0]), float(power - 1)))
            return self._times(normalised(factor), tangents[0])
        if name == "div" and tangents[1] is None:
            return self._aligned(lambda t: divide(t, operands[1]), tangents[0], found)
        if name in ("mul", "dot_general"):
            return self._product(found, operands, tangents)
        return None

    def _moved(self, found: Origin, tangents: Any) -> Any:
        values = _MOVES[found.name] or range(len(found.operands))
        if any(t is not None and i not in values for i, t in enumerate(tangents)) or found.index:
            return None
        if not jnp.issubdtype(found.equation.outvars[0].aval.dtype, jnp.floating):  # truth values jump
            return None
        fixed, terms = list(found.operands), 1
        if found.name == "reduce_sum":
            terms = int(np.prod([found.operands[0].shape[axis] for axis in found.equation.params["axes"]]))

        def call(*given: Any) -> Any:
            for i, value in zip(values, given, strict=True):
                fixed[i] = value
            return found.equation.primitive.bind(*agreeing(fixed), **found.equation.params)

        given = [self._zeros(v) if (t := tangents[i]) is None else t for i, v in enumerate(found.operands)]
        rest = [v for i, v in enumerate(found.operands) if i not in values]
        return structural(jax.vmap(call), [given[i] for i in values], rest, terms)[0]

    def _zeros(self, value: Any) -> Any:
        return np.zeros((self.size, *np.shape(value)), np.asarray(value).dtype if is_known(value) else value.dtype)

    def _shape(self, found: Origin) -> tuple[int, ...]:
        return (self.size, *found.equation.outvars[found.index].aval.shape)

    def _spread(self, tangent: Node, found: Origin) -> Node:
        """In the shape of the result, of which the operand may be one entry."""
        shape = self._shape(found)
        if tangent.shape == shape:
            return tangent
        gap = len(shape) - len(tangent.shape)

        def call(v: Any) -> Any:
            return jnp.broadcast_to(v.reshape(self.size, *(1,) * gap, *v.shape[1:]), shape)

        return move(call, tangent)

    def _aligned(self, call: Callable[[Node], Any], tangent: Node, found: Origin) -> Any:
        return call(self._spread(normalised(tangent), found))

    def _sum(self, found: Origin, first: Any, second: Any, sign: int) -> Any:
        first, second = (None if t is None else self._spread(t, found) for t in (first, second))
        if second is None:
            return first
        if first is None:
            return second if sign > 0 else negative(second)
        return add(first, second) if sign > 0 else subtract(first, second)

    def _times(self, factor: Any, tangent: Node) -> Node:
        """A factor in the shape of the node, times a tangent."""
        shape = tangent.shape
        if is_node(factor):
            factor = move(lambda v: jnp.broadcast_to(v[None], shape), factor)
        else:
            factor = (np if is_known(factor) else jnp).broadcast_to(factor, shape)
        return multiply(normalised(factor), normalised(tangent))

    def _product(self, found: Origin, operands: Any, tangents: Any) -> Any:
        terms = []
        for k, tangent in enumerate(tangents):
            if tangent is None:
                continue
            other = operands[1 - k]
            if found.name == "mul":
                if is_node(other) and other.shape != self._shape(found)[1:]:
                    other = move(lambda v: jnp.broadcast_to(v, self._shape(found)[1:]), other)
                terms.append(self._times(other, self._spread(tangent, found)))
            else:
                term = self._dot(found, k, tangent, other)
                if term is None:
                    return None
                terms.append(term)
        return terms[0] if len(terms) == 1 else add(*terms)

    def _dot(self, found: Origin, k: int, tangent: Node, other: Any) -> Any:
        """Of the tangent in the place of operand k, whose axis over x is one that is not contracted."""
        contract, (batch, _) = found.equation.params["dimension_numbers"]
        if batch or len({atom.aval.dtype for atom in found.equation.invars}) > 1:
            return None
        moved = tuple(axis + 1 for axis in contract[k])
        pair = (moved, contract[1]) if k == 0 else (contract[0], moved)
        first, second = (tangent, other) if k == 0 else (other, tangent)
        free = 0 if k == 0 else len(np.shape(other) if not is_node(other) else other.shape) - len(contract[0])
        out = dot(normalised(first), normalised(second), (pair, ((), ())), False)
        return out if not free else move(lambda v: jnp.moveaxis(v, free, 0), out)
