"""The outputs on parts of the box of x[k]: finds a state in a box on which one affine form of the outputs says little.

A form of ``T2 g`` on the whole box has a rest as large as g is bent there: ranges to beacons on a box of the size of
their distances tell nothing, though three of them meet in a point. On a part of half the width the rest is a quarter.
So the box is cut into cells, in each the outputs are contracted with a form of its own, cells that contradict an output
are dropped, and the box is cut down to the hull of what is left; and again, `ROUNDS` times. Cells cover the box and
share their edges, so no state is lost.
"""

from __future__ import annotations

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.minmax import cut, raised
from gsisio_jax.observer.contractors import affine_rows, contract_affine_rows
from gsisio_jax.observer.domain import Domain
from gsisio_jax.observer.maps import Maps
from gsisio_jax.observer.status import Source

ROUNDS = 4


def counts(cells: int, bent: np.ndarray) -> tuple[int, ...]:
    """Into how many parts every state is cut, about `cells` in all: only those in which an output is bent."""
    axes = int(bent.sum())
    if cells < 2 or not axes:
        return ()
    each = max(2, int(cells ** (1 / axes) + 1e-9))
    return tuple(each if one else 1 for one in bent)


@jax.named_scope("cells")
def contract(maps: Maps, domain: Domain, z: Interval, u: Any) -> Domain:
    """Contract with ``T2 g(x) in z`` on the cells of the box; a box that is infinite along a state is not cut there."""
    parts = maps.observer.cells
    places = np.array(list(itertools.product(*map(range, parts))))
    free = maps.free  # made once: it is kept

    def one(lower: Any, upper: Any) -> tuple[Any, Any, Any]:
        cell = Interval.unchecked(lower, upper)
        states = maps.states(cell)
        form = affine_rows(free, states, maps.free_bounds(states, cell, u))
        rows, slack = contract_affine_rows(states, form, z)
        for i in range(rows.lower.shape[0]):
            lower, upper = raised(lower, rows.lower[i]), cut(upper, rows.upper[i])
        # Boxes of different outputs may also miss each other.
        slack = jnp.minimum(slack, (upper - lower).min())
        return jnp.minimum(lower, upper), jnp.maximum(lower, upper), slack

    def turn(box: Interval, _: Any) -> tuple[Interval, Any]:
        edges = [_edges(box.lower[i], box.upper[i], count) for i, count in enumerate(parts)]
        lower = jnp.stack([edge[places[:, i]] for i, edge in enumerate(edges)], -1)
        upper = jnp.stack([edge[places[:, i] + 1] for i, edge in enumerate(edges)], -1)
        low, high, slack = jax.vmap(one)(lower, upper)
        alive = ~(slack < -domain.tolerance).any(-1)
        low = jnp.where(alive[:, None], low, jnp.inf).min(0)
        high = jnp.where(alive[:, None], high, -jnp.inf).max(0)
        # Where all contradict an output, the box stays what it is; what the best of them misses is noted.
        some = alive.any()
        left = Interval.unchecked(jnp.where(some, low, box.lower), jnp.where(some, high, box.upper))
        return left, jnp.where(some, jnp.inf, slack[jnp.argmax(slack.min(-1))])

    box, slacks = jax.lax.scan(turn, domain.box, None, length=ROUNDS)
    return domain.record_margin(slacks[-1], Source.OUTPUT).with_box(box)


def _edges(lower: Any, upper: Any, count: int) -> Any:
    """Edges of the cells along one state, increasing; the ends are those of the box. The first cell of an infinite
    box is all of it, and so are the others."""
    share = np.arange(1, count) / count
    inner = jnp.clip(lower + (upper - lower) * share, lower, upper)
    return jnp.concatenate([lower[None], inner, upper[None]])
