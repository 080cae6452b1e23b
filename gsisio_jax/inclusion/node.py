"""What the interpreter carries at every node of a function: a range, and for functions of ``x`` more than a range.

Three tiers, from least to most:

- a plain array: the node is a constant, evaluated as usual;
- a `Node` with a range only: it does not depend on ``x`` (but on an `Interval` argument), or only ranges were asked
  for. In the affine domain it stands for slope 0, in the derivative domain for derivative 0;
- a `Node` with a `Form` and, if derivatives were asked for, with an enclosure of its Jacobian.

Inside the engine the axis over the entries of ``x`` comes first, so that slopes broadcast against values.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from gsisio_jax.interval import Interval, choose
from gsisio_jax.ties import larger, smaller


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


class Form(eqx.Module):
    """``value - slope . x`` lies in ``offset`` for every x of ``box``; slope has shape (n, *shape)."""

    slope: Any
    offset: Interval
    box: Interval

    def image(self) -> Interval:
        """Bounds of the value that follow from the form alone."""
        return shift(slope_image(self.slope, self.box), self.offset)


class Node(eqx.Module):
    """A value that is not constant: range, and optionally an affine form and a Jacobian enclosure (n, *shape)."""

    range: Interval
    form: Form | None = None
    jac: Interval | None = None

    @property
    def shape(self) -> tuple[int, ...]:
        return self.range.lower.shape

    @property
    def dtype(self) -> Any:
        return self.range.lower.dtype

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


def shift(a: Interval, b: Interval) -> Interval:
    """Sum of two boxes."""
    lower = a.lower + b.lower
    return Interval.unchecked(lower, lower if is_point(a) and is_point(b) else a.upper + b.upper)


def stretch(factor: Any, a: Interval) -> Interval:
    """Product of a number and a box."""
    if is_known(factor) and np.isfinite(factor).all():
        return _stretch_known(factor, a)
    if is_point(a):
        value = times(factor, a.lower)
        return Interval.unchecked(value, value)
    up = factor >= 0
    return Interval.unchecked(
        times(factor, jnp.where(up, a.lower, a.upper)), times(factor, jnp.where(up, a.upper, a.lower))
    )


def _stretch_known(factor: Any, a: Interval) -> Interval:
    """`stretch` by numbers whose signs are known: no test for ``0 * inf`` where none of them is 0."""

    def multiple(value: Any) -> Any:
        if (factor == 0).all() and is_known(value):
            return factor * np.zeros_like(value)
        return jnp.where(factor == 0, 0, factor * value) if (factor == 0).any() else factor * value

    if is_point(a):
        value = multiple(a.lower)
        return Interval.unchecked(value, value)
    up = factor >= 0
    if up.all():
        return Interval.unchecked(multiple(a.lower), multiple(a.upper))
    if not up.any():
        return Interval.unchecked(multiple(a.upper), multiple(a.lower))
    return Interval.unchecked(multiple(jnp.where(up, a.lower, a.upper)), multiple(jnp.where(up, a.upper, a.lower)))


def product(a: Interval, b: Interval) -> Interval:
    """Product of two boxes."""
    p, q = times(a.lower, b.lower), times(a.lower, b.upper)
    r, s = times(a.upper, b.lower), times(a.upper, b.upper)
    return Interval.unchecked(smaller(smaller(p, q), smaller(r, s)), larger(larger(p, q), larger(r, s)))


def slope_image(slope: Any, box: Interval) -> Interval:
    """Image of the box (n,) under the slope (n, *shape)."""
    side = (-1,) + (1,) * (slope.ndim - 1)
    lower, upper = jnp.reshape(box.lower, side), jnp.reshape(box.upper, side)
    image = stretch(slope, Interval.unchecked(lower, upper))
    return Interval.unchecked(image.lower.sum(0), image.upper.sum(0))


def guard(a: Interval) -> Interval:
    """After an overflow: a lower bound is never ``inf``, an upper bound never ``-inf``."""
    if is_known(a.lower) and is_known(a.upper) and np.isfinite(a.lower).all() and np.isfinite(a.upper).all():
        return a
    largest = jnp.finfo(a.lower.dtype).max
    # Chosen, not clipped: the derivative of a minimum is ten operations.
    return Interval.unchecked(
        jnp.where(a.lower == jnp.inf, largest, a.lower), jnp.where(a.upper == -jnp.inf, -largest, a.upper)
    )


def meet(node: Node) -> Node:
    """Intersect the range with what the form says; where rounding makes the two miss each other, keep the range."""
    if node.form is None:
        return node
    natural, image = node.range, node.form.image()
    lower, upper = larger(natural.lower, image.lower), smaller(natural.upper, image.upper)
    return Node(choose(lower <= upper, Interval.unchecked(lower, upper), natural), node.form, node.jac)


def best_form(slope: Any, offset: Interval, natural: Interval, box: Interval) -> Form:
    """The form with this slope, or slope 0 with the natural range where that one is narrower.

    A slope that overflowed needs no care here: its image is not a number, which never enters a range, and the
    finished form is given slope 0.
    """
    width = offset.upper - offset.lower
    # At width 0 both are equally good but for rounding, and there the slope must not be lost.
    rounding = 8 * jnp.finfo(width.dtype).eps * (jnp.abs(offset.lower) + jnp.abs(natural.lower))
    good = jnp.isfinite(width) & (width - rounding <= natural.upper - natural.lower)
    return Form(jnp.where(good, slope, 0), choose(good, offset, natural), box)


def settle(node: Node) -> Node:
    """Last word on the result of every arithmetic rule, in all three domains: the place to widen for rounding."""
    if not jnp.issubdtype(node.dtype, jnp.floating):
        return node
    form, jac = node.form, node.jac
    if form is not None:
        form = Form(form.slope, guard(form.offset), form.box)
    return Node(guard(node.range), form, None if jac is None else guard(jac))


def as_node(value: Any, shape: tuple[int, ...], dtype: Any) -> Node:
    """A constant as a node of one point."""
    value = known_if_concrete(value)
    value = np.broadcast_to(value, shape) if is_known(value) else jnp.broadcast_to(value, shape)
    value = value if value.dtype == bool else value.astype(dtype)
    return Node(Interval.unchecked(value, value))


def parts(values: Any) -> tuple[Any, Any]:
    """The box of the forms and the first Jacobian among `values`, or None: which domains a rule has to fill in."""
    box, jac = None, None
    for value in values:
        if is_node(value):
            box = value.form.box if box is None and value.form is not None else box
            jac = value.jac if jac is None else jac
    return box, jac


def slope_of(node: Node, box: Interval) -> Any:
    if node.form is not None:
        return node.form.slope
    return np.zeros((box.lower.shape[0], *node.shape), node.dtype)


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
