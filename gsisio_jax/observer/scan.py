"""The recursion over the rows of a record: one compiled scan over `advance`, of either form."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax import scalar
from gsisio_jax._memo import once
from gsisio_jax.interval import devices
from gsisio_jax.interval.box import Interval, is_concrete
from gsisio_jax.interval.cast import as_array
from gsisio_jax.observer import delayed, prediction_step, tolerant
from gsisio_jax.observer import step as current_step
from gsisio_jax.observer.checks import AnyObserver
from gsisio_jax.observer.delayed import DelayedObserver
from gsisio_jax.observer.fixed import Fixed, chosen, fixed, jitted
from gsisio_jax.observer.prediction_step import PredictionObserver
from gsisio_jax.observer.tolerant import TolerantObserver
from gsisio_jax.observer.types import Carry, StepOutput
from gsisio_jax.plant.system import Noise


def scan(observer: AnyObserver, carry: Carry, y: Any, u: Any, noise: Noise, hold: bool) -> tuple[Carry, StepOutput]:
    """All rows of a record from a carry: the last carry, and what every step returned."""

    def body(carry: Carry, row: Any) -> tuple[Carry, StepOutput]:
        y_k, u_k, now = row
        return advance(observer, carry, y_k, u_k, noise_of_row(noise, now), hold)

    return turns(observer, body, carry, (y, u, noise_rows(noise)), y.shape[0])


def turns(
    observer: AnyObserver,
    body: Callable[..., Any],
    carry: Any,
    rows: Any,
    length: int | None = None,
    most: int | None = None,
) -> Any:
    """``jax.lax.scan`` of a body with one step of the observer in it, computed as suits that step; `most` as in
    `scalar.scan`."""
    if isinstance(observer, TolerantObserver):  # many copies of one step: over arrays
        return devices.scan(scalar.in_tasks(body), jax.tree.map(jnp.asarray, carry), rows, length=length)
    return scalar.scan(body, carry, rows, length=length, most=most)


def blank(observer: AnyObserver, initial: Interval) -> Carry:
    """What comes before the first step: the initial box of x[0] and no measurement."""
    return _module(observer).blank(observer, initial)


def advance(observer: AnyObserver, carry: Carry, y: Any, u: Any, noise: Noise, hold: bool) -> tuple[Carry, StepOutput]:
    """One step of the recursion that belongs to this kind of observer."""
    # What JAX traced of a step once serves the design, every batch, scan and study of that observer. A program over
    # numbers takes a call of it apart; inlined, its thousands of equations would be copied first. A program over arrays
    # is a tenth faster where it is inlined.
    inline = isinstance(observer, TolerantObserver)
    return jitted(_advance, *fixed(as_it_steps(observer)), ("hold",), inline=inline)(carry, y, u, noise, hold)


def _advance(static: Fixed | None, traced: Any, carry: Carry, y: Any, u: Any, noise: Noise, hold: bool) -> Any:
    observer = chosen(static, traced)
    return _module(observer).advance(observer, carry, y, u, noise, hold)


_UNREAD: dict[str, Any] = {
    "notes": (), "recoverable": None, "recovery_steps": (), "recovery_width": None, "lost_row_steps": (),
    "lost_row_width": None,
}  # fmt: skip


def as_it_steps(observer: AnyObserver) -> AnyObserver:
    """The observer without what its certificates say of lost rows, which no step reads: a design finds that out by
    trying steps, and the first call need not trace them again."""
    return once(observer, as_it_steps, lambda: _stripped(observer))


def _stripped(observer: AnyObserver) -> AnyObserver:
    changed: dict[str, Any] = {}
    if not isinstance(observer, TolerantObserver):
        changed["certificate"] = replace(observer.certificate, **_UNREAD)
    if isinstance(observer, DelayedObserver | TolerantObserver):
        changed["inner"] = as_it_steps(observer.inner)
    return replace(observer, **changed)


def begin(observer: AnyObserver, initial: Interval, y: Any, u: Any, noise: Noise, hold: bool) -> Any:
    """The first step, as a program of its own: smaller, as its past is known to say nothing."""

    def step(initial: Interval, y: Any, u: Any, noise: Noise) -> Any:
        return advance(observer, blank(observer, initial), y, u, noise, hold)

    return as_program(observer, step, initial, y, u, noise)


def as_program(observer: AnyObserver, step: Callable[..., Any], *args: Any) -> Any:
    """One step as a program."""
    return step(*args) if isinstance(observer, TolerantObserver) else scalar.call(step, *args)


def _module(observer: AnyObserver) -> Any:
    if isinstance(observer, DelayedObserver):
        return delayed
    if isinstance(observer, TolerantObserver):
        return tolerant
    return prediction_step if isinstance(observer, PredictionObserver) else current_step


def noise_at(noise: Noise, k: int) -> Noise:
    """Bounds of step k, where they change with time."""
    return Noise.unchecked(*(box[k] if len(box.shape) == 2 else box for box in (noise.w, noise.v)))


def noise_rows(noise: Noise) -> Noise:
    """Bounds that change with time travel with the rows of a scan; constant ones (None here) stay outside the loop."""
    return Noise.unchecked(*(box if len(box.shape) == 2 else None for box in (noise.w, noise.v)))


def noise_of_row(noise: Noise, row: Noise) -> Noise:
    """Bounds of one step from a row of `noise_rows` and the constant ones."""
    return Noise.unchecked(noise.w if row.w is None else row.w, noise.v if row.v is None else row.v)


def cut(y: Any, length: Any) -> Any:
    """A ragged record: rows behind `length` are missing."""
    if isinstance(y, np.ndarray) and is_concrete(length):
        return np.where((np.arange(len(y)) < np.asarray(length))[:, None], y, np.asarray(np.nan, y.dtype))
    return _cut(y, length if isinstance(length, jax.Array) else as_array(length))


@partial(jax.jit, inline=True)
def _cut(y: Any, length: Any) -> Any:
    return jnp.where((jnp.arange(y.shape[0]) < length)[:, None], y, jnp.nan)
