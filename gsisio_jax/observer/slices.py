"""What the slopes of a gain are on every part of a region, and what that promises of widths (theory 6).

A box that is as wide as its region meets the largest slope of the region nowhere but at one end. So every state of the
region is cut into slices, and along that state the slope counts slice by slice.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.atoms import wider
from gsisio_jax.interval.minmax import larger, smaller

_MOST = 20_000  # rounds of `settled`, each of which is a promise by itself
_SETTLED = 1e-9  # relative change of a round that ends them


class Slices(eqx.Module):
    """Slopes of a map of x, state by state and slice by slice, the other states being anywhere in the region.

    Attributes:
        edges: (n, K+1), ends of the slices of every state, the first and the last being those of the region. Slices may
            be empty.
        rising, falling: (r, n, K), upper bounds of the slope and of minus the slope of row i along state j in its slice
            s, 0 where these are negative.
    """

    edges: Any
    rising: Any
    falling: Any

    def reach(self, lower: Any, center: Any, upper: Any) -> tuple[Any, Any]:
        """How far the map may be below and above its value at a point of a box of the region, (r,) each.

        From the centre to any point along one axis after the other: along each the slope is that of the slices passed.
        Lengths are differences of numbers as they are, so rounding costs a share of them.
        """
        before, after = self._lengths(lower, center), self._lengths(center, upper)
        terms = self.edges.size

        def far(up: Any, down: Any) -> Any:
            up, down = (jnp.asarray(side, before.dtype) for side in (up, down))
            found = larger((up * after).sum(-1), (down * before).sum(-1)).sum(-1)
            return found + wider(found, terms)

        return far(self.falling, self.rising), far(self.rising, self.falling)

    def _lengths(self, begin: Any, end: Any) -> Any:
        """Of every slice, what lies between two points, (n, K)."""
        edges = jnp.asarray(self.edges, begin.dtype)
        first, last = larger(begin[:, None], edges[:, :-1]), smaller(end[:, None], edges[:, 1:])
        return larger(last - first, jnp.zeros_like(first))

    def growth(self, width: Any) -> np.ndarray:
        """Upper bounds (..., r) of the sum of what `reach` gives for boxes (..., n) of the region that are no wider.

        A row that only rises or only falls along a state reaches, below and above together, its slope summed over the
        box; any other at most twice its steepest slope summed over half a box.
        """
        edges = np.asarray(self.edges)
        width = np.minimum(np.asarray(width, np.float64), edges[:, -1] - edges[:, 0])
        rising, falling = (np.asarray(side, np.float64) for side in (self.rising, self.falling))
        steepest = np.maximum(rising, falling)
        one_way = ~(rising.any(-1) & falling.any(-1))  # (r, n)
        whole, half = self._most(steepest, width), 2 * self._most(steepest, 0.5 * width)
        return np.where(one_way, whole, half).sum(-1)

    def _most(self, density: np.ndarray, length: np.ndarray) -> np.ndarray:
        """The largest sum of a density over an interval of a given length in the region, (..., r, n): the interval
        begins or ends at an edge."""
        edges = np.asarray(self.edges, np.float64)
        anchors = np.where(np.isfinite(edges), edges, 0.0)  # a state without bounds has one slice, the same everywhere
        starts = np.concatenate(np.broadcast_arrays(anchors, anchors - length[..., None]), -1)  # (..., n, 2K+2)
        low, high = edges[:, :1], edges[:, -1:]
        starts = np.clip(starts, low, np.maximum(high - length[..., None], low))
        first = np.maximum(starts[..., None], edges[:, None, :-1])
        last = np.minimum((starts + length[..., None])[..., None], edges[:, None, 1:])
        lengths = np.maximum(last - first, 0.0)  # (..., n, 2K+2, K)
        return np.einsum("ijk,...jak->...ija", density, lengths).max(-1)

    def settled(self, start: Any, inverse: np.ndarray, added: np.ndarray, excess: Any = 0.0) -> np.ndarray:
        """Widths (..., n) at or below which boxes of the region settle: ``V (growth(width) + added) + excess`` again
        and again.

        `start`, at most the width of the region, bounds them to begin with. Widths that stay above it do not fit.
        """
        found = np.broadcast_to(start, added.shape)
        for _ in range(_MOST):
            after = (self.growth(found) + added) @ inverse.T + excess
            found, before = np.minimum(found, after), found
            if (before - found <= _SETTLED * before).all():
                break
        return np.where(after > start, after, found)
