"""`design_observer`: from a plant and its noise bounds to a verified gain and what it promises."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Literal, overload

import numpy as np

from gsisio_jax.design.arguments import checked
from gsisio_jax.design.assemble import Plan, assemble
from gsisio_jax.design.dead_beat import dead_beat_rows
from gsisio_jax.design.delay import check_delay, design_delayed, with_delay
from gsisio_jax.design.existence import check_existence
from gsisio_jax.design.feedthrough import factorise
from gsisio_jax.design.first_gain import first_gain
from gsisio_jax.design.gain_selection import (
    distinct,
    gains_for_missing,
    gains_without_state_bounds,
    profile_bank,
    typical_width,
    units,
)
from gsisio_jax.design.gains import optimal_gain
from gsisio_jax.design.initial_contraction import check_initial_contraction
from gsisio_jax.design.input_rows import rows_of_inputs
from gsisio_jax.design.inputs import input_bounds
from gsisio_jax.design.prediction import DEFAULT_BOUNDS, LeftInverse, design_prediction
from gsisio_jax.design.recovery import with_recovery
from gsisio_jax.design.region import find_region
from gsisio_jax.design.undefined import undefined_in
from gsisio_jax.design.window import window_rows
from gsisio_jax.errors import NoDesignFound, ObserverDoesNotExist
from gsisio_jax.inclusion.intersection import DEFAULT, check_methods
from gsisio_jax.interval.box import Interval
from gsisio_jax.observer.delayed import DelayedObserver
from gsisio_jax.observer.enclosures import Slopes, first_form, slopes_of
from gsisio_jax.observer.prediction_step import PredictionObserver
from gsisio_jax.observer.recovery_constants import AffineMaps
from gsisio_jax.observer.rounding_constants import with_rounding_constants
from gsisio_jax.observer.types import Observer
from gsisio_jax.observer.window_widths import WindowWidths
from gsisio_jax.plant.system import Noise, System


@overload
def design_observer(
    system: System,
    noise: Noise,
    region: Interval | Literal["auto"],
    form: Literal["current"] = "current",
    *,
    gains: int = 1,
    u_region: Interval | None = None,
    missing: bool = True,
    sweeps: int = 3,
    bounds: Sequence[str] | None = None,
    certify: bool = True,
    window: int | Literal["auto"] = 1,
    delay: Literal[0] = 0,
) -> Observer: ...


@overload
def design_observer(
    system: System,
    noise: Noise,
    region: Interval | Literal["auto"],
    form: Literal["current"] = "current",
    *,
    gains: int = 1,
    u_region: Interval | None = None,
    missing: bool = True,
    sweeps: int = 3,
    bounds: Sequence[str] | None = None,
    certify: bool = True,
    window: int | Literal["auto"] = 1,
    delay: int | Literal["auto"],
) -> Observer | DelayedObserver: ...


@overload
def design_observer(
    system: System,
    noise: Noise,
    region: Interval | Literal["auto"],
    form: Literal["prediction"],
    *,
    u_region: Interval | None = None,
    bounds: Sequence[str] | None = None,
    left_inverse: LeftInverse | Any = "pseudo",
    allow_uncertified: bool = False,
    derivative: Interval | None = None,
) -> PredictionObserver: ...


def design_observer(
    system: System,
    noise: Noise,
    region: Interval | Literal["auto"],
    form: Literal["current", "prediction"] = "current",
    gains: int = 1,
    u_region: Interval | None = None,
    missing: bool = True,
    sweeps: int = 3,
    bounds: Sequence[str] | None = None,
    left_inverse: LeftInverse | Any = "pseudo",
    allow_uncertified: bool = False,
    derivative: Interval | None = None,
    certify: bool = True,
    window: int | Literal["auto"] = 1,
    delay: int | Literal["auto"] = 0,
) -> Observer | PredictionObserver | DelayedObserver:
    """Design the gains of an interval observer offline, and certify the width of its boxes.

    Args:
        system: the plant.
        noise: constant bounds of w and v.
        region: convex box (n,) of states for which the gain is optimised and on which the width promise holds. It does
            not limit the observer: boxes are certain anywhere. Infinite sides are legal where f and g are affine or
            have bounded slopes. "auto" looks for a region that fits its own steady width.
        form: "current" uses y[k] for the box of x[k]; "prediction" is the paper's recursion, from y[0..k-1] alone, and
            takes none of `gains`, `missing` and `sweeps`.
        gains: size of the bank: the certified gain, and ``gains - 1`` more that are best for larger boxes.
        u_region: box (m,) of known inputs for which the design holds; needed where f or g takes u.
        missing: also keep gains for steps where entries of y[k] or y[k-1] are missing. A system with periodic outputs
            always has them.
        sweeps: contractions per step; more are tighter and slower.
        bounds: how f and g are bounded online, any of "affine", "natural", "decomposition", "remainder", "mean_value",
            "abstraction" (planes found offline, valid on the region); the bounds are intersected (paper, Corollary 1).
            None takes affine and natural bounds, and in the prediction form decomposition and mean-value form besides.
            Without "affine" or "mean_value" nothing that cancels between f, g and x can cancel, and boxes may grow.
        left_inverse: prediction form: J of [G; H]: "pseudo" (the paper), "feedthrough" ([0 pinv(H)], for H of full
            column rank: the closed form with rho = 0), "smallest" (smallest rho) or a matrix (p, n + l).
        allow_uncertified: prediction form: run it even where it is no framer; crossed steps carry the status CROSSED.
        derivative: prediction form: box (n + l, n) that contains the derivative of [f; g] everywhere, for
            "decomposition" and "remainder" as the paper uses them; None encloses it on every box, which is tighter.
        certify: current form: refuse where no width can be promised. False gives an observer without a certificate
            wherever boxes can be computed: they are certain all the same, but may be wide or infinite. Where f or g
            jump there is never a certificate, and this makes no difference.
        window: N: the current form also bounds x[k] from y[k-N..k] and the boxes of N steps before jointly, with rows
            chosen offline from simulated runs. 1 looks back one step; 3 to 5 come close to the exact hull where one
            step does not (rotations, chains, networks), at some more operations a step. "auto" takes 3 or 5 where
            simulated runs get 5 % narrower in some state, else 1.
        delay: L: bound x[k] from y[0..k+L], for plants whose unknown input shows only L steps later (a force, where
            positions are measured), or to smooth. Outputs, but for those of step k, must be affine in the state, and
            so must be for L >= 2 the parts of f that they see. "auto" takes the smallest L up to n that shows every
            unknown input. The result is a `DelayedObserver`; online its boxes come L steps late.

    Returns:
        An `Observer` (`PredictionObserver` for the prediction form); ``print(observer.certificate)`` says what it
        promises. A certificate may be absent or empty: the boxes are certain all the same.

    Raises:
        ObserverDoesNotExist: an input direction is proved invisible, with this delay; the message says which delay
            shows it, if one does.
        FramerNotGuaranteed: the prediction form is no framer for this system.
        NoDesignFound: no gain with finite boxes was found; says what failed, in which line of f or g where it is one,
            and what may help.
        ValueError: shapes do not agree, or an argument is out of range.

    Source: theory 3, 4 and 6; paper, Theorem 1.
    """
    given, u_region = checked(system, noise, region, form, gains, u_region, sweeps, window, missing, certify)
    if check_delay(delay, system, form):

        def inner(plant: System, noise: Noise, quick: bool) -> Observer:
            return design_observer(
                plant, noise, region, gains=1 if quick else gains, u_region=u_region, missing=missing and not quick,
                sweeps=sweeps, bounds=bounds, certify=certify and not quick, window=1 if quick else window, delay=0,
            )  # fmt: skip

        return design_delayed(inner, system, noise, given, u_region, delay)
    default = DEFAULT if form == "current" else DEFAULT_BOUNDS
    methods = check_methods("design_observer", default if bounds is None else bounds)
    if form == "prediction":
        return design_prediction(system, noise, given, u_region, methods, left_inverse, allow_uncertified, derivative)
    feedthrough = factorise(np.asarray(system.H))
    slopes_on = slopes_of(system, feedthrough.T2, u_region)
    everywhere = slopes_on(system.state_bounds)
    try:
        check_existence(system, feedthrough, everywhere)
    except ObserverDoesNotExist as error:
        raise with_delay(error, system, u_region) from None
    plan = Plan(system, noise, feedthrough, u_region)
    box = _found_region(plan, slopes_on, certify) if given is None else given
    first = first_gain(plan, slopes_on, box, certify)
    problem, main = first.problem, first.gain
    bank = [main, *profile_bank(problem, main, box, gains - 1)]
    if missing or system.periodic:  # the multiple of a periodic output is chosen without that output
        bank.extend(gains_for_missing(problem, main, box, feedthrough, [j for j, _ in system.periodic]))
    bank = distinct([*bank, *gains_without_state_bounds(problem, main, box)])
    steady = problem.steady_width(bank[0])
    width = units(steady) if np.isfinite(steady).all() else typical_width(problem, box)
    outputs, slack = first_form(system, feedthrough.T2, u_region)
    observer = assemble(plan, problem, box, bank, input_bounds(problem, width), everywhere.affine, methods, sweeps)
    if first.uncertified:
        observer = replace(observer, certificate=observer.certificate.without_promise(first.uncertified))
    if not everywhere.affine and (why := undefined_in(system, box, u_region)):
        certificate = observer.certificate
        observer = replace(observer, certificate=replace(certificate, notes=(*certificate.notes, why)))
    if window != 1:
        rows = window_rows(problem, window, width)
        observer = replace(observer, window=rows)
        if rows is not None and everywhere.affine:
            widths = WindowWidths.of(rows, problem.F, problem.E, problem.T2, problem.dd)
            observer = replace(observer, certificate=observer.certificate.with_window(widths, noise))
    observer = replace(observer, input_rows=rows_of_inputs(problem, system, window, width))
    maps = None if system.periodic_states else AffineMaps.of(system, feedthrough.T2, np.float64)
    if maps is not None:
        observer = replace(observer, recovery=dead_beat_rows(problem, maps, width))
    observer = with_rounding_constants(observer, system, first.slopes, everywhere, outputs, slack, maps, np.float64)
    if certify:
        check_initial_contraction(problem, bank[0], observer, outputs)
    if not missing:
        return observer
    return replace(observer, certificate=with_recovery(observer, width, u_region))


def _found_region(plan: Plan, slopes_on: Callable[[Interval], Slopes], certify: bool) -> Interval:
    """region="auto"; where there is none and no certificate is asked for, the point that the search began at."""
    try:
        return find_region(plan.system, lambda box: _steady_width(plan, box, slopes_on(box)))
    except NoDesignFound:
        if certify:
            raise
        center = np.asarray(plan.system.state_bounds.center, np.float64)
        return Interval(center, center)


def _steady_width(plan: Plan, region: Interval, slopes: Slopes) -> np.ndarray:
    """Steady width of the optimal gain on a region; infinite where there is none. Serves region='auto'."""
    if not slopes.finite:
        return np.full(plan.system.n, np.inf)
    problem = plan.problem(slopes)
    gain = optimal_gain(problem, np.ones(problem.n), typical_width(problem, region))
    return np.full(problem.n, np.inf) if gain is None else problem.steady_width(gain)
