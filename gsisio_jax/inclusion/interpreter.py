"""The interpreter: walk through a jaxpr and apply the rule of every primitive.

What does not depend on the box is evaluated as usual, so constants need no rule: an expression of constants counts as
the number that it evaluates to. Where it depends on data that are not known while tracing (a known input, say), its
rounding is bounded too, by a box that holds all it may be. The derivative rules a function may carry are ignored:
bounds come from its body.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextvars import ContextVar
from typing import Any

import jax
import jax.extend.core as jex
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from gsisio_jax.inclusion import nans, number_types, one_variable
from gsisio_jax.inclusion.by_hand import BY_HAND, apply_by_hand
from gsisio_jax.inclusion.form_arithmetic import Operation, fold, is_known, known_if_concrete
from gsisio_jax.inclusion.loops import kept_loop, stack
from gsisio_jax.inclusion.nan_flags import flag, flags_of, may_be_nan, pass_on
from gsisio_jax.inclusion.node import as_node, is_node, normalise, normalised
from gsisio_jax.inclusion.origin import remember, settled
from gsisio_jax.inclusion.rules import comparison, linear, patterns
from gsisio_jax.inclusion.rules.functions import CURVES
from gsisio_jax.inclusion.rules.indexing import TooManyPlacesError
from gsisio_jax.inclusion.rules.library import EXACT, WHOLE
from gsisio_jax.inclusion.rules.makers import library_function
from gsisio_jax.inclusion.rules.piecewise import by_pieces
from gsisio_jax.inclusion.rules.registry import ELEMENTWISE, LIBRARY, MOVES, REDUCTIONS, ROUNDED, UnknownPrimitiveError
from gsisio_jax.inclusion.turns import TurnsError, while_loop
from gsisio_jax.interval import rounding
from gsisio_jax.scalar.unroll import called_jaxpr, numbers_in

# Longer loops, and loops over more operations, are kept as loops: compile time grows with every unrolled turn.
_UNROLL = 16
_UNROLLED_NUMBERS = 120
# Told of every operation that is bounded: its name, the lines of the user's code that led to it, operands and results.
WATCH: ContextVar[Callable[[str, Sequence[str], Sequence[Any], Sequence[Any]], None] | None] = ContextVar(
    "gsisio_jax_watch", default=None
)
_PLACES: ContextVar[tuple[str, ...]] = ContextVar("gsisio_jax_places", default=())
_OURS, _JAX = os.path.dirname(__file__), os.path.dirname(jax.__file__)


def evaluate(jaxpr: Any, consts: Sequence[Any], args: Sequence[Any]) -> list[Any]:
    """Values of a jaxpr's results; arguments and results are constants or nodes."""
    values: dict[Any, Any] = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *args], strict=True))

    def read(atom: Any) -> Any:
        if not isinstance(atom, jex.Literal):
            return values[atom]
        aval: Any = atom.aval
        return np.asarray(atom.val, aval.dtype)

    known, needed = patterns.find(jaxpr), None
    bent = one_variable.find(jaxpr, values)
    if bent:
        needed = one_variable.needed(jaxpr, bent, known)
        known = known | bent
    for place, eqn in enumerate(jaxpr.eqns):
        if needed is not None and place not in needed:
            continue
        try:
            operands, rule = [read(atom) for atom in eqn.invars if place not in bent], None
            match = known.get(place) if eqn.primitive.name not in BY_HAND else None
            given = [read(atom) for atom in match.operands] if match is not None else []
            out = _recognised(match, given)
            if out is None:
                out = _watched(eqn, operands)
            elif match is not None:
                rule, operands = match.rule, given
                pass_on(given, [out])
        except UnknownPrimitiveError as error:
            if error.place is not None or (line := _caller(eqn)) is None:
                raise
            raise UnknownPrimitiveError(error.operation, error.detail, line) from None
        except (NotImplementedError, TooManyPlacesError, TurnsError) as error:
            raise UnknownPrimitiveError(eqn.primitive.name, str(error), _caller(eqn)) from None
        results = out if rule is None and eqn.primitive.multiple_results else [out]  # a rule gives the only result
        remember(eqn, operands, results, rule)
        values.update(zip(eqn.outvars, results, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _watched(eqn: Any, args: Sequence[Any]) -> Any:
    """`_result`, reported where somebody watches."""
    watch = WATCH.get()
    if watch is None:
        return _result(eqn, args)
    place = _caller(eqn)
    token = _PLACES.set(_PLACES.get() if place is None else (*_PLACES.get(), place))
    try:
        out = _result(eqn, args)
        name = eqn.params.get("name") or eqn.primitive.name
        watch(name, _PLACES.get(), args, out if eqn.primitive.multiple_results else [out])
        return out
    finally:
        _PLACES.reset(token)


def _unwatched(turn: Callable[..., Any]) -> Callable[..., Any]:
    """The turn of a loop that stays one: its numbers are none outside of it. Watched is the loop as a whole."""

    def run(*args: Any) -> Any:
        token = WATCH.set(None)
        try:
            return turn(*args)
        finally:
            WATCH.reset(token)

    return run


def _recognised(match: Any, operands: Sequence[Any]) -> Any:
    """The value of an equation that ends a known expression of these operands; None where it ends none."""
    value = match.rule(*map(normalised, operands)) if any(map(is_node, operands)) else None
    return None if value is None else normalise(value)


def _result(eqn: Any, args: Sequence[Any]) -> Any:
    name = eqn.primitive.name
    if not any(is_node(arg) for arg in args):
        return _call(eqn, *args) if CALLS.get(name) is _call else _constant(eqn, args)
    by_hand = BY_HAND.get(name) or BY_HAND.get(eqn.params.get("name"))
    if by_hand is not None:
        value = normalise(apply_by_hand(by_hand, [normalised(arg) for arg in args]))
        pass_on(args, [value])
        return [value] if eqn.primitive.multiple_results else value
    if name in CALLS:
        return CALLS[name](eqn, *args)
    number_types.check(eqn)
    if name in MOVES:
        value = nans.looked_at(eqn, args, MOVES[name](eqn, *args))
        nans.note(name, eqn, args, value if eqn.primitive.multiple_results else [value])
        return value
    if name in REDUCTIONS or name in ELEMENTWISE:
        return _counted(eqn, args)
    raise UnknownPrimitiveError(name)


def _counted(eqn: Any, given: Sequence[Any]) -> Any:
    """The result of an operation that counts or compares."""
    name, out, args = eqn.primitive.name, eqn.outvars[0].aval, number_types.carried(eqn, given)
    aligned = args if name in REDUCTIONS else _aligned(args, out.shape)
    value, flags = (REDUCTIONS.get(name) or ELEMENTWISE[name])(eqn, *aligned), None
    if name in ("select_n", "mul") and is_node(value):
        plain, value = value, by_pieces(eqn, given, value, _result, ELEMENTWISE)
        flags = flags_of(value) if value is not plain else None
    if name == "select_n" and flags is None:
        flags = nans.of_cases(*args)
    product = name in ("mul", "div") and all(map(is_node, args))
    last = product or not (name in CURVES or (is_node(value) and value.unnormalised))
    value = normalise(value) if is_node(value) and last else value
    value = nans.looked_at(eqn, args, value)
    unsure = may_be_nan(args) if jnp.issubdtype(out.dtype, jnp.integer) else None
    value = number_types.integer_result(eqn, name, args, value, unsure)
    if not is_node(value) and jnp.issubdtype(out.dtype, jnp.floating) and may_be_nan(args) is not None:
        value = nans.constant(value, out, args)
    flag([value], flags or ())
    nans.note(name, eqn, args, [value], passes=flags is None)
    return value


def _constant(eqn: Any, args: Sequence[Any]) -> Any:
    """Nothing depends on the box: evaluate as usual, while tracing where all numbers are known."""
    args = [known_if_concrete(arg) for arg in args]
    name, out = eqn.primitive.name, eqn.outvars[0].aval
    rounds = name in ROUNDED and rounding.outward() and jnp.issubdtype(out.dtype, jnp.floating)
    if rounds and not all(map(is_known, args)):
        nodes = [as_node(arg, jnp.shape(arg), out.dtype) for arg in args]
        aligned = nodes if name in REDUCTIONS else _aligned(nodes, out.shape)
        return normalise((REDUCTIONS.get(name) or ELEMENTWISE[name])(eqn, *aligned))
    return fold(Operation(eqn.primitive, tuple(eqn.params.items())), *args)


def _aligned(args: Sequence[Any], shape: tuple[int, ...]) -> list[Any]:
    """JAX lets scalars and axes of length 1 meet an array; slopes and Jacobians have one axis more: spread them."""
    spread = [is_node(arg) and arg.shape != shape for arg in args]
    return [
        linear.move(lambda v: jnp.broadcast_to(v, shape), arg) if wide else arg
        for arg, wide in zip(args, spread, strict=True)
    ]


def _caller(eqn: Any) -> str | None:
    """File and line of the user's code that made this equation."""
    traceback = getattr(eqn.source_info, "traceback", None)
    for frame in traceback.frames if traceback is not None else ():
        if not frame.file_name.startswith((_OURS, _JAX)) and "site-packages" not in frame.file_name:
            return f"{frame.file_name}:{frame.line_num}"
    return None


def _call(eqn: Any, *args: Any) -> Any:
    try:
        jaxpr, consts = called_jaxpr(eqn)
    except LookupError:
        raise UnknownPrimitiveError(eqn.primitive.name, "without a body") from None
    plain = all(number_types.is_plain(out.aval.dtype) for out in eqn.outvars)
    name = library_function(jaxpr) if plain else ""
    whole = WHOLE.get(name)
    if whole is not None and (given := _given(name, eqn, args)) is not None:
        found = whole(eqn, *given)
        if found is not None:
            return _library(name, eqn, given, [normalise(value) if is_node(value) else value for value in found])
    if name in LIBRARY and any(is_node(arg) for arg in args):
        numbers = number_types.carried(eqn, args)
        value = normalise(LIBRARY[name](eqn, *_aligned(numbers, eqn.outvars[0].aval.shape)))
        return _library(name, eqn, numbers, [number_types.integer_result(eqn, name, numbers, value)])
    return evaluate(jaxpr, consts, args)


def _library(name: str, eqn: Any, args: Sequence[Any], results: Sequence[Any]) -> list[Any]:
    """Results of a function of JAX's libraries, with what is to be said of NaN."""
    results = [nans.library_result(name, eqn, args, value) for value in results]
    nans.note(name, eqn, args, results)
    return results


def _given(name: str, eqn: Any, args: Sequence[Any]) -> list[Any] | None:
    """Arguments for the rule of a whole function, None where there is nothing to bound: without a node that is so to
    nearest, and of a result that is exact. Numbers that are not known while tracing become nodes, as in `_constant`."""
    if any(map(is_node, args)):
        return list(map(settled, args))
    if name in EXACT or not rounding.outward() or not any(isinstance(arg, Tracer) for arg in args):
        return None
    avals = [atom.aval for atom in eqn.invars]
    return [
        as_node(arg, aval.shape, aval.dtype)
        if isinstance(arg, Tracer) and jnp.issubdtype(aval.dtype, jnp.floating)
        else arg
        for arg, aval in zip(args, avals, strict=True)
    ]


def _cond(eqn: Any, index: Any, *args: Any) -> Any:
    branches = eqn.params["branches"]
    if not is_node(index) and not isinstance(index, Tracer):
        chosen = branches[min(max(int(index), 0), len(branches) - 1)]
        return evaluate(chosen.jaxpr, chosen.consts, args)
    if is_node(index):
        number_types.check(eqn)
    outcomes = [evaluate(branch.jaxpr, branch.consts, args) for branch in branches]
    if len(branches) == 2 and not is_node(index):
        index = index != 0
    results = []
    for cases in zip(*outcomes, strict=True):
        numbers = number_types.carried(eqn, cases) if is_node(index) else cases
        results.append(comparison.select(index, *numbers))
        pass_on(cases, results[-1:])
    return results


def _scan(eqn: Any, *args: Any) -> Any:
    """Unrolled where it is short: then every turn may find different things constant."""
    n_consts, n_carry = eqn.params["num_consts"], eqn.params["num_carry"]
    consts, carry, xs = args[:n_consts], list(args[n_consts : n_consts + n_carry]), args[n_consts + n_carry :]
    body, length, reverse = eqn.params["jaxpr"], eqn.params["length"], eqn.params["reverse"]

    def turn(carry: Sequence[Any], rows: Sequence[Any]) -> tuple[list[Any], list[Any]]:
        out = evaluate(body.jaxpr, body.consts, [*consts, *carry, *rows])
        return list(out[:n_carry]), list(out[n_carry:])

    if length > _UNROLL or (length > 1 and length * numbers_in(body.jaxpr) > _UNROLLED_NUMBERS):
        return kept_loop(_unwatched(turn), carry, xs, length, reverse)
    stacked: list[Any] = [None] * length
    for i in range(length)[::-1] if reverse else range(length):
        rows = [linear.move(lambda v, i=i: v[i], x) for x in xs]
        for x, row in zip(xs, rows, strict=True):
            pass_on([x], [row])
        carry, stacked[i] = turn(carry, rows)
    return [*carry, *(stack(list(column)) for column in zip(*stacked, strict=True))]


def _while(eqn: Any, *args: Any) -> list[Any]:
    def loop(turn: Callable[..., list[Any]], carry: list[Any], count: int) -> list[Any]:
        return kept_loop(_unwatched(lambda carry, rows: (turn(carry), [])), list(carry), [], count, False)

    def longest(body: Any) -> int:
        return min(_UNROLL, max(1, _UNROLLED_NUMBERS // max(numbers_in(body), 1)))

    return while_loop(eqn, args, evaluate, loop, longest)


CALLS: dict[str, Callable[..., Any]] = {"cond": _cond, "scan": _scan, "while": _while} | dict.fromkeys(
    (
        "jit", "pjit", "closed_call", "core_call", "remat", "remat2", "checkpoint",
        "custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr",
    ),
    _call,
)  # fmt: skip
