"""Functions in pieces: a choice, or a product with a switch, bounded piece by piece, and as continuous where it is.

Where a function switches between cases at cuts of one number p (the pivot, see `switches`), every case matters only
for p on its own side. So each is evaluated once more with the range of p cut down to the segment (`origin.Again`), and
the hull is taken of what is possible: that is the range, and with one common slope the form.

**Continuity.** At a cut c both neighbours are evaluated with p = c. Let j bound the difference of the two. Where j is 0
the function is continuous along p there, and its difference quotients lie in the hull of those of its pieces: on the
way from a to b within the box p passes through c, where both pieces agree. Where j is not 0 but as small as rounding,
``f = continuous part + r`` with ``|r| <= j`` (the jumps at all cuts): the hull bounds the continuous part, and the
range is widened by 2 j. A value of f at a point then covers the continuous part as well as f at any other point of
the box, up to the hull times the distance: that is all that mean-value forms use. Everywhere else derivatives are
infinite where a cut lies inside the range of p.

**Arrays.** Every entry of p is on a segment of its own, so where p has more than one entry nothing between it and the
result may mix entries.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Sequence
from contextlib import nullcontext
from contextvars import ContextVar
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from gsisio_jax.inclusion.form_arithmetic import box_sum, slope_image
from gsisio_jax.inclusion.nan_flags import flag, flags_of, may_be_nan
from gsisio_jax.inclusion.node import (
    Form,
    Node,
    as_node,
    best_form,
    is_node,
    jac_of,
    normalised,
    parts,
    slack_of,
    slope_of,
)
from gsisio_jax.inclusion.origin import Again, NotAgain, origin, settled
from gsisio_jax.inclusion.rules.bilinear import pick
from gsisio_jax.inclusion.rules.linear import move, subtract
from gsisio_jax.inclusion.rules.possible import hull_of_cases
from gsisio_jax.inclusion.rules.switches import Switch, switch_in, switch_of
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, choose, entire_like, intersect, magnitude
from gsisio_jax.interval.minmax import larger, smaller
from gsisio_jax.interval.primitives import times

_DEPTH: ContextVar[int] = ContextVar("gsisio_jax_piecewise_depth", default=0)
_DEEPEST = 2  # pieces within pieces that are evaluated once more

Apply = Callable[[Any, Sequence[Any]], Any]


def by_pieces(eqn: Any, args: Sequence[Any], plain: Node, apply: Apply, elementwise: Container[str]) -> Node:
    """The result of a choice or product, given what its plain rule says of it; that one where nothing is gained.

    Args:
        eqn: of ``select_n`` or ``mul``.
        args: its operands.
        plain: the node that the rule made of them.
        apply: evaluates an equation for other operands.
        elementwise: names of the primitives that do not mix entries.
    """
    if _DEPTH.get() >= _DEEPEST or not jnp.issubdtype(plain.dtype, jnp.floating):
        return plain
    if eqn.primitive.name == "select_n":
        switch = switch_of(args[0])
    else:
        switch = next((found for v in args if (found := switch_in(v)) is not None), None)
    if switch is None or switch.pivot.shape not in (plain.shape, ()) or not _fits(switch):
        return plain
    if switch.pivot.dtype != plain.dtype:  # a count, of float64 beside a box of float32: so would be the form
        return plain
    token = _DEPTH.set(_DEPTH.get() + 1)
    try:
        single = switch.pivot.range.lower.size == 1
        again = partial(Again, apply, None if single else elementwise)
        jumps = [_jump(eqn, args, again, switch, i, plain) for i in range(len(switch.cuts))]
        cases = [_on_segment(eqn, args, again, switch, i, plain) for i in range(len(switch.between))]
        cases += [_at_cut(eqn, args, again, switch, i, plain) for i in range(len(switch.cuts)) if _alone(switch, i)]
    except NotAgain:
        return plain
    finally:
        _DEPTH.reset(token)
    found = _hull(plain, switch, cases, jumps)
    flags = [case.possible.any() & case_flag for case in cases for case_flag in flags_of(case.node)]
    if (unsure := may_be_nan([switch.pivot])) is not None:
        found = pick(unsure, plain, found)  # a pivot that is no number is on no segment
        flags += [unsure & plain_flag for v in args for plain_flag in flags_of(v)]
    flag([found], flags)
    return found


def continuous_to(dtype: Any) -> float:
    """Jumps up to this share of the value count as rounding of the model's own numbers."""
    return max(1e-9, 64 * float(jnp.finfo(dtype).eps))


def _fits(switch: Switch) -> bool:
    return jnp.issubdtype(switch.pivot.dtype, jnp.floating) and all(np.isfinite(c).all() for c in switch.cuts)


class _Jump(NamedTuple):
    """Differences between the value at a cut and those just below and above it, and the size of the value."""

    below: Any
    above: Any
    size: Any


