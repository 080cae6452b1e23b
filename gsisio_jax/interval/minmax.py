"""Minimum and maximum whose derivative survives rounding.

JAX finds out which argument a minimum came from by comparing it with all of them for equality. XLA may compute a number
twice, in two fusions, and round it differently (a fused multiply-add in one of them). Then the minimum equals none of
its arguments, or both, and the derivative is lost or doubled. That happens where pieces agree to rounding, which is the
rule here: most intersections meet boxes that are the same in exact arithmetic. (Six tanks, batch 1,000: one gradient in
three was wrong, by up to 90 %.) Deciding by ``a <= b`` is no better, because forward and backward computations, or the
two branches of the latter, may decide differently.

So the weights of the two derivatives pass from one to the other over a narrow band of relative width sqrt(eps) / 64,
instead of jumping: a number that is off by an ulp moves a weight by 1e-6 (float64). Weights add up to 1 and are
nonnegative, so at a tie this is a subgradient. Values are those of JAX, bit by bit.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from gsisio_jax.interval.primitives import elementwise


def _share(a: Any, b: Any) -> Any:
    """Weight of the derivative of a in that of min(a, b): 1 where a is smaller or b is NaN, 0 where b is smaller, 1/2
    where they agree (but 1 where both are 0, or infinite)."""
    a, b = jax.lax.stop_gradient((a, b))
    info = jnp.finfo(a.dtype)
    # XLA repeats cheap operations wherever their result is used, but no division. So all that use this weight use the
    # same quotient, even where a and b are 0 but for rounding. It is NaN where both are 0, or infinite, or b is NaN.
    # The cap's inverse is a normal number: XLA divides by a constant by multiplying.
    apart = (b - a) / jnp.minimum(jnp.abs(a), float(info.max) / 8)
    share = 0.5 + apart * (32 / float(info.eps) ** 0.5)
    return jnp.where(share < 1, jnp.maximum(share, 0), 1)


def _larger_share(a: Any, b: Any) -> Any:
    return _share(-a, -b)


def _mix(share: Any, da: Any, db: Any) -> Any:
    # 1 but for rounding: a division here keeps XLA from repeating all that comes before in every fusion behind (twice
    # as many operations in the compiled gradient of a single tank, and half as much compile time again).
    one = share + (1 - share)
    return (share * da + (1 - share) * db) / one


def _smaller_derivative(primals: Any, tangents: Any, out: Any) -> Any:
    return _mix(_share(*primals), *tangents)


def _larger_derivative(primals: Any, tangents: Any, out: Any) -> Any:
    return _mix(_larger_share(*primals), *tangents)


smaller = elementwise("smaller", jax.lax.min, _smaller_derivative)
"""``jnp.minimum(a, b)``.

>>> jax.grad(lambda t: smaller(2 * t, t + 1))(1.0).item()
1.5
"""

larger = elementwise("larger", jax.lax.max, _larger_derivative)
"""``jnp.maximum(a, b)``."""


def _raised_body(lower: Any, other: Any) -> Any:
    return jax.lax.select(jax.lax.gt(other, lower), other, lower)


def _cut_body(upper: Any, other: Any) -> Any:
    return jax.lax.select(jax.lax.lt(other, upper), other, upper)


def _unless_nan(rule: Callable[..., Any]) -> Callable[..., Any]:
    def derivative(primals: Any, tangents: Any, out: Any) -> Any:
        (kept, other), (d_kept, d_other) = primals, tangents
        missing = jnp.isnan(other)
        return rule((kept, jnp.where(missing, kept, other)), (d_kept, jnp.where(missing, d_kept, d_other)), out)

    return derivative


raised = elementwise("raised", _raised_body, _unless_nan(_larger_derivative))
"""The larger of a lower bound and another one, which is passed over where it is NaN (it overflowed)."""

cut = elementwise("cut", _cut_body, _unless_nan(_smaller_derivative))
"""The smaller of an upper bound and another one, which is passed over where it is NaN (it overflowed)."""


TIES = {"smaller": _share, "cut": _share, "larger": _larger_share, "raised": _larger_share}
"""Weights of the derivative of the first argument, by name; what is left of 1 is that of the other one."""


def smallest(values: Any, axis: int) -> Any:
    """``values.min(axis)``, for an axis that is not empty."""
    return _fold(smaller, values, axis)


def largest(values: Any, axis: int) -> Any:
    """``values.max(axis)``, for an axis that is not empty."""
    return _fold(larger, values, axis)


def _fold(rule: Callable[..., Any], values: Any, axis: int) -> Any:
    """By a tournament: in pairs the weights of derivatives add up to 1 even where a number is computed twice and
    differs; means over all that equal the minimum would not."""
    values = jnp.moveaxis(values, axis, 0)
    while (count := values.shape[0]) > 1:
        half = count // 2
        met = rule(values[:half], values[half : 2 * half])
        values = met if count % 2 == 0 else jnp.concatenate([met, values[2 * half :]])
    return values[0]
