"""Numbers of other types than float32 and float64: integers, which wrap around, and what is refused.

A node carries an integer as the real number that it is. The rules compute with that, and integers modulo 2^k agree as
long as the result fits; where its bounds leave what the type can hold, all that the type can hold is possible. Casts of
numbers that do not fit saturate or wrap around, and a quotient by 0 is what the backend makes of it: the same there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.form_arithmetic import is_known, known_if_concrete
from gsisio_jax.inclusion.node import Form, Node, as_node, exact_in, is_node, normalised
from gsisio_jax.inclusion.rules.registry import UnknownPrimitiveError
from gsisio_jax.interval.box import Interval, choose, entire_like
from gsisio_jax.interval.direct import where

# Of integers these are no logic, but one of bits.
_LOGIC = {"and", "or", "xor", "not", "reduce_and", "reduce_or", "reduce_xor"}
# Results of these are some of the operands, which fit.
_CHOOSES = {
    "max", "min", "clamp", "select_n", "sign", "reduce_max", "reduce_min", "cummax", "cummin", "fmax", "fmin",
    "scatter-max", "scatter_max", "scatter-min", "scatter_min",
}  # fmt: skip
_REMAINDERS = {"rem", "remainder"}


def is_plain(dtype: Any) -> bool:
    """A type that bounds are known of, in so far as it is one of numbers."""
    if jnp.issubdtype(dtype, jnp.complexfloating):
        return False
    return not jnp.issubdtype(dtype, jnp.floating) or jnp.finfo(dtype).bits >= 32


def check(eqn: Any) -> None:
    """Refuse an operation on the box whose result is of a type that no node can carry. (That of an operand is one of
    an earlier result, or of a constant.)

    Raises:
        UnknownPrimitiveError: complex numbers, floating ones of fewer than 32 bits, bits of integers.
    """
    name = eqn.primitive.name
    for out in eqn.outvars:
        dtype = getattr(out.aval, "dtype", None)
        if dtype is None or jnp.issubdtype(dtype, jnp.bool_):
            continue
        if jnp.issubdtype(dtype, jnp.complexfloating):
            raise UnknownPrimitiveError(name, "of complex numbers")
        if not is_plain(dtype):
            raise UnknownPrimitiveError(name, f"of {dtype} numbers")
        if name in _LOGIC:
            raise UnknownPrimitiveError(name, "of integers")
        if name == "reduce_precision":
            info = jnp.finfo(dtype)
            if eqn.params["exponent_bits"] < info.nexp or eqn.params["mantissa_bits"] < info.nmant:
                raise UnknownPrimitiveError(name, "to fewer bits")


def carried(eqn: Any, args: Sequence[Any]) -> list[Any]:
    """The operands, constant integers among them as nodes carry theirs: in their own type they would wrap around in the
    middle of a rule (``min(x, y)`` is ``-max(-x, -y)``)."""
    name = eqn.primitive.name
    kind = next((arg.dtype for arg in args if is_node(arg) and jnp.issubdtype(arg.dtype, jnp.floating)), None)
    kind = jnp.result_type(float) if kind is None else kind
    found = list(args)
    for i, arg in enumerate(args):
        index = (name == "select_n" and i == 0) or (name.startswith("scatter") and i == 1)
        if is_node(arg) or index or not jnp.issubdtype(jnp.result_type(arg), jnp.integer):
            continue
        arg = known_if_concrete(arg)
        found[i] = arg.astype(kind) if exact_in(arg, kind) else as_node(arg, arg.shape, kind)
    return found


def integer_result(eqn: Any, name: str, args: Sequence[Any], value: Any, unsure: Any = None) -> Any:
    """What a rule made of an operation, as an integer where its result is one.

    Args:
        eqn: the equation.
        name: of its primitive or library function.
        args: its operands.
        value: a node or a constant.
        unsure: a truth value: may the number that was cast be none? None: no.
    """
    dtype = eqn.outvars[0].aval.dtype
    if not jnp.issubdtype(dtype, jnp.integer):
        return value
    if not is_node(value):
        return known_if_concrete(value).astype(dtype)
    if name in _CHOOSES or not jnp.issubdtype(value.dtype, jnp.floating):
        return value
    if name in _REMAINDERS:
        zero = _may_be_zero(args[1])
        unsure = zero if unsure is None else zero if zero is None else unsure | zero
    return fitted(value, dtype, unsure)


def _may_be_zero(divisor: Any) -> Any:
    """None where it certainly is not."""
    if is_node(divisor):
        divisor = normalised(divisor)
        return ~((divisor.range.lower > 0) | (divisor.range.upper < 0))
    zero = known_if_concrete(divisor) == 0
    return None if is_known(zero) and not zero.any() else zero


def fitted(node: Node, dtype: Any, unsure: Any = None) -> Node:
    """The node where its bounds lie within an integer type; else, and where `unsure`, all of that type."""
    node = normalised(node)
    info, kind = jnp.iinfo(dtype), np.dtype(node.dtype).type
    lowest, end = kind(info.min), kind(2.0 ** int(info.max).bit_length())  # which is 1 more than the largest
    bounds = node.range
    # There is no integer between a bound and the next integer inside: rounding outward is not held against it.
    inside = (jnp.ceil(bounds.lower) >= lowest) & (jnp.floor(bounds.upper) < end)
    inside = inside if unsure is None else inside & ~unsure
    whole = Interval.unchecked(lowest, kind(info.max))
    form, jac = node.form, node.jac
    if form is not None:
        slack = None if form.slack is None else where(inside, form.slack, 0)
        form = Form(where(inside, form.slope, 0), choose(inside, form.offset, whole), form.box, slack)
    if jac is not None:
        # Of an entry that a variable does not enter no wrapping makes one that it does.
        fixed = (jac.lower == 0) & (jac.upper == 0)
        jac = choose(inside | fixed, jac, entire_like(jac.lower))
    return Node(choose(inside, bounds, whole), form, jac)
