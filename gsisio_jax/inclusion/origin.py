"""Where a node comes from: its operation and operands, so that a part of a function can be evaluated once more.

A rule sees ranges, and ranges forget: that both cases of a `where` are functions of the number that it compares, that
a numerator is the sine of the denominator. What was remembered here lets rules ask for it. Origins live as long as a
function is being traced; nodes that come out of loops, or straight from an argument, have none.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Sequence
from typing import Any, NamedTuple

import numpy as np

from gsisio_jax.inclusion.form_arithmetic import is_known
from gsisio_jax.inclusion.known_boxes import case_is_open
from gsisio_jax.inclusion.nan_flags import pass_on
from gsisio_jax.inclusion.node import Node, is_node, normalised
from gsisio_jax.interval.box import is_concrete

MOST_OPERATIONS = 200  # that one evaluation once more may cost


class Origin(NamedTuple):
    """Where a node comes from.

    Attributes:
        equation: that made it.
        operands: nodes and constants.
        index: which of the results of the equation it is.
        rule: makes it from the operands in the place of the equation, where it ends an expression known as a whole.
    """

    equation: Any
    operands: Sequence[Any]
    index: int
    rule: Callable[..., Any] | None = None

    @property
    def name(self) -> str:
        """Of the operation that was done on the operands: nothing where these are what a rule took instead."""
        return "" if self.rule is not None else self.equation.primitive.name


class NotAgain(Exception):
    """It would take more than `MOST_OPERATIONS`, or mix entries where that is not allowed."""


def remember(
    equation: Any, operands: Sequence[Any], results: Sequence[Any], rule: Callable[..., Any] | None = None
) -> None:
    """Note where nodes come from that have no origin yet."""
    for index, result in enumerate(results):
        if is_node(result) and origin(result) is None and all(result is not v for v in operands):
            object.__setattr__(result, "origin", Origin(equation, tuple(operands), index, rule))


def origin(value: Any) -> Origin | None:
    return getattr(value, "origin", None)


def settled(value: Any) -> Any:
    """`normalised`, of the same origin."""
    found = normalised(value)
    if found is not value:
        if (before := origin(value)) is not None:
            object.__setattr__(found, "origin", before)
        pass_on([value], [found])
    return found


def made_by(value: Any, *names: str) -> Sequence[Any] | None:
    """The operands of a node, if one of these primitives made it."""
    found = origin(value)
    return found.operands if found is not None and found.name in names else None


def same(a: Any, b: Any, memo: dict[tuple[int, int], bool] | None = None) -> bool:
    """Are these certainly the same number: one node, equal constants, or one operation on the same operands?"""
    if a is b:
        return True
    if is_known(a) and is_known(b):
        return a.dtype == b.dtype and a.shape == b.shape and bool(np.array_equal(a, b))
    first, second = origin(a), origin(b)
    if first is None or second is None or first.name != second.name or first.index != second.index:
        return False
    if first.rule is not second.rule:
        return False
    memo = {} if memo is None else memo
    pair = id(a), id(b)
    if pair not in memo:
        memo[pair] = (
            len(first.operands) == len(second.operands)
            and _equal(first.equation.params, second.equation.params)
            and all(same(v, w, memo) for v, w in zip(first.operands, second.operands, strict=True))
        )
    return memo[pair]


def _equal(a: Any, b: Any) -> bool:
    """Parameters of two equations; what cannot be compared is not equal."""
    try:
        return a is b or bool(a == b)
    except Exception:
        return False


class Again:
    """Evaluates nodes once more with some of them replaced.

    Args:
        apply: evaluates an equation for given operands (the interpreter).
        allowed: names of the primitives that may take what is replaced; None for all.
        replaced: pairs of a node and what takes its place, a node or a constant.

    Raises:
        NotAgain: when called, where that would take too many operations, or one that is not allowed.
    """

    def __init__(
        self,
        apply: Callable[[Any, Sequence[Any]], Any],
        allowed: Container[str] | None,
        replaced: Sequence[tuple[Node, Any]],
    ):
        self.apply, self.allowed, self.replaced = apply, allowed, replaced
        self._memo: dict[int, Any] = {}
        self._same: dict[tuple[int, int], bool] = {}
        self._operations = 0

    def __call__(self, value: Any) -> Any:
        if not is_node(value):
            return value
        if id(value) not in self._memo:
            self._memo[id(value)] = self._evaluate(value)
        return self._memo[id(value)]

    def equation(self, equation: Any, operands: Sequence[Any]) -> Any:
        """The first result of an equation, for operands evaluated once more."""
        return self._applied(Origin(equation, operands, 0))

    def _evaluate(self, node: Node) -> Any:
        for old, new in self.replaced:
            if same(node, old, self._same):
                return new
        found = origin(node)
        return node if found is None else self._applied(found, node)

    def _applied(self, found: Origin, before: Node | None = None) -> Any:
        operands = [self(v) for v in found.operands]
        if before is not None and all(new is old for new, old in zip(operands, found.operands, strict=True)):
            return before
        if found.name == "select_n" and (chosen := decided(operands[0])) is not None:
            return operands[1 + chosen]
        self._operations += 1
        if self._operations > MOST_OPERATIONS or not (self.allowed is None or self._keeps_entries_apart(found)):
            raise NotAgain
        if found.rule is not None:
            results = [found.rule(*map(normalised, operands))]
            if results[0] is None:
                raise NotAgain
            pass_on(operands, results)
        else:
            out = self.apply(found.equation, operands)
            results = out if found.equation.primitive.multiple_results else [out]
        remember(found.equation, operands, results, found.rule)
        return results[found.index]

    def _keeps_entries_apart(self, found: Origin) -> bool:
        shape = found.equation.outvars[found.index].aval.shape
        alike = found.rule is None or all(np.shape(v) == shape for v in found.operands if not is_node(v))
        alike &= found.rule is None or all(v.shape == shape for v in found.operands if is_node(v))
        return alike and self.allowed is not None and found.equation.primitive.name in self.allowed


def decided(which: Any) -> int | None:
    """The case that a selection takes everywhere, where that is known while tracing."""
    sides = (which.range.lower, which.range.upper) if is_node(which) else (which,)
    if not all(is_concrete(side) for side in sides):
        case_is_open()
        return None
    cases = np.unique(np.stack([np.asarray(side) for side in sides]))
    return int(cases[0]) if cases.size == 1 else None
