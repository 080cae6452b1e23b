"""An observer that stays certain while up to q outputs of any one step are wrong (theory 8.5).

A step is taken once for every guess which outputs of y[k-1] and of y[k] are wrong, with these missing. One of the
guesses is right, so the hull over those that agree with the data holds the state: a q-relaxed intersection. What is
kept from step to step is one box for every guess about the last measurement.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax import scalar
from gsisio_jax._memo import once
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, choose, entire_like
from gsisio_jax.observer import step as current_step
from gsisio_jax.observer.certificate import Certificate
from gsisio_jax.observer.domain import Domain
from gsisio_jax.observer.maps import Maps
from gsisio_jax.observer.status import Status, bit_mask
from gsisio_jax.observer.types import Carry, Observer, StepOutput
from gsisio_jax.observer.wrapped import Wrapped
from gsisio_jax.plant.system import Noise, System

MOST_GUESSES = 20
"""About one measurement; a step takes the square of it."""


class TolerantObserver(Wrapped):
    """A designed observer that is certain while at most q outputs a step are wrong. Made by
    `design_observer(tolerate=q)`.

    Attributes:
        inner: the observer that takes a step for one guess.
        tolerate: q.
    """

    inner: Observer
    tolerate: int = eqx.field(static=True)

    @property
    def delay(self) -> int:
        """0: boxes of x[k] come with y[k]."""
        return 0

    @property
    def system(self) -> System:
        """The plant."""
        return self.inner.system

    @property
    def noise(self) -> Noise:
        """The bounds it was designed for (any others are legal at run time)."""
        return self.inner.noise

    @property
    def certificate(self) -> Certificate:
        """It promises no width: how far boxes of several guesses lie apart depends on the data."""
        return self.inner.certificate

    @property
    def output_rows(self) -> tuple[tuple[int, ...], ...]:
        """For every row of T2 the outputs that enter it."""
        return self.inner.output_rows

    def astype(self, dtype: Any) -> TolerantObserver:
        """The same observer in another floating type; boxes are rounded outward (`Observer.astype`)."""
        dtype = np.dtype(jax.dtypes.canonicalize_dtype(dtype))
        return once(self, ("type", dtype), lambda: replace(self, inner=self.inner.astype(dtype)))


class Guesses(eqx.Module):
    """What is known of x[k] for every guess which q outputs of y[k] are wrong; it stands in `Carry.older`.

    Attributes:
        alive: (C,) the guess agrees with the data so far.
        state: boxes (C, n); h: bounds of f and g on them.
        believed: (C,) y[k] is, but for the outputs of the guess.
    """

    alive: Any
    state: Interval
    h: Any
    believed: Any


def guesses(l: int, q: int) -> tuple[np.ndarray, np.ndarray]:
    """Sets of outputs as masks: the C sets of q, and those of fewer (which only tell how many agree)."""

    def masks(size: int) -> list[np.ndarray]:
        return [np.isin(np.arange(l), wrong) for wrong in combinations(range(l), size)]

    return np.array(masks(q)), np.array([mask for size in range(q) for mask in masks(size)])


def blank(observer: TolerantObserver, initial: Interval) -> Carry:
    """The past of a first step: nothing is known but the initial box."""
    carry = current_step.blank(observer.inner, initial)
    count = len(guesses(observer.system.l, observer.tolerate)[0])
    state, h = jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *jnp.shape(x))), (carry.state, carry.h))
    yes = jnp.ones(count, bool)
    return replace(carry, h=None, older=Guesses(yes, state, h, yes))


@rounding.by_observer
def advance(
    observer: TolerantObserver, carry: Carry, y: Any, u: Any, noise: Noise, hold: bool = False
) -> tuple[Carry, StepOutput]:
    """One step for all guesses.

    Where no guess agrees (CONFLICT: more than q outputs of a step are wrong, or the past is), restart goes on from y[k]
    and the state bounds, again for every guess; `hold` goes on from the past alone.
    """
    inner, before = observer.inner, carry.older
    maps = Maps.of(inner, y.dtype)
    whole, fewer = guesses(observer.system.l, observer.tolerate)
    wrong = np.concatenate([whole, fewer]) if len(fewer) else whole
    count, seen = len(whole), jnp.isfinite(y)

    def past(i: Any, alone: Interval, h: Any, believed: Any) -> Carry:
        return Carry(alone, h, jnp.where(i, jnp.nan, carry.y), carry.u, carry.noise, carry.starts, believed, ())

    pasts = jax.vmap(past)(jnp.asarray(whole), before.state, before.h, before.believed)

    def taken(measured: Any) -> Any:
        """With this measurement, for every guess about the one before."""

        def once(one: Carry, measured: Any, u: Any, noise: Noise) -> Any:
            return current_step._contract(maps, one, measured, u, noise)

        return jax.vmap(lambda one: scalar.call(once, one, measured, u, noise))(pasts)

    measured = jnp.where(wrong, jnp.nan, y)
    domains, alones, d = jax.vmap(taken)(measured)  # (guess about y[k], guess about y[k-1])
    agrees = before.alive & ~domains.conflict
    joined = _joined(domains, agrees, before.alive)
    d = _hull(d, agrees)
    agree = agrees.any(1)  # (all guesses about y[k],)
    conflict = ~agree[:count].any()

    fallback = jax.tree.map(lambda x: x[:, 0], alones)
    possible = ~fallback.conflict
    if hold:
        nothing = jnp.full_like(y, jnp.nan)
        held = jax.tree.map(lambda x: x[None], taken(nothing)[0])
        useful = before.alive & ~held.conflict
        fallback = jax.tree.map(
            lambda x: jnp.broadcast_to(x, (len(wrong), *x.shape[1:])), _joined(held, useful, before.alive)
        )
        measured, possible = jnp.where(conflict, jnp.nan, measured), jnp.ones(len(wrong), bool)
    revived = possible[:count] | ~possible[:count].any()

    last = replace(carry, older=())

    def finished(domain: Domain, fallback: Domain, last: Carry, d: Interval, one: Any, u: Any, noise: Noise) -> Any:
        return current_step._finish(maps, domain, fallback, last, d, one, u, noise, hold)

    def finish(domain: Domain, fallback: Domain, d: Interval, one: Any) -> Any:
        return scalar.call(finished, domain, fallback, last, d, one, u, noise)

    first = jax.tree.map(lambda x: x[:count], (joined, fallback, d, measured))
    after, out = jax.vmap(finish)(*first)
    alive = jnp.where(conflict, revived, agree[:count])
    state, d, d_now = (
        _hull(jax.tree.map(lambda x: x[None], box), alive[None]) for box in (out.state, out.input, out.current_input)
    )
    state, d, d_now = (jax.tree.map(lambda x: x[0], box) for box in (state, d, d_now))
    kept = _kept(wrong, seen, jnp.where(conflict, possible & (not hold), agree))
    outside = (alive & ((out.status & int(Status.OUTSIDE_REGION)) != 0)).any()
    status = bit_mask((
        (conflict, Status.CONFLICT), (~seen.all(), Status.MISSING),
        (~(jnp.isfinite(state.lower) & jnp.isfinite(state.upper)).all(), Status.UNBOUNDED),
        (outside, Status.OUTSIDE_REGION), ((seen & ~kept).any(), Status.OUTVOTED),
    ))  # fmt: skip
    best = jnp.argmax(jnp.where(alive | conflict, joined.gap[:count] + joined.tolerance[:count], -jnp.inf))
    older = Guesses(alive, after.state, after.h, after.believed)
    no, yes = jnp.asarray(False), jnp.asarray(True)
    return (
        Carry(state, None, y, u, noise, no, yes, older),
        StepOutput(state, d, d_now, status, out.margin[best], out.source[best], kept),
    )


def _joined(domains: Domain, agrees: Any, alive: Any) -> Domain:
    """Domains (J, I) of guesses J about y[k] over those about y[k-1]: the hull of the boxes that agree, and gap and
    margin of the guess that agrees best. Where none does this one is in conflict, as all are."""
    room = jnp.where(alive, domains.gap + domains.tolerance, -jnp.inf)
    best = jnp.argmax(room, 1)

    def chosen(x: Any) -> Any:
        return jnp.take_along_axis(x, best[:, None], 1)[:, 0]

    box = _hull(domains.box, agrees)
    none = ~agrees.any(1)[:, None]
    box = choose(none, entire_like(box), box)
    return Domain(box, *(chosen(x) for x in (domains.tolerance, domains.gap, domains.margin, domains.source)))


def _hull(boxes: Interval, counts: Any) -> Interval:
    """Hull over the second axis of boxes (J, I, n) that count (J, I); everything where none does."""
    count = counts[:, :, None]
    lower = jnp.where(count, boxes.lower, jnp.inf).min(1)
    upper = jnp.where(count, boxes.upper, -jnp.inf).max(1)
    some = counts.any(1)[:, None]
    return Interval.unchecked(jnp.where(some, lower, -jnp.inf), jnp.where(some, upper, jnp.inf))


def _kept(wrong: np.ndarray, seen: Any, agree: Any) -> Any:
    """Outputs (l,) that are in every largest set that agrees."""
    size = jnp.where(agree, (wrong & seen).sum(1), wrong.shape[1] + 1)
    largest = agree & (size == size.min())
    return seen & ~(largest[:, None] & wrong).any(0) & largest.any()
