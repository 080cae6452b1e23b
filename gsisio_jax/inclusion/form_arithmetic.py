"""Arithmetic of boxes and of the slopes of forms, rounded outward; and of numbers that are known while tracing.

Source: theory 9 and 10.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, nan_to_unbounded
from gsisio_jax.interval.devices import agreeing
from gsisio_jax.interval.direct import absolute, minus, plus, where
from gsisio_jax.interval.minmax import larger, smaller
from gsisio_jax.interval.primitives import add_up, times
from gsisio_jax.scalar.numpy_program import numpy_function


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
    """Call a JAX function, while tracing where all arguments are known: in NumPy, as JAX compiles it operation by
    operation for every new shape."""
    if not all(is_known(value) for value in values):
        return call(*values)
    kinds = tuple((value.shape, value.dtype) for value in values)
    try:
        hash(call)
    except TypeError:  # parameters, or what it holds, have no hash
        return numpy_function(call, *values)(*values)
    return _folded(call, kinds, bool(jax.config.read("jax_enable_x64")))(*values)


@lru_cache(512)
def _folded(call: Callable[..., Any], kinds: tuple[Any, ...], wide: bool) -> Callable[..., Any]:
    """The program of equal calls is made once: both sides of a box, and every map that has this operation, share it."""
    return numpy_function(call, *(jax.ShapeDtypeStruct(*kind) for kind in kinds))


@dataclass(frozen=True)
class Operation:
    """A primitive on its arguments; equal to another one that does the same."""

    primitive: Any
    params: tuple[tuple[str, Any], ...]

    def __call__(self, *values: Any) -> Any:
        return self.primitive.bind(*agreeing([*map(jnp.asarray, values)]), **dict(self.params))


@dataclass(frozen=True)
class Along:
    """`jax.vmap` of a function; equal to that of an equal function."""

    function: Callable[..., Any]

    def __call__(self, *values: Any) -> Any:
        return jax.vmap(self.function)(*values)


def is_point(a: Interval) -> bool:
    """Both sides are the very same array: known to be equal while tracing."""
    return a.lower is a.upper


def is_zero(a: Interval) -> bool:
    """Known to be exactly 0."""
    return is_known(a.lower) and is_known(a.upper) and not (a.lower.any() or a.upper.any())


def box_sum(a: Interval, b: Interval) -> Interval:
    """Sum of two boxes."""
    if np.shape(a.lower) == np.shape(b.lower) and (is_zero(a) or is_zero(b)):
        return a if is_zero(b) else b
    if all(is_known(side) for side in (a.lower, a.upper, b.lower, b.upper)):
        lower, upper = rounding.known_sum(a.lower, b.lower)
        return Interval.unchecked(
            lower, upper if is_point(a) and is_point(b) else rounding.known_sum(a.upper, b.upper)[1]
        )
    lower = plus(a.lower, b.lower)
    upper = lower if is_point(a) and is_point(b) else plus(a.upper, b.upper)
    return Interval.unchecked(rounding.down(lower), rounding.up(upper))


def scaled(factor: Any, a: Interval, ulps: float = 2.0) -> Interval:
    """Product of a number and a box; with more `ulps` for a factor that was itself rounded."""
    if is_known(factor) and np.isfinite(factor).all():
        return _scaled_by_known(factor, a, ulps)
    if is_point(a):
        value = times(factor, a.lower)
        return Interval.unchecked(rounding.down(value, ulps), rounding.up(value, ulps))
    up = factor >= 0
    lower, upper = times(factor, where(up, a.lower, a.upper)), times(factor, where(up, a.upper, a.lower))
    return Interval.unchecked(rounding.down(lower, ulps), rounding.up(upper, ulps))


def _scaled_by_known(factor: Any, a: Interval, ulps: float) -> Interval:
    """`scaled` by numbers whose signs are known: no test for ``0 * inf`` where none of them is 0."""
    if is_known(a.lower) and is_known(a.upper) and ulps == 2.0:
        return _known_multiple(factor, a)

    def multiple(value: Any) -> Any:
        return where(factor == 0, 0, factor * value) if (factor == 0).any() else factor * value

    def bounds(lower: Any, upper: Any) -> Interval:
        if ulps == 2.0 and is_exact(factor):
            return Interval.unchecked(lower, upper)
        low, high = rounding.down(lower, ulps), rounding.up(upper, ulps)
        if rounding.outward() and (factor == 0).any():
            low, high = where(factor == 0, 0, low), where(factor == 0, 0, high)
        return Interval.unchecked(low, high)

    if is_point(a):
        value = multiple(a.lower)
        return bounds(value, value)
    up = factor >= 0
    if up.all():
        return bounds(multiple(a.lower), multiple(a.upper))
    if not up.any():
        return bounds(multiple(a.upper), multiple(a.lower))
    return bounds(multiple(where(up, a.lower, a.upper)), multiple(where(up, a.upper, a.lower)))


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


def finite_numbers(*values: Any) -> bool:
    return all(is_known(value) and value.dtype != bool and np.isfinite(value).all() for value in values)


def known_times(factor: Any, first: Any, last: Any) -> Any:
    """``factor`` times `first` where it is positive, times `last` where it is negative, and 0 where it is 0."""
    up = factor >= 0
    value = first if up.all() else last if not up.any() else where(up, first, last)
    product = jnp.broadcast_to(value, factor.shape) if (factor == 1).all() else factor * value
    return where(factor == 0, 0, product) if (factor == 0).any() else product


def spare(exact: Any, radius: Any) -> Any:
    """Nothing for exact rows, even where they are infinite."""
    return where(exact, 0, radius) if exact.any() else radius


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
        image = scaled(slope, Interval.unchecked(lower, upper))
    return image.lower, image.upper


def slope_image(slope: Any, box: Any) -> Interval:
    """Image of the box (n,) under the slope (n, *shape), each entry of which may have been rounded once."""
    low, high = slope_products(slope, box)
    return Interval.unchecked(rounding.sum_down(low, 0), rounding.sum_up(high, 0))


def slope_magnitude(slope: Any, box: Any) -> Any:
    """``sum |slope| magnitude``, to nearest; ``0 * inf = 0``."""
    far = jnp.reshape(box.magnitude, (-1,) + (1,) * (slope.ndim - 1))
    size = absolute(slope)
    no_zero = is_known(size) and size.all()
    terms = size * far if no_zero else where(size == 0, 0, size * far)
    return add_up(jax.lax.stop_gradient(terms), 0)


def loosened(a: Interval, radius: Any, ulps: float = 2.0) -> Interval:
    """The box, `radius` larger on either side, which is itself known to some `ulps`."""
    lower, upper = minus(a.lower, radius), plus(a.upper, radius)
    return Interval.unchecked(
        rounding.lowered(lower, plus(absolute(a.lower), radius), ulps),
        rounding.raised(upper, plus(absolute(a.upper), radius), ulps),
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
        before = before + jax.lax.stop_gradient(where((factor == 0) | (slack == 0), 0, kind(info.tiny)))
    lost = abs(product) * kind(ulps * info.eps) + kind(info.tiny)
    return sum_slack(jax.lax.stop_gradient(where((factor == 0) | (slope == 0), 0, lost)), before)


def added_slack(a: Any, b: Any, total: Any) -> Any:
    """What the sum of two slopes loses: nothing where one of them is 0."""
    if not rounding.outward():
        return None
    if is_known(total):
        low, high = rounding.known_sum(a, b)
        return high - low
    kind = np.dtype(total.dtype).type
    lost = abs(total) * kind(2 * jnp.finfo(total.dtype).eps)
    return jax.lax.stop_gradient(where((a == 0) | (b == 0), 0, lost))


def guard(a: Interval) -> Interval:
    """After an overflow: a lower bound is never ``inf``, an upper bound never ``-inf``; neither is NaN."""
    if is_known(a.lower) and is_known(a.upper) and np.isfinite(a.lower).all() and np.isfinite(a.upper).all():
        return a
    if rounding.outward():
        return nan_to_unbounded(a)
    largest = jnp.finfo(a.lower.dtype).max
    # Chosen, not clipped: the derivative of a minimum is ten operations.
    return Interval.unchecked(
        where(a.lower == jnp.inf, largest, a.lower), where(a.upper == -jnp.inf, -largest, a.upper)
    )
