"""`tightness`: widths of boxes over those of the hull of all states that agree with the record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from gsisio_jax.interval.box import Interval
from gsisio_jax.observer.checks import AnyObserver, prepare
from gsisio_jax.observer.estimation import estimate
from gsisio_jax.observer.prediction_step import PredictionObserver
from gsisio_jax.observer.rounding_constants import slopes_of
from gsisio_jax.plant.system import Noise, System
from gsisio_jax.scalar.numpy_program import numpy_function

if TYPE_CHECKING:
    from gsisio_jax.study.record_program import Affine, Sides, Stretch

STEPS = 10


@dataclass(frozen=True)
class Tightness:
    """How near to the hull the boxes of a record are. Print it; draw it with `plot`.

    Attributes:
        steps: the steps k that were looked at, (K,).
        lower, upper: the observer's boxes of x[k], (K, n), units of the states.
        hull_lower, hull_upper: the hull of all x[k] that agree with the record, (K, n); NaN where no run does
            (`exact`), or where none was found.
        exact: f and g are affine on the state bounds, and the hull is exact. Otherwise it is that of the runs that
            were found: a lower bound of the hull's width, so that `ratio` is an upper bound of what is left to gain.
        horizon: number of steps that the hull looks back, or None for all.
    """

    steps: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    hull_lower: np.ndarray
    hull_upper: np.ndarray
    exact: bool
    horizon: int | None

    @property
    def width(self) -> np.ndarray:
        """Widths of the boxes, (K, n)."""
        return self.upper - self.lower

    @property
    def hull_width(self) -> np.ndarray:
        """Widths of the hull, (K, n): where not `exact`, lower bounds of them."""
        return self.hull_upper - self.hull_lower

    @property
    def ratio(self) -> np.ndarray:
        """Width of the box over that of the hull, (K, n); 1 where both are 0 or both infinite."""
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = self.width / self.hull_width
        same = (self.width == self.hull_width) & ((self.width == 0) | np.isinf(self.width))
        return np.where(same, 1.0, ratio)

    @property
    def mean(self) -> np.ndarray:
        """Mean ratio of every state over the steps that have one, (n,)."""
        return self._over_steps(np.mean)

    @property
    def worst(self) -> np.ndarray:
        """Largest ratio of every state, (n,)."""
        return self._over_steps(np.max)

    def _over_steps(self, of: Any) -> np.ndarray:
        return np.array([of(row[~np.isnan(row)]) if not np.isnan(row).all() else np.nan for row in self.ratio.T])

    @property
    def against(self) -> str:
        """What the boxes are compared with, in words."""
        over = "the whole record" if self.horizon is None else f"the last {self.horizon} steps and the box before"
        return f"the exact hull of {over}" if self.exact else f"the runs found that agree with {over}"

    def __str__(self) -> str:
        lines = [
            f"Widths of boxes over those of {self.against}, {len(self.steps)} steps from {self.steps[0]} to "
            f"{self.steps[-1]}",
            f"  {'state':<6}{'mean':>11}{'worst':>11}{'at step':>9}{'mean width':>13}{'of the hull':>13}",
        ]
        for i, ratio in enumerate(self.ratio.T):
            known = ~np.isnan(ratio)
            if not known.any():
                lines.append(f"  {f'x{i + 1}':<6}{'-':>11}{'-':>11}{'-':>9}{'-':>13}{'-':>13}")
                continue
            at = self.steps[known][ratio[known].argmax()]
            width, hull = (w[known, i].mean() for w in (self.width, self.hull_width))
            lines.append(
                f"  {f'x{i + 1}':<6}{self.mean[i]:>11.4g}{self.worst[i]:>11.4g}{at:>9}{width:>13.4g}{hull:>13.4g}"
            )
        if not self.exact:
            lines.append(
                "  f or g is not affine: the hull is at least as wide as these runs; no more than the ratio can be gained"
            )
        if (none := self.steps[np.isnan(self.ratio).any(axis=1)]).size:
            said = "agrees with the record" if self.exact else "was found"
            lines.append(f"  no run {said} at steps {', '.join(map(str, none))}")
        return "\n".join(lines)

    def plot(self, ax: Any = None) -> Any:
        """Draw the ratio of every state over the steps: `gsisio_jax.plot.tightness`."""
        from gsisio_jax.plot import tightness

        return tightness(self, ax)


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
    known state and input bounds as stated, whose measurements are y[0..k]; no observer can be narrower. Where f and g
    are affine in x (for the known inputs at hand, on the state bounds) two linear programs a state and step give it up
    to the tolerance of HiGHS (1e-10). Otherwise runs as far apart as possible are looked for, and every one is played
    through the plant and checked against the record (to 1e-12 of the size of a measurement): their hull is a *lower
    bound* of the hull, and the ratio an *upper bound* of what is left to gain.

    Args:
        observer: from `design_observer`; in the prediction form x[k] is bounded from y[0..k-1], and so is the hull.
        initial: box of x[0] before y[0], (n,).
        y: measurements (T, l); NaN marks a missing entry. One record.
        u: known inputs (T, m); needed where m > 0.
        noise: bounds at run time, also varying with time; None takes those of the design.
        steps: the steps to look at, negative ones from the end; None: ten, spread evenly over the record, with the
            last. A step costs 2 n linear programs of all rows before it, several times that for nonlinear plants.
        horizon: look back so many steps only, from the observer's own box then; None: the whole record. This hull is
            no narrower than that of the record, and the ratio says what a longer window would bring at most.

    Returns:
        `Tightness`. Rows in which nothing agrees with the record (a conflict) are NaN.

    Raises:
        ValueError: as `estimate`; a step is not in the record, the horizon is below 1, or the system is periodic.

    >>> import gsisio_jax as gx
    >>> turn = 0.95 * np.array([[0.955, -0.296], [0.296, 0.955]])
    >>> system = gx.System(lambda x: turn @ x, lambda x: x, G=np.zeros((2, 0)), H=np.zeros((2, 0)))
    >>> noise = gx.Noise(w=gx.Interval.symmetric([0.02, 0.02]), v=gx.Interval.symmetric([0.05, 2.0]))
    >>> observer = gx.design_observer(system, noise, gx.Interval.symmetric([5.0, 5.0]), missing=False, sweeps=1)
    >>> y = 0.03 * np.sin(np.arange(40.0)).reshape(20, 2)
    >>> found = gx.tightness(observer, gx.Interval.symmetric([3.0, 3.0]), y, steps=[9, 19])
    >>> print(found)
    Widths of boxes over those of the exact hull of the whole record, 2 steps from 9 to 19
      state        mean      worst  at step   mean width  of the hull
      x1              1          1        9          0.1          0.1
      x2          5.909      7.439        9        1.671       0.2833
    """
    call = "tightness"
    _, y_ready, u_ready, bounds, _ = prepare(call, observer, initial, y, u, noise, rows=True)
    system = observer.system
    if system.periodic or system.periodic_states:
        raise ValueError(
            f"{call}: the system is periodic, so what agrees with the record is no convex set; unwrap the outputs "
            "(numpy.unwrap) and leave `periodic` and `periodic_states` out of the System"
        )
    rows = len(y_ready)
    chosen = _chosen(steps, rows)
    if horizon is not None and (isinstance(horizon, bool) or int(horizon) != horizon or horizon < 1):
        raise ValueError(f"{call}: `horizon` must be a number of steps of at least 1, or None, got {horizon!r}")
    boxes = _sides(estimate(observer, initial, y, u, noise).state)
    record = _record(system, y if np.ndim(y) == 2 else y_ready, u_ready, bounds)
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
    from gsisio_jax.study.record_program import Sides

    lower, upper = (np.asarray(side, np.float64) for side in (box.lower, box.upper))
    return Sides(lower, upper) if shape is None else Sides(np.broadcast_to(lower, shape), np.broadcast_to(upper, shape))


