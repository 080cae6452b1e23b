"""What the interpreter carries at every node of a function: a range, and for functions of ``x`` more than a range.

Three tiers, from least to most:

- a plain array: the node is a constant, evaluated as usual;
- a `Node` with a range only: it does not depend on ``x`` (but on an `Interval` argument), or only ranges were asked
  for. In the affine domain it stands for slope 0, in the derivative domain for derivative 0;
- a `Node` with a `Form` and, if derivatives were asked for, with an enclosure of its Jacobian.

Inside the engine the axis over the entries of ``x`` comes first, so that slopes broadcast against values.

Rounding: ranges, offsets and Jacobians are boxes, rounded outward by every operation here (`gsisio_jax.rounding`). A
slope is rounded to nearest, and what that may have lost is kept beside it, as `slack`: times the reach of the box it
belongs to the offset. Kept apart, because the box may be infinite, and because slopes of linear functions are often
exact: then the form of such a function on an infinite box stays what it is.
"""

from __future__ import annotations

from contextvars import ContextVar
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from gsisio_jax import rounding
from gsisio_jax.fusion import add_up, once
from gsisio_jax.interval import Interval, choose, held, reach
from gsisio_jax.ties import larger, smaller

# The box is a point and only ranges are asked for: forms are kept for linear functions alone, whose value at the point
# they give with a single widening.
THIN: ContextVar[bool] = ContextVar("gsisio_jax_thin", default=False)
_LOSS = 64.0  # in best_form: narrower by less than this many ulps is narrower by rounding


@jax.custom_jvp
def times(a: Any, b: Any) -> Any:
    """``a * b`` with ``0 * inf = 0``; its derivative treats a factor near infinity as 0, so gradients stay finite."""
    product = a * b
    return jnp.where(jnp.isnan(product), 0, product)


@times.defjvp
def _times_jvp(primals: Any, tangents: Any) -> Any:
    (a, b), (da, db) = primals, tangents
    largest = moderate(jnp.result_type(a, b))
    return times(a, b), jnp.where(jnp.abs(a) < largest, a, 0) * db + jnp.where(jnp.abs(b) < largest, b, 0) * da


def moderate(dtype: Any) -> float:
    """Numbers above this one overflow as soon as a gradient weighs them."""
    info = jnp.finfo(dtype)
    return float(info.max) * float(info.eps) ** 2


class Domain(eqx.Module):
    """The box of x, and the largest magnitude of every entry."""

    lower: Any
    upper: Any
    reach: Any

    @classmethod
    def of(cls, box: Interval) -> Domain:
        return cls(box.lower, box.upper, abs(box.lower) if is_point(box) else reach(box))


class Form(eqx.Module):
    """``value - s . x`` lies in ``offset`` for every x of ``box``, with some s within ``slack`` of ``slope``.

    Slope and slack have shape (n, *shape); no slack (None): the slope is exact.
    """

    slope: Any
    offset: Interval
    box: Domain
    slack: Any = None

    def folded(self) -> Interval:
        """The offset that belongs to the slope alone."""
        if self.slack is None:
            return self.offset
        return loosened(self.offset, slope_reach(self.slack, self.box), self.slope.shape[0] + 4.0)

    def image(self) -> Interval:
        """Bounds of the value that follow from the form alone."""
        if self.is_told():
            return self._known_image()
        low, high = slope_products(self.slope, self.box)
        lower, upper = add_up(low, 0) + self.offset.lower, add_up(high, 0) + self.offset.upper
        if not rounding.outward():
            return Interval.unchecked(lower, upper)
        n = low.shape[0] + 6.0
        # The slack counts whole; its own rounding is far below what it was taken too large by.
        loss = 0 if self.slack is None else slope_reach(self.slack, self.box)
        lower = lower - (loss + rounding.error(add_up(abs(low), 0) + abs(self.offset.lower) + loss, n, n))
        upper = upper + (loss + rounding.error(add_up(abs(high), 0) + abs(self.offset.upper) + loss, n, n))
        return Interval.unchecked(lower, upper)

    def is_told(self) -> bool:
        """All numbers but those of the box are known while tracing: the function is linear."""
        return _finite_numbers(self.slope, self.offset.lower, self.offset.upper) and (
            self.slack is None or _finite_numbers(self.slack)
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
                terms = [_known_times(slope[j], first[j], last[j]) for j in used]
                total = sum(terms[1:], terms[0]) if terms else None
                size = sum((abs(term) for term in terms[1:]), abs(terms[0])) if terms and outward else None
            elif used:
                spread = (-1,) + (1,) * (slope.ndim - 1)
                many = _known_times(slope[used], *(jnp.reshape(side[np.array(used)], spread) for side in (first, last)))
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
                size + slope_reach(self.slack / share.max(), self.box) for size in (low_size, high_size)
            )
        radius = jax.lax.stop_gradient(_spare(exact, low_size * share) + floor)
        other = radius if same else jax.lax.stop_gradient(_spare(exact, high_size * share) + floor)
        return Interval.unchecked(lower - radius, upper + other)


