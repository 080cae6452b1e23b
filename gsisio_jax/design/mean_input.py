"""Boxes of the mean of the unknown input over several steps (theory 7.6): much smaller than the mean of its boxes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax._calls import named_arguments
from gsisio_jax.design.assemble import Plan
from gsisio_jax.design.feedthrough import factorise
from gsisio_jax.design.gain_selection import profile_of
from gsisio_jax.design.input_rows import rows_of_sums
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, is_concrete
from gsisio_jax.interval.reading import check_type, is_whole
from gsisio_jax.observer.checks import prepare
from gsisio_jax.observer.enclosures import slopes_of
from gsisio_jax.observer.estimation import Estimate
from gsisio_jax.observer.fixed import Fixed
from gsisio_jax.observer.input_memory import InputRows, from_rows
from gsisio_jax.observer.maps import Maps
from gsisio_jax.observer.measurement import typed
from gsisio_jax.observer.past import Past
from gsisio_jax.observer.residuals import nearest_feedthrough
from gsisio_jax.observer.rounding_constants import with_input_residual
from gsisio_jax.observer.status import Status
from gsisio_jax.observer.types import Observer
from gsisio_jax.observer.window import by_state
from gsisio_jax.plant.system import Noise


@named_arguments
def mean_input(
    observer: Observer, estimate: Estimate, y: Any, u: Any = None, noise: Noise | None = None, *, steps: int
) -> Interval:
    """Boxes of the mean of the unknown input over every `steps` steps in a row.

    Of a difference over many steps the noise counts once, so the mean is known about `steps` times as well as d itself.

    Args:
        observer: from `design_observer`, in the current form, without a delay and without periodic outputs.
        estimate: what `gsisio_jax.estimate` returned for this record.
        y: measurements (T, l) that it was called with.
        u: its known inputs (T, m).
        noise: its bounds; None takes those of the design.
        steps: m >= 1, below T.

    Returns:
        Box (T - m, p); row i is of the mean of d[i], ..., d[i+m-1], from y[0..i+m], in units of d. Where a conflict or
        a missing measurement takes a row away it is the mean of the boxes of d, which may be infinite.

    Raises:
        ValueError: shapes do not agree, the system has no unknown input, or the observer is of another kind.

    Rows are chosen once per observer and number of steps, in seconds. Works under `jax.vmap` and `jax.grad` over
    everything but the observer.

    Source: theory 7.6.
    """
    check_type("mean_input", "observer", observer, Observer, "one without a delay, in the current form")
    check_type("mean_input", "estimate", estimate, Estimate, "it is what gx.estimate returns for this record")
    box = Interval.entire(observer.system.n).astype(estimate.state.dtype)
    _, y, u, noise, prepared = prepare("mean_input", observer, box, y, u, noise, True)
    assert isinstance(prepared, Observer)
    observer = prepared
    system, T = observer.system, y.shape[0]
    if system.periodic or not system.p:
        why = "has periodic outputs" if system.p else "has no unknown input"
        raise ValueError(f"mean_input: the system {why}; the boxes of gx.estimate are all there is")
    if not is_whole(steps) or not 1 <= steps < T:
        raise ValueError(f"mean_input: `steps` must be a whole number from 1 to {T - 1} (T - 1), got {steps!r}")
    if estimate.state.shape != (T, system.n) or estimate.input.shape != (T - 1, system.p):
        raise ValueError(
            f"mean_input: `estimate` must be of this record and observer: boxes of shape {(T, system.n)} and "
            f"{(T - 1, system.p)}, got {estimate.state.shape} and {estimate.input.shape}"
        )
    if not all(map(is_concrete, jax.tree.leaves(observer))):
        raise ValueError("mean_input: the observer is traced by JAX, but rows come from its numbers; close over it")
    run = Fixed.of(observer).program((_means, steps), lambda fixed: _program(fixed, steps))
    noise = Noise.unchecked(*(_by_row(part, T) for part in (noise.w, noise.v)))
    return run(estimate.state, estimate.input, estimate.status, y, u, noise)


def _program(observer: Observer, steps: int) -> Any:
    with jax.ensure_compile_time_eval():
        rows = _rows(observer, steps)
    return jax.jit(lambda *record: _means(observer, rows, steps, *record))


def _by_row(box: Interval, T: int) -> Interval:
    return jax.tree.map(lambda side: jnp.broadcast_to(side, (T, side.shape[-1])), box)


def _rows(observer: Observer, steps: int) -> InputRows | None:
    system, certificate = observer.system, observer.certificate
    feedthrough = factorise(np.asarray(system.H))
    slopes = slopes_of(system, feedthrough.T2, observer.u_region)(certificate.region)
    if not slopes.finite:
        return None
    problem = Plan(system, observer.noise, feedthrough, observer.u_region).problem(slopes)
    width = profile_of(problem, np.asarray(certificate.steady_width), certificate.region)
    rows = rows_of_sums(problem, system, steps, width)
    H_slack = nearest_feedthrough(np.asarray(observer.T2, np.float64), np.asarray(system.H))
    dtype = np.asarray(observer.T2).dtype
    return None if rows is None else with_input_residual(rows, system, H_slack, dtype)


@rounding.by_observer
def _means(
    observer: Observer, rows: InputRows | None, steps: int, state: Interval, d: Interval, status: Any, y: Any, u: Any,
    noise: Noise,
) -> Interval:  # fmt: skip
    count = y.shape[0] - steps
    lower = rounding.sum_down(jnp.stack([d.lower[i : i + count] for i in range(steps)], -1)) / steps
    upper = rounding.sum_up(jnp.stack([d.upper[i : i + count] for i in range(steps)], -1)) / steps
    lower, upper = rounding.down(lower), rounding.up(upper)
    if rows is None:
        return Interval.unchecked(lower, upper)
    maps = Maps.of(replace(observer, input_rows=rows), y.dtype)  # it counts the terms of these rows
    h = jax.vmap(lambda box, now: maps.bounds(maps.states(box), box, now))(state, u)
    conflict = (status & int(Status.CONFLICT)) != 0
    # A conflict in between takes away what was known before it; what was measured at one is not believed.
    broken = jnp.stack([conflict[i + 1 : i + 1 + count] for i in range(steps)], -1).any(-1)
    system = observer.system
    moves = typed(Interval.entire(system.p) if system.input_rate is None else system.input_rate, y.dtype)

    def of_window(steps: Any, inputs: Any) -> Interval:
        found = from_rows(maps, rows, steps, inputs, [moves] * (rows.length + 1))
        return by_state(found, rows.targets, system.p)

    def at(tree: Any, lag: int) -> Any:
        first = steps - 1 - lag
        return jax.tree.map(lambda leaf: leaf[first : first + count], tree)

    every = Past(y, u, noise, ~conflict, jnp.ones_like(conflict), state, h)
    now, *pasts = [at(every, lag) for lag in range(-1, rows.length)]
    pasts = [Past(p.y, p.u, p.noise, p.believed, p.trusted & ~broken, p.state, p.h) for p in pasts]
    found = jax.vmap(of_window)([now, *pasts], [at(d, lag) for lag in range(rows.length)])
    # Sides that are NaN (they overflowed) say nothing.
    low = rounding.down(jnp.nan_to_num(found.lower / steps, nan=-jnp.inf, posinf=jnp.inf, neginf=-jnp.inf).max(-2))
    high = rounding.up(jnp.nan_to_num(found.upper / steps, nan=jnp.inf, posinf=jnp.inf, neginf=-jnp.inf).min(-2))
    low, high = jnp.maximum(low, lower), jnp.minimum(high, upper)
    crossed = low > high
    return Interval.unchecked(jnp.where(crossed, lower, low), jnp.where(crossed, upper, high))
