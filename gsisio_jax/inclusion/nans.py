"""Where results may be no number, and what looks at that: see `nan_flags`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.form_arithmetic import is_known, known_if_concrete
from gsisio_jax.inclusion.nan_flags import flag, flags_of, joined, may_be_nan, pass_on
from gsisio_jax.inclusion.node import Node, as_node, is_node, normalised, parts
from gsisio_jax.inclusion.rules.bilinear import pick
from gsisio_jax.inclusion.rules.comparison import select, step
from gsisio_jax.inclusion.rules.linear import move, negative
from gsisio_jax.inclusion.rules.possible import unknown
from gsisio_jax.interval.box import Interval, is_concrete

# Where an argument may lie outside of the domain, or at a pole: a bound that is NaN counts.
_DOMAINS: dict[str, Callable[[Interval], Any]] = {
    "sqrt": lambda a: ~(a.lower >= 0),
    "rsqrt": lambda a: ~(a.lower > 0),
    "log": lambda a: ~(a.lower > 0),
    "log1p": lambda a: ~(a.lower > -1),
    "asin": lambda a: ~((a.lower >= -1) & (a.upper <= 1)),
    "acos": lambda a: ~((a.lower >= -1) & (a.upper <= 1)),
    "atanh": lambda a: ~((a.lower > -1) & (a.upper < 1)),
    "acosh": lambda a: ~(a.lower >= 1),
    "logit": lambda a: ~((a.lower > 0) & (a.upper < 1)),
    "_xlogx": lambda a: ~(a.lower >= 0),
}
_QUOTIENTS = {"div", "rem", "remainder", "floor_divide"}
# Which part of a box they have no value on is not known, but they have no bounds on it.
_BY_RESULT = {"cholesky", "lu", "triangular_solve", "custom_linear_solve", "slogdet", "det"}
_COMPARISONS = {"lt", "le", "gt", "ge", "eq"}  # false of NaN


def note(name: str, eqn: Any, args: Sequence[Any], results: Sequence[Any], passes: bool = True) -> None:
    """Note on the results of an operation, or library function, that they may be NaN: because an operand is (where that
    `passes`), or because there is no value."""
    real = [jnp.issubdtype(out.aval.dtype, jnp.floating) for out in eqn.outvars]
    results = [value for value, mine in zip(results, real, strict=True) if mine]
    if not results:
        return
    if passes:
        pass_on(args, results)
    where = None
    if name in _DOMAINS and is_node(args[0]):
        where = _DOMAINS[name](normalised(args[0]).range)
    elif name in _QUOTIENTS:
        where = _holds_zero(args[1])
    elif name == "integer_pow" and eqn.params["y"] < 0:
        where = _holds_zero(args[0])
    elif name == "pow":
        where = _power(*args)
    elif name in _BY_RESULT or (name == "gather" and is_node(args[1])):  # of places outside of a table
        bounds = [normalised(v).range for v in results if is_node(v)]
        where = joined([~(jnp.isfinite(b.lower) & jnp.isfinite(b.upper)).all() for b in bounds])
    where = None if where is None else where.any()
    if where is not None and not (is_known(where) and not where):
        flag(results, (where,))


def _holds_zero(value: Any) -> Any:
    if is_node(value):
        bounds = normalised(value).range
        return ~((bounds.lower > 0) | (bounds.upper < 0))
    return known_if_concrete(value) == 0


def _power(base: Any, exponent: Any) -> Any:
    """A negative base has a power for integer exponents only, and 0 none for negative ones."""
    low = normalised(base).range.lower if is_node(base) else known_if_concrete(base)
    if is_node(exponent) or not is_concrete(exponent):
        return ~(low > 0)
    exponent = np.asarray(exponent)
    pole, whole = (exponent < 0).any(), (exponent == np.rint(exponent)).all()
    if whole:
        return _holds_zero(base) if pole else None
    return ~(low > 0) if pole else ~(low >= 0)


def of_cases(which: Any, *cases: Any) -> list[Any]:
    """Flags of a choice: those of the cases that are possible."""
    node = is_node(which)
    low, high = (which.range.lower, which.range.upper) if node else 2 * (known_if_concrete(which),)
    found = []
    for i, case in enumerate(cases):
        if flags := flags_of(case):
            possible = ((high if i else ~low) if low.dtype == bool else (low <= i) & (i <= high)).any()
            if not (is_known(possible) and not possible):
                found += [one if is_known(possible) else one & possible for one in flags]
    return found


def constant(value: Any, out: Any, args: Sequence[Any]) -> Node:
    """A number, or NaN where an operand is: ``x - x``, as a node that may carry flags."""
    node, (_, jac) = as_node(value, out.shape, out.dtype), parts(args)
    if jac is None:
        return node
    flat = np.zeros((jac.lower.shape[0], *out.shape), jac.lower.dtype)
    return Node(node.range, None, Interval.unchecked(flat, flat))


# What looks at NaN ----------------------------------------------------------------------------------------------------
def looked_at(eqn: Any, args: Sequence[Any], value: Any) -> Any:
    """The result (or results) of a rule that takes its operands for numbers, if they may be none."""
    name, keys = eqn.primitive.name, eqn.params.get("num_keys", 1) if eqn.primitive.name == "sort" else len(args)
    if name not in _LOOKS or (unsure := may_be_nan(args[:keys])) is None:
        return value
    return _LOOKS[name](eqn, args, value, unsure)


def _truth(false: bool, true: bool) -> Callable[..., Node]:
    """For truth values that are `false` or `true` of NaN; both: either may be."""

    def rule(eqn: Any, args: Sequence[Any], value: Any, unsure: Any) -> Node:
        lower, upper = (value.range.lower, value.range.upper) if is_node(value) else (value, value)
        outcome = Interval.unchecked(lower & ~unsure if false else lower, upper | unsure if true else upper)
        return step(outcome, args)

    return rule


def _convert(eqn: Any, args: Sequence[Any], value: Node, unsure: Any) -> Node:
    """As a truth value NaN is true. (Casts to integers: `number_types.integer_result`.)"""
    logical = jnp.issubdtype(eqn.params["new_dtype"], jnp.bool_)
    return _truth(False, True)(eqn, args, value, unsure) if logical else value


def _place(eqn: Any, args: Sequence[Any], value: Node, unsure: Any) -> Node:
    """argmax and argmin: that of a NaN, wherever it is."""
    (axis,) = eqn.params["axes"]
    return counted(value, eqn.invars[0].aval.shape[axis] - 1, args, unsure)


def counted(value: Node, most: int, args: Sequence[Any], unsure: Any) -> Node:
    """A number of 0, 1, ... `most` that may be any of these where unsure."""
    lower, upper = jnp.where(unsure, 0, value.range.lower), jnp.where(unsure, most, value.range.upper)
    return step(Interval.unchecked(lower, upper), [v for v in args if is_node(v)])


def _sorted(eqn: Any, args: Sequence[Any], values: Sequence[Any], unsure: Any) -> list[Any]:
    """A NaN changes the places of all others."""
    return [unbounded(v, args, unsure) if is_node(v) else v for v in values]


def unbounded(value: Node, args: Sequence[Any], unsure: Any) -> Node:
    return pick(unsure, unknown(value.shape, value.dtype, args), normalised(value))


_LOOKS: dict[str, Callable[..., Any]] = {
    **dict.fromkeys(_COMPARISONS, _truth(True, False)),
    "ne": _truth(False, True),
    **dict.fromkeys(("lt_to", "le_to"), _truth(True, True)),
    "is_finite": _truth(True, False),
    "convert_element_type": _convert,
    **dict.fromkeys(("argmax", "argmin"), _place),
    **dict.fromkeys(("sort", "top_k"), _sorted),
}


def library_result(name: str, eqn: Any, args: Sequence[Any], value: Any) -> Any:
    """`looked_at` for the result of a function of JAX's libraries that is known as a whole."""
    unsure = may_be_nan(args)
    if unsure is None or not is_node(value):
        return value
    if name in ("fmax", "fmin"):
        # Of a number and a NaN it is the number.
        shape = value.shape
        for one, other in (args, args[::-1]):
            if (unsure := may_be_nan([one])) is not None:
                other = move(lambda v: jnp.broadcast_to(v, shape), other)
                value = select(_perhaps(shape, [one, other], unsure), value, other)
        return value
    if name == "copysign":
        return select(_perhaps(value.shape, args, unsure), value, negative(value))
    if name == "searchsorted":
        return counted(value, eqn.invars[0].aval.shape[0], args, unsure)
    if name == "_interp":
        return unbounded(value, args, unsure)  # a table of jumps gives a number
    return value


def _perhaps(shape: tuple[int, ...], args: Sequence[Any], unsure: Any) -> Node:
    """False, or perhaps true."""
    no = jnp.zeros(shape, bool)
    return step(Interval.unchecked(no, no | unsure), args)