class Node(eqx.Module):
    """A value that is not constant: range, and optionally an affine form and a Jacobian enclosure (n, *shape).

    The range of a linear function (`Form.is_told`) need not be given: no other one is better than the image of its
    form, which is computed when it is asked for.

    Sums hand a NaN on, so it need not be looked for after each of them: `raw` nodes may hold one where they overflowed,
    until `settle` turns it into "no bound". Every rule that compares its arguments settles them first.
    """

    given: Interval | None
    form: Form | None = None
    jac: Interval | None = None
    raw: bool = eqx.field(static=True, default=False)

    @property
    def range(self) -> Interval:
        if self.given is None:
            assert self.form is not None
            image = guard(self.form.image())
            object.__setattr__(self, "given", image if is_known(image.lower) else held(image))
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
    def is_told(self) -> bool:
        """A linear function or a constant, with known numbers."""
        if self.form is None:
            return self.given is not None and _finite_numbers(self.given.lower, self.given.upper)
        return self.form.is_told()

    @property
    def offset(self) -> Interval:
        """Offset of the form; a node without form has slope 0, so its range."""
        return self.range if self.form is None else self.form.offset


def is_node(value: Any) -> bool:
    return isinstance(value, Node)


def is_known(value: Any) -> bool:
    """A NumPy array: its numbers are known while tracing. Slopes of affine functions stay of this kind, so that a
    linear map costs no operation at run time and its signs need no selects."""
    return isinstance(value, np.ndarray | np.generic)


def known_if_concrete(value: Any, dtype: Any = None) -> Any:
    """As a NumPy array where the numbers can be looked at, else as a JAX array."""
    if isinstance(value, Tracer):
        return value if dtype is None else value.astype(dtype)
    value = np.asarray(value)
    return value.astype(jax.dtypes.canonicalize_dtype(value.dtype if dtype is None else dtype))


def fold(call: Any, *values: Any) -> Any:
    """Call a JAX function, while tracing where all arguments are known."""
    if not all(is_known(value) for value in values):
        return call(*values)
    with jax.ensure_compile_time_eval():
        return jax.tree.map(np.asarray, call(*values))


def is_point(a: Interval) -> bool:
    """Both sides are the very same array: known to be equal while tracing."""
    return a.lower is a.upper


def is_zero(a: Interval) -> bool:
    """Known to be exactly 0."""
    return is_known(a.lower) and is_known(a.upper) and not (a.lower.any() or a.upper.any())


def shift(a: Interval, b: Interval) -> Interval:
    """Sum of two boxes."""
    if np.shape(a.lower) == np.shape(b.lower) and (is_zero(a) or is_zero(b)):
        return a if is_zero(b) else b
    if all(is_known(side) for side in (a.lower, a.upper, b.lower, b.upper)):
        lower, upper = rounding.known_sum(a.lower, b.lower)
        return Interval.unchecked(
            lower, upper if is_point(a) and is_point(b) else rounding.known_sum(a.upper, b.upper)[1]
        )
    lower = a.lower + b.lower
    upper = lower if is_point(a) and is_point(b) else a.upper + b.upper
    return Interval.unchecked(rounding.down(lower), rounding.up(upper))


def stretch(factor: Any, a: Interval, ulps: float = 2.0) -> Interval:
    """Product of a number and a box; with more `ulps` for a factor that was itself rounded."""
    if is_known(factor) and np.isfinite(factor).all():
        return _stretch_known(factor, a, ulps)
    if is_point(a):
        value = times(factor, a.lower)
        return Interval.unchecked(rounding.down(value, ulps), rounding.up(value, ulps))
    up = factor >= 0
    lower, upper = times(factor, jnp.where(up, a.lower, a.upper)), times(factor, jnp.where(up, a.upper, a.lower))
    return Interval.unchecked(rounding.down(lower, ulps), rounding.up(upper, ulps))