def _evaluated(
    eqn: Any, args: Sequence[Any], again: Callable[[Any], Again], switch: Switch, pivot: Node, value: Any, plain: Node
) -> Node:
    """The result for another pivot, and with that value of the switch."""
    fixed = np.full(switch.node.shape, value, switch.node.dtype)
    found = again([(switch.pivot, pivot), (switch.node, fixed)]).equation(eqn, args)
    return settled(found) if is_node(found) else as_node(found, plain.shape, plain.dtype)


def _jump(eqn: Any, args: Sequence[Any], again: Callable[[Any], Again], switch: Switch, i: int, plain: Node) -> _Jump:
    pivot = switch.pivot
    cut = np.broadcast_to(switch.cuts[i], pivot.shape).astype(pivot.dtype)
    thin = Node(Interval.unchecked(cut, cut))
    known = _only_constants(args, pivot)
    with jax.ensure_compile_time_eval() if known else nullcontext():
        # Mostly the value at the cut is that of a neighbour, and there is no jump to that side.
        there, *beside = switch.at[i], switch.between[i], switch.between[i + 1]
        at = _evaluated(eqn, args, again, switch, thin, there, plain)
        size, jumps = magnitude(at.range), []
        for value in beside:
            if value == there:
                jumps.append(jnp.zeros_like(size))
            else:
                other = _evaluated(eqn, args, again, switch, thin, value, plain)
                jumps.append(magnitude(normalised(subtract(at, other)).range))
        parts_of = [*(jnp.where(jnp.isnan(jump), jnp.inf, jump) for jump in jumps), size]
        return _Jump(*(map(np.asarray, parts_of) if known else parts_of))


def _only_constants(args: Sequence[Any], pivot: Node) -> bool:
    """Do the operands depend on nothing but the pivot and constants?"""
    stack, seen = list(args), set()
    while stack:
        value = stack.pop()
        if id(value) in seen or value is pivot:
            continue
        seen.add(id(value))
        if not is_node(value):
            if isinstance(value, Tracer):
                return False
        elif (found := origin(value)) is not None:
            stack += found.operands
        else:
            return False
    return True


class _Case(NamedTuple):
    """One segment: can p lie on it (a mask), the range of p there, and the result if it does."""

    possible: Any
    pivot: Interval
    node: Node


def _on_segment(
    eqn: Any, args: Sequence[Any], again: Callable[[Any], Again], switch: Switch, i: int, plain: Node
) -> _Case:
    pivot, cuts = normalised(switch.pivot), switch.cuts
    low, high = pivot.range.lower, pivot.range.upper
    first = low if i == 0 else larger(low, jnp.asarray(cuts[i - 1], low.dtype))
    last = high if i == len(cuts) else smaller(high, jnp.asarray(cuts[i], low.dtype))
    # A segment that only touches the range counts where it owns the point, as nothing else does then.
    owned = jnp.ones_like(first, bool)
    for j in (i - 1, i):
        if 0 <= j < len(cuts):
            owned &= (first != cuts[j]) | (switch.at[j] == switch.between[i])
    possible = (first < last) | ((first == last) & owned)
    # Where the segment is out of reach anything will do: the cut itself.
    stand_in = jnp.asarray(cuts[min(i, len(cuts) - 1)], low.dtype)
    box = choose(possible, Interval.unchecked(first, last), Interval.unchecked(stand_in, stand_in))
    cut_down = Node(box, _loose(pivot.form), pivot.jac)
    node = _evaluated(eqn, args, again, switch, cut_down, switch.between[i], plain)
    return _Case(jnp.broadcast_to(possible, plain.shape), box, node)


def _alone(switch: Switch, i: int) -> bool:
    """The value at the cut is that of neither neighbour, as with the sign of 0."""
    return switch.at[i] not in (switch.between[i], switch.between[i + 1])


def _at_cut(eqn: Any, args: Sequence[Any], again: Callable[[Any], Again], switch: Switch, i: int, plain: Node) -> _Case:
    pivot = normalised(switch.pivot)
    cut = jnp.broadcast_to(jnp.asarray(switch.cuts[i], pivot.dtype), pivot.shape)
    possible = (pivot.range.lower <= cut) & (cut <= pivot.range.upper)
    thin = Interval.unchecked(cut, cut)
    node = _evaluated(eqn, args, again, switch, Node(thin, _loose(pivot.form), pivot.jac), switch.at[i], plain)
    return _Case(jnp.broadcast_to(possible, plain.shape), thin, node)


def _loose(form: Form | None) -> Form | None:
    """The form with numbers that are not known while tracing: else its image would stand for the range."""
    if form is None:
        return None
    offset = Interval.unchecked(jnp.asarray(form.offset.lower), jnp.asarray(form.offset.upper))
    return Form(jnp.asarray(form.slope), offset, form.box, form.slack)


