"""What the interpreter carries at every node of a function: a range, and for functions of ``x`` more than a range.

Three tiers, from least to most:

- a plain array: the node is a constant, evaluated as usual;
- a `Node` with a range only: it does not depend on ``x`` (but on an `Interval` argument), or only ranges were asked
  for. In the affine domain it stands for slope 0, in the derivative domain for derivative 0;
- a `Node` with a `Form` and, if derivatives were asked for, with an enclosure of its Jacobian.

Inside the engine the axis over the entries of ``x`` comes first, so that slopes broadcast against values.

Rounding: ranges, offsets and Jacobians are boxes, rounded outward by every operation here (see
`gsisio_jax.interval.rounding`). A slope is rounded to nearest, and what that may have lost is kept beside it, as
`slack`: times the magnitude of the box it belongs to the offset. Kept apart, because the box may be infinite, and
because slopes of linear functions are often exact: then the form of such a function on an infinite box stays what it
is.
"""

from __future__ import annotations

from contextvars import ContextVar
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.combinations import Share
from gsisio_jax.inclusion.form_arithmetic import (
    box_sum,
    finite_numbers,
    guard,
    is_exact,
    is_known,
    is_point,
    known_if_concrete,
    known_times,
    loosened,
    product,
    slope_magnitude,
    slope_products,
    spare,
)
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, choose, computed_once, magnitude
from gsisio_jax.interval.direct import where
from gsisio_jax.interval.minmax import larger, smaller
from gsisio_jax.interval.primitives import add_up, fusion_barrier

# The box is a point and only ranges are asked for: forms are kept for linear functions alone, whose value at the point
# they give with a single widening.
POINT_MODE: ContextVar[bool] = ContextVar("gsisio_jax_point_mode", default=False)
_LOSS = 64.0  # in best_form: narrower by less than this many ulps is narrower by rounding


class InputBox(eqx.Module):
    """The box of x, and the largest magnitude of every entry."""

    lower: Any
    upper: Any
    magnitude: Any

    @classmethod
    def of(cls, box: Interval) -> InputBox:
        return cls(box.lower, box.upper, abs(box.lower) if is_point(box) else magnitude(box))


class Form(eqx.Module):
    """``value - s . x`` lies in ``offset`` for every x of ``box``, with some s within ``slack`` of ``slope``.

    Slope and slack have shape (n, *shape); no slack (None): the slope is exact.
    """

    slope: Any
    offset: Interval
    box: InputBox
    slack: Any = None

    def folded(self) -> Interval:
        """The offset that belongs to the slope alone."""
        if self.slack is None:
            return self.offset
        return loosened(self.offset, slope_magnitude(self.slack, self.box), self.slope.shape[0] + 4.0)

    def image(self) -> Interval:
        """Bounds of the value that follow from the form alone."""
        if self.is_static_affine():
            return self._known_image()
        low, high = slope_products(self.slope, self.box)
        lower, upper = add_up(low, 0) + self.offset.lower, add_up(high, 0) + self.offset.upper
        if not rounding.outward():
            return Interval.unchecked(lower, upper)
        n = low.shape[0] + 6.0
        # The slack counts whole; its own rounding is far below what it was taken too large by.
        loss = 0 if self.slack is None else slope_magnitude(self.slack, self.box)
        lower = lower - (loss + rounding.error(add_up(abs(low), 0) + abs(self.offset.lower) + loss, n, n))
        upper = upper + (loss + rounding.error(add_up(abs(high), 0) + abs(self.offset.upper) + loss, n, n))
        return Interval.unchecked(lower, upper)

    def is_static_affine(self) -> bool:
        """All numbers but those of the box are known while tracing: the function is linear."""
        return finite_numbers(self.slope, self.offset.lower, self.offset.upper) and (
            self.slack is None or finite_numbers(self.slack)
        )

    def _known_image(self) -> Interval:
        """`image` where signs and zeros are known: rows that round nothing are not widened."""
        slope, offset = self.slope, self.offset
        used = [j for j in range(len(slope)) if slope[j].any()]
        count = (slope != 0).sum(0)
        plain = np.ones(slope.shape[1:], bool)
        for j in used:
            plain &= is_exact(slope[j], each=True)
        exact = (count == 0) | ((count == 1) & plain & (offset.lower == 0) & (offset.upper == 0))
        if self.slack is not None:
            exact &= ~self.slack.any(0)
        outward = rounding.outward() and not exact.all()
        sides: list[Any] = []
        same = self.box.lower is self.box.upper and is_point(offset)
        for sign in (-1,) if same else (-1, 1):
            start = offset.lower if sign < 0 else offset.upper
            first, last = (self.box.lower, self.box.upper) if sign < 0 else (self.box.upper, self.box.lower)
            if slope[0].size == 1:
                terms = [known_times(slope[j], first[j], last[j]) for j in used]
                total = sum(terms[1:], terms[0]) if terms else None
                size = sum((abs(term) for term in terms[1:]), abs(terms[0])) if terms and outward else None
            elif used:
                spread = (-1,) + (1,) * (slope.ndim - 1)
                ends = [
                    side if len(used) == len(slope) else jnp.stack([side[j] for j in used]) for side in (first, last)
                ]
                many = known_times(slope[used], *(jnp.reshape(end, spread) for end in ends))
                total, size = add_up(many, 0), add_up(abs(many), 0) if outward else None
            else:
                total = size = None
            if start.any():
                total, size = (start, abs(start)) if total is None else (total + start, outward and size + abs(start))
            sides.append((np.broadcast_to(start, slope.shape[1:]) if total is None else total, size))
        (lower, low_size), (upper, high_size) = sides[0], sides[-1]
        if not outward:
            return Interval.unchecked(lower, upper)
        n = len(used) + 6.0
        info = np.finfo(slope.dtype)
        share, floor = (np.where(exact, 0, value).astype(slope.dtype) for value in (n * info.eps, n * info.tiny))
        if self.slack is not None and self.slack.any():
            low_size, high_size = (
                size + slope_magnitude(self.slack / share.max(), self.box) for size in (low_size, high_size)
            )
        radius = jax.lax.stop_gradient(spare(exact, low_size * share) + floor)
        other = radius if same else jax.lax.stop_gradient(spare(exact, high_size * share) + floor)
        return Interval.unchecked(lower - radius, upper + other)


