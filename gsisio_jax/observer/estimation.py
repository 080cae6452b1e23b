"""`estimate`: a whole record at once, as one compiled `lax.scan` over the steps of `step`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp

from gsisio_jax._calls import named_arguments
from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.reading import check_type
from gsisio_jax.interval.rounding import Rounding
from gsisio_jax.observer.alarms import Alarm, read_alarms
from gsisio_jax.observer.checks import AnyObserver, check_length, check_on_conflict, normal, prepare
from gsisio_jax.observer.compiled import compiled
from gsisio_jax.observer.delayed import DelayedObserver, to_the_end
from gsisio_jax.observer.fixed import Fixed, chosen, fixed
from gsisio_jax.observer.scan import advance, as_program, begin, blank, cut, scan
from gsisio_jax.observer.summary import summary
from gsisio_jax.observer.types import Carry, StepOutput, cast
from gsisio_jax.plant.system import Noise

OnConflict = Literal["restart", "hold"]


class Estimate(eqx.Module):
    """Boxes of a record; a pytree. Under `jax.vmap` every array gains the batch axes in front.

    Attributes:
        state: box of x[k] from y[0..k], (T, n); from y[0..k-1] in the prediction form. Of a periodic state up to a
            multiple of its period (`gsisio_jax.wrapped`, `gsisio_jax.nearest`).
        input: box of d[k] from y[0..k+1], (T-1, p).
        current_input: box of V1' d[k] from y[0..k], (T, p_H).
        status: `Status` bit mask, (T,).
        margin: (T,) signed slack of the tightest intersection of the step; negative is the size of a contradiction, in
            the unit of the component that `alarms` names.
        source: (T,) code of that intersection (`gsisio_jax.observer.status.Source`).
        guaranteed: the boxes hold on the machine, rounding included; False for ``rounding="nearest"`` and for the
            prediction form, whose boxes hold up to rounding errors (where they are framers at all).
        delay: L of an observer with a delay: the box of x[k] is from y[0..k+L], that of d[k] from y[0..k+1+L]. The
            last L rows lack measurements, so they have the status MISSING and may be infinite.
        kept: (T, l) of an observer that tolerates wrong outputs: those that are in every largest set of outputs that
            agree with each other and with the past; False also for missing ones. Else None.

    Source: theory 8 and 11.
    """

    state: Interval
    input: Interval
    current_input: Interval
    status: Any
    margin: Any
    source: Any
    output_rows: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    guaranteed: bool = eqx.field(static=True, default=True)
    delay: int = eqx.field(static=True, default=0)
    kept: Any = None

    def alarms(self) -> list[Alarm]:
        """Every step whose data contradict the stated bounds, in order, with what emptied and by how much.

        Raises:
            ValueError: the estimate is batched; take one record first.
        """
        return read_alarms(self.status, self.margin, self.source, self.output_rows)

    def summary(self, observer: AnyObserver | None = None, u: Any = None) -> str:
        """A few lines: steps, conflicts, missing and unbounded ones, and those for which no width is promised, because
        a box (or u) was outside of the region; of a batch, over all of it.

        Args:
            observer: that of the run; then what its certificate is worth here is said, too.
            u: known inputs (T, m) of the run; then those outside of `u_region` are counted.
        """
        if observer is not None:
            check_type("Estimate.summary", "observer", observer, get_args(AnyObserver), "that of the run")
        return summary(self, observer, u)

    def to_xarray(self, **labels: Any) -> Any:
        """The boxes as an ``xarray.Dataset`` over time, with names and units: `gsisio_jax.dataset.to_dataset`.

        Args:
            labels: of `to_dataset`: ``time`` ([s], or dates) or ``dt`` [s], ``state_names``, ``input_names``,
                ``output_names``, units likewise, the measurements ``y``, ``title``, ``certificate``.
        """
        from gsisio_jax.dataset import to_dataset

        return to_dataset(self, **labels)

    def to_pandas(self, **labels: Any) -> Any:
        """The boxes as a ``pandas.DataFrame``, one row a step: the variables of `to_xarray` as columns.

        Args:
            labels: as in `to_xarray`; the index is the time in seconds, the dates with their zone, or the number of the
                step.

        Returns:
            Columns ``<signal>_lower``, ``<signal>_upper`` of every state and input, ``measured_<output>`` where ``y``
            is given, ``status`` and ``margin``.
        """
        from gsisio_jax.dataset import zone_of_dates

        frame = self.to_xarray(**labels).to_dataframe()
        zone = zone_of_dates(labels.get("time"))
        return frame if zone is None else frame.tz_localize("UTC").tz_convert(zone)


@named_arguments
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
    `jax.vmap` over any of `initial`, `y`, `u`, `noise`, `length`, and `jax.grad`. Under `jax.jit` close over the
    observer: as an argument all its numbers are traced, and the program for any numbers compiles up to five times as
    long.

    Args:
        observer: from `design_observer`.
        initial: box of x[0] before y[0], (n,); infinite sides allowed.
        y: measurements (T, l), units of the outputs; NaN marks a missing entry, as do masked entries of NumPy, NA of
            pandas and None.
        u: known inputs (T, m), finite; needed where m > 0.
        noise: bounds at run time; None takes those of the design. Bounds of shape (T, .) change with time.
        on_conflict: where the data contradict the bounds: "restart" believes that the past was wrong and goes on from
            y[k] and the state bounds alone (from nothing, where these give no whole box); "hold" believes the past, and
            takes those outputs as missing that contradict it. Nothing after a conflict is certain unless that is right.
        length: number of rows of `y` that count (ragged batches); rows behind are taken as missing.
        rounding: "outward": boxes hold on the machine. "nearest": they hold up to rounding errors, and the result says
            so; for comparisons of speed. None takes that of the observer, which is "outward" by default.

    Returns:
        `Estimate`.

    Raises:
        ValueError: shapes do not agree, `u` is missing or not finite, `y` is infinite, or `on_conflict` is unknown.

    Source: theory 5 and 11.
    """
    initial, y, u, noise, observer = prepare("estimate", observer, initial, y, u, noise, True, rounding)
    if length is not None:
        check_length(length, y.shape[0])
        y = cut(y, length)
    return _estimate(*fixed(observer), initial, y, u, noise, check_on_conflict("estimate", on_conflict))


