"""`design_observer`: from a plant and its noise bounds to a verified gain and what it promises."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Literal, overload

import numpy as np

from gsisio_jax.design.arguments import check_cells, checked
from gsisio_jax.design.assemble import Plan, assemble
from gsisio_jax.design.dead_beat import dead_beat_rows
from gsisio_jax.design.delay import check_delay, design_delayed, with_delay
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
    typical_width,
    units,
)
from gsisio_jax.design.gains import optimal_gain
from gsisio_jax.design.gains_with_less import gains_with_less
from gsisio_jax.design.guidance import what_helps, what_recovers, what_settles
from gsisio_jax.design.initial_contraction import check_initial_contraction
from gsisio_jax.design.inputs import input_bounds
from gsisio_jax.design.prediction import DEFAULT_BOUNDS, LeftInverse, design_prediction
from gsisio_jax.design.progress import Say, told
from gsisio_jax.design.recovery import with_recovery
from gsisio_jax.design.region import Around, find_region, grown_around, read_around
from gsisio_jax.design.slices import check_split, with_slices
from gsisio_jax.design.tolerant import Guessed, check_tolerate, tolerant
from gsisio_jax.design.undefined import undefined_in
from gsisio_jax.design.window import window_rows
from gsisio_jax.errors import NoDesignFound, ObserverDoesNotExist
from gsisio_jax.inclusion.intersection import DEFAULT, check_methods
from gsisio_jax.interval.box import Interval
from gsisio_jax.observer.cells import counts
from gsisio_jax.observer.delayed import DelayedObserver
from gsisio_jax.observer.enclosures import Slopes, first_form, slopes_of
from gsisio_jax.observer.prediction_step import PredictionObserver
from gsisio_jax.observer.recovery_constants import AffineMaps
from gsisio_jax.observer.rounding_constants import with_rounding_constants
from gsisio_jax.observer.tolerant import TolerantObserver
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
    gains: int | Literal["auto"] = 1,
    u_region: Interval | None = None,
    missing: bool = True,
    sweeps: int = 3,
    bounds: Sequence[str] | None = None,
    certify: bool = True,
    window: int | Literal["auto"] = "auto",
    delay: Literal[0] = 0,
    cells: int = 1,
    split: int | Literal["auto"] = 1,
    tolerate: Literal[0] = 0,
    around: Around | None = None,
    progress: bool | None = None,
) -> Observer: ...


@overload
def design_observer(
    system: System,
    noise: Noise,
    region: Interval | Literal["auto"],
    form: Literal["current"] = "current",
    *,
    gains: int | Literal["auto"] = 1,
    u_region: Interval | None = None,
    missing: bool = True,
    sweeps: int = 3,
    bounds: Sequence[str] | None = None,
    certify: bool = True,
    window: int | Literal["auto"] = "auto",
    delay: Literal[0] = 0,
    cells: int = 1,
    tolerate: int,
) -> Observer | TolerantObserver: ...


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
    window: int | Literal["auto"] = "auto",
    delay: int | Literal["auto"],
    cells: int = 1,
    split: int | Literal["auto"] = 1,
    around: Around | None = None,
    progress: bool | None = None,
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
    around: Around | None = None,
    progress: bool | None = None,
) -> PredictionObserver: ...


def design_observer(
    system: System,
    noise: Noise,
    region: Interval | Literal["auto"],
    form: Literal["current", "prediction"] = "current",
    gains: int | Literal["auto"] = 1,
    u_region: Interval | None = None,
    missing: bool = True,
    sweeps: int = 3,
    bounds: Sequence[str] | None = None,
    left_inverse: LeftInverse | Any = "pseudo",
    allow_uncertified: bool = False,
    derivative: Interval | None = None,
    certify: bool = True,
    window: int | Literal["auto"] = "auto",
    delay: int | Literal["auto"] = 0,
    cells: int = 1,
    split: int | Literal["auto"] = 1,
    tolerate: int = 0,
    around: Around | None = None,
    progress: bool | None = None,
) -> Observer | PredictionObserver | DelayedObserver | TolerantObserver:
    """Design the gains of an interval observer offline, and certify the width of its boxes.

    Args:
        system: the plant.
        noise: constant bounds of w and v.
        region: convex box (n,) of states for which the gain is optimised and on which the width promise holds. It does
            not limit the observer: boxes are certain anywhere. Infinite sides are legal where f and g are affine or
            have bounded slopes. "auto" looks for a region that has room for its own steady width, see `around`.
        form: "current" uses y[k] for the box of x[k]; "prediction" is the paper's recursion, from y[0..k-1] alone, and
            takes none of `gains`, `missing` and `sweeps`.
        gains: size of the bank: the certified gain, and ``gains - 1`` more that are best for boxes of other widths,
            up to the region's. "auto" adds one after the other, from the region inwards, until the last one narrows a
            noise-free run from the region (from 100 steady widths where it is infinite) by less than 1 %.
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
            step does not (rotations, chains, networks), at some more operations a step. "auto" takes 3, or 5, where
            some state gets 5 % narrower by it, else 1: in simulated runs with the slopes of the region, or with fixed
            ones. It stays at 1 for more than 10 states, for periodic ones, and where slopes have no bounds.
        delay: L: bound x[k] from y[0..k+L], for plants whose unknown input shows only L steps later (a force, where
            positions are measured), or to smooth. Outputs, but for those of step k, must be affine in the state, and
            so must be for L >= 2 the parts of f that they see. "auto" takes the smallest L up to n that shows every
            unknown input. The result is a `DelayedObserver`; online its boxes come L steps late.
        cells: current form: into about how many parts the box of x[k] is cut in every step where outputs are bent, to
            bound them part by part: 64 finds a position by ranges and bearings in a box as large as the distances,
            where one part may leave it as wide as the state bounds. 1 takes the box whole.
        split: cut every state of the region into so many slices, most where slopes of f and g vary, and count slopes
            slice by slice: boxes nearly as wide as the region then get the width promise that they keep anyway, where
            the largest slope of the region says more, or leaves the certificate empty. Costs operations in proportion.
            "auto" takes 4, 8 or 16, as long as widths shrink by 2 %, and 1 where slopes do not vary.
        tolerate: q: boxes are certain even if up to q outputs of any one step are wrong, whichever these are. Outputs
            are voted out: `Estimate.kept` says which agree. The result is a `TolerantObserver`; a step is as many
            steps as there are choices of q wrong outputs in this and in the last measurement.
        around: where region="auto" looks: a state (n,), a box (an `Interval` (n,), the initial one say), or a
            trajectory: states (T, n) or boxes over time, as of a simulation or an earlier estimate. The region holds
            all of it and the steady boxes there. None: the centre of the state bounds (0 where there are none); a run
            elsewhere leaves such a region, which the certificate notes, and ``est.summary()`` counts.
        progress: say on standard error what the design is at, once it has taken two seconds. None: where that is a
            terminal.

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
    check_cells(cells, form)
    check_tolerate(tolerate, system, form, missing, window, delay)
    given, u_region = checked(system, noise, region, form, gains, u_region, sweeps, window, missing, certify, progress)
    check_split(split, form)
    near = read_around(system, around, given is None)
    late = check_delay(delay, system, form)
    default = DEFAULT if form == "current" else DEFAULT_BOUNDS
    methods = check_methods("design_observer", default if bounds is None else bounds)
    with told("design_observer", progress) as say:
        if form == "prediction":
            return design_prediction(
                system, noise, given, u_region, methods, left_inverse, allow_uncertified, derivative, near
            )

        def design(plant: System, noise: Noise, quick: bool) -> Observer:
            return _design(
                plant, noise, given, near, 1 if quick else gains, u_region, missing and not quick, sweeps, methods,
                certify and not quick, 1 if quick else window, 1 if quick else cells, 1 if quick else split,
                tolerate, say,
            )  # fmt: skip

        return design_delayed(design, system, noise, given, u_region, delay) if late else design(system, noise, False)


