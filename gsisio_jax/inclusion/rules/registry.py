"""The table: one rule for every primitive, grouped by what the rule does.

A rule takes the equation (for its static parameters) and the values of its operands, of which at least one is a node;
it returns a node, or a list of them for a primitive with several results.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.extend.core as jex
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.form_arithmetic import Operation
from gsisio_jax.inclusion.node import Node, is_node, normalised
from gsisio_jax.inclusion.origin import made_by, same
from gsisio_jax.inclusion.rules import (
    activations,
    bilinear,
    comparison,
    convolution,
    factors,
    functions,
    indexing,
    library,
    linear,
    log_sums,
    order,
    powers,
    scattering,
    solving,
    univariate,
)
from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.devices import agreeing


class UnknownPrimitiveError(ValueError):
    """A function uses an operation for which no bounds are known; the message says which, where, and the remedy."""

    def __init__(self, operation: str, detail: str = "", place: str | None = None):
        self.operation, self.detail, self.place = operation, detail, place
        super().__init__(
            f"inclusion: no bounds are known for the operation `{operation}`{' ' * bool(detail)}{detail}, used at "
            f"{place or 'an unknown place'}. Write the function with other operations, or supply bounds by hand: put "
            f"the expression into a function under jax.jit, and give gsisio_jax.inclusion.register_bounds the name of "
            f"that function and its bounds."
        )


Rule = Callable[..., Any]


def _structural(*data: int, terms: Callable[[Any], int] = lambda eqn: 1, moving: Rule | None = None) -> Rule:
    """Rule for a primitive that moves entries about or sums them; `data` are its arguments that are values.

    The others (indices) must be constants, unless there is a rule for `moving` ones. No numbers: all arguments are
    values. `terms` says how many it adds at most.
    """

    def rule(eqn: Any, *args: Any) -> Any:
        where = data or tuple(range(len(args)))
        if any(is_node(arg) for i, arg in enumerate(args) if i not in where):
            if moving is not None:
                return moving(eqn, *args)
            raise UnknownPrimitiveError(eqn.primitive.name, "with indices that depend on the box")
        rest = [arg for i, arg in enumerate(args) if i not in where]
        fixed = list(args)

        def call(*values: Any) -> Any:
            for i, value in zip(where, values, strict=True):
                fixed[i] = value
            return eqn.primitive.bind(*agreeing(fixed), **eqn.params)

        whole = call if rest else Operation(eqn.primitive, tuple(eqn.params.items()))
        nodes = linear.structural(whole, [args[i] for i in where], rest, terms(eqn))
        return nodes if eqn.primitive.multiple_results else nodes[0]

    return rule


def _curve(name: str) -> Rule:
    return lambda eqn, x: univariate.apply(functions.CURVES[name], x)


def _plain(fn: Callable[..., Any]) -> Rule:
    return lambda eqn, *args: fn(*args)


def _same(eqn: Any) -> bool:
    """Are the two operands one and the same variable?"""
    x, y = eqn.invars
    return not isinstance(x, jex.Literal) and x is y


def _mul(eqn: Any, x: Any, y: Any) -> Node:
    return univariate.apply(functions.SQUARE, x) if _same(eqn) else bilinear.multiply(x, y)


def _sub(eqn: Any, x: Any, y: Any) -> Any:
    return np.zeros(x.shape, x.dtype) if _same(eqn) else linear.subtract(x, y)


def _relation(fn: Callable[..., Node], reflexive: bool) -> Rule:
    def rule(eqn: Any, x: Any, y: Any) -> Any:
        return np.full(x.shape, reflexive) if _same(eqn) else fn(x, y)

    return rule


def _convert(eqn: Any, x: Node) -> Node:
    """Between floating types the bounds follow; an integer is carried as the floating number it is."""
    target = eqn.params["new_dtype"]
    if jnp.issubdtype(target, jnp.floating):
        return _to_floating(x, target)
    if x.dtype == jnp.bool_:
        return x if target == jnp.bool_ else linear.move(lambda v: v.astype(jnp.result_type(float)), x)
    if target == jnp.bool_:
        return comparison.invert(comparison.equal(x, jnp.zeros(x.shape, x.dtype)))
    return x if jnp.issubdtype(eqn.invars[0].aval.dtype, jnp.integer) else comparison.truncate(x)


def _to_floating(x: Any, target: Any) -> Any:
    """A node or a constant in that floating type."""
    if is_node(x) and jnp.issubdtype(x.dtype, jnp.floating) and jnp.finfo(target).bits < jnp.finfo(x.dtype).bits:
        # Bounds are those of the number before it is rounded to the narrower type, as for every other operation.
        x = normalised(x)
        narrow = x.range.astype(target)
        jac = None if x.jac is None else x.jac.astype(target)
        return Node(narrow, None, jac)
    return linear.move(lambda v: v.astype(target), x)


def _dot(eqn: Any, x: Any, y: Any) -> Any:
    """Unlike all others, this primitive takes factors of several types: a matrix of float64 times an x of float32."""
    types = [atom.aval.dtype for atom in (*eqn.invars, *eqn.outvars)]
    floating = all(jnp.issubdtype(dtype, jnp.floating) for dtype in types)
    if floating and len(set(types)) > 1:
        wide = jnp.result_type(*types)
        x, y = (_to_floating(v, wide) for v in (x, y))
    out = bilinear.dot(x, y, eqn.params["dimension_numbers"], _same(eqn))
    return _to_floating(out, types[-1]) if floating and out.dtype != types[-1] else out


def _div(eqn: Any, x: Any, y: Any) -> Node:
    sine = made_by(x, "sin")
    if sine is not None and is_node(y) and same(sine[0], y):
        # sin(t) / t, continued by 1 at 0; `SINC` counts in half turns, and 1 / pi is off by half an ulp.
        return univariate.apply(activations.SINC, linear.multiple(1 / math.pi, normalised(y), rounded=True))
    quotient = bilinear.divide(x, y)
    return comparison.truncate(quotient) if jnp.issubdtype(eqn.outvars[0].aval.dtype, jnp.integer) else quotient


def _rounding(eqn: Any, x: Node) -> Node:
    nearest_even = int(eqn.params["rounding_method"]) == 1
    return comparison.staircase(jnp.round if nearest_even else _away_from_zero, -0.5, 0.5)(x)


def _away_from_zero(t: Any) -> Any:
    """The nearest integer, of two the larger in magnitude; nothing here rounds, as adding a half would."""
    size = abs(t)
    whole = jnp.floor(size)
    return jnp.copysign(whole + (size - whole >= 0.5), t)


def _reduce(fn: Callable[[Any, Any], Node]) -> Rule:
    return lambda eqn, x: bilinear.reduce_products(x, eqn.params["axes"], fn)


def _running(fn: Callable[[Any, Any], Node]) -> Rule:
    """cumprod, cummax, cummin: one entry after the other."""

    def rule(eqn: Any, x: Node) -> Node:
        axis, count = eqn.params["axis"], x.shape[eqn.params["axis"]]
        items = [linear.move(lambda v, i=i: jax.lax.slice_in_dim(v, i, i + 1, axis=axis), x) for i in range(count)]
        items = items[::-1] if eqn.params["reverse"] else items
        for i in range(1, count):
            items[i] = fn(items[i - 1], items[i])
        items = items[::-1] if eqn.params["reverse"] else items
        return linear.structural(lambda *v: jnp.concatenate(v, axis), items)[0] if count > 1 else x

    return rule


def _scattered(eqn: Any) -> int:
    return 1 + math.prod(eqn.invars[2].aval.shape)


def _scatter(known: Rule, other: Rule) -> Rule:
    """By the places that are met, where these are known."""

    def rule(eqn: Any, *args: Any) -> Any:
        found = known(eqn, *args)
        return other(eqn, *args) if found is None else found

    return rule


def _truth_reduce(fn: Callable[..., Any]) -> Rule:
    def rule(eqn: Any, x: Node) -> Node:
        axes = tuple(eqn.params["axes"])
        outcome = Interval.unchecked(fn(x.range.lower, axes), fn(x.range.upper, axes))
        return comparison.step(outcome, [x])

    return rule


# Entry by entry; a scalar operand has been spread to the shape of the result.
ELEMENTWISE: dict[str, Rule] = {
    "add": _plain(linear.add),
    "add_any": _plain(linear.add),
    "sub": _sub,
    "neg": _plain(linear.negative),
    "mul": _mul,
    "div": _div,
    "rem": _plain(comparison.truncated_remainder),
    "pow": powers.power,
    "integer_pow": lambda eqn, x: bilinear.integer_power(x, eqn.params["y"]),
    "atan2": _plain(bilinear.angle),
    "max": _plain(comparison.maximum),
    "min": _plain(comparison.minimum),
    "clamp": _plain(comparison.clamp),
    "sign": _plain(comparison.sign),
    "floor": _plain(comparison.staircase(jnp.floor, -1.0, 0.0)),
    "ceil": _plain(comparison.staircase(jnp.ceil, 0.0, 1.0)),
    "round": _rounding,
    "lt": _relation(comparison.less, False),
    "le": _relation(comparison.at_most, True),
    "gt": _relation(lambda x, y: comparison.less(y, x), False),
    "ge": _relation(lambda x, y: comparison.at_most(y, x), True),
    "eq": _relation(comparison.equal, True),
    "ne": _relation(lambda x, y: comparison.invert(comparison.equal(x, y)), False),
    "and": _plain(comparison.junction(jnp.logical_and)),
    "or": _plain(comparison.junction(jnp.logical_or)),
    "xor": _plain(comparison.exclusive),
    "not": _plain(comparison.invert),
    "is_finite": _plain(comparison.finite),
    "select_n": _plain(comparison.select),
    "convert_element_type": _convert,
}
# Across entries.
REDUCTIONS: dict[str, Rule] = {
    "dot_general": _dot,
    "reduce_sum": lambda eqn, x: linear.total(x, eqn.params["axes"]),
    "reduce_max": _reduce(comparison.maximum),
    "reduce_min": _reduce(comparison.minimum),
    "reduce_prod": _reduce(bilinear.multiply),
    "reduce_and": _truth_reduce(jnp.all),
    "reduce_or": _truth_reduce(jnp.any),
    "cumprod": _running(bilinear.multiply),
    "cummax": _running(comparison.maximum),
    "cummin": _running(comparison.minimum),
    **dict.fromkeys(
        ("scatter-add", "scatter_add"), _scatter(scattering.scatter_add, _structural(0, 2, terms=_scattered))
    ),
    "scatter-sub": scattering.scatter_sub,
    **dict.fromkeys(("scatter-mul", "scatter_mul"), scattering.combined(bilinear.multiply, 1.0)),
    **dict.fromkeys(("scatter-max", "scatter_max"), scattering.combined(comparison.maximum, -math.inf)),
    **dict.fromkeys(("scatter-min", "scatter_min"), scattering.combined(comparison.minimum, math.inf)),
    "cumsum": _structural(terms=lambda eqn: eqn.invars[0].aval.shape[eqn.params["axis"]]),
    "conv_general_dilated": convolution.convolve,
}
ELEMENTWISE |= {name: _curve(name) for name in functions.CURVES}
# Of these the result is not exact even where the arguments are.
ROUNDED = {
    "add", "add_any", "sub", "mul", "div", "rem", "pow", "integer_pow", "atan2", "dot_general", "reduce_sum",
    "reduce_prod", "cumprod", "conv_general_dilated", "scatter-add", "scatter_add", "cumsum", *functions.CURVES,
} - {"abs"}  # fmt: skip
# Results of these need no widening: they only move numbers about, or their insides have been through it.
MOVES: dict[str, Rule] = {
    name: _structural(*data)
    for name, data in {
        "broadcast_in_dim": (0,),
        "reshape": (0,),
        "squeeze": (0,),
        "expand_dims": (0,),
        "tile": (0,),
        "transpose": (0,),
        "rev": (0,),
        "copy": (0,),
        "copy_p": (0,),
        "stop_gradient": (0,),
        "optimization_barrier": (),
        "reduce_precision": (0,),
        "concatenate": (),
        "stack": (),
        "split": (0,),
        "slice": (0,),
        "pad": (0, 1),
        "device_put": (),
        "unstack": (0,),
    }.items()
}
MOVES |= {
    "scatter": _scatter(scattering.scatter, _structural(0, 2)),
    "gather": _structural(0, moving=indexing.gather),
    "dynamic_slice": _structural(0, moving=indexing.dynamic_slice),
    "dynamic_update_slice": _structural(0, 1, moving=indexing.dynamic_update_slice),
    "sort": order.sort,
    "top_k": order.top_k,
    "argmax": order.argmax,
    "argmin": order.argmin,
    "lu": lambda eqn, a: factors.lu(a),
    # Of pivots that say "none" or nothing at all, which are the ones that `factors.lu` makes.
    "lu_pivots_to_permutation": lambda eqn, pivots: Node(pivots.range, None, pivots.jac),
    "cholesky": lambda eqn, a: factors.cholesky(a),
    "triangular_solve": solving.triangular_solve,
    "custom_linear_solve": library.linear_system,
    "debug_callback": lambda eqn, *args: [],
    "debug_print": lambda eqn, *args: [],
    "lt_to": ELEMENTWISE["lt"],
    "le_to": ELEMENTWISE["le"],
}

# Functions of JAX's own libraries whose body loses what the function as a whole keeps. Matched by name, and only where
# the body comes from JAX itself.
LIBRARY: dict[str, Rule] = {
    "logaddexp": _plain(log_sums.log_add_exp),
    "logaddexp2": _plain(log_sums.log_add_exp2),
    "remainder": _plain(comparison.floored_remainder),
    "floor_divide": lambda eqn, x, y: comparison.staircase(jnp.floor, -1.0, 0.0)(bilinear.divide(x, y)),
    "trunc": _plain(comparison.truncate),
    "fmax": _plain(comparison.maximum),
    "fmin": _plain(comparison.minimum),
}
