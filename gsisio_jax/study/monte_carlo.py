"""`monte_carlo`: many simulated runs, estimated as they are simulated, with the containment of every step checked."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax._calls import named_arguments
from gsisio_jax._extras import need
from gsisio_jax._room import with_room
from gsisio_jax.errors import ContainmentLost
from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.reading import read_array
from gsisio_jax.interval.rounding import Rounding
from gsisio_jax.observer import checks
from gsisio_jax.observer.checks import AnyObserver
from gsisio_jax.observer.estimation import OnConflict
from gsisio_jax.plant.simulation import read_key
from gsisio_jax.plant.system import Noise
from gsisio_jax.study.arguments import prepare
from gsisio_jax.study.axes import RUN, Axis, Layout, bare
from gsisio_jax.study.containment import Containment, TrueRun
from gsisio_jax.study.job import Job
from gsisio_jax.study.labels import Labels
from gsisio_jax.study.later import check_longer
from gsisio_jax.study.plant import Simulated
from gsisio_jax.study.reductions import resolve
from gsisio_jax.study.run import run
from gsisio_jax.study.summary import check_confidence, summary
from gsisio_jax.study.truth import Coverage
from gsisio_jax.tracing import explanation

CALL = "monte_carlo"
# Dimensions of every argument of one case.
RANKS = {
    "initial": (1,), "noise": (1, 2), "u": (2,), "x0": (1,), "d": (2,), "run": (0,), "key": (1,), "steady": (1,),
}  # fmt: skip

Draw = Literal["uniform", "vertices"] | Callable[..., Any]


@with_room
@named_arguments
def monte_carlo(
    observer: AnyObserver,
    key: Any,
    runs: int | Sequence[int],
    steps: int,
    x0: Any,
    d: Any = None,
    noise: Noise | Axis | None = None,
    reduce: Any = ("final", "max", "mean"),
    *,
    initial: Interval | Axis | None = None,
    draw: Draw = "uniform",
    u: Any = None,
    on_miss: Literal["raise", "record"] = "raise",
    confidence: float = 0.95,
    batch: int | None = None,
    store: Any = None,
    resume: bool = True,
    client: Any = None,
    mesh: Any = None,
    progress: bool = True,
    on_conflict: OnConflict = "restart",
    state_names: Sequence[str] | None = None,
    input_names: Sequence[str] | None = None,
    state_units: Sequence[str] | None = None,
    input_units: Sequence[str] | None = None,
    time: Any = None,
    title: str = "",
    rounding: Rounding | None = None,
) -> Any:
    """Simulate many runs of the plant, estimate each as it goes, and check that the boxes hold the truth at every step.

    Simulation and estimation are one compiled program: no record is ever stored. Run i draws from
    ``jax.random.fold_in(key, i)`` and step k of it from that and k alone, so a run can be had again by itself, shorter
    runs are the beginnings of longer ones, and cases that differ in noise bounds or boxes share their random numbers.

    Args:
        observer: from `design_observer`; with a delay as in `sweep`.
        key: a key of `jax.random`, or an integer seed.
        runs: how many; or the numbers of the runs to do, for example ``[17]``.
        steps: measurements T of each run.
        x0: true first states: a box, from which they are drawn as the noise is; one point (n,); or ``x0(key)`` -> (n,).
        d: true unknown input: (T, p), or ``d(key, k, x)`` -> (p,); None is zero.
        noise: bounds from which noise is drawn and which the observer is given, as in `sweep`; may lie on a `grid`.
        reduce: as in `sweep`; "coverage" is always among them. None keeps every box, and the truth as
            ``state_true`` and ``input_true``.
        initial: boxes of x[0] for the observer, (n,) or on a `grid`; where left out, `x0`.
        draw: how noise lies in its bounds: "uniform"; "vertices", a random vertex at every step; or
            ``draw(key, k, x, noise)`` -> (w, v), inside of `noise`, the bounds of step k. With the latter two a run is
            one of the plant as stated without any rounding, where bounds of w and v leave room for that (float64,
            boxes rounded outward, nothing periodic), and then no miss is too small to count. Else one that rounding
            may explain does not: 1e-9 (float32: 1e-3) of the state and of its box, or of the promised width if less.
        u: known inputs (T, m), as in `sweep`.
        on_miss: "raise": end with an error at a box that misses the truth, or a run that breaks its own bounds;
            "record": only count it.
        confidence: of the intervals in the summary.
        batch: as in `sweep`; likewise all that follow.

    Returns:
        ``xarray.Dataset`` as of `sweep`, with the axis "run" last, and with it

        - ``state_coverage``, ``state_miss`` and likewise for inputs; ``first_miss`` (NaN: never);
        - ``broken_at``, ``broken``: first step (NaN: never) at which the simulation left the bounds on which the boxes
            rely (`study.BROKEN`), as a bit mask of what;
        - ``<name>_summary`` of every number above over the runs: see `study.summary`;
        - attribute ``missed``: runs in which a box missed the truth, with the upper end of the confidence interval of
            their share.

    Raises:
        ContainmentLost: a box missed the truth, or a run broke its own bounds. The message says which run and step, and
            how to do that run again. Finished tiles of a store are kept.
        ValueError: shapes or axes do not agree, a number is not legal, or a reduction is unknown.
        MissingExtra: xarray is not installed.

    Source: theory 1, 11 and 13.
    """
    need("xarray", extra="study", purpose="a Monte Carlo study")
    observer = checks.rounded(CALL, observer, rounding)
    checks.refuse_input_model(
        CALL, observer.system, "and drawn inputs are not held against it; simulate inputs that keep to it with "
        "gx.simulate, and use gx.estimate or gx.sweep"
    )  # fmt: skip
    hold = checks.check_on_conflict(CALL, on_conflict)
    if on_miss not in ("raise", "record"):
        raise ValueError(f'{CALL}: `on_miss` must be "raise" or "record", got {on_miss!r}')
    check_confidence(CALL, confidence)
    system = observer.system
    numbers = _numbers(runs)
    key = read_key(CALL, key)
    _check_steps(steps)
    check_longer(CALL, observer, steps, None)
    if not callable(draw) and draw not in ("uniform", "vertices"):
        raise ValueError(f'{CALL}: `draw` must be "uniform", "vertices" or a function, got {draw!r}')

    start, of_point = _first_states(system, x0, draw)
    if initial is None:
        if start is None:
            raise ValueError(f"{CALL}: `x0` is a function; give the box of the observer as `initial`")
        initial = Interval(start, start) if of_point else start
    given = {
        "initial": initial, "y": np.zeros((steps, system.l)), "noise": observer.noise if noise is None else noise,
        "u": u, "length": None, "truth": None,
    }  # fmt: skip
    prepared, dtype = prepare(CALL, system, given)
    if on_miss == "raise" and start is not None:
        _check_start(start, bare(prepared["initial"]), of_point)
    arguments = {name: prepared[name] for name in ("initial", "noise", "u")}
    if start is not None:
        start = jax.tree.map(lambda a: np.asarray(a, dtype), start)
    arguments |= {
        "x0": start,
        "d": None if d is None or callable(d) else _input(d, steps, system.p, dtype),
        "key": np.asarray(jax.random.key_data(key)),
        "run": Axis(RUN, numbers, numbers.astype(np.int64), ""),
    }
    Layout.build(CALL, arguments, RANKS)
    _check_functions(system, key, arguments, dtype, x0, d, draw)
    labels = Labels.of(CALL, system, state_names, input_names, state_units, input_units, time, steps)
    # Boxes that round to nearest hold up to rounding, whole periods round where they are taken off the truth, and what
    # the numbers of a plant are in single precision is not known here.
    # Uniform noise hardly comes near its bounds; to enclose f and g at every step takes a fifth to a half more time.
    exact = dtype == np.float64 and observer.guaranteed and not (system.periodic or system.periodic_states)
    strict = exact and draw != "uniform"
    rows = Simulated(
        steps, str(jax.random.key_impl(key)), d if callable(d) else None, draw, x0 if callable(x0) else None, on_miss,
        strict,
    )  # fmt: skip
    others = (r for r in resolve(CALL, reduce, True) if not isinstance(r, Coverage))
    kept = (TrueRun(),) if reduce is None else ()
    reductions = (*others, *kept, Containment(dtype == np.float64))
    job = Job.plan(CALL, observer, arguments, dtype, RANKS, rows, reductions, hold, batch)
    found = run(job, observer, labels, title, store, resume, progress, client, mesh)
    return summary(found, confidence=confidence)


def _numbers(runs: int | Sequence[int]) -> np.ndarray:
    if isinstance(runs, Interval):
        raise ValueError(
            f"{CALL}: `runs` must be a number of runs, got Interval; are the arguments in the right order?"
        )
    numbers = np.arange(runs) if isinstance(runs, int | np.integer) and runs > 0 else np.asarray(runs)
    if numbers.ndim != 1 or not numbers.size or numbers.dtype.kind not in "iu" or numbers.min() < 0:
        raise ValueError(f"{CALL}: `runs` must be a number of runs, at least 1, or the numbers of runs; got {runs!r}")
    if numbers.max() >= 2**32:
        raise ValueError(f"{CALL}: `runs` must be below 2**32, got {numbers.max()}")
    return numbers.astype(np.uint32)


def _check_steps(steps: Any) -> None:
    if not isinstance(steps, int | np.integer) or steps < 1:
        raise ValueError(f"{CALL}: `steps` must be the number of measurements of a run, at least 1; got {steps!r}")


def _first_states(system: Any, x0: Any, draw: Any) -> tuple[Any, bool]:
    """Box or point of the first states (None where a function draws them), and is it a point."""
    if callable(x0):
        return None, False
    if isinstance(x0, Interval):
        if x0.shape != (system.n,) or not np.isfinite(np.asarray(x0.width)).all():
            raise ValueError(
                f"{CALL}: `x0` must be a finite box of shape ({system.n},), got shape {x0.shape}, widths "
                f"{np.asarray(x0.width)}; for states from elsewhere give a function x0(key)"
            )
        return x0, False
    point = np.asarray(read_array(CALL, "x0", x0), dtype=np.float64)
    if point.shape != (system.n,) or not np.isfinite(point).all():
        raise ValueError(f"{CALL}: `x0` must be a box, a finite point ({system.n},) or a function of a key; got {x0!r}")
    return point, True


def _check_start(x0: Any, initial: Interval, of_point: bool) -> None:
    """Refuse first states outside of the boxes that the observer is given before anything is compiled for them."""
    lower, upper = (x0, x0) if of_point else (np.asarray(x0.lower), np.asarray(x0.upper))
    # The boxes have been rounded outward where they are narrower, the states to nearest: within an ulp of each other.
    kind = initial.lower.dtype
    outside = (lower.astype(kind) < initial.lower) | (upper.astype(kind) > initial.upper)
    if outside.any():
        i = int(np.argwhere(outside)[0][-1])
        low, high = (np.reshape(side, (-1, len(lower)))[:, i] for side in (initial.lower, initial.upper))
        at = f"{lower[i]:g}" if of_point else f"{lower[i]:g} to {upper[i]:g}"
        raise ContainmentLost(
            f"{CALL}: `x0` of x{i + 1} is {at}: the first state lies outside of the initial box, where the boxes "
            f"promise nothing; `initial` is {low.max():g} to {high.min():g} there. Give a larger `initial` (or "
            'on_miss="record", to count such runs)'
        )


def _input(d: Any, steps: int, size: int, dtype: Any) -> np.ndarray:
    d = np.asarray(read_array(CALL, "d", d), dtype)
    if d.shape != (steps, size) or not np.isfinite(d).all():
        raise ValueError(
            f"{CALL}: `d` must be a finite array ({steps}, {size}) or a function d(key, k, x), got shape {d.shape}"
        )
    return d


def _check_functions(system: Any, key: Any, arguments: Any, dtype: Any, x0: Any, d: Any, draw: Any) -> None:
    """The user's functions must take what they are given and return what is needed; nothing is computed."""
    k, x = jnp.int32(0), jax.ShapeDtypeStruct((system.n,), dtype)
    noise = jax.tree.map(lambda size: jax.ShapeDtypeStruct((size,), dtype), Noise.unchecked(
        Interval.unchecked(system.n, system.n), Interval.unchecked(system.l, system.l)
    ))  # fmt: skip
    for name, function, given, sizes in (
        ("x0(key)", x0, (key,), (system.n,)),
        ("d(key, k, x)", d, (key, k, x), (system.p,)),
        ("draw(key, k, x, noise)", draw, (key, k, x, noise), (system.n, system.l)),
    ):
        if not callable(function):
            continue
        expected = " and ".join(f"({size},)" for size in sizes)
        try:
            shapes = [np.shape(leaf) for leaf in jax.tree.leaves(jax.eval_shape(function, *given))]
        except Exception as error:
            raise ValueError(
                f"{CALL}: {name} must be a function that JAX can trace and return {expected}. {explanation(error)}"
            ) from error
        if shapes != [(size,) for size in sizes]:
            raise ValueError(f"{CALL}: {name} must return {expected}, got {' and '.join(map(str, shapes))}")
