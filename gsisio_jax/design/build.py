"""`design_observer`: from a plant and its noise bounds to a verified gain and what it promises."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, overload

from gsisio_jax._calls import named_arguments
from gsisio_jax._collector import rare_collection
from gsisio_jax._room import with_room
from gsisio_jax.design.arguments import check_cells, checked
from gsisio_jax.design.current import Dials, design_current
from gsisio_jax.design.delay import check_delay, design_delayed
from gsisio_jax.design.prediction import DEFAULT_BOUNDS, LeftInverse, design_prediction
from gsisio_jax.design.progress import told
from gsisio_jax.design.rates import check_rates
from gsisio_jax.design.region import Around, read_around
from gsisio_jax.design.slices import check_split
from gsisio_jax.design.tolerant import check_tolerate
from gsisio_jax.inclusion.intersection import DEFAULT, check_methods
from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.reading import check_type
from gsisio_jax.observer.delayed import DelayedObserver
from gsisio_jax.observer.prediction_step import PredictionObserver
from gsisio_jax.observer.tolerant import TolerantObserver
from gsisio_jax.observer.types import Observer
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
    cells: int | Literal["auto"] = "auto",
    split: int | Literal["auto"] = 1,
    tolerate: Literal[0] = 0,
    around: Around | None = None,
    progress: bool | None = None,
    rates: Sequence[int] | None = None,
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
    cells: int | Literal["auto"] = "auto",
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
    cells: int | Literal["auto"] = "auto",
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


@with_room
@named_arguments
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
    cells: int | Literal["auto"] = "auto",
    split: int | Literal["auto"] = 1,
    tolerate: int = 0,
    around: Around | None = None,
    progress: bool | None = None,
    rates: Sequence[int] | None = None,
) -> Observer | PredictionObserver | DelayedObserver | TolerantObserver:
    """Design the gains of an interval observer offline, and certify the width of its boxes.

    Args:
        system: the plant.
        noise: constant bounds of w and v.
        region: convex box (n,) of states for which the gain is optimised and on which the width promise holds. It does
            not limit the observer: boxes are certain anywhere. What lies beyond the state bounds is left out of it.
            Infinite sides are legal where f and g are affine or have bounded slopes. "auto" looks for a region that has
            room for its own steady width, see `around`.
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
            jump, or give no number in part of the region, there is never one, and this makes no difference.
        window: N: the current form also bounds x[k] from y[k-N..k] and the boxes of N steps before jointly, with rows
            chosen offline from simulated runs. 1 looks back one step; 3 to 5 come close to the exact hull where one
            step does not (rotations, chains, networks), at some more operations a step. Rows look back no farther than
            that narrows runs; where that is less than N, the certificate notes it. "auto" takes 3, or 5, where some
            state gets 5 % narrower by it, else 1: in simulated runs with the slopes of the region, or with fixed ones;
            10 or 20 steps with a few rows, where 5 are worth it and each of these lengths makes some state a quarter
            narrower than the one before; and as many rows as are worth the time that they add to a step. It stays at 1
            for more than 20 states, for periodic ones, and where slopes have no bounds.
        delay: L: bound x[k] from y[0..k+L], for plants whose unknown input shows only L steps later (a force, where
            positions are measured), or to smooth. Outputs, but for those of step k, must be affine in the state, and
            so must be for L >= 2 the parts of f that they see. "auto" takes the smallest L up to n that shows every
            unknown input. The result is a `DelayedObserver`; online its boxes come L steps late.
        cells: current form: into about how many parts the box of x[k] is cut in every step where outputs are bent, and
            the last one where f or g is, to bound them part by part: 64 finds a position by ranges and bearings in a
            box as large as the distances, where one part may leave it as wide as the state bounds; 36 bring the boxes
            of the paper's example from 5 % to .5 % above the exact hull. A step takes many times as long. 1 takes the
            boxes whole. "auto" takes 64, of x[k] alone, where an unknown input moves such a state freely, its box would
            stay wider than a tenth of its bounds or than twice what straight outputs would leave, and cells halve it,
            in runs without noise; the certificate notes it.
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
            terminal or a notebook.
        rates: current form: for every output, every how many rows it comes: (1, 20) for a second one that comes with
            every twentieth row and is NaN in between. Rows over several steps are then chosen for that pattern ("auto":
            over whole periods), and where f and g are affine the certificate promises widths for every phase of it.
            Boxes are certain whatever comes. None: every output comes in every row, but for what is lost.

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
    given, u_region = checked(system, noise, region, form, gains, u_region, sweeps, window, missing, certify, progress)
    check_tolerate(tolerate, system, form, missing, window, delay)
    check_split(split, form)
    if derivative is not None:
        check_type("design_observer", "derivative", derivative, Interval, "one interval for every partial derivative")
        if form != "prediction":
            raise ValueError(
                f'design_observer: `derivative` is for form="prediction", got form={form!r}; leave it out, or bound '
                "your own functions with inclusion.register_bounds"
            )
    near = read_around(system, around, given is None)
    late = check_delay(delay, system, form)
    default = DEFAULT if form == "current" else DEFAULT_BOUNDS
    methods = check_methods("design_observer", default if bounds is None else bounds)
    # Whole numbers of NumPy are Python's from here on: the design tells "auto" from a number by its type.
    window = window if isinstance(window, str) else int(window)
    rates = check_rates(rates, system.l, form, missing, delay, tolerate)
    dials = Dials(gains, missing, sweeps, methods, certify, window, cells, split, tolerate, rates)
    with rare_collection(), told("design_observer", progress) as say:
        if form == "prediction":
            return design_prediction(
                system, noise, given, u_region, methods, left_inverse, allow_uncertified, derivative, near
            )

        def design(plant: System, noise: Noise, quick: bool) -> Observer:
            return design_current(plant, noise, given, near, u_region, dials.quick() if quick else dials, say)

        return design_delayed(design, system, noise, given, u_region, delay) if late else design(system, noise, False)
