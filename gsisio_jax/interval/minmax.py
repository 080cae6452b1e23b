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

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp


def smaller(a: Any, b: Any) -> Any:
    """``jnp.minimum(a, b)``.

    >>> jax.grad(lambda t: smaller(2 * t, t + 1))(1.0).item()
    1.5
    """
    return _smaller(*_alike(a, b))


def larger(a: Any, b: Any) -> Any:
    """``jnp.maximum(a, b)``."""
    return _larger(*_alike(a, b))


def _alike(a: Any, b: Any) -> tuple[Any, Any]:
    # In one type: an integer would have no derivative to weigh.
    dtype = jnp.result_type(a, b)
    return jnp.asarray(a, dtype), jnp.asarray(b, dtype)


@jax.custom_jvp
def _smaller(a: Any, b: Any) -> Any:
    return jnp.minimum(a, b)


@_smaller.defjvp
def _smaller_jvp(primals: tuple[Any, Any], tangents: tuple[Any, Any]) -> tuple[Any, Any]:
    (a, b), (da, db) = primals, tangents
    return _smaller(a, b), _mix(_share(a, b), da, db)


@jax.custom_jvp
def _larger(a: Any, b: Any) -> Any:
    return jnp.maximum(a, b)


@_larger.defjvp
def _larger_jvp(primals: tuple[Any, Any], tangents: tuple[Any, Any]) -> tuple[Any, Any]:
    (a, b), (da, db) = primals, tangents
    return _larger(a, b), _mix(_share(b, a), da, db)


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def smallest(values: Any, axis: int) -> Any:
    """``values.min(axis)``, for an axis that is not empty."""
    return values.min(axis)


@smallest.defjvp
def _smallest_jvp(axis: int, primals: tuple[Any], tangents: tuple[Any]) -> tuple[Any, Any]:
    (values,), (slopes,) = primals, tangents
    return smallest(values, axis), _first(jnp.moveaxis(values, axis, 0), jnp.moveaxis(slopes, axis, 0))


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def largest(values: Any, axis: int) -> Any:
    """``values.max(axis)``, for an axis that is not empty."""
    return values.max(axis)


@largest.defjvp
def _largest_jvp(axis: int, primals: tuple[Any], tangents: tuple[Any]) -> tuple[Any, Any]:
    (values,), (slopes,) = primals, tangents
    return largest(values, axis), _first(-jnp.moveaxis(values, axis, 0), jnp.moveaxis(slopes, axis, 0))


def _first(values: Any, slopes: Any) -> Any:
    """The slope that belongs to the smallest value along the first axis, by a tournament: in pairs the weights add up
    to 1 even where a number is computed twice and differs; means over all that equal the minimum would not."""
    while (count := values.shape[0]) > 1:
        half = count // 2
        a, b = values[:half], values[half : 2 * half]
        met = _mix(_share(a, b), slopes[:half], slopes[half : 2 * half])
        values = jnp.concatenate([jnp.minimum(a, b), values[2 * half :]])
        slopes = jnp.concatenate([met, slopes[2 * half :]])
    return slopes[0]


def _share(a: Any, b: Any) -> Any:
    """Weight of the derivative of a in that of min(a, b): 1 where a is smaller, 0 where b is, 1/2 where they agree."""
    a, b = jax.lax.stop_gradient((a, b))
    size = jnp.abs(a) + jnp.abs(b)
    usual = (size > 0) & (size < jnp.inf)  # else both are 0, or one of them is infinite
    steepness = 64 / float(jnp.finfo(size.dtype).eps) ** 0.5
    part = jnp.where(usual, jnp.clip(0.5 * size + steepness * (b - a), 0, size), (a <= b).astype(size.dtype))
    # The quotient comes last: XLA repeats cheap operations wherever their result is used, but no division. So all that
    # use this weight use the same number, even where a and b are 0 but for rounding.
    return part / jnp.where(usual, size, 1)


def _mix(share: Any, da: Any, db: Any) -> Any:
    # 1 but for rounding: a division here keeps XLA from repeating all that comes before in every fusion behind (twice
    # as many operations in the compiled gradient of a single tank, and half as much compile time again).
    one = share + (1 - share)
    return (share * da + (1 - share) * db) / one
