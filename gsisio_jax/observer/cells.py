"""The box of x[k] in parts: finds a state in a box on which one affine form of the outputs says little.

A form of ``T2 g`` on the whole box has a rest as large as g is bent there: ranges to beacons on a box of the size of
their distances tell nothing, though three of them meet in a point. On a part of half the width the rest is a quarter.
So the box is cut into cells, in each the outputs are contracted with a form of its own and (*) is solved for every
gain, cells that contradict one of them are dropped, and the box is cut down to the hull of what is left; and again,
`ROUNDS` times. Cells cover the box and share their edges, so no state is lost (theory 5.4).

`past_cells` does the same with the box of x[k-1].
"""

from __future__ import annotations

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.atoms import States
from gsisio_jax.interval import devices
from gsisio_jax.interval.box import Interval, choose
from gsisio_jax.interval.direct import where
from gsisio_jax.interval.minmax import cut, larger, largest, raised, smaller, smallest
from gsisio_jax.observer.contractors import Affine, affine_rows, contract_affine_rows, solve_remainder
from gsisio_jax.observer.domain import Domain
from gsisio_jax.observer.maps import Maps
from gsisio_jax.observer.status import Source

ROUNDS = 4


def counts(cells: int, bent: np.ndarray) -> tuple[int, ...]:
    """Into how many parts every state is cut, about `cells` in all: only those in which a map is bent."""
    axes = int(bent.sum())
    if cells < 2 or not axes:
        return ()
    each = max(2, int(cells ** (1 / axes) + 1e-9))
    return tuple(each if one else 1 for one in bent)


@jax.named_scope("cells")
def contract(
    maps: Maps, domain: Domain, z: Interval, right: Interval, free_rows: tuple[Affine, Interval] | None, u: Any
) -> Domain:
    """Contract on the cells of the box; a box that is infinite along a state is not cut there.

    Args:
        maps: of the observer.
        domain: of x[k] so far.
        z: box (q,) of T2 (y - D u - v).
        right: right sides of (*) without psi, (K, n).
        free_rows: rows of x[k] with their boxes (`past_cells`), or None.
        u: known input now.
    """
    free, remainder = maps.free, maps.remainder  # made once: they are kept
    N_z = maps.observer.gains.remainder

    def one(lower: Any, upper: Any) -> tuple[Any, Any, Any]:
        cell = Interval.unchecked(lower, upper)
        states = maps.states(cell)
        atoms = maps.free_bounds(states, cell, u)
        solved, _ = solve_remainder(N_z, right, affine_rows(remainder, states, atoms), states, maps.terms)
        cell, slack, room = contracted(states, affine_rows(free, states, atoms), z, cell)
        slack, least = jnp.minimum(slack, room.min()), room.min()
        if free_rows is not None:
            cell, *more = contracted(maps.states(cell), *free_rows, cell)
            least = jnp.minimum(least, jnp.concatenate(more).min())
        cell, room = _met(cell, solved)
        return cell, slack, jnp.minimum(room, least)

    def turn(box: Interval, _: Any) -> tuple[Interval, Any]:
        cells, slack, room = jax.vmap(one)(*cut_up(box, maps.observer.cells))
        least = jnp.minimum(slack.min(-1, initial=jnp.inf), room.min(-1))
        left, some = hull(cells, ~(least < -domain.tolerance))
        # Where all contradict something, the box stays what it is; what the best of them misses is noted.
        best = jnp.argmax(least)
        return choose(some, left, box), tuple(where(some, jnp.inf, part[best]) for part in (slack, room))

    box, (slack, room) = devices.scan(turn, domain.box, None, length=ROUNDS)
    return domain.record_margin(slack[-1], Source.OUTPUT).record_margin(room[-1], Source.STATE).with_box(box)


def contracted(states: States, form: Affine, z: Interval, cell: Interval) -> tuple[Interval, Any, Any]:
    """A cell contracted with ``m(x) in z``, never crossed; the slack of every row, and the room along every state."""
    rows, slack = contract_affine_rows(states, form, z)
    met, room = _met(cell, rows)
    return met, slack, room


def _met(cell: Interval, boxes: Interval) -> tuple[Interval, Any]:
    """The cell met with a stack of boxes (k, n), its sides exchanged where they miss each other; and its widths."""
    lower, upper = cell.lower, cell.upper
    for i in range(boxes.lower.shape[0]):
        lower, upper = raised(lower, boxes.lower[i]), cut(upper, boxes.upper[i])
    return Interval.unchecked(smaller(lower, upper), larger(lower, upper)), upper - lower


def cut_up(box: Interval, parts: tuple[int, ...]) -> tuple[Any, Any]:
    """Lower and upper corners (cells, n)."""
    places = np.array(list(itertools.product(*map(range, parts))))
    sides = [_cut(box.lower[i], box.upper[i], count) for i, count in enumerate(parts)]
    lower, upper = (jnp.stack([side[k][places[:, i]] for i, side in enumerate(sides)], -1) for k in (0, 1))
    return lower, upper


def _cut(lower: Any, upper: Any, count: int) -> tuple[Any, Any]:
    """Lower and upper ends of the cells along one state, which share their edges. Where the box is infinite every cell
    is all of it: there is no share of an infinite length."""
    share = (np.arange(1, count) / count).astype(lower.dtype)
    inner = jnp.clip(lower + (upper - lower) * share, lower, upper)
    edges, finite = jnp.concatenate([lower[None], inner, upper[None]]), jnp.isfinite(upper - lower)
    return where(finite, edges[:-1], lower), where(finite, edges[1:], upper)


def hull(boxes: Interval, alive: Any) -> tuple[Interval, Any]:
    """Hull of the boxes (cells, r) that are alive, and whether there are any."""
    low = smallest(where(alive[:, None], boxes.lower, jnp.inf), 0)
    high = largest(where(alive[:, None], boxes.upper, -jnp.inf), 0)
    return Interval.unchecked(low, high), alive.any()
