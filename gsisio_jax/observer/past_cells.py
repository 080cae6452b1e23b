"""The box of x[k-1] in parts: what its corners, in which no state lies that agrees with y[k-1], add to that of x[k].

The box is cut into cells, each is contracted with the outputs of step k-1 and with what earlier steps said of it
besides its box, and those that contradict them are dropped. f and g are bounded on what is left, cell by cell. So the
right side of (*) and the bounds of d[k-1] are hulls over cells, and so are the *free rows*: sums of the plant's
equations in which d[k-1] cancels, ``r x[k] = r (f + B u + w) + s (g + D u + v - y)`` with ``r G + s H = 0``. Rows with
the same r share the noise of a cell, and meet there before the hull is taken. Their boxes stay in the carry: a box of
x[k] alone forgets them (theory 5.4).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.interval.box import Interval, choose, entire_like, is_concrete
from gsisio_jax.interval.image import loose_matvec_upper, plain_image, widened_for_sums
from gsisio_jax.interval.minmax import cut, larger, raised, smaller
from gsisio_jax.observer.bank import Known
from gsisio_jax.observer.cells import contracted, cut_up, hull
from gsisio_jax.observer.contractors import Affine, affine_rows
from gsisio_jax.observer.domain import Domain
from gsisio_jax.observer.lost import Lost, plainly_wider
from gsisio_jax.observer.maps import Maps
from gsisio_jax.observer.measurement import everything_unless, output_box
from gsisio_jax.observer.types import Carry, Observer

MOST_ROWS = 64
_PARALLEL = 1e-12
_SPANNED = 1e3


class FreeRows(NamedTuple):
    """Rows that are free of d[k-1], those of one direction of x[k] together; at most `MOST_ROWS`.

    Attributes:
        which: indices (c,) of them among the circuits of [G; H].
        groups: for every direction, the rows that are multiples of it.
        shares: (c,) these multiples; errors: (c, n), by how much a row may differ from that multiple.
        directions: (r, n).
    """

    which: np.ndarray
    groups: list[list[int]]
    shares: np.ndarray
    errors: np.ndarray
    directions: Any

    @classmethod
    def of(cls, observer: Observer) -> FreeRows:
        circuits, n = observer.exact.circuits, observer.system.n
        if not is_concrete(circuits):
            count = min(len(circuits), MOST_ROWS)
            groups = [[i] for i in range(count)]
            return cls(np.arange(count), groups, np.ones(count), np.zeros((count, n)), circuits[:count, :n])
        of_x = np.asarray(circuits, np.float64)[:, :n]
        which = np.flatnonzero(of_x.any(1))[:MOST_ROWS]
        groups: list[list[int]] = []
        shares, errors = np.ones(len(which)), np.zeros((len(which), n))
        for i, row in enumerate(of_x[which]):
            for group in groups:
                first = of_x[which[group[0]]]
                at = np.abs(first).argmax()
                share = row[at] / first[at]
                off = np.abs(row - share * first)
                if (off <= _PARALLEL * np.abs(row).max()).all():
                    # The product and the difference are rounded themselves.
                    shares[i], errors[i] = share, 2 * off + 2.0**-51 * np.abs(row)
                    group.append(i)
                    break
            else:
                groups.append([i])
        firsts = which[[group[0] for group in groups]]
        return cls(which, groups, shares, errors, np.asarray(circuits)[firsts, :n])

    def linear(self) -> Affine | None:
        """The directions as affine bounds of themselves; None where there are none."""
        none = np.zeros(len(self.directions), self.directions.dtype)
        return Affine(self.directions, none, none) if len(none) else None

    def met(self, rows: Interval, terms: int) -> tuple[Interval, Any]:
        """Boxes of the rows (c,) as boxes of the directions (r,), never crossed, and by how much their rows agree."""
        times = 1 / self.shares
        lower, upper = (
            jnp.where(times > 0, a, b) * times.astype(a.dtype)
            for a, b in ((rows.lower, rows.upper), (rows.upper, rows.lower))
        )
        box = widened_for_sums(Interval.unchecked(lower, upper), terms)
        low, high = [], []
        for first, *others in self.groups:
            a, b = box.lower[first], box.upper[first]
            for i in others:
                a, b = raised(a, box.lower[i]), cut(b, box.upper[i])
            low.append(a), high.append(b)
        a, b = jnp.stack(low), jnp.stack(high)
        return Interval.unchecked(smaller(a, b), larger(a, b)), b - a


@jax.named_scope("cells")
def contract(
    maps: Maps, domain: Domain, carry: Carry, known: Known, lost: Lost, right: Interval, d_fixed: Interval
) -> tuple[Domain, Interval, Interval]:
    """Cut the box of x[k-1], drop the cells that contradict what was known of it, and bound what is left.

    At the start, and where no cell is left, nothing changes.

    Args:
        maps: of the observer.
        domain: of x[k] so far.
        carry: the step before.
        known: what the step knows without a box.
        lost: bounds the inputs of the last step.
        right: right side of (*) without psi (K, n), from the box as a whole.
        d_fixed: bounds of d[k-1] but for x[k] (K, p), likewise.

    Returns:
        The domain, with the boxes of the directions of `FreeRows`, and the other two, narrowed.
    """
    observer, free = maps.observer, FreeRows.of(maps.observer)
    n, exact = observer.system.n, observer.exact
    circuits, of_known = exact.circuits[free.which], exact.circuits_known[free.which]
    banks = (observer.gains.residual, observer.inverses.residual)
    parts = [*(bank.reshape(-1, bank.shape[-1]) for bank in banks), circuits]
    weights = (np if all(map(is_concrete, parts)) else jnp).concatenate(parts)
    rows, outputs = maps.rows(weights), maps.rows(maps.on_outputs(observer.T2))
    # What is known besides f and g: of the free rows with what they leave of d[k-1] and of their direction.
    terms = weights.shape[-1] + of_known.shape[-1]
    joined = Interval.unchecked(
        *(jnp.concatenate([getattr(b, side) for b in (known.terms.shift, known.terms.known)]) for side in _SIDES)
    )
    balance = plain_image(jnp.concatenate([circuits, -of_known], -1), widened_for_sums(joined, terms))
    balance = plainly_wider(balance, lost.of_inputs(observer.rounding_constants.circuits[free.which], domain.box))
    if free.errors.any():
        errors = np.nextafter(free.errors.astype(domain.box.dtype), np.inf)
        balance = plainly_wider(balance, loose_matvec_upper(errors, lost.magnitudes(domain.box)[0]))
    added = [known.right, known.inputs, balance]
    added = Interval.unchecked(*(jnp.concatenate([getattr(b, side).ravel() for b in added]) for side in _SIDES))
    # Rows that use a measurement that is not believed say nothing.
    uses = (weights[:, n:] != 0).any(-1)
    added = everything_unless(~carry.starts & jnp.logical_or(carry.believed, ~uses), added)
    z = output_box(observer.system, carry.y, carry.u, carry.noise.v)
    z = everything_unless(carry.believed, plain_image(observer.T2, widened_for_sums(z, observer.system.l)))
    directions, count = free.linear(), len(weights) - len(circuits)

    def one(lower: Any, upper: Any) -> tuple[Interval, Any]:
        cell = Interval.unchecked(lower, upper)
        states = maps.states(cell)
        form = affine_rows(outputs, states, maps.bounds(states, cell, carry.u))
        cell, slack = contracted(states, form, z, cell)
        if directions is not None and carry.rows is not None:
            cell, more = contracted(maps.states(cell), directions, carry.rows, cell)
            slack = jnp.concatenate([slack, more])
        states = maps.states(cell)
        found = rows.bounds(states, maps.bounds(states, cell, carry.u))
        found = Interval.unchecked(found.lower + added.lower, found.upper + added.upper)
        if directions is None:
            return found, slack
        met, more = free.met(found[count:], maps.terms)
        both = (jnp.concatenate([getattr(b, side) for b in (found[:count], met)]) for side in _SIDES)
        return Interval.unchecked(*both), jnp.concatenate([slack, more])

    boxes, slack = jax.vmap(one)(*cut_up(carry.state, observer.past_cells))
    left, some = hull(boxes, ~(slack < -domain.tolerance).any(-1))
    left = everything_unless(some, left)
    first = right.lower.size
    right = _narrowed(right, left[:first])
    d_fixed = _narrowed(d_fixed, left[first:count])
    return domain.with_rows(left[count:]), right, d_fixed


def solved(maps: Maps, domain: Domain, known: Known, size: Any) -> list[tuple[Any, Interval]]:
    """Right sides of (*) from the boxes of the directions: whatever N_z, Gamma and N_s are, with the directions R

        x = Gamma R x + N_z (T2 g(x) - psi(x)) + N_s S x + (I - Gamma R - N_z C - N_s S) x,

    and the last matrix is 0 but for rounding if the rest of a gain is a combination of directions.

    Returns:
        The N_z (K, n, q) for which it is with their right sides (K, n), if there are any.
    """
    observer, free = maps.observer, FreeRows.of(maps.observer)
    gains, parts = observer.gains, (observer.gains.remainder, observer.gains.bounds, observer.C, free.directions)
    if domain.rows is None or not len(free.directions) or not all(map(is_concrete, parts)):
        return []
    N_z, N_s, C, R = (np.asarray(part, np.float64) for part in parts)
    S = np.asarray(observer.bounded_states, np.float64)
    rest = np.eye(R.shape[1]) - N_z @ C - N_s @ S
    kind = domain.box.dtype
    gamma = (rest @ np.linalg.pinv(R)).astype(kind)
    summed = np.eye(R.shape[1]) + abs(gamma) @ abs(R) + abs(N_z) @ abs(C) + abs(N_s) @ abs(S)
    error = abs(rest - gamma.astype(np.float64) @ R) + summed * 2.0**-48
    good = (error <= _SPANNED * float(np.finfo(kind).eps) * summed.max((1, 2), keepdims=True)).all((1, 2))
    if not good.any():
        return []
    N_z = np.asarray(gains.remainder)[good]
    weights = np.concatenate([gamma[good], N_z, np.asarray(gains.bounds)[good]], -1)
    boxes = (domain.rows, known.z, known.terms.bounds)
    joined = Interval.unchecked(*(jnp.concatenate([getattr(b, side) for b in boxes]) for side in _SIDES))
    right = plain_image(weights, widened_for_sums(joined, weights.shape[-1]))
    left = np.nextafter(error[good].astype(kind), np.inf)
    return [(N_z, plainly_wider(right, loose_matvec_upper(left, size)))]


_SIDES = ("lower", "upper")


def _narrowed(whole: Interval, parts: Interval) -> Interval:
    """A bank met with the same from cells (flat); where the two miss each other it stays what it is."""
    shape = whole.lower.shape
    lower, upper = raised(whole.lower, parts.lower.reshape(shape)), cut(whole.upper, parts.upper.reshape(shape))
    return choose(lower <= upper, Interval.unchecked(lower, upper), whole)


def directions(observer: Observer) -> Affine | None:
    """Those of ``Domain.rows``; None where there are none."""
    return FreeRows.of(observer).linear() if observer.past_cells else None


def unknown(observer: Observer, dtype: Any) -> Interval | None:
    """`Carry.rows` of which nothing is known."""
    if not observer.past_cells:
        return None
    return entire_like(jnp.zeros(len(FreeRows.of(observer).directions), dtype))


def after(observer: Observer, domain: Domain, carry: Carry) -> Interval | None:
    """`Carry.rows` for the next step. After a conflict nothing is known of them; nor where a periodic state may have
    been moved by its period."""
    if carry.rows is None:
        return None
    if domain.rows is None or observer.system.periodic_states:
        return entire_like(carry.rows)
    return everything_unless(~domain.conflict, domain.rows)
