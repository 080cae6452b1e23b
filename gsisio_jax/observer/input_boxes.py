"""Boxes of the unknown input d[k-1], and what they say of the state (theory 7)."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.atoms import States
from gsisio_jax.interval.box import Interval, in_a_row, is_concrete
from gsisio_jax.interval.image import plain_image, widened_for_sums
from gsisio_jax.interval.minmax import smaller
from gsisio_jax.interval.primitives import matmul, scale
from gsisio_jax.observer.bank import Terms
from gsisio_jax.observer.contractors import Affine
from gsisio_jax.observer.domain import Domain
from gsisio_jax.observer.lost import Lost, plainly_wider
from gsisio_jax.observer.maps import Maps
from gsisio_jax.observer.measurement import everything_unless, typed
from gsisio_jax.observer.status import Source
from gsisio_jax.observer.types import Carry, Observer


def from_inverses(maps: Maps, domain: Domain, states: States, fixed: Interval, psi: Affine) -> tuple[Interval, Domain]:
    """Box of d[k-1] from every left inverse, given the box of x[k] (theory 7)."""
    observer = maps.observer
    inverses, limits = observer.inverses, typed(observer.system.input_bounds, fixed.dtype)
    # state x[k] - remainder psi(x[k]) with psi = D x + [e], slopes combined before the box is applied.
    slope = inverses.state - matmul(inverses.remainder, psi.slope)  # (K, p, n)
    middle = matmul(slope, states.center) - matmul(inverses.remainder, psi.center)
    loose = scale(abs(slope), states.radius).sum(-1) + scale(abs(inverses.remainder), psi.radius).sum(-1)
    # What rounding the slope has lost, where it was combined.
    combined = jnp.where((inverses.remainder != 0).any(-1, keepdims=True), abs(inverses.state), 0)
    loose = loose + scale(combined, states.error).sum(-1)
    now = Interval.unchecked(fixed.lower + (middle - loose), fixed.upper + (middle + loose))
    d = Domain.of(limits, 0.0).intersect(now, Source.INPUT)
    return d.box, domain.taken(d)


def moved_without(maps: Maps, past: States, carry: Carry, terms: Terms) -> Interval:
    """Box (n + l,) of [f + B u + w; g + D u + v - y][k-1]: of what [G; H] d does not explain."""
    n, l = maps.observer.system.n, maps.observer.system.l
    found = maps.rows(np.eye(n + l)).natural(past, carry.h)
    return Interval.unchecked(found.lower + terms.shift.lower, found.upper + terms.shift.upper)


def dynamics(maps: Maps, domain: Domain, moved: Interval, d: Interval) -> Domain:
    """``x = f + B u + G d + w``: no way to a first box, but a contraction of a correct one (paper, Algorithm 1)."""
    system = maps.observer.system
    through = plain_image(system.G, widened_for_sums(d, system.p + 2))
    moved = widened_for_sums(moved[: system.n], 2)
    now = Interval.unchecked(moved.lower + through.lower, moved.upper + through.upper)
    return domain.intersect(now[None], Source.DYNAMICS)


def exact_from_box(
    maps: Maps, domain: Domain, moved: Interval, carry: Carry, terms: Terms, d: Interval, lost: Lost
) -> tuple[Interval, Domain]:
    """The exact box of d[k-1] for ``[G; H] d`` in the box of ``[x[k]; 0]`` minus what has moved without it."""
    zero = jnp.zeros(maps.observer.system.l, d.dtype)
    explained = Interval.unchecked(
        jnp.concatenate([domain.box.lower, zero]) - moved.upper, jnp.concatenate([domain.box.upper, zero]) - moved.lower
    )
    new = _beyond_inverses(maps.observer)
    return exact_input(maps.observer, domain, explained, terms.known, d, lost, carry.believed, new)


def exact_input(
    observer: Observer,
    domain: Domain,
    explained: Interval,
    known: Interval,
    d: Interval,
    lost: Any,
    believed: Any,
    new: Any = True,
) -> tuple[Interval, Domain]:
    """The exact box of d[k-1] for ``[G; H] d in explained`` (paper, Lemma 3; theory 7), and conflicts that it shows.

    Args:
        observer: for its rows.
        domain: of x[k].
        explained: box (n + l,).
        known: bounds of the inputs that have them (b,).
        d: what is known of d[k-1] so far, (p,).
        lost: bounds what the rows leave of d[k-1]; None if they leave nothing.
        believed: the measurement behind `explained` is.
        new: mask (K, p) of rows that say something new.
    """
    exact, constants = observer.exact, observer.rounding_constants
    if not observer.system.p:
        return d, domain
    terms = explained.shape[0] + known.shape[0]
    joined = widened_for_sums(in_a_row(explained, known), terms)

    def image_of(rows: Any, of_known: Any, residual: Any) -> Interval:
        found = plain_image(jnp.concatenate([rows, of_known], -1), joined)
        return found if lost is None else plainly_wider(found, lost.of_inputs(residual, domain.box))

    rows = everything_unless(new, image_of(exact.rows, exact.known, constants.rows))
    met = Domain.of(d, 0.0).intersect(everything_unless(believed, rows), Source.INPUT)
    domain = domain.taken(met)
    # Some d must reach the box at all: every combination of rows that is free of d contains 0.
    balance = image_of(exact.circuits, exact.circuits_known, constants.circuits)
    slack = smaller(balance.upper, -balance.lower)
    return met.box, domain.record_margin(jnp.where(believed, slack, jnp.inf), Source.BALANCE)


def _beyond_inverses(observer: Observer) -> Any:
    """Which rows of the exact box (K, p) are not those of a left inverse as well, which bounds f and g jointly."""
    exact, inverses = observer.exact.rows, observer.inverses
    if not all(map(is_concrete, jax.tree.leaves((exact, inverses)))):
        return True
    exact, inverses = jax.tree.map(np.asarray, (exact, inverses))
    direct = [j for j in range(len(inverses.residual)) if not (inverses.remainder[j].any() or inverses.output[j].any())]
    old = np.zeros(exact.shape[:2], bool)
    for j in direct:
        old |= (exact == -inverses.residual[j]).all(-1)
    return ~old
