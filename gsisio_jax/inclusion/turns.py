"""Loops whose number of turns is known: `lax.while_loop` with a counter, or a time, that does not depend on the box."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.form_arithmetic import is_known, known_if_concrete
from gsisio_jax.inclusion.node import Node, is_node
from gsisio_jax.interval.box import Interval, entire_like

MOST_TURNS = 100_000


class TurnsError(ValueError):
    """It is not known while tracing how often a loop runs."""


def while_loop(
    eqn: Any,
    args: Sequence[Any],
    evaluate: Callable[..., list[Any]],
    loop: Callable[..., list[Any]],
    longest: Callable[[Any], int],
) -> list[Any]:
    """Unrolled where it is short, else as a scan over nodes (`loop`).

    Args:
        eqn: the equation.
        args: constants of the condition, constants of the body, and what is carried.
        evaluate: takes a jaxpr, its constants and its arguments.
        loop: takes a turn, the carry, and the number of turns.
        longest: how many turns of a body are unrolled.
    """
    params = eqn.params
    n_test, n_body = params["cond_nconsts"], params["body_nconsts"]
    test, body = params["cond_jaxpr"], params["body_jaxpr"]
    test_consts, body_consts = args[:n_test], args[n_test : n_test + n_body]
    carry = [known_if_concrete(v) if not is_node(v) else v for v in args[n_test + n_body :]]

    def turn(carry: Sequence[Any], consts: Sequence[Any] = body_consts) -> list[Any]:
        return evaluate(body.jaxpr, body.consts, [*consts, *carry])

    def goes_on(carry: Sequence[Any]) -> bool:
        (answer,) = evaluate(test.jaxpr, test.consts, [*test_consts, *carry])
        if is_node(answer) or not is_known(known_if_concrete(answer)):
            what = "depends on the box" if is_node(answer) else "is not known while tracing"
            raise TurnsError(f"whose number of turns {what}")
        return bool(np.asarray(answer))

    if not goes_on(carry):
        return carry
    known = _known(turn, carry)
    atoms = [atom.aval for atom in eqn.invars[n_test:]]
    dummies = [np.zeros(aval.shape, aval.dtype) for aval in atoms]
    plain = [v if _is_known(v) else dummy for v, dummy in zip(body_consts, dummies, strict=False)]
    count = _count(lambda now: turn(now, plain), goes_on, carry, known, dummies[n_body:])
    if count > longest(body.jaxpr):
        return loop(turn, carry, count)
    for _ in range(count):
        carry = turn(carry)
    return carry


def _is_known(value: Any) -> bool:
    return not is_node(value) and is_known(known_if_concrete(value))


def _known(turn: Callable[..., list[Any]], carry: Sequence[Any]) -> list[bool]:
    """What is known while tracing in every turn: what does not depend on anything that is not."""
    known = [_is_known(v) for v in carry]
    after = turn(carry)
    while True:
        still = [k and _is_known(v) for k, v in zip(known, after, strict=True)]
        if still == known:
            return known
        known = still
        after = turn([v if k else w for v, w, k in zip(carry, after, known, strict=True)])


def _count(
    turn: Callable[..., list[Any]],
    goes_on: Callable[..., bool],
    carry: Sequence[Any],
    known: Sequence[bool],
    dummies: Sequence[Any],
) -> int:
    """How many turns: with zeros for all that is not known, on which nothing that is known depends, and which the
    condition must not look at."""
    now, count = [v if k else _anything(v) for v, k in zip(carry, known, strict=True)], 0
    while goes_on(now):
        count += 1
        if count > MOST_TURNS:
            raise TurnsError(f"that takes more than {MOST_TURNS} turns")
        given = [v if k else dummy for v, k, dummy in zip(now, known, dummies, strict=True)]
        now = [known_if_concrete(v) if k else old for v, k, old in zip(turn(given), known, now, strict=True)]
    return count


def _anything(value: Any) -> Node:
    """A node of which nothing is known."""
    shape = value.shape if is_node(value) else np.shape(value)
    if jnp.issubdtype(value.dtype, jnp.bool_):
        return Node(Interval.unchecked(np.zeros(shape, bool), np.ones(shape, bool)))
    return Node(entire_like(jnp.zeros(shape)))
