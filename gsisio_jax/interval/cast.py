"""Casts between floating types, towards one side where the number does not fit."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax._calls import config


def as_array(value: Any, dtype: Any = None) -> Any:
    """`jnp.asarray`, which compiles a program for every shape of a NumPy array; here numbers that are known are copied
    to the device, and nothing is compiled."""
    if isinstance(value, jax.Array):
        return value if dtype is None else value.astype(dtype)
    value = np.asarray(value)
    # A copy: the array on the device may be the very memory that it is given.
    return jax.device_put(np.array(value, jax.dtypes.canonicalize_dtype(value.dtype if dtype is None else dtype)))


def floating_type(*types: Any) -> Any:
    """The floating type that values of these types are brought to, of those that JAX knows.

    `jnp.result_type` takes ten microseconds, and refuses two types where `jax_numpy_dtype_promotion` is "strict". That
    is for operations of which a user cannot know what they return; here it is said what two types mean.
    """
    # Arrays of 64 bits may come where JAX has 32 by now: each type first by itself, which is silent.
    known = {jax.dtypes.canonicalize_dtype(kind) for kind in set(types)}
    if len(known) == 1:
        (dtype,) = known
    else:
        with jax.numpy_dtype_promotion("standard"):
            dtype = jnp.result_type(*known)
    return dtype if jnp.issubdtype(dtype, jnp.floating) else jax.dtypes.canonicalize_dtype(np.float64)


def looked_at(value: Any) -> np.ndarray:
    """The numbers of an array that is known, in NumPy. That this fetches them from the device is meant, whatever
    `jax.transfer_guard` says of what happens unnoticed."""
    if not isinstance(value, jax.Array):
        return np.asarray(value)
    with jax.transfer_guard_device_to_host("allow"):
        return np.asarray(value)


def default_device() -> Any:
    """Where JAX puts what says nothing of it, if a user has chosen that; else None."""
    return config.jax_default_device


def cast_towards(value: Any, dtype: Any, towards: float) -> Any:
    """Cast to `dtype`, towards -inf or inf where the number does not fit."""
    dtype = jax.dtypes.canonicalize_dtype(dtype)
    if isinstance(value, np.ndarray | np.generic):
        return as_array(cast_known(value, dtype, towards))
    return value if value.dtype == dtype else _cast(value, dtype, towards)


@partial(jax.jit, static_argnums=(1, 2), inline=True)
def _cast(value: Any, dtype: Any, towards: float) -> Any:
    tiny = float(jnp.finfo(dtype).tiny)
    cast = value.astype(dtype)
    if jnp.finfo(dtype).bits >= jnp.finfo(value.dtype).bits:
        return cast
    back = cast.astype(value.dtype)
    wrong = back > value if towards < 0 else back < value
    # nextafter has no derivative rule: add its step as a constant, so that gradients see a plain cast.
    fixed = jax.lax.stop_gradient(cast)
    step = jax.lax.stop_gradient(jnp.nextafter(fixed, jnp.asarray(towards, dtype)) - fixed)
    largest = jnp.finfo(dtype).max if towards < 0 else jnp.finfo(dtype).min
    moved = jnp.where(jnp.isfinite(fixed), cast + jnp.where(jnp.isfinite(step), step, 0), largest)
    moved = jnp.where(abs(fixed) <= tiny, jnp.copysign(2 * tiny, towards), moved)
    return jnp.where(wrong, moved, cast)


def cast_known(value: Any, dtype: Any, towards: float) -> np.ndarray:
    """`cast_towards` in NumPy, before JAX sees the number: with 64-bit types off, JAX itself would round to nearest."""
    if value.dtype == dtype:
        return np.asarray(value)
    exact: Any = value
    tiny = float(np.finfo(dtype).tiny)
    with np.errstate(all="ignore"):
        cast = np.asarray(exact, dtype)
        wrong = cast > exact if towards < 0 else cast < exact
        moved = np.nextafter(cast, np.asarray(towards, dtype))
        # Compiled code takes subnormal numbers for zero: they are no bounds.
        moved = np.where(np.abs(moved) < tiny, np.copysign(tiny, towards), moved)
        return np.asarray(np.where(wrong, moved, cast), dtype)


def cast_down(value: Any, dtype: Any) -> Any:
    """Cast to `dtype`, towards minus infinity where the number does not fit."""
    return cast_towards(value, dtype, -np.inf)


def cast_up(value: Any, dtype: Any) -> Any:
    """Cast to `dtype`, towards infinity where the number does not fit."""
    return cast_towards(value, dtype, np.inf)
