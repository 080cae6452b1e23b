"""What every call checks before it runs, and the one floating type that everything is brought to."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax._memo import memory, once_per_observer
from gsisio_jax.interval.box import Interval, add, is_concrete
from gsisio_jax.interval.cast import as_array, default_device, floating_type, looked_at
from gsisio_jax.interval.direct import is_symbolic
from gsisio_jax.interval.reading import check_type, read_array
from gsisio_jax.interval.rounding import Rounding, check_rounding
from gsisio_jax.observer.delayed import DelayedObserver
from gsisio_jax.observer.prediction_step import PredictionObserver
from gsisio_jax.observer.tolerant import TolerantObserver
from gsisio_jax.observer.types import Observer
from gsisio_jax.plant.system import Noise

AnyObserver = Observer | PredictionObserver | DelayedObserver | TolerantObserver


def check_on_conflict(call: str, on_conflict: str) -> bool:
    """True for "hold"; refuses anything but "restart" and "hold"."""
    if on_conflict not in ("restart", "hold"):
        raise ValueError(f'{call}: `on_conflict` must be "restart" or "hold", got {on_conflict!r}')
    return on_conflict == "hold"


def rounded(call: str, observer: AnyObserver, rounding: Rounding | None) -> AnyObserver:
    """The observer with the rounding that a call asks for."""
    check_type(call, "observer", observer, AnyObserver.__args__, "it is what gx.design_observer returns")
    if rounding is None:
        return observer
    check_rounding(call, rounding)
    return observer if observer.rounding == rounding else observer.with_rounding(rounding)


def refuse_input_model(call: str, system: Any, why: str) -> None:
    """For calls that know nothing of how the unknown input moves."""
    for name in ("input_rate", "input_constant"):
        if getattr(system, name) is not None:
            raise ValueError(f"{call}: the system has `{name}`, {why}")


def check_length(length: Any, rows: int) -> None:
    if np.ndim(length) or not jnp.issubdtype(jnp.result_type(length), jnp.integer):
        raise ValueError(f"estimate: `length` must be one integer per record, got {length!r}; for many use jax.vmap")
    if is_concrete(length) and not 0 <= int(length) <= rows:
        raise ValueError(f"estimate: `length` must be between 0 and the {rows} rows of `y`, got {int(length)}")


def prepare(
    call: str,
    observer: AnyObserver,
    initial: Interval,
    y: Any,
    u: Any,
    noise: Noise | None,
    rows: bool,
    rounding: Rounding | None = None,
) -> tuple[Interval, Any, Any, Noise, AnyObserver]:
    """Check shapes (and values of concrete arrays), and bring everything to one dtype, bounds rounded outward."""
    observer = rounded(call, observer, rounding)
    n, l, m = _sizes(observer)
    if call != "step":  # which is called many times, and was checked by `start`
        observer.system.check_unchanged(call)
    lead = "(T, " if rows else "("
    check_type(call, "initial", initial, Interval, f"gx.Interval(lower, upper) of shape ({n},)")
    lower, upper = initial.lower, initial.upper
    if lower.shape != (n,):
        raise ValueError(
            f"{call}: `initial` must be an Interval of shape ({n},), got {initial.shape}; for many boxes use jax.vmap"
        )
    y = read_array(call, "y" if rows else "the measurement", y, missing=True)
    shape = y.shape
    if len(shape) != 1 + rows or shape[-1] != l or (rows and call == "estimate" and shape[0] == 0):
        needed = f"(T, {l}) with T >= 1" if rows else f"({l},)"
        raise ValueError(f"{call}: measurements must have shape {needed}, got {shape}; {_hint(shape, l, rows)}")
    alone = is_concrete(y)
    if alone and np.isinf(looked_at(y)).any():
        raise ValueError(f"{call}: a measurement is infinite; mark missing entries with NaN")
    alone = alone and is_concrete(lower)
    dtype = floating_type(lower.dtype, upper.dtype, y.dtype)
    if u is None:
        if m > 0:
            raise ValueError(f"{call}: the system has {m} known inputs; give `u` of shape {lead}{m})")
        u = _nothing((*shape[:-1], 0), dtype, alone)
    else:
        u = read_array(call, "u", u)
        if np.shape(u) != (*shape[:-1], m):
            raise ValueError(
                f"{call}: `u` must have shape {(*shape[:-1], m)}, one row per measurement, got {np.shape(u)}"
            )
        if is_concrete(u) and not np.isfinite(looked_at(u)).all():
            raise ValueError(f"{call}: `u` must be finite in every row; a known input cannot be missing")
    if noise is None:
        noise = _own_noise(observer, dtype, alone)
    check_type(call, "noise", noise, Noise, "gx.Noise(w, v)")
    w, v = noise.w, noise.v
    for name, box, size in (("w", w, n), ("v", v, l)):
        own = box.lower.shape
        if own != (size,) and (not rows or own != (shape[0], size)):
            legal = [(size,), (shape[0], size)] if rows else [(size,)]
            raise ValueError(
                f"{call}: the noise bounds of `{name}` must have shape {' or '.join(map(str, legal))}, got {own}"
            )
    if dtype != np.float64:
        observer = observer.astype(dtype)
    # What has that type already is left alone: every operation outside of a compiled program costs more than a step.
    initial, w, v = (box if _has_type(box, dtype) else box.astype(dtype) for box in (initial, w, v))
    noise = _with_lost(y, Noise.unchecked(w, v), dtype)
    y, u = (value if getattr(value, "dtype", None) == dtype else jnp.asarray(value, dtype) for value in (y, u))
    return initial, y, u, noise, observer


@once_per_observer
def _sizes(observer: AnyObserver) -> tuple[int, int, int]:
    """States, outputs and known inputs. To ask Equinox for an attribute takes a microsecond, and these lie deep."""
    system = observer.system
    return system.n, system.l, system.m


def _own_noise(observer: AnyObserver, dtype: Any, alone: bool) -> Noise:
    """The noise of the design. Of a call with plain numbers it lies on the device, once: handed over at every step its
    four arrays took as long as the step, and `jax.transfer_guard` refused them."""
    if not alone:
        return observer.noise
    key = _own_noise, np.dtype(dtype), default_device()
    known = memory(observer).get(key)
    # A program may return the very array that it is given, and the user donate that one.
    if known is not None and not any(side.is_deleted() for side in known[1]):
        return known[0]
    noise = observer.noise
    w, v = (box if _has_type(box, dtype) else box.astype(dtype) for box in (noise.w, noise.v))
    noise = Noise.unchecked(w, v)
    if all(map(is_concrete, jax.tree.leaves(noise))):
        with jax.ensure_compile_time_eval():  # what is remembered must not belong to a program that is traced
            noise = jax.tree.map(as_array, noise)
        memory(observer)[key] = noise, jax.tree.leaves(noise)
    return noise


def _nothing(shape: tuple[Any, ...], dtype: Any, alone: bool) -> Any:
    """Known inputs where there are none."""
    if not alone:  # the number of rows may be a symbol (`jax.export`)
        return jnp.zeros(shape, dtype) if is_symbolic(shape) else np.zeros(shape)
    found = _empty(shape, np.dtype(dtype), default_device())
    if found.is_deleted():  # see `_own_noise`
        _empty.cache_clear()
        found = _empty(shape, np.dtype(dtype), default_device())
    return found


@lru_cache(64)
def _empty(shape: tuple[int, ...], dtype: Any, device: Any) -> Any:
    with jax.ensure_compile_time_eval():
        return as_array(np.zeros(shape, dtype))


def _hint(shape: tuple[int, ...], outputs: int, rows: bool) -> str:
    """How measurements of that shape can be brought into the right one."""
    if rows and len(shape) == 1 and outputs == 1:
        return "y[:, None] has it"
    if rows and len(shape) == 2 and shape[0] == outputs:
        return "y.T has it"
    return "for many records use jax.vmap" if rows else "give one row; for a record use gx.estimate"


def _has_type(box: Interval, dtype: Any) -> bool:
    return box.lower.dtype == dtype and box.upper.dtype == dtype


def normal(initial: Interval, noise: Noise) -> tuple[Interval, Noise]:
    """In a compiled program: boxes that come from outside, without the subnormal numbers that it takes for zero."""
    return initial.astype(initial.lower.dtype), noise.astype(noise.w.lower.dtype)


def _with_lost(y: Any, noise: Noise, dtype: Any) -> Noise:
    """What a measurement loses when it is rounded to a narrower type belongs to its noise."""
    if not isinstance(y, np.ndarray) or y.dtype == dtype:
        return noise
    narrow = y.astype(dtype)
    with np.errstate(invalid="ignore"):
        lost = np.where(np.isnan(y), 0, np.abs(y - narrow.astype(y.dtype)))
    if not lost.any():
        return noise
    radius = Interval(-lost, lost).astype(dtype)
    return Noise.unchecked(noise.w, add(noise.v, radius))
