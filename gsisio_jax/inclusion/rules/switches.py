"""Switches: truth values and signs as functions of one number, the pivot, that change at known cuts.

``x > 1`` is false up to the cut 1 and true beyond; ``abs(x) < 1`` changes at -1 and at 1; ``sign(v)`` at 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsisio_jax.inclusion.form_arithmetic import is_known, known_if_concrete
from gsisio_jax.inclusion.node import Node, is_node
from gsisio_jax.inclusion.origin import origin, same
from gsisio_jax.interval.box import is_concrete

_MIRRORED = {"lt": "gt", "gt": "lt", "le": "ge", "ge": "le", "eq": "eq", "ne": "ne"}
# Value below the cut, at the cut, and above it.
_RELATIONS = {
    "lt": (True, False, False),
    "le": (True, True, False),
    "gt": (False, False, True),
    "ge": (False, True, True),
    "eq": (False, True, False),
    "ne": (True, False, True),
}
_THROUGH = ("mul", "neg", "div", "convert_element_type", "select_n", "broadcast_in_dim", "jit")
_DEEPEST = 5  # operations between a product and the switch in one of its factors


@dataclass(frozen=True)
class Switch:
    """A node as a function of the pivot.

    Attributes:
        node: the truth value or sign.
        pivot: the number it depends on.
        cuts: ascending, known arrays that fit the shape of the pivot.
        between: its values on the segments that the cuts make, one more than there are cuts.
        at: its values at the cuts.
    """

    node: Node
    pivot: Node
    cuts: tuple[np.ndarray, ...]
    between: tuple[Any, ...]
    at: tuple[Any, ...]


def switch_of(node: Any) -> Switch | None:
    """The node as a switch; None where it is none, or where its cuts are not known."""
    found = origin(node)
    if found is None:
        return None
    if found.name == "sign" and is_node(found.operands[0]):
        zero = np.zeros((), node.dtype)
        return _unwound(Switch(node, found.operands[0], (zero,), (-1.0, 1.0), (0.0,)))
    if found.name in _RELATIONS:
        return _comparison(node, found.name, *found.operands)
    if found.name == "not" and (inner := switch_of(found.operands[0])) is not None:
        return _mapped(node, inner, lambda value: not value)
    if found.name in ("and", "or"):
        first, second = (switch_of(v) for v in found.operands)
        if first is not None and second is not None and same(first.pivot, second.pivot):
            rule = (lambda a, b: a and b) if found.name == "and" else (lambda a, b: a or b)
            return _joined(node, first, second, rule)
    return None


def switch_in(value: Any, deepest: int = _DEEPEST) -> Switch | None:
    """The first switch that a product holds as a factor."""
    found = origin(value)
    if found is None or deepest == 0:
        return None
    own = switch_of(value)
    if own is not None:
        return own
    name = found.equation.primitive.name  # also of an expression that is known as a whole: it is evaluated as one
    if name not in _THROUGH:
        return None
    for operand in found.operands[:1] if name == "select_n" else found.operands:
        inner = switch_in(operand, deepest - 1)
        if inner is not None:
            return inner
    return None


def _comparison(node: Node, name: str, a: Any, b: Any) -> Switch | None:
    if not is_node(a):
        a, b, name = b, a, _MIRRORED[name]
    if is_node(b) or not is_concrete(b) or not np.issubdtype(a.dtype, np.floating):
        return None
    cut = np.asarray(known_if_concrete(b), a.dtype)
    if np.broadcast_shapes(cut.shape, a.shape) != a.shape:
        return None
    below, there, above = _RELATIONS[name]
    return _unwound(Switch(node, a, (cut,), (below, above), (there,)))


def _unwound(switch: Switch) -> Switch | None:
    """The same switch as a function of what its pivot was computed from, as far as the cuts stay exact."""
    while True:
        found = origin(switch.pivot)
        if found is None or len(switch.cuts) != 1 or not np.isfinite(switch.cuts[0]).all():
            return switch
        if not np.issubdtype(found.equation.outvars[found.index].aval.dtype, np.floating):
            return switch  # a sum of integers may have wrapped around
        (cut,), (below, above), (there,) = switch.cuts, switch.between, switch.at
        inner = found.operands[0]
        if found.name == "neg":
            switch = Switch(switch.node, inner, (-cut,), (above, below), (there,))
        elif found.name == "abs" and (cut > 0).all():
            switch = Switch(switch.node, inner, (-cut, cut), (above, below, above), (there, there))
        elif found.name == "abs" and not cut.any():
            switch = Switch(switch.node, inner, (cut,), (above, above), (there,))
        elif found.name in ("add", "sub") and (moved := _moved(found.name, found.operands, cut)) is not None:
            pivot, new, turned = moved
            switch = Switch(switch.node, pivot, (new,), (above, below) if turned else (below, above), (there,))
        else:
            return switch


def _moved(name: str, operands: Any, cut: np.ndarray) -> tuple[Node, np.ndarray, bool] | None:
    """``x + b`` or ``x - b`` or ``b - x`` at the cut: x there, if that is a number of the type, and is x turned?"""
    x, b = operands
    turned = not is_node(x) and name == "sub"
    if not is_node(x):
        x, b = b, x
    if is_node(b) or not is_known(b := known_if_concrete(b)):
        return None
    first, second = (b, -cut) if turned else (cut, -b if name == "add" else b)
    with np.errstate(all="ignore"):
        new = first + second
        part = new - first
        lost = (first - (new - part)) + (second - part)  # what the sum was rounded by
    fits = np.broadcast_shapes(np.shape(new), x.shape) == x.shape
    return (x, np.asarray(new, cut.dtype), turned) if fits and not lost.any() else None


def _mapped(node: Node, inner: Switch, rule: Callable[[Any], Any]) -> Switch:
    return Switch(node, inner.pivot, inner.cuts, tuple(map(rule, inner.between)), tuple(map(rule, inner.at)))


def _joined(node: Node, a: Switch, b: Switch, rule: Callable[[Any, Any], Any]) -> Switch | None:
    """Two switches of one pivot, where the order of their cuts is the same in all entries."""
    cuts: list[np.ndarray] = []
    for cut in (*a.cuts, *b.cuts):
        places = [i for i, other in enumerate(cuts) if (cut <= other).all()]
        place = places[0] if places else len(cuts)
        if not all((cut >= other).all() for other in cuts[:place]):
            return None
        if not (place < len(cuts) and np.array_equal(cut, cuts[place])):
            cuts.insert(place, cut)

    def value(switch: Switch, i: int, there: bool) -> Any:
        last = i if there else i - 1
        below = sum(1 for c in switch.cuts if last >= 0 and (c <= cuts[last]).all())
        for c, at in zip(switch.cuts, switch.at, strict=True):
            if there and np.array_equal(c, cuts[i]):
                return at
        return switch.between[below]

    between = tuple(rule(value(a, i, False), value(b, i, False)) for i in range(len(cuts) + 1))
    at = tuple(rule(value(a, i, True), value(b, i, True)) for i in range(len(cuts)))
    return Switch(node, a.pivot, tuple(cuts), between, at)
