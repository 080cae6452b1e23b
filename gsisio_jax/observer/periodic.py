"""Which multiple of its period a logged angle stands for, chosen before anything else is made of it (theory 8.4).

A step of a plant with periodic outputs contracts twice: with these entries of y[k] missing, which gives a box of x[k]
and so a range of what is measured; then with the only multiples that lie in that range. What several multiples or the
rounding of the period leave open goes into the noise bounds of that entry, so all that follows, and the next step, see
an ordinary measurement.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.interval import devices, rounding
from gsisio_jax.interval.box import Interval, add, choose, is_concrete, nan_to_unbounded
from gsisio_jax.interval.direct import where
from gsisio_jax.interval.image import image, plain_image, widened_for_sums
from gsisio_jax.observer.contractors import affine_rows, contract_affine_rows
from gsisio_jax.observer.domain import Domain
from gsisio_jax.observer.maps import Maps
from gsisio_jax.observer.measurement import output_box, point, typed
from gsisio_jax.observer.status import Source, Status
from gsisio_jax.observer.types import Carry, StepOutput
from gsisio_jax.plant.periodic import columns, moved_by
from gsisio_jax.plant.system import Noise, System

MOST_TURNS = 2.0**20
"""Beyond so many periods a measurement counts as missing."""
_FAR = 64  # periods from 0 at which a periodic state is moved back to it
_EDGE = 64.0  # units in the last place by which a record may miss its own noise bounds

Contract = Callable[[Maps, Carry, Any, Any, Noise], tuple[Domain, Domain, Interval]]
Alone = Callable[[Maps, Carry, Any, Any, Noise], Domain]


class Unwrapped(NamedTuple):
    """A measurement on the real line.

    Attributes:
        y: (l,), NaN where it says nothing.
        noise: bounds that hold for that y.
        open: (r,) for every periodic output: more than one multiple fits.
        slack: (l,) by how much the nearest multiple misses (negative) where none fits, else inf.
    """

    y: Any
    noise: Noise
    open: Any
    slack: Any

    def unless(self, mask: Any, other: Unwrapped) -> Unwrapped:
        """The other one where the mask holds."""
        return jax.tree.map(lambda mine, its: where(mask, its, mine), self, other)


def unwrap(system: System, ranges: Interval, y: Any, u: Any, noise: Noise) -> Unwrapped:
    """Choose the multiples of the periodic outputs.

    Args:
        system: the plant.
        ranges: (r,) of the periodic entries of g(x[k]).
        y: (l,) as logged.
        u: (m,).
        noise: bounds of v[k].

    Source: theory 8.4.
    """
    rows, period = [j for j, _ in system.periodic], _periods(system, y.dtype)
    missing, target = ~jnp.isfinite(_at(y, rows)), _target(system, ranges, u, noise)
    seen = where(missing, 0, _at(y, rows))
    first, last, near, usable = _multiples(seen, target, period)
    usable = usable & ~missing
    # Where none fits, the nearest one: what it contradicts, and by how much, is what a reader wants to know.
    none = usable & (last < first)
    first, last = (where(usable, where(none, near, k), 0) for k in (first, last))
    middle, half = 0.5 * (first + last) * period, 0.5 * (last - first) * period
    turned, still = seen + middle, (first == 0) & (last == 0)
    radius = half
    if rounding.outward():  # the period, products and sums: less than five ulps of what enters
        radius = half + rounding.error(abs(seen) + abs(middle) + half, 8.0)
    radius = where(still, 0, radius)
    v = noise.v
    wider = add(Interval.unchecked(_at(v.lower, rows), _at(v.upper, rows)), Interval.unchecked(-radius, radius))
    sides = (
        _with(side, rows, where(still, _at(side, rows), its))
        for side, its in ((v.lower, wider.lower), (v.upper, wider.upper))
    )
    slack = jnp.minimum(target.upper - turned, turned - target.lower)
    return Unwrapped(
        _with(y, rows, where(usable, turned, jnp.nan)),
        Noise.unchecked(noise.w, Interval.unchecked(*sides)),
        ~missing & (~usable | (first < last)),
        _with(jnp.full_like(y, jnp.inf), rows, where(none, slack, jnp.inf)),
    )


def _target(system: System, ranges: Interval, u: Any, noise: Noise) -> Interval:
    """Box (r,) of ``g(x) + D u + H d + v`` in the periodic entries."""
    rows = [j for j, _ in system.periodic]
    v = Interval.unchecked(_at(noise.v.lower, rows), _at(noise.v.upper, rows))
    parts = [ranges, v]
    if system.m:
        parts.append(image(jnp.asarray(_at(system.D, rows), ranges.dtype), point(u)))
    if system.p and not (is_concrete(system.H) and not np.asarray(system.H)[np.array(rows)].any()):
        parts.append(image(jnp.asarray(_at(system.H, rows), ranges.dtype), typed(system.input_bounds, ranges.dtype)))
    return nan_to_unbounded(add(*parts))


def _multiples(seen: Any, target: Interval, period: np.ndarray) -> tuple[Any, Any, Any, Any]:
    """First and last whole number k for which ``seen + k period`` may lie in the target, the one next to its middle,
    and whether they are known and not too large; constants for gradients."""
    seen, low, high = jax.lax.stop_gradient((seen, target.lower, target.upper))
    finite = jnp.isfinite(low) & jnp.isfinite(high)
    low, high = where(finite, low, 0), where(finite, high, 0)
    eps = float(jnp.finfo(seen.dtype).eps)
    edge = (abs(seen) + abs(low) + abs(high)) * np.dtype(seen.dtype).type(_EDGE * eps)
    first, last = rounding.down((low - edge - seen) / period, 6.0), rounding.up((high + edge - seen) / period, 6.0)
    near = jnp.round(0.5 * (first + last))
    first, last = jnp.ceil(first), jnp.floor(last)
    return first, last, near, finite & (abs(first) <= MOST_TURNS) & (abs(last) <= MOST_TURNS)


def ranges_on(maps: Maps, box: Interval, u: Any) -> Interval:
    """Range (r,) of the periodic entries of g on a box of x."""
    system, states = maps.observer.system, maps.states(box)
    rows = maps.rows(np.eye(system.n + system.l)[[system.n + j for j, _ in system.periodic]])
    return nan_to_unbounded(rows.bounds(states, maps.bounds(states, box, u)))


def contract(
    once: Contract, alone: Alone, maps: Maps, carry: Carry, y: Any, u: Any, noise: Noise, hold: bool
) -> tuple[Domain, Domain, Interval, Unwrapped]:
    """What `once`, a contraction with a given y[k], says of x[k] and d[k-1] where entries of y[k] are periodic.

    `alone` gives what y[k] and the state bounds say.

    Returns:
        The box of x[k]; the one to go on from after a conflict; the box of d[k-1]; and y[k] on the real line, as it
        belongs to the one of both boxes that will be used.
    """
    system, lost = maps.observer.system, jnp.full_like(y, jnp.nan)
    rows = [j for j, _ in system.periodic]

    def turn(seen: Unwrapped) -> tuple[Unwrapped, Any]:
        found, fallback, d = once(maps, carry, seen.y, u, seen.noise)
        return unwrap(system, ranges_on(maps, found.box, u), y, u, noise), (seen, found, fallback, d)

    unknown = Unwrapped(_with(y, rows, lost[: len(rows)]), noise, jnp.zeros(len(rows), bool), jnp.full_like(y, jnp.inf))
    if maps.expansion is None:  # large: compiled once for both
        _ = maps.free, maps.remainder  # made here: they are kept, and what a loop has traced is of no use behind it
        turns = devices.scan(lambda seen, _: turn(seen), jax.tree.map(jnp.asarray, unknown), None, length=2)[1]
        (_, _, fallback, _), (now, domain, _, d) = (jax.tree.map(lambda leaf, i=i: leaf[i], turns) for i in range(2))
    else:
        now, (_, _, fallback, _) = turn(unknown)
        domain, _, d = once(maps, carry, now.y, u, now.noise)
    domain = domain.record_margin(now.slack, Source.PERIODIC)
    if hold:
        fallback, _, _ = once(maps, carry, lost, u, noise)
        then = Unwrapped(lost, noise, jnp.zeros_like(now.open), jnp.full_like(y, jnp.inf))
    else:
        then = unwrap(system, ranges_on(maps, fallback.box, u), y, u, noise)
        fallback = alone(maps, carry, then.y, u, then.noise)
        fallback = fallback.record_margin(then.slack, Source.PERIODIC)
    conflict = domain.conflict
    chosen = now.unless(conflict, then)
    if system.periodic_states:
        unused = conflict & (jnp.asarray(hold) | fallback.conflict)
        box = choose(conflict, fallback.box, domain.box)
        box, chosen = settled(maps, box, chosen, where(unused, lost, y), u, noise)
        domain, fallback = domain.with_box(box), fallback.with_box(box)
    return domain, fallback, d, chosen


def settled(maps: Maps, box: Interval, chosen: Unwrapped, y: Any, u: Any, noise: Noise) -> tuple[Interval, Unwrapped]:
    """Choose the multiples of periodic states anew where they are open: one period around what is measured.

    Any box as long as the period holds the state up to a multiple, wherever it lies; so it is laid around the value
    that a measured angle gives, and the other multiples of the measurement are half a period away. Where the state is
    known, but far from 0, its box is moved back there.

    Args:
        maps: of the observer.
        box: of x[k].
        chosen: y[k] on the real line for that box.
        y: (l,) as logged; NaN where it is missing or not believed.
        u: (m,).
        noise: bounds of v[k].

    Returns:
        The box, and y[k] on the real line for it.
    """
    system, dtype = maps.observer.system, y.dtype
    n, turns = system.n, np.array(system.turns).reshape(len(system.periodic), -1)
    period = columns(system.periodic_states, n).astype(dtype)
    tied = np.zeros((n, len(system.periodic)), int)
    tied[[i for i, _ in system.periodic_states]] = turns.T
    free = (box.width >= period) & np.isfinite(period) | ((tied != 0) & chosen.open).any(-1)
    far = ~free & (abs(box.center) > _FAR * period)
    center = _around(maps, box, free, tied, y, u, noise)
    half = np.where(np.isfinite(period), period / 2, 0)
    # One period, and not a bit less.
    slip = rounding.error(abs(center) + half, 6.0) if rounding.outward() else 0.0
    around = Interval.unchecked(center - half - slip, center + half + slip)
    moved = choose(free, around, box)
    count = where(free | far, -jnp.round(moved.center / period), 0)
    moved = moved_by(moved, count, period)
    turned = unwrap(system, ranges_on(maps, moved, u), y, u, noise)
    found = _measured(maps, moved, turned, u)
    # Where a range of several periods has other reasons, what was known of the state may be better.
    gain = (where(free, box.width - found.width, 0) / period).sum()
    better = far.any() | (gain > 0)
    return choose(better, found, box), chosen.unless(better, turned)


def _around(maps: Maps, box: Interval, free: Any, tied: np.ndarray, y: Any, u: Any, noise: Noise) -> Any:
    """A guess (n,) of free states from what is measured: any number would be sound."""
    system, middle = maps.observer.system, box.center
    held = choose(free, point(middle), box)
    seen = _target(system, ranges_on(maps, held, u), u, noise)
    off = _at(y, [j for j, _ in system.periodic]) - seen.center
    entries = [middle[i] for i in range(system.n)]
    for i, period in system.periodic_states:
        guess, done = middle[i], jnp.asarray(False)
        for r, (_, of_output) in enumerate(system.periodic):
            if abs(tied[i, r]) == 1:
                usable = jnp.isfinite(off[r]) & ~done
                guess = guess + where(usable, where(usable, off[r], 0) * float(tied[i, r] * period / of_output), 0)
                done = done | usable
        entries[i] = guess
    return jnp.stack(entries)


def _measured(maps: Maps, box: Interval, seen: Unwrapped, u: Any) -> Interval:
    """The box contracted with ``T2 g(x) in T2 (y - D u - v)``."""
    observer, states = maps.observer, maps.states(box)
    output = output_box(observer.system, seen.y, u, seen.noise.v)
    z = plain_image(observer.T2, widened_for_sums(output, observer.system.l))
    form = affine_rows(maps.free, states, maps.free_bounds(states, box, u))
    rows, _ = contract_affine_rows(states, form, z)
    return Domain.of(box, 0.0).intersect(None, Source.STATE, quiet=rows).box


def noted(out: StepOutput, y: Any, seen: Unwrapped) -> StepOutput:
    """The status of a step for the y[k] that was logged: MISSING means what is missing there."""
    here = jnp.isfinite(y).all() & ~jnp.isfinite(seen.y).all()
    status = out.status - where(here, int(Status.MISSING), 0) + where(seen.open.any(), int(Status.AMBIGUOUS), 0)
    return StepOutput(out.state, out.input, out.current_input, status.astype(jnp.int32), out.margin, out.source)


def _periods(system: System, dtype: Any) -> np.ndarray:
    return np.array([period for _, period in system.periodic], dtype)


def _at(value: Any, rows: list[int]) -> Any:
    return jnp.stack([value[j] for j in rows])


def _with(value: Any, rows: list[int], entries: Any) -> Any:
    """The array with other entries in some places."""
    parts = [value[j] for j in range(value.shape[0])]
    for r, j in enumerate(rows):
        parts[j] = entries[r]
    return jnp.stack(parts)