def _stretch_known(factor: Any, a: Interval, ulps: float) -> Interval:
    """`stretch` by numbers whose signs are known: no test for ``0 * inf`` where none of them is 0."""
    if is_known(a.lower) and is_known(a.upper) and ulps == 2.0:
        return _known_multiple(factor, a)

    def multiple(value: Any) -> Any:
        return jnp.where(factor == 0, 0, factor * value) if (factor == 0).any() else factor * value

    def bounds(lower: Any, upper: Any) -> Interval:
        if ulps == 2.0 and is_exact(factor):
            return Interval.unchecked(lower, upper)
        low, high = rounding.down(lower, ulps), rounding.up(upper, ulps)
        if rounding.outward() and (factor == 0).any():
            low, high = jnp.where(factor == 0, 0, low), jnp.where(factor == 0, 0, high)
        return Interval.unchecked(low, high)

    if is_point(a):
        value = multiple(a.lower)
        return bounds(value, value)
    up = factor >= 0
    if up.all():
        return bounds(multiple(a.lower), multiple(a.upper))
    if not up.any():
        return bounds(multiple(a.upper), multiple(a.lower))
    return bounds(multiple(jnp.where(up, a.lower, a.upper)), multiple(jnp.where(up, a.upper, a.lower)))


def _known_multiple(factor: Any, a: Interval) -> Interval:
    lower, upper = rounding.known_product(factor, a.lower)
    if is_point(a):
        return Interval.unchecked(lower, upper)
    other = rounding.known_product(factor, a.upper)
    return Interval.unchecked(np.minimum(lower, other[0]), np.maximum(upper, other[1]))


def is_exact(factor: Any, each: bool = False) -> Any:
    """Powers of two (or 0) of magnitude one at least: a product with them rounds nothing, and nothing is flushed."""
    size = np.abs(factor)
    found = (size == 0) | ((np.frexp(size)[0] == 0.5) & (size >= 1))
    return found if each else bool(found.all())


def _finite_numbers(*values: Any) -> bool:
    return all(is_known(value) and value.dtype != bool and np.isfinite(value).all() for value in values)


def _known_times(factor: Any, first: Any, last: Any) -> Any:
    """``factor`` times `first` where it is positive, times `last` where it is negative, and 0 where it is 0."""
    up = factor >= 0
    value = first if up.all() else last if not up.any() else jnp.where(up, first, last)
    product = jnp.broadcast_to(value, factor.shape) if (factor == 1).all() else factor * value
    return jnp.where(factor == 0, 0, product) if (factor == 0).any() else product


def _spare(exact: Any, radius: Any) -> Any:
    """Nothing for exact rows, even where they are infinite."""
    return jnp.where(exact, 0, radius) if exact.any() else radius


def product(a: Interval, b: Interval) -> Interval:
    """Product of two boxes."""
    p, q = times(a.lower, b.lower), times(a.lower, b.upper)
    r, s = times(a.upper, b.lower), times(a.upper, b.upper)
    lower, upper = smaller(smaller(p, q), smaller(r, s)), larger(larger(p, q), larger(r, s))
    return Interval.unchecked(rounding.down(lower), rounding.up(upper))


def slope_products(slope: Any, box: Any) -> tuple[Any, Any]:
    """Smallest and largest of every product of a slope (n, *shape) with the box (n,), to nearest."""
    side = (-1,) + (1,) * (slope.ndim - 1)
    lower, upper = jnp.reshape(box.lower, side), jnp.reshape(box.upper, side)
    with rounding.using("nearest"):
        image = stretch(slope, Interval.unchecked(lower, upper))
    return image.lower, image.upper


def slope_image(slope: Any, box: Any) -> Interval:
    """Image of the box (n,) under the slope (n, *shape), each entry of which may have been rounded once."""
    low, high = slope_products(slope, box)
    return Interval.unchecked(rounding.sum_down(low, 0), rounding.sum_up(high, 0))


def slope_reach(slope: Any, box: Domain) -> Any:
    """``sum |slope| reach``, to nearest; ``0 * inf = 0``."""
    far = jnp.reshape(box.reach, (-1,) + (1,) * (slope.ndim - 1))
    size = abs(slope)
    if is_known(size):
        terms = jnp.where(size == 0, 0, size * far) if (size == 0).any() else size * far
    else:
        terms = jnp.where(size == 0, 0, size * far)
    return add_up(jax.lax.stop_gradient(terms), 0)


def loosened(a: Interval, radius: Any, ulps: float = 2.0) -> Interval:
    """The box, `radius` larger on either side, which is itself known to some `ulps`."""
    lower, upper = a.lower - radius, a.upper + radius
    return Interval.unchecked(
        rounding.lowered(lower, abs(a.lower) + radius, ulps), rounding.raised(upper, abs(a.upper) + radius, ulps)
    )


def sum_slack(*slacks: Any) -> Any:
    """Sum of slacks. Each is at least twice of what was lost, so its own rounding needs no care."""
    present = [slack for slack in slacks if slack is not None and not (is_known(slack) and not slack.any())]
    return sum(present[1:], present[0]) if present and rounding.outward() else None