def _design(
    system: System,
    noise: Noise,
    given: Interval | None,
    near: Interval | None,
    gains: int | Literal["auto"],
    u_region: Interval,
    missing: bool,
    sweeps: int,
    methods: tuple[str, ...],
    certify: bool,
    window: int | Literal["auto"],
    cells: int,
    split: int | Literal["auto"],
    tolerate: int,
    say: Say,
) -> Any:
    """The current form, its arguments checked; `given` is the region, or None and it is looked for around `near`."""
    say("bounding slopes")
    feedthrough = factorise(np.asarray(system.H))
    slopes_on = slopes_of(system, feedthrough.T2, u_region)
    everywhere = slopes_on(system.state_bounds)
    try:
        check_existence(system, feedthrough, everywhere)
    except ObserverDoesNotExist as error:
        say("looking for what would help")
        reason = with_delay(error, system, u_region)
        ways = what_helps(Plan(system, noise, feedthrough, u_region), slopes_on, near if given is None else given)
        raise type(reason)(f"{reason}{ways}") from None
    plan = Plan(system, noise, feedthrough, u_region)
    say("looking for a region")
    box = _found_region(plan, slopes_on, certify, near) if given is None else given
    say("choosing gains")
    first = first_gain(plan, slopes_on, box, certify)
    problem, main = first.problem, first.gain
    say("bounding unknown inputs")
    maps = None if system.periodic_states else AffineMaps.of(system, feedthrough.T2, np.float64)
    outputs, slack = first_form(system, feedthrough.T2, u_region)

    def assembled(gains: list[np.ndarray], scale: np.ndarray) -> Observer:
        inputs = input_bounds(problem, scale)
        return assemble(plan, problem, box, gains, inputs, everywhere.affine, methods, sweeps)

    def finished(observer: Observer) -> Observer:
        slices = observer.certificate.slices
        return with_rounding_constants(
            observer, system, first.slopes, everywhere, outputs, slack, maps, np.float64, slices
        )  # fmt: skip

    steady = problem.steady_width(main)
    width = units(steady) if np.isfinite(steady).all() else typical_width(problem, box)
    if gains == "auto":
        bank = grown(
            [main],
            lambda share: profile_at(problem, main, box, share),
            lambda gains: widths_of_run(finished(assembled(gains, width)), box, width, u_region),
        )
    else:
        bank = [main, *profile_bank(problem, main, box, gains - 1)]
    if missing or system.periodic:  # the multiple of a periodic output is chosen without that output
        bank.extend(gains_for_missing(problem, main, box, feedthrough, [j for j, _ in system.periodic]))
    guessed = Guessed(problem, main, box, feedthrough, tolerate) if tolerate else None
    if guessed is not None:
        bank.extend(guessed.gains())
    bank = distinct([*bank, *gains_without_state_bounds(problem, main, box)])
    bank = distinct([*bank, *gains_with_less(problem, bank, box)])
    observer = assembled(bank, width)
    if first.uncertified:
        observer = replace(observer, certificate=observer.certificate.without_promise(first.uncertified))
    elif split != 1 and not everywhere.affine:
        weights = np.asarray(observer.gains.residual[0])
        certificate = with_slices(observer.certificate, noise, weights, slopes_on, box, split)
        observer = replace(observer, certificate=certificate)
    observer = replace(observer, cells=counts(cells, everywhere.bent_outputs))
    if not (first.uncertified or observer.certificate.certified):
        way = what_settles(plan, slopes_on, box)
        observer = replace(observer, certificate=observer.certificate.with_notes(way))
    if not everywhere.affine:
        found = (undefined_in(system, box, u_region), grown_around(near, box) if given is None else "")
        observer = replace(observer, certificate=observer.certificate.with_notes(*found))
    chosen = window == "auto"
    if not tolerate and window != 1 and (not chosen or (first.slopes.finite and not system.periodic_states)):
        say("choosing rows over several steps")
        rows = window_rows(problem, window, width, bank)
        observer = replace(observer, window=rows)
        if rows is not None and everywhere.affine:
            widths = WindowWidths.of(rows, problem.F, problem.E, problem.T2, problem.dd)
            observer = replace(observer, certificate=observer.certificate.with_window(widths, noise))
    if maps is not None:
        rows_alone = dead_beat_rows(problem, maps, width) if guessed is None else guessed.rows(maps, width)
        observer = replace(observer, recovery=rows_alone)
    say("bounding what rounding leaves")
    observer = finished(observer)
    if certify:
        try:
            check_initial_contraction(problem, bank[0], observer, outputs)
        except NoDesignFound as error:
            raise NoDesignFound(f"{error}{what_helps(plan, slopes_on, box)}") from None
    if tolerate:
        return tolerant(observer, tolerate)
    if not missing:
        return observer
    say("trying what happens after a lost row")
    certificate = with_recovery(observer, width, u_region)
    if certificate.recoverable is False:
        certificate = certificate.with_notes(what_recovers(plan, slopes_on, box))
    return replace(observer, certificate=certificate)


def _found_region(
    plan: Plan, slopes_on: Callable[[Interval], Slopes], certify: bool, near: Interval | None
) -> Interval:
    """region="auto"; where there is none and no certificate is asked for, the point that the search began at."""
    try:
        return find_region(plan.system, lambda box: _steady_width(plan, box, slopes_on(box)), near)
    except NoDesignFound as error:
        if certify:
            raise NoDesignFound(f"{error}{what_helps(plan, slopes_on, near)}") from None
        if near is not None:
            return near
        center = np.asarray(plan.system.state_bounds.center, np.float64)
        return Interval(center, center)


def _steady_width(plan: Plan, region: Interval, slopes: Slopes) -> np.ndarray:
    """Steady width of the optimal gain on a region; infinite where there is none. Serves region='auto'."""
    if not slopes.finite:
        return np.full(plan.system.n, np.inf)
    problem = plan.problem(slopes)
    gain = optimal_gain(problem, np.ones(problem.n), typical_width(problem, region))
    return np.full(problem.n, np.inf) if gain is None else problem.steady_width(gain)
