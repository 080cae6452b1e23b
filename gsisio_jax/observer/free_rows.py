"""Sums of the plant's equations in which d[k-1] cancels: what step k-1 says of combinations of x[k]."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from gsisio_jax.interval.box import Interval, is_concrete
from gsisio_jax.interval.image import widened_for_sums
from gsisio_jax.interval.minmax import cut, larger, raised, smaller
from gsisio_jax.observer.contractors import Affine
from gsisio_jax.observer.types import Observer

MOST_ROWS = 64
_PARALLEL = 1e-9  # share of a row by which it may miss a multiple of another one
_ROUNDING = 1e-9  # share of a row's largest weight below which what it takes of x[k] is rounding


class FreeRows(NamedTuple):
    """``r x[k] = r (f + B u + w) + s (g + D u + v - y)`` with ``r G + s H = 0``, those of one direction together.

    Attributes:
        weights: (c, n + l), r and s; known: (c, b), of the inputs with bounds.
        lost: (c, p), what they leave of d[k-1].
        groups: for every direction, the rows whose r are multiples of it.
        shares: (c,) these multiples; errors: (c, n), by how much r may differ from that multiple.
        directions: (m, n).
    """

    weights: Any
    known: Any
    lost: Any
    groups: list[list[int]]
    shares: np.ndarray
    errors: np.ndarray
    directions: Any

    @classmethod
    def of(cls, observer: Observer) -> FreeRows:
        """The circuits of [G; H], and what the gains take of step k-1; at most `MOST_ROWS`."""
        n, exact, gains, constants = observer.system.n, observer.exact, observer.gains, observer.rounding_constants
        circuits = exact.circuits, -exact.circuits_known, constants.circuits
        if not all(map(is_concrete, (*circuits, gains.residual, gains.known, constants.gains.d))):
            weights, known, lost = (part[:MOST_ROWS] for part in circuits)
            c = len(weights)
            return cls(weights, known, lost, [[i] for i in range(c)], np.ones(c), np.zeros((c, n)), weights[:, :n])
        of_gains = (_flat(np.asarray(part)) for part in (gains.residual, gains.known, constants.gains.d))
        weights, known, lost = (
            np.concatenate([np.asarray(a), b]) for a, b in zip(circuits, of_gains, strict=True)
        )  # fmt: skip
        size = np.abs(weights).max(1, keepdims=True, initial=0.0)
        which = np.flatnonzero((np.abs(weights[:, :n]) > _ROUNDING * size).any(1))
        which = np.sort(which[np.unique(weights[which], axis=0, return_index=True)[1]])[:MOST_ROWS]
        of_x = weights[which, :n].astype(np.float64)
        groups, shares, errors = _grouped(of_x)
        firsts = which[[group[0] for group in groups]]
        return cls(weights[which], known[which], lost[which], groups, shares, errors, weights[firsts, :n])

    def linear(self) -> Affine | None:
        """The directions as affine bounds of themselves; None where there are none."""
        none = np.zeros(len(self.directions), self.directions.dtype)
        return Affine(self.directions, none, none) if len(none) else None

    def met(self, rows: Interval, terms: int) -> tuple[Interval, Any]:
        """Boxes of the rows (c,) as boxes of the directions (m,), never crossed, and how much room they leave."""
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
            low.append(a)
            high.append(b)
        a, b = jnp.stack(low), jnp.stack(high)
        return Interval.unchecked(smaller(a, b), larger(a, b)), b - a


def _flat(stack: np.ndarray) -> np.ndarray:
    """(K, r, m) as (K r, m)."""
    return stack.reshape(stack.shape[0] * stack.shape[1], stack.shape[2])


def _grouped(of_x: np.ndarray) -> tuple[list[list[int]], np.ndarray, np.ndarray]:
    groups: list[list[int]] = []
    shares, errors = np.ones(len(of_x)), np.zeros_like(of_x)
    for i, row in enumerate(of_x):
        for group in groups:
            first = of_x[group[0]]
            at = np.abs(first).argmax()
            share = row[at] / first[at]
            off = np.abs(row - share * first)
            if share and (off <= _PARALLEL * np.abs(row).max()).all():
                # Product and difference are rounded themselves.
                shares[i], errors[i] = share, 2 * off + 2.0**-51 * np.abs(row)
                group.append(i)
                break
        else:
            groups.append([i])
    return groups, shares, errors