class Node(eqx.Module):
    """A value that is not constant: range, and optionally an affine form and a Jacobian enclosure (n, *shape).

    The range of a linear function (`Form.is_static_affine`) need not be given: no other one is better than the image
    of its form, which is computed when it is asked for.

    Sums hand a NaN on, so it need not be looked for after each of them: `unnormalised` nodes may hold one where they
    overflowed, until `normalise` turns it into "no bound". Every rule that compares its arguments does that first.

    A range with a `share` is a sum of operands that were widened before (`combinations`): the next linear operation
    need not widen it.
    """

    given: Interval | None
    form: Form | None = None
    jac: Interval | None = None
    unnormalised: bool = eqx.field(static=True, default=False)
    share: Share | None = eqx.field(static=True, default=None)

    @property
    def range(self) -> Interval:
        if self.given is None:
            assert self.form is not None
            image = guard(self.form.image())
            if image.lower.dtype != self.dtype:  # of a box whose numbers were promoted
                image = Interval.unchecked(*(side.astype(self.dtype) for side in (image.lower, image.upper)))
            object.__setattr__(self, "given", image if is_known(image.lower) else computed_once(image))
        assert self.given is not None
        return self.given

    @property
    def shape(self) -> tuple[int, ...]:
        if self.given is None and self.form is not None:
            return self.form.slope.shape[1:]
        return self.range.lower.shape

    @property
    def dtype(self) -> Any:
        if self.given is None and self.form is not None:
            return self.form.slope.dtype
        return self.range.lower.dtype

    @property
    def is_static_affine(self) -> bool:
        """A linear function or a constant, with known numbers."""
        if self.form is None:
            return self.given is not None and finite_numbers(self.given.lower, self.given.upper)
        return self.form.is_static_affine()

    @property
    def offset(self) -> Interval:
        """Offset of the form; a node without form has slope 0, so its range."""
        return self.range if self.form is None else self.form.offset


def is_node(value: Any) -> bool:
    return isinstance(value, Node)


def meet(node: Node) -> Node:
    """Intersect the range with what the form says; where rounding makes the two miss each other, keep the range."""
    if node.form is None or node.given is None:
        return node
    natural, image = node.range, node.form.image()
    lower, upper = larger(natural.lower, image.lower), smaller(natural.upper, image.upper)
    met = choose(lower <= upper, Interval.unchecked(lower, upper), natural)
    return Node(computed_once(met), node.form, node.jac, node.unnormalised)


def best_form(slope: Any, offset: Interval, natural: Interval, box: InputBox, slack: Any = None, size: Any = 0) -> Form:
    """The form with this slope, or slope 0 with the natural range where that one is narrower.

    A slope that overflowed needs no care here: its image is not a number, which never enters a range, and the
    finished form is given slope 0. `size` is the sum of what the rounding of the offset was taken from.
    """
    width = offset.upper - offset.lower
    # At width 0 both are equally good but for rounding, and there the slope must not be lost.
    size = jnp.abs(offset.lower) + jnp.abs(natural.lower) + size
    loss = _LOSS * jnp.finfo(width.dtype).eps * jax.lax.stop_gradient(size)
    good = jnp.isfinite(width) & (width - loss <= natural.upper - natural.lower)
    slack = None if slack is None else where(good, slack, 0)
    return Form(fusion_barrier(where(good, slope, 0)), computed_once(choose(good, offset, natural)), box, slack)


