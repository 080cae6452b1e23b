"""Tables that repeat themselves (`jnp.interp` with a period): functions of the angle of a shaft, of the time of day.

An interval is moved by whole periods until it begins in the first one, [0, P). Where it then ends in the first or the
second one, what lies in either is bounded by the table on [0, P]. Longer intervals see all of it.

Rounding: where the moved interval begins and ends is off by less than ``4 eps (|t| + |k P|)``. Both ends of the table
meet up to a gap that rounding has left in the model's own knots; bounds are widened for it, as in `piecewise`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.rules.piecewise import continuous_to
from gsisio_jax.inclusion.rules.tables import PiecewiseLinear, agree, looked_up, whole
from gsisio_jax.inclusion.rules.univariate import hull_of
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, choose


class _Moved(NamedTuple):
    """An interval in the first period and, where it goes on, its rest in the second one.

    Attributes:
        first: where it lies in [0, P].
        rest: from 0 on, where it goes on; else `first` once more.
        goes_on: does it?
        shift: by how much it was moved.
        usable: is that so? Else `first` is all of a period: the interval is too long, or nobody knows where it lies.
    """

    first: Interval
    rest: Interval
    goes_on: Any
    shift: Any
    usable: Any


@dataclass(frozen=True, eq=False)
class PeriodicTable:
    """A function of one variable (`univariate.apply`).

    Attributes:
        table: on [0, period], and from the last knot before to the first one behind.
        period: positive.
        gap: bound of the difference of its values at both ends.
    """

    table: PiecewiseLinear
    period: Any
    gap: Any

    def _moved(self, a: Any, b: Any) -> _Moved:
        P, finite = self.period, jnp.isfinite(a) & jnp.isfinite(b)
        a, b = (jnp.where(finite, side, 0) for side in (a, b))
        shift = jax.lax.stop_gradient(jnp.floor(a / P)) * P
        low = rounding.lowered(a - shift, abs(a) + abs(shift), 4.0)
        high = rounding.raised(b - shift, abs(b) + abs(shift), 4.0)
        # The table goes on a little beyond both ends, which is where rounding may lead.
        usable = finite & (low >= self.table.knots[0]) & (high - P <= self.table.knots[-1])
        low, high = jnp.where(usable, low, 0), jnp.where(usable, high, P)
        goes_on, first = high > P, Interval.unchecked(low, jnp.minimum(high, P))
        rest = Interval.unchecked(jnp.zeros_like(low), rounding.up(high - P))
        return _Moved(first, choose(goes_on, rest, first), goes_on, shift, usable)

    def _hull(self, bounds: Callable[[Any, Any], Interval], moved: _Moved) -> Interval:
        return hull_of([bounds(part.lower, part.upper) for part in (moved.first, moved.rest)])

    def _wider(self, found: Interval) -> Interval:
        slip = 3 * self.gap  # two for derivatives, one for what of the table is beyond its ends
        return Interval.unchecked(rounding.down(found.lower - slip), rounding.up(found.upper + slip))

    @whole
    def range(self, a: Any, b: Any) -> Interval:
        return self._wider(self._hull(self.table.range, self._moved(a, b)))

    @whole
    def derivative(self, a: Any, b: Any) -> Interval:
        return self._hull(self.table.derivative, self._moved(a, b))

    def line(self, a: Any, b: Any, natural: Interval) -> tuple[Any, Interval]:
        s, rest, usable = self._line(a, b)
        return s, choose(usable, rest, natural)

    @whole
    def _line(self, a: Any, b: Any) -> tuple[Any, Interval, Any]:
        """The slope is that of the secant, or of the table where the interval is short."""
        moved = self._moved(a, b)
        low, high = moved.first.lower, jnp.where(moved.goes_on, moved.rest.upper, moved.first.upper)
        length = jnp.where(moved.goes_on, high + (self.period - low), high - low)
        wide = length > 1e-3 * self.period
        slopes = self._hull(self.table.derivative, moved)
        middle = 0.5 * slopes.lower + 0.5 * slopes.upper
        rise = self.table._at(high)[0] - self.table._at(low)[0]
        s = jnp.where(wide, rise / jnp.where(wide, length, 1), middle)
        usable = moved.usable & jnp.isfinite(s)
        s = jnp.where(usable, s, 0)

        # phi(x) - s x is the same of t = x - shift, less s shift; in the second period t = x - shift - P.
        def part(box: Interval, shift: Any) -> Interval:
            found, by = self.table._extremes(box.lower, box.upper, s), s * shift
            return Interval.unchecked(
                rounding.lowered(found.lower - by, abs(found.lower) + abs(by), 4.0),
                rounding.raised(found.upper - by, abs(found.upper) + abs(by), 4.0),
            )

        further = jnp.where(moved.goes_on, moved.shift + self.period, moved.shift)
        return s, self._wider(hull_of([part(moved.first, moved.shift), part(moved.rest, further)])), usable


def periodic(eqn: Any, knots: Any, values: Any, others: Any) -> PeriodicTable | None:
    """The function that a call of ``jnp.interp`` with a period stands for, None where it is something else: it is
    compared with the body of the call in the middle of, at and beside all knots, in five periods."""
    knots, values = np.asarray(knots), np.asarray(values)
    if len(others) != 1 or np.shape(others[0]) != () or knots.ndim != 1 or not np.isfinite([knots, values]).all():
        return None
    period = abs(np.asarray(others[0], knots.dtype)[()])
    if not 0 < period < np.inf:
        return None
    # As jax.numpy computes them: a constant expression of the model is the number that it evaluates to.
    places = np.mod(knots, period)
    order = np.argsort(places, kind="stable")
    places, heights = places[order], values[order]
    around = np.concatenate([places[-1:] - period, places, places[:1] + period])
    if not (np.diff(around) > 0).all():
        return None
    table = PiecewiseLinear.of(around, np.concatenate([heights[-1:], heights, heights[:1]]))
    ends, sizes = table.values_at(np.array([0, period], knots.dtype))
    eps = np.finfo(knots.dtype).eps
    steepest = np.abs([table.low[1], table.high[1], table.low[-2], table.high[-2]]).max()
    gap = abs(ends[1] - ends[0]) + eps * (8 * sizes.sum() + 2 * period * steepest)
    if not gap <= continuous_to(knots.dtype) * max(abs(values).max(), 1):
        return None
    first = np.concatenate(
        [places, 0.5 * around[1:] + 0.5 * around[:-1], *(places + d * period for d in (-1e-3, 1e-3))]
    )
    points = np.concatenate([first + k * period for k in range(-2, 3)])
    points, theirs = looked_up(eqn, knots, values, others, points)
    ours = table.values_at(np.mod(points, period).astype(knots.dtype))[0]
    return PeriodicTable(table, period, gap) if agree(ours, theirs, values, points.dtype) else None
