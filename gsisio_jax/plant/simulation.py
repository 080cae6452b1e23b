"""Simulated records whose noise lies inside the stated bounds after rounding, too."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gsisio_jax._calls import named_arguments
from gsisio_jax._room import with_room
from gsisio_jax.interval import devices
from gsisio_jax.interval.box import Interval, is_concrete
from gsisio_jax.interval.reading import check_type, is_whole, read_array
from gsisio_jax.plant.periodic import wrapped_outputs
from gsisio_jax.plant.system import Noise, System
from gsisio_jax.scalar import in_tasks


class Simulation(NamedTuple):
    """A simulated record: x (T+1, n), y (T, l), and the noise w (T, n), v (T, l) that the record really holds."""

    x: Float[Array, "steps+1 n"]
    y: Float[Array, "steps l"]
    w: Float[Array, "steps n"]
    v: Float[Array, "steps l"]


@with_room
@named_arguments
def simulate(system: System, key: Any, x0: Any, d: Any, noise: Noise, u: Any = None) -> Simulation:
    """Simulate the plant with noise drawn uniformly from its bounds.

    ``state_bounds`` and ``input_bounds`` of the system are not enforced. A record that leaves them is not one of this
    system, and boxes need not hold it.

    Args:
        system: the plant.
        key: a key of `jax.random`, or an integer seed.
        x0: first state, shape (n,).
        d: unknown input, shape (T, p).
        noise: bounds of w and v.
        u: known input, shape (T, m); needed where m > 0.

    Returns:
        `Simulation`. w and v are computed back from the recorded x and y, so that rounding of the sums cannot carry
        the record out of the stated bounds by more than the rounding of that difference. Periodic outputs are wrapped
        to between minus and plus half a period; states are not.

    Raises:
        ValueError: shapes do not agree, or a number is not finite.

    Source: paper, (eq:system); theory 11.
    """
    check_type("simulate", "system", system, System)
    check_type("simulate", "noise", noise, Noise, "gx.Noise(w, v)")
    system.check_unchanged("simulate")
    key = read_key("simulate", key)
    if d is None:
        raise ValueError(
            f"simulate: give the unknown input `d`, shape (T, {system.p}); np.zeros((T, {system.p})) is none"
        )
    x0, d = _floating("x0", x0), _floating("d", d)
    if d.ndim != 2 or d.shape[1] != system.p:
        raise ValueError(f"simulate: `d` must have shape (T, {system.p}), got {d.shape}")
    if x0.shape != (system.n,):
        raise ValueError(f"simulate: `x0` must have shape ({system.n},), got {x0.shape}")
    if u is None:
        if system.m > 0:
            raise ValueError(f"simulate: the system has {system.m} known inputs; give `u` of shape (T, {system.m})")
        u = jnp.zeros((d.shape[0], 0))
    u = _floating("u", u)
    if u.shape != (d.shape[0], system.m):
        raise ValueError(f"simulate: `u` must have shape ({d.shape[0]}, {system.m}), got {u.shape}")
    for name, box, size in (("w", noise.w, system.n), ("v", noise.v, system.l)):
        if box.shape not in ((size,), (d.shape[0], size)):
            raise ValueError(
                f"simulate: the noise bounds of `{name}` must have shape ({size},) or ({d.shape[0]}, {size}), got "
                f"{box.shape}"
            )
    try:
        return _simulate(system, key, x0, d, noise.astype(x0.dtype), u)
    except ValueError as error:
        if "operand type mismatch" not in str(error) or x0.dtype == np.float64:
            raise
        raise ValueError(
            "simulate: JAX mixes up float64 and float32 where f or g hands a NumPy table (float64) to a function of "
            "JAX, such as jnp.interp. Make the table an array of JAX, jnp.asarray(table), or use float64 throughout: "
            "jax.config.update('jax_enable_x64', True) before all else"
        ) from error


def read_key(call: str, key: Any) -> Any:
    """One key of `jax.random`, which an integer seed makes, too.

    Raises:
        ValueError: it is neither.
    """
    if is_whole(key):
        return jax.random.key(int(key))
    if isinstance(key, jax.Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key) and key.ndim == 0:
        return key
    try:
        return jax.random.wrap_key_data(jnp.asarray(key))
    except (TypeError, ValueError) as error:
        shape = getattr(key, "shape", None)
        got = f"{type(key).__name__} {str(key)[:40]}" if shape is None else f"an array of shape {shape}"
        raise ValueError(f"{call}: `key` must be one key of jax.random or an integer seed; got {got}") from error


def _floating(name: str, value: Any) -> Any:
    array = jnp.asarray(read_array("simulate", name, value), float)
    if is_concrete(array) and not np.isfinite(np.asarray(array)).all():
        raise ValueError(f"simulate: `{name}` must be finite everywhere; a simulation has no missing numbers")
    return array


@jax.jit
def _simulate(system: System, key: Any, x0: Any, d: Any, noise: Noise, u: Any) -> Simulation:
    steps = d.shape[0]
    key_w, key_v = jax.random.split(key)
    bounds_w = _per_step(noise.w, steps, system.n)
    bounds_v = _per_step(noise.v, steps, system.l)

    def draw(key: Any, box: Interval) -> Any:
        share = jax.random.uniform(key, box.shape, box.lower.dtype)
        return jnp.clip(box.lower + share * (box.upper - box.lower), box.lower, box.upper)

    def step(x: Any, inputs: Any) -> tuple[Any, Any]:
        d_k, u_k, w_k, v_k, box_w, box_v = inputs
        y, v = measured(system, x, d_k, u_k, v_k, box_v)
        x_next, w = moved(system, x, d_k, u_k, w_k, box_w)
        return x_next, (x, y, w, v)

    drawn = (draw(key_w, bounds_w), draw(key_v, bounds_v))
    last, (x, y, w, v) = devices.scan(in_tasks(step), x0, (d, u, *drawn, bounds_w, bounds_v))
    return Simulation(jnp.concatenate([x, last[None]]), y, w, v)


def measured(system: System, x: Any, d: Any, u: Any, v: Any, bounds: Interval) -> tuple[Any, Any]:
    """The measurement y[k], periodic outputs as a sensor logs them, and the noise v[k] that it holds after rounding."""
    y, v = _add(system.measurement(x, u) + system.D @ u + system.H @ d, v, bounds)
    return wrapped_outputs(system.periodic, y), v


def moved(system: System, x: Any, d: Any, u: Any, w: Any, bounds: Interval) -> tuple[Any, Any]:
    """The next state x[k+1], and the noise w[k] that it holds after rounding."""
    return _add(system.dynamics(x, u) + system.B @ u + system.G @ d, w, bounds)


def pulled_in(noise: Any, box: Interval, margin: Any) -> Any:
    """Noise that keeps off the sides of its box by `margin`, or is in the middle where there is no room for that."""
    low, high = jnp.minimum(box.lower + margin, box.center), jnp.maximum(box.upper - margin, box.center)
    return jnp.clip(noise, low, high)


def _add(base: Any, noise: Any, box: Interval) -> tuple[Any, Any]:
    # The sum rounds; the noise the record holds is the difference. Pull it inside by a few ulps where it left.
    total = base + noise
    margin = 4 * jnp.finfo(total.dtype).eps * jnp.abs(total)
    inner = pulled_in(noise, box, margin)
    # What was drawn outside of its bounds stays there: an output that may be wrong, or a run that breaks them.
    total = jnp.where(box.contains(total - base) | ~box.contains(noise), total, base + inner)
    return total, total - base


def _per_step(box: Interval, steps: int, size: int) -> Interval:
    shape = (steps, size)
    return Interval.unchecked(jnp.broadcast_to(box.lower, shape), jnp.broadcast_to(box.upper, shape))