def _hull(plain: Node, switch: Switch, cases: Sequence[_Case], jumps: Sequence[_Jump]) -> Node:
    pivot = normalised(switch.pivot)
    tolerance = continuous_to(plain.dtype)
    # Of a value without bounds no share is small.
    sizes = [jnp.where(jnp.isfinite(j.size), jnp.maximum(j.size, 1), 1) for j in jumps]
    small = [[jump <= tolerance * size for jump in (j.below, j.above)] for j, size in zip(jumps, sizes, strict=True)]
    slip = sum(jnp.where(ok[0], j.below, 0) + jnp.where(ok[1], j.above, 0) for ok, j in zip(small, jumps, strict=True))
    possible = [case.possible for case in cases]
    natural, _ = intersect(hull_of_cases(possible, [case.node.range for case in cases]), plain.range)
    extra = rounding.generous(2 * slip) if rounding.outward() else 2 * slip
    natural = Interval.unchecked(natural.lower - extra, natural.upper + extra)
    box, jac = parts([plain, *(case.node for case in cases)])
    form = None
    if box is not None:
        wide = move(lambda v: jnp.broadcast_to(v, plain.shape), pivot) if pivot.shape != plain.shape else pivot
        form = _common_form(wide, cases, natural, extra, box)
    if jac is not None:
        size = jac.lower.shape[0]
        jac = hull_of_cases(possible, [jac_of(case.node, size) for case in cases])
        cuts = switch.cuts if pivot.jac is not None else ()  # what does not depend on x does not jump in x
        low, high = pivot.range.lower, pivot.range.upper
        for ok, cut in zip(small, cuts, strict=False):
            smooth = (~((low < cut) & (cut <= high)) | ok[0]) & (~((low <= cut) & (cut < high)) | ok[1])
            jac = choose(jnp.broadcast_to(smooth, jac.lower.shape), jac, entire_like(jac.lower))
    return Node(natural, form, jac)


def _common_form(pivot: Node, cases: Sequence[_Case], natural: Interval, extra: Any, box: Any) -> Form:
    """One slope for all pieces, each weighed with its share of the range of p: for pieces that are straight lines that
    is the slope of the chord. What a piece has more or less of it goes to the offset, as a multiple of p where it is
    one: p is known better on a segment than x is."""
    slopes = [slope_of(case.node, box) for case in cases]
    slope = jnp.stack([times(share, own) for share, own in zip(_shares(cases), slopes, strict=True)]).sum(0)
    along = slope_of(pivot, box)
    length = (along * along).sum(0)
    slack = sum((slack_of(case.node, own) for case, own in zip(cases, slopes, strict=True)), jnp.zeros_like(slope))
    offsets = []
    for case, own in zip(cases, slopes, strict=True):
        # own - slope = part * (slope of p) + left, for any number `part`.
        rest = own - slope
        part = jnp.where(length > 0, (rest * along).sum(0) / jnp.where(length > 0, length, 1), 0)
        part = jnp.where(jnp.isfinite(part), part, 0)
        left = rest - part * along
        # What these lines round; nothing in differences of equal numbers and with 0, nor in products with 1.
        lost = 4 * float(jnp.finfo(slope.dtype).eps) * (abs(own) + abs(slope) + abs(part * along))
        exact = (own == 0) | (slope == 0) | (own == slope)
        exact &= (along == 0) | ((abs(along) == 1) & (left == 0))
        lost = jnp.where(exact, 0, lost)
        slack = slack + jax.lax.stop_gradient(lost) + abs(part) * slack_of(pivot, along)
        moved = box_sum(case.pivot, Interval.unchecked(-pivot.offset.upper, -pivot.offset.lower))
        up = part >= 0
        scaled = Interval.unchecked(
            rounding.down(times(part, jnp.where(up, moved.lower, moved.upper))),
            rounding.up(times(part, jnp.where(up, moved.upper, moved.lower))),
        )
        scaled = choose(part == 0, Interval.unchecked(0 * part, 0 * part), scaled)
        offset = box_sum(box_sum(case.node.offset, slope_image(left, box)), scaled)
        offsets.append(Interval.unchecked(offset.lower - extra, offset.upper + extra))
    offset = hull_of_cases([case.possible for case in cases], offsets)
    return best_form(slope, offset, natural, box, slack if rounding.outward() else None)


def _shares(cases: Sequence[_Case]) -> list[Any]:
    """Which share of the range of p every segment has; of infinite ones, all alike have all of it."""
    lengths = [jnp.where(case.possible, case.pivot.upper - case.pivot.lower, 0) for case in cases]
    infinite = [jnp.isinf(length) for length in lengths]
    total = sum(jnp.where(inf, 0, length) for inf, length in zip(infinite, lengths, strict=True))
    many, alive = sum(inf.astype(int) for inf in infinite), sum(case.possible.astype(int) for case in cases)
    found = []
    for case, inf, length in zip(cases, infinite, lengths, strict=True):
        finite = jnp.where(total > 0, length / jnp.where(total > 0, total, 1), case.possible / jnp.maximum(alive, 1))
        share = jnp.where(many > 0, inf / jnp.maximum(many, 1), finite)
        found.append(jax.lax.stop_gradient(share.astype(length.dtype)))
    return found