def _record(system: System, y: Any, u: Any, noise: Noise) -> Stretch:
    """The whole record, with the state bounds for all of its rows."""
    from gsisio_jax.study.record_program import Stretch

    G, H, B, D, y, u = (np.asarray(a, np.float64) for a in (system.G, system.H, system.B, system.D, y, u))
    states = (len(y), system.n)
    return Stretch(
        G, H, y - u @ D.T, u @ B.T, u, _sides(noise.w, states), _sides(noise.v, y.shape),
        _sides(system.state_bounds, states), _sides(system.input_bounds),
    )  # fmt: skip


def affine_plant(system: System, u: np.ndarray) -> Affine | None:
    """f and g at every row of u (T, m), if they are affine in x on the state bounds; else None."""
    from gsisio_jax.study.record_program import Affine

    bounds = system.state_bounds
    slopes_on = slopes_of(system, np.zeros((0, system.l)), Interval(u.min(axis=0), u.max(axis=0)))
    slopes = [slopes_on(bounds)]
    if not slopes[0].affine:
        if not system.takes_u:
            return None
        slopes = []
        for row in u:
            slopes.append(slopes_on(bounds, Interval(row, row)))
            if not slopes[-1].affine:
                return None
    slopes = slopes * (len(u) // len(slopes))
    A, C = (np.array([getattr(s, name) for s in slopes]) for name in ("F", "E"))
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
    from gsisio_jax.study.record_program import Sides, exact_hull

    longest = int(chosen[-1]) + 1 if horizon is None else min(horizon, int(chosen[-1])) + 1
    runs = None if affine is not None else AgreeingRuns(observer.system, longest)
    found = []
    for k in chosen:
        first = 0 if horizon is None else max(k - horizon, 0)
        begin = boxes.rows(first) if first else initial
        stretch = _cut(record, first, k, begin, last=not isinstance(observer, PredictionObserver))
        if affine is not None:
            found.append(exact_hull(stretch, affine.rows(slice(first, k + 1))))
        elif runs is not None:
            found.append(runs.hull(stretch, _met(stretch.state, boxes.rows(slice(first, k + 1)))))
    return Sides(*(np.array(side) for side in zip(*found, strict=True)))


def _met(a: Sides, b: Sides) -> Sides:
    """The intersection, and the first where they miss each other or where a side of the second is NaN."""
    from gsisio_jax.study.record_program import Sides

    lower, upper = np.fmax(a.lower, b.lower), np.fmin(a.upper, b.upper)
    return Sides(np.where(lower <= upper, lower, a.lower), np.where(lower <= upper, upper, a.upper))


def _cut(record: Stretch, first: int, last_row: int, begin: Sides, last: bool) -> Stretch:
    """Rows of a record, begun in a box; without the last measurement where that does not count."""
    from gsisio_jax.study.record_program import Sides, Stretch

    rows = slice(first, last_row + 1)
    y = record.y[rows].copy()
    if not last:
        y[-1] = np.nan
    state = Sides(*(side.copy() for side in record.state.rows(rows)))
    state.lower[0], state.upper[0] = np.maximum(state.lower[0], begin.lower), np.minimum(state.upper[0], begin.upper)
    return Stretch(
        record.G,
        record.H,
        y,
        record.push[rows],
        record.u[rows],
        record.w.rows(rows),
        record.v.rows(rows),
        state,
        record.input,
    )
