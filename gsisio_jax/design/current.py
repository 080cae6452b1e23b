"""The current form: from slopes on a region to gains, rows and rounding constants, and what they promise."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal, NamedTuple

import numpy as np

from gsisio_jax.design.anchored import with_anchored_rows
from gsisio_jax.design.assemble import Plan, assemble
from gsisio_jax.design.cells import with_cells
from gsisio_jax.design.dead_beat import dead_beat_rows
from gsisio_jax.design.delay import with_delay
from gsisio_jax.design.delay_gain import what_a_delay_gives
from gsisio_jax.design.existence import check_existence
from gsisio_jax.design.feedthrough import factorise
from gsisio_jax.design.first_gain import first_gain
from gsisio_jax.design.gain_growth import grown, widths_of_run
from gsisio_jax.design.gain_selection import (
    distinct,
    gains_for_missing,
    gains_without_state_bounds,
    profile_at,
    profile_bank,
    profile_of,
    typical_width,
)
from gsisio_jax.design.gains import optimal_gain
from gsisio_jax.design.gains_with_less import certified_with_less, gains_with_less
from gsisio_jax.design.gains_without_outputs import gains_without_outputs
from gsisio_jax.design.guidance import what_helps, what_settles
from gsisio_jax.design.guidance_recovery import what_recovers
from gsisio_jax.design.initial_contraction import check_initial_contraction
from gsisio_jax.design.input_rows import rows_of_inputs
from gsisio_jax.design.inputs import input_bounds
from gsisio_jax.design.progress import Say
from gsisio_jax.design.rates import gains_of_rates, rate_widths, rows_of_rates
from gsisio_jax.design.recovery import with_recovery
from gsisio_jax.design.region import Near, find_region, grown_around
from gsisio_jax.design.slices import what_split_gives, with_slices
from gsisio_jax.design.tolerant import Guessed, tolerant
from gsisio_jax.design.undefined import undefined_in
from gsisio_jax.design.window import what_is_cut, what_windows_may_give
from gsisio_jax.design.window_length import units_of_windows
from gsisio_jax.design.window_with_less import window_rows_with_less
from gsisio_jax.errors import NoDesignFound, ObserverDoesNotExist
from gsisio_jax.interval.box import Interval
from gsisio_jax.observer.enclosures import Enclosures, Slopes
from gsisio_jax.observer.recovery_constants import AffineMaps
from gsisio_jax.observer.rounding_constants import with_rounding_constants
from gsisio_jax.observer.types import Observer
from gsisio_jax.observer.window_widths import WindowWidths
from gsisio_jax.plant.system import Noise, System


class Dials(NamedTuple):
    """Options of `design_observer` in the current form, as they stand there."""

    gains: int | Literal["auto"]
    missing: bool
    sweeps: int
    methods: tuple[str, ...]
    certify: bool
    window: int | Literal["auto"]
    cells: int | Literal["auto"]
    split: int | Literal["auto"]
    tolerate: int
    rates: tuple[int, ...] | None = None

    def quick(self) -> Dials:
        """For a design that is tried only."""
        return self._replace(gains=1, missing=False, certify=False, window=1, cells=1, split=1)


def design_current(
    system: System,
    noise: Noise,
    given: Interval | None,
    near: Near | None,
    u_region: Interval,
    dials: Dials,
    say: Say,
) -> Any:
    """The current form, its arguments checked; `given` is the region, or None and it is looked for around `near`."""
    say("bounding slopes")
    feedthrough = factorise(np.asarray(system.H))
    plan = Plan(system, noise, feedthrough, u_region)
    on = Enclosures.of(system, feedthrough.T2, u_region)
    everywhere = on.slopes(system.state_bounds)
    try:
        check_existence(system, feedthrough, everywhere)
    except ObserverDoesNotExist as error:
        say("looking for what would help")
        reason = with_delay(error, system, u_region)
        ways = what_helps(plan, on, _place(near) if given is None else given)
        raise type(reason)(f"{reason}{ways}") from None
    say("looking for a region")
    box = _found_region(plan, on, dials.certify, near) if given is None else given
    say("choosing gains")
    first = first_gain(plan, on, box, dials.certify)
    problem, main = first.problem, first.gain
    say("bounding unknown inputs")
    maps = AffineMaps.of(on.maps, system.state_bounds)
    outputs, slack = on.outputs(system.state_bounds)

    def assembled(gains: list[np.ndarray], scale: np.ndarray) -> Observer:
        steady = problem.steady_width(main)
        inputs = input_bounds(problem, steady if np.isfinite(steady).all() else scale)
        return assemble(plan, problem, box, gains, inputs, everywhere.affine, dials.methods, dials.sweeps)

    def finished(observer: Observer) -> Observer:
        slices = observer.certificate.slices
        return with_rounding_constants(
            observer, system, first.slopes, everywhere, outputs, slack, maps, np.float64, slices
        )  # fmt: skip

    width = profile_of(problem, problem.steady_width(main), box)
    if dials.split != 1 and not (first.uncertified or everywhere.affine):
        inputs = input_bounds(problem, width)

        def promised(gain: np.ndarray) -> np.ndarray:
            alone = assemble(plan, problem, box, [gain], inputs, False, dials.methods, dials.sweeps)
            weights = np.asarray(alone.gains.residual[0])
            found = with_slices(alone.certificate, noise, weights, on.slopes, box, dials.split)
            return np.asarray(found.steady_width)

        main = certified_with_less(problem, main, box, promised)
        width = profile_of(problem, problem.steady_width(main), box)
    if dials.gains == "auto":
        bank = grown(
            [main],
            lambda share: profile_at(problem, main, box, share),
            lambda gains: widths_of_run(finished(assembled(gains, width)), box, width, u_region),
        )
    else:
        bank = [main, *profile_bank(problem, main, box, dials.gains - 1)]
    together = [j for j, _ in system.periodic] if dials.missing or system.periodic else None
    if together is not None:  # the multiple of a periodic output is chosen without that output
        bank.extend(gains_for_missing(problem, main, box, together))
    if main is not first.gain:
        bank.append(first.gain)
    if dials.rates is not None:
        bank.extend(gains_of_rates(problem, dials.rates, main, box))
    guessed = Guessed(problem, main, box, feedthrough, dials.tolerate) if dials.tolerate else None
    if guessed is not None:
        bank.extend(guessed.gains())
    bank = distinct([*bank, *gains_without_state_bounds(problem, main, box)])
    bank = distinct([*bank, *gains_with_less(problem, bank, box)])
    bank = distinct([*bank, *gains_without_outputs(problem, bank, box)])
    observer = assembled(bank, width)
    if first.uncertified:
        observer = replace(observer, certificate=observer.certificate.without_promise(first.uncertified))
    elif dials.split != 1 and not everywhere.affine:
        weights = np.asarray(observer.gains.residual[0])
        certificate = with_slices(observer.certificate, noise, weights, on.slopes, box, dials.split)
        observer = replace(observer, certificate=certificate)
    elif dials.certify and observer.certificate.certified and not observer.certificate.self_consistent:
        weights = np.asarray(observer.gains.residual[0])
        way = "" if everywhere.affine else what_split_gives(observer.certificate, noise, weights, on.slopes, box)
        observer = replace(observer, certificate=observer.certificate.with_notes(way))
    unsettled = not (first.uncertified or observer.certificate.certified)
    if unsettled and not everywhere.affine:
        observer = replace(observer, certificate=observer.certificate.with_notes(what_settles(plan, on, box)))
    if not everywhere.affine:
        undefined, found = undefined_in(system, box, u_region), observer.certificate
        found = found.without_promise(undefined) if undefined else found
        found = found.with_notes(grown_around(near, box) if given is None else "")
        observer = replace(observer, certificate=found)
    window = 1 if dials.tolerate else dials.window
    if everywhere.affine and not np.isfinite(problem.steady_width(main)).all():
        width = units_of_windows(problem, width, system.n + 1)
    if window == "auto" and not (first.slopes.finite and not system.periodic_states):
        window = 1
    if window != 1:
        say("choosing rows over several steps")
        if dials.rates is None:
            rows = window_rows_with_less(problem, window, width, bank, box, together)
        else:
            rows = rows_of_rates(problem, dials.rates, window, width, bank)
        observer = replace(observer, window=rows)
        if rows is not None and everywhere.affine and dials.rates is None:
            widths = WindowWidths.of(rows, problem.F, problem.E, problem.T2, problem.dd)
            observer = replace(observer, certificate=observer.certificate.with_window(widths, noise))
        observer = replace(observer, certificate=observer.certificate.with_notes(what_is_cut(window, rows)))
    by_window = everywhere.affine and observer.window is not None and not observer.certificate.certified
    if dials.rates is not None or by_window:
        rates = dials.rates or (1,) * problem.l
        found = rate_widths(problem, rates, observer.window, bank) if everywhere.affine else None
        observer = replace(observer, certificate=observer.certificate.with_rates(found, noise))
    if unsettled and everywhere.affine and not observer.certificate.settles_by_rates:
        observer = replace(observer, certificate=observer.certificate.with_notes(what_settles(plan, on, box)))
    observer = replace(observer, input_rows=rows_of_inputs(problem, system, dials.window, width, bank, observer.window))
    if maps is not None:
        rows_alone = dead_beat_rows(problem, maps, width) if guessed is None else guessed.rows(maps, width)
        observer = replace(observer, recovery=rows_alone)
    if window == "auto" and dials.rates is None:
        way = what_windows_may_give(observer, problem, width)
        observer = replace(observer, certificate=observer.certificate.with_notes(way))
    if dials.certify and not dials.tolerate:
        way = what_a_delay_gives(plan, observer.certificate, box)
        observer = replace(observer, certificate=observer.certificate.with_notes(way))
    say("bounding what rounding leaves")
    observer = finished(observer)
    if dials.cells != 1:
        say("trying cells")
    observer = with_cells(observer, problem, dials.cells, everywhere, u_region)
    if dials.certify:
        try:
            check_initial_contraction(problem, bank[0], observer, outputs)
        except NoDesignFound as error:
            raise NoDesignFound(f"{error}{what_helps(plan, on, box)}") from None
    if dials.tolerate:
        return tolerant(observer, dials.tolerate)
    if not dials.missing:
        return observer
    say("trying what happens after a lost row")
    certificate = with_recovery(observer, width, u_region)
    if maps is not None:
        observer, certificate = with_anchored_rows(observer, certificate, problem, maps, width, u_region)
    if certificate.recoverable is False:
        certificate = certificate.with_notes(what_recovers(plan, on, box, maps))
    return replace(observer, certificate=certificate)


def _found_region(plan: Plan, on: Enclosures, certify: bool, near: Near | None) -> Interval:
    """region="auto"; where there is none and no certificate is asked for, the point that the search began at."""
    try:
        return find_region(plan.system, lambda box: _steady_width(plan, box, on.slopes(box)), near)
    except NoDesignFound as error:
        if certify:
            raise NoDesignFound(f"{error}{what_helps(plan, on, _place(near))}") from None
        if near is not None:
            return near.box
        center = np.asarray(plan.system.state_bounds.center, np.float64)
        return Interval(center, center)


def _place(near: Near | None) -> Interval | None:
    return None if near is None else near.box


def _steady_width(plan: Plan, region: Interval, slopes: Slopes) -> np.ndarray:
    """Steady width of the optimal gain on a region; infinite where there is none. Serves region='auto'."""
    if not slopes.finite:
        return np.full(plan.system.n, np.inf)
    problem = plan.problem(slopes)
    gain = optimal_gain(problem, np.ones(problem.n), typical_width(problem, region))
    return np.full(problem.n, np.inf) if gain is None else problem.steady_width(gain)