@named_arguments
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
        The carry for `step` (a pytree that can be saved), and a `StepOutput`; with a delay its status is PENDING.

    Source: theory 11.
    """
    initial, y0, u0, noise, observer = prepare("start", observer, initial, y0, u0, noise, False, rounding)
    return _start(*fixed(observer), initial, y0, u0, noise, check_on_conflict("start", on_conflict))


@named_arguments
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
        The next carry, and a `StepOutput`; its `input` is the box of d[k-1]. With a delay of L these are boxes of
        x[k-L] and d[k-1-L], or nothing (status PENDING) where k < L; L missing rows at the end finish the last ones.

    Source: theory 11.
    """
    check_type("step", "carry", carry, Carry, "it comes from gx.start, and then from every gx.step")
    box, y_k, u_k, noise, observer = prepare("step", observer, carry.state, y_k, u_k, noise, False, rounding)
    return _step(*fixed(observer), _as(carry, box.lower.dtype), y_k, u_k, noise, check_on_conflict("step", on_conflict))


@named_arguments
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
    check_type("resume", "carry", carry, Carry, "it comes from gx.start, and then from every gx.step")
    box, y, u, noise, observer = prepare("resume", observer, carry.state, y, u, noise, True, rounding)
    return _resume(*fixed(observer), _as(carry, box.lower.dtype), y, u, noise, check_on_conflict("resume", on_conflict))


def _as(carry: Carry, dtype: Any) -> Carry:
    """A carry of lower precision, widened to that of the data; nothing is lost."""
    return carry if carry.state.lower.dtype == dtype else cast(carry, dtype)


@named_arguments
def collect(observer: AnyObserver, outputs: Sequence[StepOutput]) -> Estimate:
    """Join the outputs of `start`, `step` and `resume`, in order, into the `Estimate` of the whole record.

    Raises:
        ValueError: there are none, or something else is among them.
    """
    if not isinstance(outputs, Sequence) or not outputs:
        got = "none" if isinstance(outputs, Sequence) else type(outputs).__name__
        raise ValueError(f"collect: `outputs` must be a list of what gx.start, gx.step and resume return, got {got}")
    for out in outputs:
        check_type("collect", "outputs", out, StepOutput, "the second of what gx.start, gx.step and resume return")
    rows = [jax.tree.map(lambda x: jnp.expand_dims(x, 0), out) if jnp.ndim(out.status) == 0 else out for out in outputs]
    return _as_estimate(observer, jax.tree.map(lambda *x: jnp.concatenate(x), *rows))


@compiled
def _estimate(
    static: Fixed | None, traced: Any, initial: Interval, y: Any, u: Any, noise: Noise, hold: bool
) -> Estimate:
    observer = chosen(static, traced)
    initial, noise = normal(initial, noise)
    if isinstance(observer, DelayedObserver):
        y, u, noise = to_the_end(observer, y, u, noise)
    _, out = scan(observer, blank(observer, initial), y, u, noise, hold)
    return _as_estimate(observer, out)


@compiled
def _start(static: Fixed | None, traced: Any, initial: Interval, y: Any, u: Any, noise: Noise, hold: bool) -> Any:
    initial, noise = normal(initial, noise)
    return begin(chosen(static, traced), initial, y, u, noise, hold)


@compiled
def _step(static: Fixed | None, traced: Any, carry: Carry, y: Any, u: Any, noise: Noise, hold: bool) -> Any:
    observer = chosen(static, traced)
    _, noise = normal(carry.state, noise)
    return as_program(observer, lambda c, y, u, noise: advance(observer, c, y, u, noise, hold), carry, y, u, noise)


@compiled
def _resume(static: Fixed | None, traced: Any, carry: Carry, y: Any, u: Any, noise: Noise, hold: bool) -> Any:
    _, noise = normal(carry.state, noise)
    return scan(chosen(static, traced), carry, y, u, noise, hold)


def _as_estimate(observer: AnyObserver, out: StepOutput) -> Estimate:
    delay = observer.delay if isinstance(observer, DelayedObserver) else 0
    out = jax.tree.map(lambda rows: _from(rows, delay), out) if delay else out  # the first rows finish no step
    inputs = jax.tree.map(lambda rows: _from(rows, 1), out.input)
    return Estimate(
        out.state, inputs, out.current_input, out.status, out.margin, out.source, observer.output_rows,
        observer.guaranteed, delay, out.kept,
    )  # fmt: skip


def _from(rows: Any, first: int) -> Any:
    """``rows[first:]``; written so, JAX would copy the index to the device where nothing is traced."""
    return jax.lax.slice_in_dim(rows, first, None)
