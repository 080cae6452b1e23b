"""Sums of clips, ramps and maxima in a jaxpr, as the piecewise-linear functions of one number that they are together.

The jaxpr is read number by number (`gsisio_jax.scalar.hinges`). An equation with a result that bends several times
along one direction is bounded as linear terms and tables; what leads to it and is used by nothing else is left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import partial
from typing import Any

import jax.extend.core as jex
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from gsisio_jax.inclusion.node import Form, Node, as_node, is_node, normalised, slack_of
from gsisio_jax.inclusion.rules.hinge_tables import hinge_table
from gsisio_jax.inclusion.rules.linear import add, move, multiple, structural
from gsisio_jax.inclusion.rules.makers import Match
from gsisio_jax.inclusion.rules.univariate import apply
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval
from gsisio_jax.scalar.graph import Graph, Number
from gsisio_jax.scalar.hinges import BENT, Bends, Bent
from gsisio_jax.scalar.unroll import applied, collected, constants, numbers_in, plain_dtype

_MOST_NUMBERS = 4_000  # of a jaxpr that is read
_MOST_ENTRIES = 64  # of an array that is made of tables
_MOVES = {"broadcast_in_dim", "reshape", "squeeze", "expand_dims", "slice", "concatenate", "transpose", "rev", "copy"}


def find(jaxpr: Any, values: dict[Any, Any]) -> dict[int, Match]:
    """Equations with such results, by their place; `values` are the constants and arguments of the jaxpr."""
    if _bends_in(jaxpr) < 2 or numbers_in(jaxpr) > _MOST_NUMBERS:
        return {}
    graph, bends, arrays = Graph(), Bends(), dict[Any, np.ndarray]()
    moving = {var for var in [*jaxpr.constvars, *jaxpr.invars] if is_node(values[var])}
    where: dict[int, tuple[Any, int]] = {}  # the variable and entry that a number stands in, by its order

    def note(var: Any, entries: np.ndarray) -> None:
        arrays[var] = entries
        for i, entry in enumerate(entries.ravel()):
            if isinstance(entry, Number):
                where.setdefault(entry.order, (var, i))

    for var in [*jaxpr.constvars, *jaxpr.invars]:
        value, shape = values[var], var.aval.shape
        if is_node(value) or isinstance(value, Tracer):
            dtype = plain_dtype(var.aval.dtype)
            note(var, collected([graph.input(dtype) for _ in range(math.prod(shape))], shape))
        else:
            note(var, constants(np.asarray(value)))
    found = {}
    for place, eqn in enumerate(jaxpr.eqns):
        given = [v.val if isinstance(v, jex.Literal) else v for v in eqn.invars]
        args = [arrays[v] if isinstance(v, jex.Var) else constants(np.asarray(v)) for v in given]
        if any(isinstance(v, jex.Var) and v in moving for v in eqn.invars):
            moving.update(eqn.outvars)
        for var, entries in zip(eqn.outvars, applied(graph, eqn, args, ""), strict=True):
            note(var, entries)
        match = _match(eqn, arrays, bends, where, moving)
        if match is not None:
            found[place] = match
    return found


def _bends_in(jaxpr: Any) -> int:
    """Entries of all results that bend."""
    total = 0
    for eqn in jaxpr.eqns:
        inner = [v for v in eqn.params.values() if hasattr(v, "jaxpr") or hasattr(v, "eqns")]
        total += sum(_bends_in(getattr(v, "jaxpr", v)) for v in inner)
        if eqn.primitive.name in BENT | {"reduce_max", "reduce_min"}:
            total += max(math.prod(v.aval.shape) for v in (*eqn.outvars, *eqn.invars))
    return total


def _match(
    eqn: Any, arrays: dict[Any, np.ndarray], bends: Bends, where: dict[int, tuple[Any, int]], moving: set[Any]
) -> Match | None:
    if len(eqn.outvars) != 1 or eqn.primitive.name in _MOVES:
        return None
    out = eqn.outvars[0]
    entries = arrays[out].ravel()
    if out not in moving or not 0 < len(entries) <= _MOST_ENTRIES or not jnp.issubdtype(out.aval.dtype, jnp.floating):
        return None
    read = [bent for entry in entries if (bent := bends.of(entry)) is not None]
    if len(read) < len(entries) or not any(bent.joint for bent in read):
        return None
    bases = sorted({b for bent in read for b in bent.bases()})
    # A number that is first seen inside of a call, or in this result itself, is no variable to start from.
    if not all(b in where and where[b][0] is not out and where[b][0] in moving for b in bases):
        return None
    places = {b: (i, where[b][1]) for i, b in enumerate(bases)}
    rule = partial(_joined, entries=read, places=places, shape=out.aval.shape, dtype=plain_dtype(out.aval.dtype))
    return Match(rule, [where[b][0] for b in bases])


def _node(bent: Bent, base: Callable[[int], Node], dtype: Any) -> Node:
    """Linear terms, a constant, and tables."""
    rest, tables = bent.tables()
    terms = [
        apply(hinge_table(slope, constant, jumps, dtype), _combined(dict(t), base))
        for t, slope, constant, jumps in tables
    ]
    if rest.linear:
        terms.append(_combined(rest.linear, base))
    if rest.constant or not terms:
        terms.append(_nearly(as_node(np.asarray(float(rest.constant), dtype), (), dtype), rest.constant))
    total = terms[0]
    for term in terms[1:]:
        total = normalised(add(total, term))
    return total


def _joined(
    *operands: Any, entries: Sequence[Bent], places: dict[int, tuple[int, int]], shape: Any, dtype: Any
) -> Node:
    def base(b: int) -> Node:
        operand, entry = places[b]
        value = operands[operand]
        node = value if is_node(value) else as_node(value, jnp.shape(value), dtype)
        return normalised(move(lambda v: v.reshape(-1)[entry], node))

    nodes = [_node(bent, base, dtype) for bent in entries]
    return structural(lambda *v: jnp.stack(v).reshape(shape), nodes)[0]


def _combined(weights: dict[int, Fraction], base: Callable[[int], Node]) -> Node:
    total = None
    for b, weight in weights.items():
        node = base(b)
        term = (
            node if weight == 1 else _nearly(normalised(multiple(np.asarray(float(weight), node.dtype), node)), weight)
        )
        total = term if total is None else normalised(add(total, term))
    assert total is not None
    return total


def _nearly(node: Node, factor: Fraction) -> Node:
    """A multiple by the floating number nearest to a fraction, as one by that fraction: off by an ulp of itself."""
    if Fraction(float(np.asarray(float(factor), node.dtype))) == factor or not rounding.outward():
        return node

    def wider(box: Interval) -> Interval:
        return Interval.unchecked(rounding.down(box.lower), rounding.up(box.upper))

    form = node.form
    if form is not None:
        slack = slack_of(node, form.slope) + 2 * float(jnp.finfo(node.dtype).eps) * abs(form.slope)
        form = Form(form.slope, wider(form.offset), form.box, slack)
    return Node(wider(node.range), form, None if node.jac is None else wider(node.jac))


def needed(jaxpr: Any, bent: dict[int, Match], known: dict[int, Match]) -> set[int]:
    """Places of the equations that the results come from, where some bend as a whole. Of an expression that is `known`
    as a whole the last equation still counts: its rule may not apply to what it is given."""
    wanted, places = {v for v in jaxpr.outvars if isinstance(v, jex.Var)}, set[int]()
    for place in range(len(jaxpr.eqns) - 1, -1, -1):
        eqn = jaxpr.eqns[place]
        if eqn.effects or any(v in wanted for v in eqn.outvars):
            places.add(place)
            match = bent.get(place) or known.get(place)
            operands = () if match is None else match.operands
            read = operands if place in bent else (*eqn.invars, *operands)
            wanted |= {v for v in read if isinstance(v, jex.Var)}
    return places
