"""Which outputs of y[k] a restart believes: the largest set of them that agrees with itself and the state bounds."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.interval.box import Interval, choose, is_concrete
from gsisio_jax.interval.direct import where
from gsisio_jax.interval.image import plain_image, widened_for_sums
from gsisio_jax.observer.contractors import contract_affine_rows
from gsisio_jax.observer.domain import Domain
from gsisio_jax.observer.initial import FirstForm
from gsisio_jax.observer.maps import Maps
from gsisio_jax.observer.measurement import output_box, typed
from gsisio_jax.plant.system import Noise

_MOST_SETS = 20


def can_disagree(observer: Any) -> bool:
    """Can outputs of one step contradict each other or the state bounds? Known while tracing."""
    bounds = observer.system.state_bounds
    if len(observer.output_rows) < 2:
        return False
    if not (is_concrete(bounds.lower) and is_concrete(bounds.upper)):
        return True
    return bool((np.isfinite(bounds.lower) | np.isfinite(bounds.upper)).any()) or _redundant(observer)


def _redundant(observer: Any) -> bool:
    """More unknown-input-free outputs than states they show."""
    return not is_concrete(observer.C) or np.linalg.matrix_rank(np.asarray(observer.C)) < len(observer.C)


@jax.named_scope("restart")
def agreeing(maps: Maps, alone: Domain, y: Any, u: Any, noise: Noise) -> tuple[Domain, Any]:
    """Where y[k] contradicts itself or the state bounds, what the largest set of its outputs that does not says.

    Args:
        maps: of the observer.
        alone: what all of y[k] and the state bounds say.
        y, u, noise: of step k.

    Returns:
        The hull over all sets of that size that agree, and y with NaN for the outputs that are not in all of them. What
        was given where y[k] agrees, or where no set of those that are tried does.

    Source: theory 8.2.
    """
    observer, system, tolerance = maps.observer, maps.observer.system, alone.tolerance
    bounds, first = typed(system.state_bounds, y.dtype), FirstForm.of(observer, u)
    z = plain_image(observer.T2, widened_for_sums(output_box(system, y, u, noise.v), system.l))
    seen, sets, redundant = jnp.isfinite(y), _sets(system.l), _redundant(observer)
    on_bounds = contract_affine_rows(maps.states(bounds), first.on(bounds), z)

    def of(kept: np.ndarray) -> tuple[Any, Interval]:
        """Whether a set agrees, and what it says of x[k]."""
        rows = [r for r, outputs in enumerate(observer.output_rows) if kept[list(outputs)].all()]
        box, gap = _met(bounds, *on_bounds, rows)
        if redundant:  # rows of several states say something once others are known
            box, less = _met(box, *contract_affine_rows(maps.states(box), first.on(box), z), rows)
            gap = jnp.minimum(gap, less)
        return gap >= -tolerance, box

    disagree = alone.conflict
    if redundant:
        disagree = disagree | ~of(np.ones(system.l, bool))[0]
    if not sets:  # so many outputs that even those without one of them are too many sets
        return Domain(alone.box, tolerance, where(disagree, -jnp.inf, alone.gap), alone.margin, alone.source), y
    agree, boxes = zip(*map(of, sets), strict=True)
    size = [where(ok, (seen & kept).sum(), -1) for ok, kept in zip(agree, sets, strict=True)]
    largest = jnp.stack(size).max()
    chosen = [(count == largest) & (largest >= 0) for count in size]
    lower = jnp.stack([where(yes, box.lower, jnp.inf) for yes, box in zip(chosen, boxes, strict=True)]).min(0)
    upper = jnp.stack([where(yes, box.upper, -jnp.inf) for yes, box in zip(chosen, boxes, strict=True)]).max(0)
    used = disagree & (largest >= 0)
    believed = jnp.stack([kept | ~yes for yes, kept in zip(chosen, sets, strict=True)]).all(0)
    box = choose(used, Interval.unchecked(lower, upper), alone.box)
    gap = where(used, 0, where(disagree, -jnp.inf, alone.gap))
    return Domain(box, tolerance, gap, alone.margin, alone.source), where(used & ~believed, jnp.nan, y)


def _met(box: Interval, boxes: Interval, slack: Any, rows: list[int]) -> tuple[Interval, Any]:
    """A box met with those of some rows, never crossed, and the least slack; what overflowed says nothing."""
    lower, upper, gap = box.lower, box.upper, jnp.asarray(jnp.inf, box.dtype)
    for r in rows:
        lower = where(boxes.lower[r] > lower, boxes.lower[r], lower)
        upper = where(boxes.upper[r] < upper, boxes.upper[r], upper)
        gap = where(slack[r] < gap, slack[r], gap)
    for i in range(lower.shape[0]):
        gap = where(upper[i] - lower[i] < gap, upper[i] - lower[i], gap)
    return Interval.unchecked(jnp.minimum(lower, upper), jnp.maximum(lower, upper)), gap


def _sets(l: int) -> list[np.ndarray]:
    """Sets of outputs as masks, the largest ones first, down to the size with which they become too many."""
    found: list[np.ndarray] = []
    for size in range(l - 1, 0, -1):
        more = [np.isin(np.arange(l), kept) for kept in combinations(range(l), size)]
        if len(found) + len(more) > _MOST_SETS:
            break
        found.extend(more)
    return found
