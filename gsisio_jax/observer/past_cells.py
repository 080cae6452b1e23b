"""The box of x[k-1] in parts: what its corners, in which no state lies that agrees with y[k-1], add to that of x[k].

The box is cut into cells, each is contracted with the outputs of step k-1, and those that contradict them are dropped.
f and g are bounded on what is left, cell by cell. So the right side of (*) and the bounds of d[k-1] are hulls over
cells, and so are the boxes of `FreeRows`: rows of one direction share the noise of a cell, and meet there before the
hull is taken (theory 5.4).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.interval.box import Interval, choose, in_a_row, is_concrete
from gsisio_jax.interval.image import loose_matvec_upper, plain_image, widened_for_sums
from gsisio_jax.interval.minmax import cut, raised
from gsisio_jax.observer.bank import Known
from gsisio_jax.observer.cells import contracted, cut_up, hull
from gsisio_jax.observer.contractors import Affine, affine_rows
from gsisio_jax.observer.domain import Domain
from gsisio_jax.observer.free_rows import FreeRows
from gsisio_jax.observer.lost import Lost, plainly_wider
from gsisio_jax.observer.maps import Maps
from gsisio_jax.observer.measurement import everything_unless, output_box
from gsisio_jax.observer.types import Carry


@jax.named_scope("cells")
def contract(
    maps: Maps, domain: Domain, carry: Carry, known: Known, lost: Lost, right: Interval, d_fixed: Interval
) -> tuple[Interval, Interval, tuple[Affine, Interval] | None]:
    """Cut the box of x[k-1], drop the cells that contradict y[k-1], and bound what is left.

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
        The latter two, narrowed; and the directions of `FreeRows` with their boxes, if there are any.
    """
    observer, free = maps.observer, FreeRows.of(maps.observer)
    system, banks = observer.system, (observer.gains.residual, observer.inverses.residual)
    parts = [*(bank.reshape(-1, bank.shape[-1]) for bank in banks), free.weights]
    weights = (np if all(map(is_concrete, parts)) else jnp).concatenate(parts)
    rows, outputs = maps.rows(weights), maps.rows(maps.on_outputs(observer.T2))
    added = in_a_row(known.right, known.inputs, _balance(free, domain, known, lost))
    # Rows that use a measurement that is not believed say nothing.
    uses = (weights[:, system.n :] != 0).any(-1)
    added = everything_unless(~carry.starts & jnp.logical_or(carry.believed, ~uses), added)
    z = output_box(system, carry.y, carry.u, carry.noise.v)
    z = everything_unless(carry.believed, plain_image(observer.T2, widened_for_sums(z, system.l)))
    along, count = free.linear(), len(weights) - len(free.weights)

    def one(lower: Any, upper: Any) -> tuple[Interval, Any]:
        cell = Interval.unchecked(lower, upper)
        states = maps.states(cell)
        form = affine_rows(outputs, states, maps.bounds(states, cell, carry.u))
        cell, *slack = contracted(states, form, z, cell)
        states = maps.states(cell)
        found = rows.bounds(states, maps.bounds(states, cell, carry.u))
        found = Interval.unchecked(found.lower + added.lower, found.upper + added.upper)
        if along is not None:
            met, room = free.met(found[count:], maps.terms)
            found = in_a_row(found[:count], met)
            slack.append(room)
        return found, jnp.concatenate(slack)

    boxes, slack = jax.vmap(one)(*cut_up(carry.state, observer.past_cells))
    left, some = hull(boxes, ~(slack < -domain.tolerance).any(-1))
    left = everything_unless(some, left)
    first = right.lower.size
    free_rows = None if along is None else (along, left[count:])
    return _narrowed(right, left[:first]), _narrowed(d_fixed, left[first:count]), free_rows


def _balance(free: FreeRows, domain: Domain, known: Known, lost: Lost) -> Interval:
    """What is known of the rows besides f and g (c,), with what they leave of d[k-1] and miss of their direction."""
    joined = in_a_row(known.terms.shift, known.terms.known)
    weights = jnp.concatenate([free.weights, free.known], -1)
    found = plain_image(weights, widened_for_sums(joined, weights.shape[-1]))
    found = plainly_wider(found, lost.of_inputs(free.lost, domain.box))
    if not free.errors.any():
        return found
    errors = np.nextafter(free.errors.astype(domain.box.dtype), np.inf)
    return plainly_wider(found, loose_matvec_upper(errors, lost.magnitudes(domain.box)[0]))


def _narrowed(whole: Interval, parts: Interval) -> Interval:
    """A bank met with the same from cells (flat); where the two miss each other it stays what it is."""
    shape = whole.lower.shape
    lower, upper = raised(whole.lower, parts.lower.reshape(shape)), cut(whole.upper, parts.upper.reshape(shape))
    return choose(lower <= upper, Interval.unchecked(lower, upper), whole)
