"""Angles: outputs that are logged modulo a period, and states that are the same after a period (theory 8.4)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax._calls import named_arguments
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.reading import check_type, is_whole, read_array
from gsisio_jax.scalar.numpy_program import numpy_function

Periods = tuple[tuple[int, float], ...]
"""Pairs (index, period), by index."""
_POINTS = 8
_TOLERANCE = 1e-6


def read_periods(name: str, given: Mapping[int, float] | None, size: int, what: str) -> Periods:
    """Check the argument `name` of a System, ``{index: period}`` for some of `size` outputs or states.

    Raises:
        ValueError: an index or a period cannot be.
    """
    if given is None:
        return ()
    if not isinstance(given, Mapping):
        raise ValueError(
            f"System: `{name}` must be a mapping {{index of the {what}: period}}, such as {{2: 2 * math.pi}}, got "
            f"{given!r}"
        )
    found = []
    for index, period in given.items():
        if not is_whole(index) or not 0 <= index < size:
            raise ValueError(
                f"System: `{name}` has the index {index!r}; it must be that of one of the {size} {what}s, 0 to "
                f"{size - 1}"
            )
        try:
            number = float(period)
        except (TypeError, ValueError):
            number = math.nan
        if not 1e-30 < number < 1e30:
            raise ValueError(
                f"System: `{name}`[{index}] must be a positive, finite period in the unit of the {what} (2 * math.pi, "
                f"or 360 for degrees), got {period!r}"
            )
        found.append((int(index), number))
    return tuple(sorted(found))


def check_feedthrough(periodic: Periods, H: np.ndarray, input_bounds: Interval) -> None:
    """Refuse periodic outputs that an unbounded input reaches at once: it may turn them by any number of periods.

    Raises:
        ValueError: there is one.
    """
    bounded = np.isfinite(np.asarray(input_bounds.lower)) & np.isfinite(np.asarray(input_bounds.upper))
    for j, period in periodic:
        free = np.flatnonzero((H[j] != 0) & ~bounded)
        if free.size:
            raise ValueError(
                f"System: output {j} is periodic, and the unknown input {free[0]} enters it at once (H[{j}, {free[0]}] "
                f"= {H[j, free[0]]:g}) without any bound, so no measurement can tell one multiple of {period:g} from "
                "another. Give finite `input_bounds` for that input, or leave that output out of `periodic`"
            )


def check_states(periodic_states: Periods, state_bounds: Interval) -> None:
    """Refuse bounds of a state whose multiple of the period is free.

    Raises:
        ValueError: there is one.
    """
    for i, period in periodic_states:
        low, high = float(np.asarray(state_bounds.lower)[i]), float(np.asarray(state_bounds.upper)[i])
        if math.isfinite(low) or math.isfinite(high):
            raise ValueError(
                f"System: state {i} is periodic ({period:g}) and has the state bounds [{low:g}, {high:g}]; a bound of "
                "the state on the real line means nothing where any multiple of the period stands for it. Leave "
                "it without bounds (-inf, inf), or out of `periodic_states`"
            )


def turns(
    maps: Callable[..., Any], n: int, m: int, periodic: Periods, periodic_states: Periods, state_bounds: Interval
) -> tuple[tuple[int, ...], ...]:
    """By how many of its periods every periodic output moves when a periodic state moves by one; tried at some points.

    Returns:
        A row for every periodic output, a column for every periodic state.

    Raises:
        ValueError: f or g change otherwise, so the state is not periodic.
    """
    if not periodic_states:
        return tuple(() for _ in periodic)
    sides = (np.asarray(side, float) for side in (state_bounds.lower, state_bounds.upper))
    low, high = (np.nan_to_num(side, posinf=4, neginf=-4) for side in sides)
    low, high = np.minimum(low, high - 1), np.maximum(high, low + 1)
    period = dict(periodic_states) | {n + j: p for j, p in periodic}  # of what may move, f above g
    found: dict[tuple[int, int], int] = {}
    rng = np.random.default_rng(0)
    try:
        with jax.enable_x64(True):
            program = numpy_function(maps, np.zeros(n), np.zeros(m))
            for _ in range(_POINTS):
                x, u = rng.uniform(low, high), rng.uniform(0, 1, m)
                before = np.asarray(program(x, u))
                for i, step in periodic_states:
                    after = np.asarray(program(x + step * (np.arange(n) == i), u))
                    _count(found, i, step, before, after, n, period)
    except jax.errors.TracerArrayConversionError:
        pass  # f and g hold traced numbers: taken on trust
    return tuple(tuple(found.get((n + j, i), 0) for i, _ in periodic_states) for j, _ in periodic)


def _count(
    found: dict[tuple[int, int], int],
    i: int,
    step: float,
    before: np.ndarray,
    after: np.ndarray,
    n: int,
    period: dict[int, float],
) -> None:
    """By how many periods every entry has moved; the same everywhere, and 0 for one that has no period."""
    for row in map(int, np.flatnonzero(np.isfinite(before) & np.isfinite(after))):
        unit, moved = period.get(row), float(after[row] - before[row])
        whole = 0 if unit is None else round(moved / unit)
        slack = _TOLERANCE * (1 + abs(before[row]) + abs(after[row]) + step)
        if abs(moved - whole * (unit or 0.0)) > slack or found.setdefault((row, i), whole) != whole:
            _refuse(i, step, row, n, moved, unit)


def _refuse(i: int, step: float, row: int, n: int, moved: float, unit: float | None) -> None:
    where, index = ("f", row) if row < n else ("g", row - n)
    allowed = "it must not change" if unit is None else f"it may change by the same multiple of {unit:g} everywhere"
    remedy = "periodic_states" if where == "f" else "periodic"
    raise ValueError(
        f"System: state {i} is not periodic: moved by {step:g}, it changes entry {index} of {where} by {moved:g}, "
        f"where {allowed}. If that entry is itself an angle, name it in `{remedy}`; otherwise leave the state out of "
        "`periodic_states`"
    )


def columns(periods: Periods, size: int) -> np.ndarray:
    """The period of every entry, inf where it has none."""
    period = np.full(size, np.inf)
    for i, value in periods:
        period[i] = value
    return period


@named_arguments
def wrapped(system: Any, boxes: Any) -> Interval:
    """State boxes for display: those of periodic states moved by multiples of the period, so that their centers lie
    between minus and plus half a period. Boxes are not cut: one that holds pi reaches beyond it.

    Args:
        system: the plant (or an observer), with its `periodic_states`.
        boxes: state boxes (..., n), or an `Estimate`.

    Returns:
        Boxes (..., n), moved outward by the rounding of the period; infinite ones as they are.

    >>> from gsisio_jax import System
    >>> none = np.zeros((1, 0))
    >>> course = System(lambda x: x + 1, lambda x: x, none, none, periodic={0: 360}, periodic_states={0: 360})
    >>> wrapped(course, Interval([[355.0]], [[375.0]])).center.round(3).tolist()
    [[5.0]]
    """
    system, boxes = _plant_and_boxes("wrapped", system, boxes)
    if not system.periodic_states:
        return boxes
    period = columns(system.periodic_states, system.n)
    return moved_by(boxes, -jnp.round(boxes.center / period), period)


def _plant_and_boxes(call: str, system: Any, boxes: Any) -> tuple[Any, Interval]:
    """The plant of an observer, the boxes of an estimate."""
    system, boxes = getattr(system, "system", system), getattr(boxes, "state", boxes)
    if not hasattr(system, "periodic_states"):
        raise ValueError(f"{call}: `system` must be a System or an observer, got {type(system).__name__}")
    check_type(call, "boxes", boxes, Interval, "or an Estimate")
    if boxes.shape[-1:] != (system.n,):
        raise ValueError(f"{call}: `boxes` must have shape (..., {system.n}), got {boxes.shape}")
    return system, boxes


def moved_by(boxes: Interval, count: Any, period: np.ndarray) -> Interval:
    """Boxes moved by so many periods (a constant for gradients), rounded outward; `period` is inf where there is none.

    The period counts as known to an ulp, and both operations round: less than four ulps of what enters.
    """
    dtype = boxes.lower.dtype
    period = np.where(np.isfinite(period), period, 0).astype(dtype)
    shift = jax.lax.stop_gradient(count) * period
    lower = rounding.lowered(boxes.lower + shift, abs(boxes.lower) + abs(shift), 4)
    upper = rounding.raised(boxes.upper + shift, abs(boxes.upper) + abs(shift), 4)
    still = shift == 0
    return Interval.unchecked(
        jnp.where(still | jnp.isinf(boxes.lower), boxes.lower, lower),
        jnp.where(still | jnp.isinf(boxes.upper), boxes.upper, upper),
    )


@named_arguments
def nearest(system: Any, x: Any, boxes: Interval) -> Any:
    """The states x (..., n) with periodic ones moved by multiples of the period, as near as possible to the middle of
    the box: what to compare a box with, which holds of a periodic state up to such a multiple.

    Args:
        system: the plant (or an observer).
        x: states (..., n), or None.
        boxes: state boxes (..., n), or an `Estimate`.
    """
    system, boxes = _plant_and_boxes("nearest", system, boxes)
    if x is not None:
        x = read_array("nearest", "x", x, missing=True)
        if np.shape(x)[-1:] != (system.n,):
            raise ValueError(f"nearest: `x` must have shape (..., {system.n}), got {np.shape(x)}")
    if x is None or not system.periodic_states:
        return x
    period = columns(system.periodic_states, system.n)
    count = jax.lax.stop_gradient(jnp.round((boxes.center - x) / period))
    return x + count * np.where(np.isfinite(period), period, 0).astype(jnp.result_type(x))


def wrapped_outputs(periodic: Periods, y: Any) -> Any:
    """Outputs (l,) as a sensor logs them: periodic ones between minus and plus half a period."""
    if not periodic:
        return y
    period = columns(periodic, y.shape[0])
    whole = np.where(np.isfinite(period), period, 0).astype(y.dtype)
    return y - whole * jnp.round(y / period.astype(y.dtype))