def scaled_slack(factor: Any, slope: Any, product: Any, slack: Any, ulps: float = 2.0) -> Any:
    """Slack of ``product = factor * slope``, the slope having a slack itself; exactly 0 where a factor is."""
    if not rounding.outward():
        return None
    if is_known(product):
        low, high = rounding.known_product(factor, slope)
        new = high - low if ulps == 2.0 else 4 * np.spacing(np.abs(product)) * (product != 0)
        return sum_slack(new, None if slack is None else np.abs(factor) * slack)
    info = jnp.finfo(product.dtype)
    kind = np.dtype(product.dtype).type
    before = None if slack is None else abs(factor) * slack
    if ulps == 2.0 and is_known(factor) and is_exact(factor):
        return sum_slack(before)
    if before is not None:
        # A slack that is flushed to zero would be lost for good, however far the box reaches.
        before = before + jax.lax.stop_gradient(jnp.where((factor == 0) | (slack == 0), 0, kind(info.tiny)))
    lost = abs(product) * kind(ulps * info.eps) + kind(info.tiny)
    return sum_slack(jax.lax.stop_gradient(jnp.where((factor == 0) | (slope == 0), 0, lost)), before)


def added_slack(a: Any, b: Any, total: Any) -> Any:
    """What the sum of two slopes loses: nothing where one of them is 0."""
    if not rounding.outward():
        return None
    if is_known(total):
        low, high = rounding.known_sum(a, b)
        return high - low
    kind = np.dtype(total.dtype).type
    lost = abs(total) * kind(2 * jnp.finfo(total.dtype).eps)
    return jax.lax.stop_gradient(jnp.where((a == 0) | (b == 0), 0, lost))


def guard(a: Interval) -> Interval:
    """After an overflow: a lower bound is never ``inf``, an upper bound never ``-inf``; neither is NaN."""
    if is_known(a.lower) and is_known(a.upper) and np.isfinite(a.lower).all() and np.isfinite(a.upper).all():
        return a
    if rounding.outward():
        return Interval.unchecked(rounding.unbounded(a.lower, -jnp.inf), rounding.unbounded(a.upper, jnp.inf))
    largest = jnp.finfo(a.lower.dtype).max
    return Interval.unchecked(jnp.minimum(a.lower, largest), jnp.maximum(a.upper, -largest))


def meet(node: Node) -> Node:
    """Intersect the range with what the form says; where rounding makes the two miss each other, keep the range."""
    if node.form is None or node.given is None:
        return node
    natural, image = node.range, node.form.image()
    lower, upper = larger(natural.lower, image.lower), smaller(natural.upper, image.upper)
    return Node(held(choose(lower <= upper, Interval.unchecked(lower, upper), natural)), node.form, node.jac, node.raw)


def best_form(slope: Any, offset: Interval, natural: Interval, box: Domain, slack: Any = None, size: Any = 0) -> Form:
    """The form with this slope, or slope 0 with the natural range where that one is narrower.

    A slope that overflowed needs no care here: its image is not a number, which never enters a range, and the
    finished form is given slope 0. `size` is the sum of what the rounding of the offset was taken from.
    """
    width = offset.upper - offset.lower
    # At width 0 both are equally good but for rounding, and there the slope must not be lost.
    size = jnp.abs(offset.lower) + jnp.abs(natural.lower) + size
    loss = _LOSS * jnp.finfo(width.dtype).eps * jax.lax.stop_gradient(size)
    good = jnp.isfinite(width) & (width - loss <= natural.upper - natural.lower)
    slack = None if slack is None else jnp.where(good, slack, 0)
    return Form(once(jnp.where(good, slope, 0)), held(choose(good, offset, natural)), box, slack)


def unsettled(given: Interval | None, form: Form | None, jac: Interval | None) -> Node:
    """A node that a linear rule made; to nearest it is settled at once."""
    return Node(given, form, jac, rounding.outward())


def settled(value: Any) -> Any:
    """`settle` where that has not been done."""
    return settle(value) if is_node(value) and value.raw else value


def settle(node: Node) -> Node:
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
    value = value if value.dtype == bool else value.astype(dtype)
    return Node(Interval.unchecked(value, value))


def parts(values: Any) -> tuple[Any, Any]:
    """The box of the forms and the first Jacobian among `values`, or None: which domains a rule has to fill in."""
    box, jac = None, None
    for value in values:
        if is_node(value):
            box = value.form.box if box is None and value.form is not None and not THIN.get() else box
            jac = value.jac if jac is None else jac
    return box, jac


def slope_of(node: Node, box: Domain) -> Any:
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
    return None if jac is None else product(derivative, jac)


def join(a: Interval | None, b: Interval | None) -> Interval | None:
    """Sum of two Jacobians, absent ones being zero."""
    if a is None or b is None:
        return b if a is None else a
    return shift(a, b)
