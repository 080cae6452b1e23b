"""`estimate`: a whole record at once, as one compiled `lax.scan` over the steps of `step`."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.interval.box import Interval, add, is_concrete
from gsisio_jax.interval.rounding import Rounding, check_rounding
from gsisio_jax.observer import prediction_step
from gsisio_jax.observer import step as current_step
from gsisio_jax.observer.alarms import Alarm, read_alarms
from gsisio_jax.observer.prediction_step import PredictionObserver
from gsisio_jax.observer.types import Carry, Observer, StepOutput, cast
from gsisio_jax.plant.system import Noise

OnConflict = Literal["restart", "hold"]
AnyObserver = Observer | PredictionObserver


class Estimate(eqx.Module):
    """Boxes of a record; a pytree. Under `jax.vmap` every array gains the batch axes in front.

    Attributes:
        state: box of x[k] from y[0..k], (T, n); from y[0..k-1] in the prediction form.
        input: box of d[k] from y[0..k+1], (T-1, p).
        current_input: box of V1' d[k] from y[0..k], (T, p_H).
        status: `Status` bit mask, (T,).
        margin: (T,) signed slack of the tightest intersection of the step; negative is the size of a contradiction, in
            the unit of the component that `alarms` names.
        source: (T,) code of that intersection (`gsisio_jax.observer.status.Source`).
        guaranteed: the boxes hold on the machine, rounding included; False for ``rounding="nearest"`` and for the
            prediction form, whose boxes hold up to rounding errors (where they are framers at all).

    Source: design 7 and 4.6.
    """

    state: Interval
    input: Interval
    current_input: Interval
    status: Any
    margin: Any
    source: Any
    output_rows: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    guaranteed: bool = eqx.field(static=True, default=True)

    def alarms(self) -> list[Alarm]:
        """Every step whose data contradict the stated bounds, in order, with what emptied and by how much.

        Raises:
            ValueError: the estimate is batched; take one record first.
        """
        return read_alarms(self.status, self.margin, self.source, self.output_rows)


def estimate(
    observer: AnyObserver,
    initial: Interval,
    y: Any,
    u: Any = None,
    noise: Noise | None = None,
    on_conflict: OnConflict = "restart",
    length: Any = None,
    rounding: Rounding | None = None,
) -> Estimate:
    """Boxes that are certain to contain the states and the unknown inputs of a record.

    Compiled once per shape; new numbers, another noise or another initial box compile nothing. Works under `jax.jit`,
    `jax.vmap` over any of `initial`, `y`, `u`, `noise`, `length`, and `jax.grad`.

    Args:
        observer: from `design_observer`.
        initial: box of x[0] before y[0], (n,); infinite sides allowed.
        y: measurements (T, l), units of the outputs; NaN marks a missing entry.
        u: known inputs (T, m), finite; needed where m > 0.
        noise: bounds at run time; None takes those of the design. Bounds of shape (T, .) change with time.
        on_conflict: where the data contradict the bounds, go on from y[k] and the state bounds alone ("restart"), or
            from the past alone with y[k] taken as missing ("hold"). Nothing after a conflict is certain unless the data
            that follow are right.
        length: number of rows of `y` that count (ragged batches); rows behind are taken as missing.
        rounding: "outward": boxes hold on the machine. "nearest": they hold up to rounding errors, and the result says
            so; for comparisons of speed. None takes that of the observer, which is "outward" by default.

    Returns:
        `Estimate`.

    Raises:
        ValueError: shapes do not agree, `u` is missing or not finite, `y` is infinite, or `on_conflict` is unknown.

    Source: design 4.3 and 7.
    """
    initial, y, u, noise, observer = _prepare("estimate", observer, initial, y, u, noise, True, rounding)
    if length is not None:
        _check_length(length, y.shape[0])
        y = cut(y, length)
    return _estimate(observer, initial, y, u, noise, check_on_conflict("estimate", on_conflict))


def start(
    observer: AnyObserver,
    initial: Interval,
    y0: Any,
    u0: Any = None,
    noise: Noise | None = None,
    on_conflict: OnConflict = "restart",
    rounding: Rounding | None = None,
) -> tuple[Carry, StepOutput]:
    """First step of an online run (k = 0): the initial box met with the first measurement.

    Args:
        observer: from `design_observer`.
        initial: box of x[0], (n,).
        y0: first measurement (l,), NaN where missing.
        u0: first known input (m,).
        noise: bounds of w[0] and v[0]; None takes those of the design.
        on_conflict: as in `estimate`.
        rounding: as in `estimate`.

    Returns:
        The carry for `step` (a pytree that can be saved), and a `StepOutput`.

    Source: design 7.
    """
    initial, y0, u0, noise, observer = _prepare("start", observer, initial, y0, u0, noise, False, rounding)
    return _start(observer, initial, y0, u0, noise, check_on_conflict("start", on_conflict))


def step(
    observer: AnyObserver,
    carry: Carry,
    y_k: Any,
    u_k: Any = None,
    noise: Noise | None = None,
    on_conflict: OnConflict = "restart",
    rounding: Rounding | None = None,
) -> tuple[Carry, StepOutput]:
    """One step of an online run: the same numbers as `estimate`.

    Args:
        observer: from `design_observer`.
        carry: from `start` or `step`.
        y_k: measurement (l,), NaN where missing.
        u_k: known input (m,).
        noise: bounds of w[k] and v[k]; None takes those of the design.
        on_conflict: as in `estimate`.
        rounding: as in `estimate`.

    Returns:
        The next carry, and a `StepOutput`; its `input` is the box of d[k-1].

    Source: design 7.
    """
    box, y_k, u_k, noise, observer = _prepare("step", observer, carry.state, y_k, u_k, noise, False, rounding)
    # A carry of lower precision is widened to that of the data; nothing is lost.
    return _step(observer, cast(carry, box.dtype), y_k, u_k, noise, check_on_conflict("step", on_conflict))


def resume(
    observer: AnyObserver,
    carry: Carry,
    y: Any,
    u: Any = None,
    noise: Noise | None = None,
    on_conflict: OnConflict = "restart",
    rounding: Rounding | None = None,
) -> tuple[Carry, StepOutput]:
    """Many steps of an online run in one compiled scan: `y` (rows, l) follows the measurement that `carry` has seen.

    Returns:
        The carry after the last row, and a `StepOutput` whose arrays have one row per row of `y`.
    """
    box, y, u, noise, observer = _prepare("resume", observer, carry.state, y, u, noise, True, rounding)
    return _resume(observer, cast(carry, box.dtype), y, u, noise, check_on_conflict("resume", on_conflict))


def collect(observer: AnyObserver, outputs: Sequence[StepOutput]) -> Estimate:
    """Join the outputs of `start`, `step` and `resume`, in order, into the `Estimate` of the whole record."""
    rows = [jax.tree.map(lambda x: x[None], out) if jnp.ndim(out.status) == 0 else out for out in outputs]
    return _as_estimate(observer, jax.tree.map(lambda *x: jnp.concatenate(x), *rows))


@partial(jax.jit, static_argnames="hold")
def _estimate(observer: AnyObserver, initial: Interval, y: Any, u: Any, noise: Noise, hold: bool) -> Estimate:
    carry, first = begin(observer, initial, y[0], u[0], noise_at(noise, 0), hold)
    _, rest = _scan(observer, carry, y[1:], u[1:], _rows_from(noise, 1), hold)
    return _as_estimate(observer, jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, rest))


@partial(jax.jit, static_argnames="hold")
def _start(observer: AnyObserver, initial: Interval, y: Any, u: Any, noise: Noise, hold: bool) -> Any:
    return begin(observer, initial, y, u, noise, hold)


@partial(jax.jit, static_argnames="hold")
def _step(observer: AnyObserver, carry: Carry, y: Any, u: Any, noise: Noise, hold: bool) -> Any:
    return advance(observer, carry, y, u, noise, hold)


@partial(jax.jit, static_argnames="hold")
def _resume(observer: AnyObserver, carry: Carry, y: Any, u: Any, noise: Noise, hold: bool) -> Any:
    return _scan(observer, carry, y, u, noise, hold)


def _scan(observer: AnyObserver, carry: Carry, y: Any, u: Any, noise: Noise, hold: bool) -> tuple[Carry, StepOutput]:
    def body(carry: Carry, row: Any) -> tuple[Carry, StepOutput]:
        y_k, u_k, now = row
        return advance(observer, carry, y_k, u_k, noise_of_row(noise, now), hold)

    return jax.lax.scan(body, carry, (y, u, noise_rows(noise)))


# Inlined, so programs are as if these were plain functions; but what JAX traced of a step once serves every batch, scan
# and study of that observer, and tracing takes seconds.
@partial(jax.jit, static_argnames="hold", inline=True)
def begin(observer: AnyObserver, initial: Interval, y: Any, u: Any, noise: Noise, hold: bool) -> Any:
    """Step 0 of the recursion that belongs to this kind of observer."""
    return recursion_of(observer).begin(observer, initial, y, u, noise, hold)


@partial(jax.jit, static_argnames="hold", inline=True)
def advance(observer: AnyObserver, carry: Carry, y: Any, u: Any, noise: Noise, hold: bool) -> Any:
    """One step of it."""
    return recursion_of(observer).advance(observer, carry, y, u, noise, hold)


def recursion_of(observer: AnyObserver) -> Any:
    """The module of this kind of observer."""
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
    return jnp.where((jnp.arange(y.shape[0]) < length)[:, None], y, jnp.nan)


def _rows_from(noise: Noise, k: int) -> Noise:
    return Noise.unchecked(*(box[k:] if len(box.shape) == 2 else box for box in (noise.w, noise.v)))


def _as_estimate(observer: AnyObserver, out: StepOutput) -> Estimate:
    return Estimate(
        out.state, out.input[1:], out.current_input, out.status, out.margin, out.source, observer.output_rows,
        observer.guaranteed,
    )  # fmt: skip


def check_on_conflict(call: str, on_conflict: str) -> bool:
    """True for "hold"; refuses anything but "restart" and "hold"."""
    if on_conflict not in ("restart", "hold"):
        raise ValueError(f'{call}: `on_conflict` must be "restart" or "hold", got {on_conflict!r}')
    return on_conflict == "hold"


def rounded(call: str, observer: AnyObserver, rounding: Rounding | None) -> AnyObserver:
    """The observer with the rounding that a call asks for."""
    if rounding is None:
        return observer
    check_rounding(call, rounding)
    return observer if observer.rounding == rounding else observer.with_rounding(rounding)


def _check_length(length: Any, rows: int) -> None:
    if np.ndim(length) or not jnp.issubdtype(jnp.result_type(length), jnp.integer):
        raise ValueError(f"estimate: `length` must be one integer per record, got {length!r}; for many use jax.vmap")
    if is_concrete(length) and not 0 <= int(length) <= rows:
        raise ValueError(f"estimate: `length` must be between 0 and the {rows} rows of `y`, got {int(length)}")


def _prepare(
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
    system = observer.system
    lead = "(T, " if rows else "("
    if not (isinstance(y, jax.Array | np.ndarray) and jnp.issubdtype(y.dtype, jnp.floating)):
        y = np.asarray(y, dtype=np.float64) if not isinstance(y, jax.Array) else y.astype(float)
    if not isinstance(initial, Interval) or initial.shape != (system.n,):
        raise ValueError(
            f"{call}: `initial` must be an Interval of shape ({system.n},), got {getattr(initial, 'shape', initial)}; "
            "for many boxes use jax.vmap"
        )
    if y.ndim != 1 + rows or y.shape[-1] != system.l or (rows and y.shape[0] == 0 and call == "estimate"):
        raise ValueError(
            f"{call}: measurements must have shape {lead}{system.l}) with T >= 1, got {y.shape}; for many records use "
            "jax.vmap"
        )
    if is_concrete(y) and np.isinf(np.asarray(y)).any():
        raise ValueError(f"{call}: a measurement is infinite; mark missing entries with NaN")
    # Arrays of 64 bits may come where JAX has 32 by now: each type first by itself, which is silent.
    dtype = jnp.result_type(*map(jax.dtypes.canonicalize_dtype, (initial.dtype, y.dtype)))
    if not jnp.issubdtype(dtype, jnp.floating):
        dtype = jnp.result_type(float)
    dtype = jax.dtypes.canonicalize_dtype(dtype)
    if u is None:
        if system.m > 0:
            raise ValueError(f"{call}: the system has {system.m} known inputs; give `u` of shape {lead}{system.m})")
        u = np.zeros((*y.shape[:-1], 0))
    if np.shape(u) != (*y.shape[:-1], system.m):
        raise ValueError(
            f"{call}: `u` must have shape {(*y.shape[:-1], system.m)}, one row per measurement, got {np.shape(u)}"
        )
    if is_concrete(u) and not np.isfinite(np.asarray(u)).all():
        raise ValueError(f"{call}: `u` must be finite in every row; a known input cannot be missing")
    noise = observer.noise if noise is None else noise
    for name, box, size in (("w", noise.w, system.n), ("v", noise.v, system.l)):
        legal = [(size,), (y.shape[0], size)] if rows else [(size,)]
        if box.shape not in legal:
            raise ValueError(
                f"{call}: the noise bounds of `{name}` must have shape {' or '.join(map(str, legal))}, got {box.shape}"
            )
    if dtype != np.float64:
        observer = observer.astype(dtype)
    initial, noise = initial.astype(dtype), noise.astype(dtype)
    return initial, jnp.asarray(y, dtype), jnp.asarray(u, dtype), _with_lost(y, noise, dtype), observer


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
