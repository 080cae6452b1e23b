"""Designs with a delay: x[k] from y[0..k+L], where the unknown input shows L steps later (theory 5.9)."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from gsisio_jax.design.assemble import Plan
from gsisio_jax.design.existence import check_existence, check_rank
from gsisio_jax.design.feedthrough import factorise
from gsisio_jax.design.recovery import with_recovery
from gsisio_jax.design.shared_noise import combinations
from gsisio_jax.errors import NoDesignFound, ObserverDoesNotExist
from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.reading import is_whole
from gsisio_jax.observer.certificate import Certificate
from gsisio_jax.observer.delayed import DelayedObserver
from gsisio_jax.observer.enclosures import slopes_of
from gsisio_jax.observer.types import Observer
from gsisio_jax.plant.later_outputs import LiftedRows
from gsisio_jax.plant.lift import lifted, output_of
from gsisio_jax.plant.system import Noise, System

_EQUAL = 1e-3  # share of a width that weights of few bits may cost


def check_delay(delay: Any, system: System, form: str) -> bool:
    """Is a delay asked for?

    Raises:
        ValueError: it is no whole number, or goes with nothing.
    """
    whole = is_whole(delay)
    if not (whole and delay >= 0) and not (isinstance(delay, str) and delay == "auto"):
        raise ValueError(
            f'design_observer: `delay` must be a whole number of steps, at least 0, or "auto", got {delay!r}'
        )
    if whole and delay == 0:
        return False
    if form == "prediction" or system.periodic or system.periodic_states:
        raise ValueError(
            "design_observer: `delay` must be 0 in the prediction form (which bounds x[k] from y[0..k-1]) and where "
            "outputs or states are periodic (unwrap the outputs, numpy.unwrap, and leave the periods out), got "
            f"{delay!r}"
        )
    return True


def design_delayed(
    design: Callable[[System, Noise, bool], Observer],
    system: System,
    noise: Noise,
    region: Interval | None,
    u_region: Interval,
    delay: int | str,
) -> Observer | DelayedObserver:
    """The observer of the lifted plant, in terms of the plant.

    Args:
        design: designs the ordinary observer of a system with some noise; as asked for, or quickly, for its widths.
        system, noise: the plant.
        region: of the design, None where it is looked for.
        u_region: known inputs of the design.
        delay: L, or "auto": the smallest one up to n that works.
    """
    if isinstance(delay, str):
        delay = _smallest(system, noise, region, u_region)
    if not delay:
        return design(system, noise, False)
    plant = lifted(system, delay)
    inner = design(plant, noise_of(plant, noise), True)
    fuller = _with_more(system, plant, inner, noise, u_region, delay)
    if fuller is not None:
        with contextlib.suppress(NoDesignFound):
            found = design(fuller, noise_of(fuller, noise), False)
            if (found.certificate.steady_width <= inner.certificate.steady_width * (1 + _EQUAL)).all():
                return _delayed(found, system, noise, u_region, delay)
    return _delayed(design(plant, noise_of(plant, noise), False), system, noise, u_region, delay)


def _with_more(
    system: System, plant: System, inner: Observer, noise: Noise, u_region: Interval, delay: int
) -> System | None:
    """The lifted plant with combinations that are worth an output of their own, because their noise is shared; None
    where there are none."""
    steady = np.asarray(inner.certificate.steady_width)
    slopes = slopes_of(system, np.zeros((0, system.l)), u_region)(inner.certificate.region)
    if not (np.isfinite(steady).all() and slopes.finite):
        return None
    width = np.maximum(steady, 1e-12 * steady.max(initial=1.0))
    more = combinations(system, _rows(plant), noise, slopes, width)
    try:
        return lifted(system, delay, more) if more else None
    except NoDesignFound:  # their weights have too many bits
        return None


def _delayed(inner: Observer, system: System, noise: Noise, u_region: Interval, delay: int) -> DelayedObserver:
    """The observer in terms of the plant."""
    rows = _rows(inner.system)
    certificate = _certificate(inner.certificate, rows, system, delay)
    observer = DelayedObserver(system=system, noise=noise, certificate=certificate, inner=inner, delay=delay)
    steady = inner.certificate.steady_width
    if inner.certificate.recoverable is None or not np.isfinite(steady).all():
        return observer
    return replace(observer, certificate=with_recovery(observer, steady, u_region))


def with_delay(error: ObserverDoesNotExist, system: System, u_region: Interval) -> Exception:
    """What is to be said where no observer exists: which longer delay would do, if one does."""
    lift = output_of(system)
    plant, delay = (system, 0) if lift is None else (lift.plant, lift.delay)
    if plant.periodic or plant.periodic_states:  # no delay goes with these
        return error
    text = str(error).removeprefix("design_observer: no observer exists. ")
    now = f"with delay={delay}" if delay else "without a delay"
    blocked = ""
    for later in range(delay + 1, plant.n + 1):
        longer = lifted(plant, later)
        blocked = _rows(longer).blocked
        if _seen(longer, u_region):
            return ObserverDoesNotExist(
                f"design_observer: {now} there is no observer, but the unknown input shows {_steps(later)} later: "
                f"delay={later} gives boxes of x[k] from y[0..k+{later}]. {text}"
            )
    if blocked:
        return ObserverDoesNotExist(
            f"design_observer: {now} there is no observer. Whether the unknown input shows later was not found out: "
            f"{blocked}. {text}"
        )
    return ObserverDoesNotExist(
        f"design_observer: no observer exists, with no delay up to n = {_steps(plant.n)}. {text}"
    )


def _steps(count: int) -> str:
    return f"{count} step{'' if count == 1 else 's'}"


def _smallest(system: System, noise: Noise, region: Interval | None, u_region: Interval) -> int:
    """delay="auto"."""
    for delay in range(system.n + 1):
        plant = lifted(system, delay) if delay else system
        if _seen(plant, u_region, region, noise):
            return delay
    if blocked := _rows(plant).blocked:
        raise NoDesignFound(
            f"design_observer: no delay up to n = {_steps(system.n)} was found that shows the unknown input. Not all "
            f"outputs could be followed over several steps: {blocked}. Measure more, or give `input_bounds` or "
            "`state_bounds`"
        )
    # Says which direction it is.
    feedthrough = factorise(np.asarray(plant.H))
    slopes_on = slopes_of(plant, feedthrough.T2, u_region)
    try:
        check_existence(plant, feedthrough, slopes_on(plant.state_bounds))
    except ObserverDoesNotExist as error:
        raise with_delay(error, plant, u_region) from None
    raise NoDesignFound(
        f"design_observer: with no delay up to n = {system.n} the unknown input shows at the centre of the region; try "
        "a region around another point, or give `state_bounds`, `input_bounds` or more outputs"
    )


def _seen(system: System, u_region: Interval, region: Interval | None = None, noise: Noise | None = None) -> bool:
    """Is no direction of the unknown input proved invisible, and do slopes at the centre of the region show it?"""
    feedthrough = factorise(np.asarray(system.H))
    slopes_on = slopes_of(system, feedthrough.T2, u_region)
    try:
        check_existence(system, feedthrough, slopes_on(system.state_bounds))
        if region is not None and noise is not None:
            slopes = slopes_on(region)
            more = system.l - noise.v.shape[0]
            v = Interval(np.pad(noise.v.lower, (0, more)), np.pad(noise.v.upper, (0, more)))
            if slopes.finite:
                check_rank(Plan(system, Noise(noise.w, v), feedthrough, u_region).problem(slopes))
    except (ObserverDoesNotExist, NoDesignFound):
        return False
    return True


def _rows(plant: System) -> LiftedRows:
    lift = output_of(plant)
    assert lift is not None
    return lift.rows(np.float64)


def noise_of(plant: System, noise: Noise) -> Noise:
    """Bounds of the noise of the lifted plant, for the design."""
    rows = _rows(plant)
    steps = rows.outputs.shape[1] // noise.v.shape[0]
    sides = []
    for low, high in ((noise.v.lower, noise.v.upper), (noise.v.upper, noise.v.lower)):
        w = (noise.w.lower, noise.w.upper) if low is noise.v.lower else (noise.w.upper, noise.w.lower)
        more = sum(
            np.maximum(M, 0) @ np.tile(a, steps) + np.minimum(M, 0) @ np.tile(b, steps)
            for M, (a, b) in ((rows.outputs, (low, high)), (rows.process, w))
        )
        sides.append(np.concatenate([np.asarray(low), more]))
    return Noise(noise.w, Interval(*sides))


def _certificate(found: Certificate, rows: LiftedRows, system: System, delay: int) -> Certificate:
    """The certificate of the lifted plant, its weights of noise as those of the plant's noise."""
    l, more = system.l, len(rows.entries)
    of_v = np.abs(rows.outputs).reshape(more, delay + 1, l).sum(1)
    of_w = np.abs(rows.process).reshape(more, delay + 1, system.n).sum(1)

    def split(weights: Any) -> tuple[np.ndarray, np.ndarray]:
        weights = np.asarray(weights)
        return weights[:, :l] + weights[:, l:] @ of_v, weights[:, l:] @ of_w

    (noise_v, more_w), (input_v, input_w) = split(found.noise_v), split(found.input_noise_v)

    def in_noise_of_plant(widths: Any) -> Any:
        if widths is None:
            return None
        of_rows, more_of_rows = split(widths.noise_v)
        return replace(widths, noise_v=of_rows, noise_w=np.asarray(widths.noise_w) + more_of_rows)

    note = f"delay {delay}: these are boxes of x[k] from y[0..k+{delay}]"
    return replace(
        found, noise_v=noise_v, noise_w=np.asarray(found.noise_w) + more_w, input_noise_v=input_v,
        input_noise_w=input_w, window=in_noise_of_plant(found.window), rates=in_noise_of_plant(found.rates),
        notes=(*found.notes, note),
    )  # fmt: skip
