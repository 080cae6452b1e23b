"""The numbers of a program: every operation once, simplified where its operands allow it.

Constants are NumPy scalars. A simplification holds for every number, infinities and NaN included, unless it says
otherwise; `scale` and `times` are products with ``0 * inf = 0``, so a constant 0 takes them away.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np


class Number:
    """One number of a program: a primitive and its operands (numbers or constants).

    Attributes:
        name: of the primitive; "input" for an argument of the program, "part" for an entry of an array operation.
        operands: numbers and constants.
        equation: the primitive with its parameters, None for those without any.
        nonnegative: known to be 0 or more (or NaN).
        stage: the innermost `jax.named_scope` it was first needed in.
        order: of the numbers of a graph, set when it is made.
    """

    __slots__ = ("dtype", "equation", "name", "nonnegative", "operands", "order", "stage")

    def __init__(self, name: str, operands: tuple[Any, ...], equation: Any, dtype: Any, nonnegative: bool, stage: str):
        self.name, self.operands, self.equation = name, operands, equation
        self.dtype, self.nonnegative, self.stage = dtype, nonnegative, stage
        self.order = 0


def is_constant(value: Any) -> bool:
    return not isinstance(value, Number)


class Graph:
    """Builds numbers, each operation on the same operands once."""

    def __init__(self) -> None:
        self._found: dict[Any, Number] = {}
        self._made = 0
        self.stage = ""

    def count(self, names: set[str]) -> int:
        """How many numbers these primitives make."""
        return sum(number.name in names for number in self._found.values())

    def input(self, dtype: Any) -> Number:
        return self._ordered(Number("input", (), None, dtype, False, ""))

    def _ordered(self, number: Number) -> Number:
        """Addresses would do to tell two numbers apart, but not to make the same program again."""
        self._made += 1
        number.order = self._made
        return number

    def make(self, name: str, operands: tuple[Any, ...], dtype: Any, equation: Any = None, key: Any = None) -> Number:
        """The number as it stands, without simplification."""
        names = tuple(id(v) if isinstance(v, Number) else (v.dtype.char, v.tobytes()) for v in operands)
        identity = name, names, key, dtype
        found = self._found.get(identity)
        if found is None:
            sign = _NONNEGATIVE.get(name)
            nonnegative = sign is not None and sign(*operands)
            found = self._ordered(Number(name, operands, equation, dtype, nonnegative, self.stage))
            self._found[identity] = found
        return found

    def apply(self, name: str, *operands: Any, dtype: Any = None, equation: Any = None, key: Any = None) -> Any:
        """A number or a constant: the primitive of that name on these operands, simplified."""
        dtype = operands[0].dtype if dtype is None else dtype
        if all(map(is_constant, operands)) and name in _FOLDED:
            with np.errstate(all="ignore"):
                return np.asarray(_FOLDED[name](*operands), dtype)[()]
        rule = _RULES.get(name)
        simple = None if rule is None else rule(self, *operands)
        return self.make(name, operands, dtype, equation, key) if simple is None else simple

    def commuting(self, name: str, a: Any, b: Any) -> Number:
        """The same number for both orders of its operands; a constant comes last."""
        if is_constant(a) or (isinstance(b, Number) and b.order < a.order):
            a, b = b, a
        return self.make(name, (a, b), np.dtype(bool) if name == "eq" else a.dtype)

    def fold(self, name: str, values: Any, dtype: Any, empty: Any) -> Any:
        """``values[0] op values[1] op ...``, in that order."""
        values = list(values)
        if not values:
            return np.asarray(empty, dtype)[()]
        total = values[0]
        for value in values[1:]:
            total = self.apply(name, total, value, dtype=dtype)
        return total


def _is(value: Any, number: float) -> bool:
    return is_constant(value) and bool(value == number)


def _positive(value: Any) -> bool:
    return value.nonnegative if isinstance(value, Number) else bool(value >= 0)


def _both(a: Any, b: Any) -> bool:
    return _positive(a) and _positive(b)


def _either(a: Any, b: Any) -> bool:
    return _positive(a) or _positive(b)


_NONNEGATIVE: dict[str, Callable[..., bool]] = {
    **dict.fromkeys(("abs", "sqrt", "exp", "square"), lambda a: True),
    **dict.fromkeys(("add", "mul", "scale", "times", "div", "min", "smaller"), _both),
    **dict.fromkeys(("max", "larger"), _either),
    "select_n": lambda which, *cases: which.dtype == bool and all(map(_positive, cases)),
    **dict.fromkeys(("stop_gradient", "wave", "falling_wave"), lambda value, *_: _positive(value)),
}


def _product(a: Any, b: Any) -> Any:
    return a * b if a != 0 and b != 0 else type(a)(0)


_FOLDED: dict[str, Callable[..., Any]] = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide, "neg": np.negative, "abs": np.abs,
    "max": np.maximum, "min": np.minimum, "larger": np.maximum, "smaller": np.minimum, "sign": np.sign,
    "raised": lambda a, b: b if b > a else a, "cut": lambda a, b: b if b < a else a,
    "floor": np.floor, "ceil": np.ceil, "sqrt": np.sqrt, "square": np.square, "is_finite": np.isfinite,
    "lt": np.less, "le": np.less_equal, "gt": np.greater, "ge": np.greater_equal, "eq": np.equal, "ne": np.not_equal,
    "and": np.bitwise_and, "or": np.bitwise_or, "not": np.invert, "xor": np.bitwise_xor,
    "select_n": lambda which, *cases: cases[int(which)],
    **dict.fromkeys(("wave", "falling_wave"), lambda value, t, slope: value),
    "clamp": lambda low, x, high: np.minimum(np.maximum(x, low), high),
    "scale": _product, "times": _product,
    **dict.fromkeys(("stop_gradient", "fusion_barrier", "copy", "convert_element_type"), lambda a: a),
}  # fmt: skip


def _add(graph: Graph, a: Any, b: Any) -> Any:
    if _is(a, 0) or _is(b, 0):
        return b if _is(a, 0) else a
    if isinstance(b, Number) and b.name == "neg":
        return graph.apply("sub", a, b.operands[0])
    if isinstance(a, Number) and a.name == "neg":
        return graph.apply("sub", b, a.operands[0])
    return graph.commuting("add", a, b)


def _sub(graph: Graph, a: Any, b: Any) -> Any:
    if _is(b, 0):
        return a
    if _is(a, 0):
        return graph.apply("neg", b)
    if isinstance(b, Number) and b.name == "neg":
        return graph.apply("add", a, b.operands[0])
    return None


def _mul(graph: Graph, a: Any, b: Any) -> Any:
    for x, y in ((a, b), (b, a)):
        if _is(x, 1):
            return y
        if _is(x, -1):
            return graph.apply("neg", y)
    for x, y in ((a, b), (b, a)):
        if isinstance(x, Number) and x.name == "neg":
            if isinstance(y, Number) and y.name == "neg":
                return graph.apply("mul", x.operands[0], y.operands[0])
            if not isinstance(y, Number):
                return graph.apply("mul", x.operands[0], -y)
    return graph.commuting("mul", a, b)


def _safe(name: str) -> Callable[..., Any]:
    def rule(graph: Graph, a: Any, b: Any) -> Any:
        for x, y in ((a, b), (b, a)):
            # A NaN that is passed on as such was never a product of 0 and infinity.
            if not isinstance(x, Number) and np.isfinite(x):
                return x - x if x == 0 else graph.apply("mul", x, y)
        return graph.make(name, (a, b), a.dtype)

    return rule


def _neg(graph: Graph, a: Number) -> Any:
    if a.name == "neg":
        return a.operands[0]
    if a.name == "sub":
        return graph.apply("sub", a.operands[1], a.operands[0])
    if a.name == "mul" and is_constant(a.operands[1]):
        return graph.apply("mul", a.operands[0], -a.operands[1])
    return None


def _abs(graph: Graph, a: Number) -> Any:
    if a.nonnegative:
        return a
    if a.name == "neg":
        return graph.apply("abs", a.operands[0])
    if a.name == "mul" and is_constant(a.operands[1]):
        return graph.apply("mul", graph.apply("abs", a.operands[0]), abs(a.operands[1]))
    return None


def _extreme(name: str, neutral: float) -> Callable[..., Any]:
    def rule(graph: Graph, a: Any, b: Any) -> Any:
        if a is b:
            return a
        for x, y in ((a, b), (b, a)):
            if _is(x, neutral) or (neutral < 0 and is_constant(x) and x <= 0 and _positive(y)):
                return y
        return graph.commuting(name, a, b)

    return rule


def _passing_over(neutral: float) -> Callable[..., Any]:
    """Of `raised` and `cut`: the other bound says nothing, or the first one did not."""

    def rule(graph: Graph, a: Any, b: Any) -> Any:
        if a is b or _is(b, neutral) or (is_constant(b) and np.isnan(b)):
            return a
        return None

    return rule


def _select(graph: Graph, which: Any, *cases: Any) -> Any:
    if is_constant(which):
        return cases[int(which)]
    first = cases[0]
    if all(case is first for case in cases[1:]):
        return first
    if all(map(is_constant, cases)) and all(case.tobytes() == first.tobytes() for case in cases[1:]):
        return first
    if len(cases) == 2 and which.name == "not":
        return graph.apply("select_n", which.operands[0], cases[1], first, dtype=first.dtype)
    if len(cases) == 2 and first.dtype == bool and all(map(is_constant, cases)):
        return graph.apply("not", which) if first else which
    if len(cases) == 2 and (kept := _replaced(which, *cases)) is not None and not is_constant(kept[0]):
        before = kept[0]
        if before.name == "select_n" and (inner := _replaced(*before.operands)) is not None and inner[1:] == kept[1:]:
            return before  # what an operation has left, the same one leaves
    return None


def _replaced(which: Any, *cases: Any) -> tuple[Any, ...] | None:
    """Of ``x if x > limit else other``, in any comparison: x, and what the operation is; None of something else."""
    if is_constant(which) or len(which.operands) != 2 or len(cases) != 2 or not is_constant(which.operands[1]):
        return None
    x, limit = which.operands
    place = next((i for i, case in enumerate(cases) if case is x), None)
    if place is None or not is_constant(other := cases[1 - place]):
        return None
    return x, which.name, place, limit.tobytes(), other.tobytes()


def _junction(name: str, absorbing: bool) -> Callable[..., Any]:
    def rule(graph: Graph, a: Any, b: Any) -> Any:
        if a.dtype != bool:
            return None
        for x, y in ((a, b), (b, a)):
            if is_constant(x):
                return np.bool_(absorbing) if bool(x) is absorbing else y
        return a if a is b else graph.commuting(name, a, b)

    return rule


_RULES: dict[str, Callable[..., Any]] = {
    "add": _add, "sub": _sub, "mul": _mul, "neg": _neg, "abs": _abs, "scale": _safe("scale"), "times": _safe("times"),
    "max": _extreme("max", -np.inf), "min": _extreme("min", np.inf), "raised": _passing_over(-np.inf),
    "larger": _extreme("larger", -np.inf), "smaller": _extreme("smaller", np.inf), "cut": _passing_over(np.inf),
    "select_n": _select, "and": _junction("and", False), "or": _junction("or", True),
    "not": lambda graph, a: a.operands[0] if a.name == "not" else None,
    "div": lambda graph, a, b: a if _is(b, 1) else None, "eq": lambda graph, a, b: graph.commuting("eq", a, b),
    "stop_gradient": lambda graph, a: a if a.name == "stop_gradient" else None,
    **dict.fromkeys(("wave", "falling_wave"), lambda graph, value, t, slope: value if is_constant(value) else None),
    **dict.fromkeys(("copy", "fusion_barrier"), lambda graph, a: a),
}  # fmt: skip
