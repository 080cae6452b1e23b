"""`tightness`: widths of boxes over those of the hull of all states that agree with the record."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from gsisio_jax._calls import named_arguments
from gsisio_jax._room import with_room
from gsisio_jax.interval.box import Interval
from gsisio_jax.observer.checks import AnyObserver, prepare, refuse_input_model
from gsisio_jax.observer.delayed import DelayedObserver
from gsisio_jax.observer.enclosures import slopes_of
from gsisio_jax.observer.estimation import estimate
from gsisio_jax.observer.prediction_step import PredictionObserver
from gsisio_jax.observer.tolerant import TolerantObserver
from gsisio_jax.plant.system import Noise, System
from gsisio_jax.scalar.numpy_program import numpy_function
from gsisio_jax.study.stretch import Affine, Sides, Stretch
from gsisio_jax.study.tightness_result import Tightness

STEPS = 10


@with_room
@named_arguments
def tightness(
    observer: AnyObserver,
    initial: Interval,
    y: Any,
    u: Any = None,
    noise: Noise | None = None,
    *,
    steps: Sequence[int] | None = None,
    horizon: int | None = None,
) -> Tightness:
    """How much narrower any observer could be on this record: widths of boxes over those of the exact hull.

    The hull of x[k] is the smallest box of all states that some run of the plant has at k, with noise, initial state,
    known state and input bounds as stated, whose measurements are y[0..k]; no observer can be narrower. (For observers
    with a delay of L: y[0..k+L].) Where f and g are affine in x (for the known inputs at hand, on the state bounds) two
    linear programs a state and step give it up to the tolerance of HiGHS (1e-10). Otherwise runs as far apart as
    possible are looked for, and every one is played through the plant and checked against the record (to 1e-12 of the
    size of a measurement): their hull is a *lower bound* of the hull, and the ratio an *upper bound* of what is left to
    gain.

    Args:
        observer: from `design_observer`; in the prediction form x[k] is bounded from y[0..k-1], and so is the hull.
        initial: box of x[0] before y[0], (n,).
        y: measurements (T, l); NaN marks a missing entry. One record.
        u: known inputs (T, m); needed where m > 0.
        noise: bounds at run time, also varying with time; None takes those of the design.
        steps: the steps to look at, negative ones from the end; None: ten, spread evenly over the record, with the
            last. A step costs 2 n linear programs of all rows before it, several times that for nonlinear plants.
        horizon: look back so many steps only, from the observer's own box then; None: the whole record. This hull is
            no narrower than that of the record; the ratio says what an exact window of that length would bring.

    Returns:
        `Tightness`. Rows in which nothing agrees with the record (a conflict) are NaN.

    Raises:
        ValueError: as `estimate`; a step is not in the record, the horizon is below 1, the system is periodic, or the
            observer tolerates wrong outputs.
        RuntimeError: HiGHS fails on a program.

    >>> import gsisio_jax as gx
    >>> turn = 0.95 * np.array([[0.955, -0.296], [0.296, 0.955]])
    >>> system = gx.System(lambda x: turn @ x, lambda x: x, G=np.zeros((2, 0)), H=np.zeros((2, 0)))
    >>> noise = gx.Noise(w=gx.Interval.symmetric([0.02, 0.02]), v=gx.Interval.symmetric([0.05, 2.0]))
    >>> observer = gx.design_observer(system, noise, gx.Interval.symmetric([5.0, 5.0]), missing=False, window=1)
    >>> y = 0.03 * np.sin(np.arange(40.0)).reshape(20, 2)
    >>> found = gx.tightness(observer, gx.Interval.symmetric([3.0, 3.0]), y, steps=[9, 19])
    >>> print(found)
    Widths of boxes over those of the exact hull of the whole record, 2 steps from 9 to 19
      state        mean      worst  at step   mean width  of the hull
      x1              1          1        9          0.1          0.1
      x2          5.909      7.439        9        1.671       0.2833
    """
    call = "tightness"
    u_ready = prepare(call, observer, initial, y, u, noise, rows=True)[2]
    system = observer.system
    if system.periodic or system.periodic_states:
        raise ValueError(
            f"{call}: the system is periodic, so what agrees with the record is no convex set; unwrap the outputs "
            "(numpy.unwrap) and leave `periodic` and `periodic_states` out of the System"
        )
    if isinstance(observer, TolerantObserver):
        raise ValueError(
            f"{call}: `observer` tolerates wrong outputs ({observer.tolerate} a step), and the exact hull believes "
            "every output; give one of a design with tolerate=0, and a record without faults"
        )
    refuse_input_model(call, system, "which the exact hull does not know, so boxes may be smaller; leave it out")
    chosen = _chosen(steps, len(u_ready))
    if horizon is not None and (isinstance(horizon, bool) or int(horizon) != horizon or horizon < 1):
        raise ValueError(f"{call}: `horizon` must be a number of steps of at least 1, or None, got {horizon!r}")
    boxes = _sides(estimate(observer, initial, y, u, noise).state)
    record = _record(system, y, u_ready, observer.noise if noise is None else noise)
    affine = affine_plant(system, record.u)
    found = _hulls(observer, record, affine, boxes, _sides(initial), chosen, horizon)
    return Tightness(chosen, *boxes.rows(chosen), *found, affine is not None, horizon)


def _chosen(steps: Sequence[int] | None, rows: int) -> np.ndarray:
    if rows == 0:
        raise ValueError("tightness: the record has no rows")
    if steps is None:
        return np.arange(rows) if rows <= STEPS else np.linspace(0, rows - 1, STEPS + 1).round().astype(int)[1:]
    found = np.asarray(steps)
    if found.ndim != 1 or not found.size or found.dtype.kind not in "iu":
        raise ValueError(f"tightness: `steps` must be a list of integers, got {steps!r}")
    if ((found < -rows) | (found >= rows)).any():
        raise ValueError(f"tightness: `steps` must lie in the record of {rows} rows, got {found.tolist()}")
    return np.unique(np.where(found < 0, found + rows, found))


def _sides(box: Interval, shape: tuple[int, ...] | None = None) -> Sides:
    lower, upper = (np.asarray(side, np.float64) for side in (box.lower, box.upper))
    return Sides(lower, upper) if shape is None else Sides(np.broadcast_to(lower, shape), np.broadcast_to(upper, shape))


def _record(system: System, y: Any, u: Any, noise: Noise) -> Stretch:
    """The whole record, with the state bounds for all of its rows."""
    G, H, B, D, y, u = (np.asarray(a, np.float64) for a in (system.G, system.H, system.B, system.D, y, u))
    states = (len(y), system.n)
    return Stretch(
        G, H, y - u @ D.T, u @ B.T, u, _sides(noise.w, states), _sides(noise.v, y.shape),
        _sides(system.state_bounds, states), _sides(system.input_bounds),
    )  # fmt: skip


def affine_plant(system: System, u: np.ndarray) -> Affine | None:
    """f and g at every row of u (T, m), if they are affine in x on the state bounds; else None."""
    bounds = system.state_bounds
    slopes_on = slopes_of(system, np.zeros((0, system.l)), Interval(u.min(axis=0), u.max(axis=0)))
    slopes, which = [slopes_on(bounds)], np.zeros(len(u), int)
    if not slopes[0].affine and system.takes_u:
        different, which = np.unique(u, axis=0, return_inverse=True)
        slopes = []
        for row in different:
            slopes.append(slopes_on(bounds, Interval(row, row)))
            if not slopes[-1].affine:
                break
    if not slopes[-1].affine:
        return None
    A, C = (np.array([getattr(one, name) for one in slopes])[which] for name in ("F", "E"))
    x = np.tile(_sides(bounds).clip(np.zeros(system.n)), (len(u), 1))

    def both(x: Any, u: Any) -> tuple[Any, Any]:
        return system.dynamics(x, u), system.measurement(x, u)

    with jax.enable_x64(True):
        f, g = numpy_function(jax.vmap(both), x, u)(x, u)
    return Affine(A, f - np.einsum("sij,sj->si", A, x), C, g - np.einsum("sij,sj->si", C, x))


def _hulls(
    observer: AnyObserver,
    record: Stretch,
    affine: Affine | None,
    boxes: Sides,
    initial: Sides,
    chosen: np.ndarray,
    horizon: int | None,
) -> Sides:
    from gsisio_jax.study.agreeing_runs import AgreeingRuns
    from gsisio_jax.study.record_program import exact_hull

    delay = observer.delay if isinstance(observer, DelayedObserver) else 0
    longest = int(chosen[-1]) if horizon is None else min(horizon, int(chosen[-1]))
    runs = None if affine is not None else AgreeingRuns(observer.system, longest + delay + 1)
    found = []
    for k in chosen:
        first = 0 if horizon is None else max(k - horizon, 0)
        begin = boxes.rows(first) if first else initial
        last = min(k + delay, record.length - 1)
        stretch = record.cut(first, last, begin, measured=not isinstance(observer, PredictionObserver))
        if affine is not None:
            found.append(exact_hull(stretch, affine.rows(slice(first, last + 1)), k - first))
        elif runs is not None:
            found.append(runs.hull(stretch, _met(stretch.state, boxes.rows(slice(first, last + 1))), k - first))
    return Sides(*(np.array(side) for side in zip(*found, strict=True)))


def _met(a: Sides, b: Sides) -> Sides:
    """The intersection, and the first where they miss each other or where a side of the second is NaN."""
    lower, upper = np.fmax(a.lower, b.lower), np.fmin(a.upper, b.upper)
    return Sides(np.where(lower <= upper, lower, a.lower), np.where(lower <= upper, upper, a.upper))