def unnormalised_node(
    given: Interval | None, form: Form | None, jac: Interval | None, share: Share | None = None
) -> Node:
    """A node that a linear rule made; to nearest it is normalised at once."""
    return Node(given, form, jac, rounding.outward(), share)


def normalised(value: Any) -> Any:
    """`normalise` where that has not been done."""
    return normalise(value) if is_node(value) and value.unnormalised else value


def normalise(node: Node) -> Node:
    """Last word on the result of every arithmetic rule, in all three domains: what overflowed is unbounded."""
    if not jnp.issubdtype(node.dtype, jnp.floating):
        return node
    if node.given is None:
        return node if node.jac is None else Node(None, node.form, guard(node.jac))
    form, jac = node.form, node.jac
    if form is not None:
        form = Form(form.slope, guard(form.offset), form.box, form.slack)
    return Node(guard(node.range), form, None if jac is None else guard(jac))


def as_node(value: Any, shape: tuple[int, ...], dtype: Any) -> Node:
    """A constant as a node of one point."""
    value = known_if_concrete(value)
    if is_known(value) and np.issubdtype(value.dtype, np.floating) and np.issubdtype(dtype, np.floating):
        value = value.astype(dtype)
        tiny = np.finfo(value.dtype).tiny
        # Compiled code would take a subnormal number for zero.
        if ((value != 0) & (np.abs(value) < tiny)).any():
            ends = rounding.normal(value, value)
            return Node(Interval.unchecked(*(np.broadcast_to(end, shape) for end in ends)))
    value = np.broadcast_to(value, shape) if is_known(value) else jnp.broadcast_to(value, shape)
    if value.dtype == bool or exact_in(value, dtype):
        value = value if value.dtype == bool else value.astype(dtype)
        return Node(Interval.unchecked(value, value))
    near = value.astype(dtype)
    far = abs(near) >= 2.0 ** (jnp.finfo(dtype).nmant + 1)
    if is_known(near):
        below, above = np.nextafter(near, near.dtype.type(-np.inf)), np.nextafter(near, near.dtype.type(np.inf))
    else:
        below, above = rounding.down(near), rounding.up(near)
    return Node(Interval.unchecked(where(far, below, near), where(far, above, near)))


def exact_in(value: Any, dtype: Any) -> bool:
    """Are these numbers, if they are integers, certainly numbers of that floating type?"""
    if not (jnp.issubdtype(value.dtype, jnp.integer) and jnp.issubdtype(dtype, jnp.floating)):
        return True
    most = 2 ** (int(jnp.finfo(dtype).nmant) + 1)
    if int(jnp.iinfo(value.dtype).max) <= most:
        return True
    return is_known(value) and all(
        -most <= int(v) <= most for v in (np.min(value, initial=0), np.max(value, initial=0))
    )


def parts(values: Any) -> tuple[Any, Any]:
    """The box of the forms and the first Jacobian among `values`, or None: which domains a rule has to fill in."""
    box, jac = None, None
    for value in values:
        if is_node(value):
            box = value.form.box if box is None and value.form is not None and not POINT_MODE.get() else box
            jac = value.jac if jac is None else jac
    return box, jac


def slope_of(node: Node, box: InputBox) -> Any:
    if node.form is not None:
        return node.form.slope
    return np.zeros((box.lower.shape[0], *node.shape), node.dtype)


def slack_of(node: Node, slope: Any) -> Any:
    """Slack of `slope_of`, zeros where it is exact."""
    slack = None if node.form is None else node.form.slack
    return np.zeros(np.shape(slope), node.dtype) if slack is None else slack


def jac_of(node: Node, size: int) -> Interval:
    if node.jac is not None:
        return node.jac
    dtype = node.dtype if jnp.issubdtype(node.dtype, jnp.floating) else jnp.result_type(float)
    zero = np.zeros((size, *node.shape), dtype)
    return Interval.unchecked(zero, zero)


def chain(derivative: Interval, jac: Interval | None) -> Interval | None:
    """Derivative of an elementwise function times the Jacobian of its argument."""
    return None if jac is None else sparse(product(derivative, jac), jac)


def sparse(jac: Interval, *factors: Interval) -> Interval:
    """The Jacobian, exactly 0 where all factors are: a variable that does not enter may be unbounded, and the least
    that widening adds to a zero would make everything of it."""
    if not rounding.outward() or is_known(jac.lower):
        return jac
    zero = None
    for factor in factors:
        now = (factor.lower == 0) & (factor.upper == 0)
        zero = now if zero is None else zero & now
    return choose(zero, Interval.unchecked(0, 0), jac)


def join(a: Interval | None, b: Interval | None) -> Interval | None:
    """Sum of two Jacobians, absent ones being zero."""
    if a is None or b is None:
        return b if a is None else a
    return sparse(box_sum(a, b), a, b)
