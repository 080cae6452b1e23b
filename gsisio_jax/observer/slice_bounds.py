"""Slopes of a map on slices of a region, from enclosures: offline and in NumPy (theory 6)."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np

from gsisio_jax.interval.box import Interval
from gsisio_jax.observer.enclosures import Slopes
from gsisio_jax.observer.slices import Slices

_UP = 1 + 1e-12  # covers the rounding of a few float64 sums


def slices_of(
    weights: np.ndarray, slopes_on: Callable[[Interval], Slopes], edges: np.ndarray, dtype: Any, parts: int = 1
) -> Slices:
    """Slopes of ``weights [f; g]`` on slices.

    Args:
        weights: (r, n + l).
        slopes_on: from `slopes_of`, in that type.
        edges: (n, K+1), numbers of that type.
        dtype: the type of the bounds, which are rounded up.
        parts: into which every slice is cut once more, for narrower bounds.
    """
    n, count = edges.shape[0], edges.shape[1] - 1
    rising = np.zeros((len(weights), n, count))
    falling = np.zeros_like(rising)
    for j in range(n):
        for s in range(count):
            first, last = edges[j, s], edges[j, s + 1]
            if s > 0 and not first < last:
                continue
            inner = np.linspace(first, last, parts + 1)[1:-1] if np.isfinite(last - first) else []
            for low, high in pairwise(np.concatenate([[first], inner, [last]]).astype(dtype)):
                lower, upper = edges[:, 0].astype(dtype), edges[:, -1].astype(dtype)
                lower[j], upper[j] = low, high
                least, most = _slope(weights, slopes_on(Interval(lower, upper)), j)
                rising[:, j, s] = np.maximum(rising[:, j, s], most)
                falling[:, j, s] = np.maximum(falling[:, j, s], -least)
    up = np.nextafter(np.asarray([rising, falling], dtype), np.asarray(np.inf, dtype))
    rising, falling = np.where(np.array([rising, falling]) > 0, up, 0)
    return Slices(np.asarray(edges, dtype), np.asarray(rising, dtype), np.asarray(falling, dtype))


def _slope(weights: np.ndarray, slopes: Slopes, state: int) -> tuple[np.ndarray, np.ndarray]:
    """Bounds (r,) of the derivative of ``weights [f; g]`` along one state."""
    middle = np.concatenate([slopes.F[:, state], slopes.E[:, state]])
    radius = np.concatenate([slopes.F_radius[:, state], slopes.E_radius[:, state]])
    far = np.abs(weights) @ (radius * _UP + 4e-16 * (weights.shape[1] + 2) * np.abs(middle)) * _UP
    return weights @ middle - far, weights @ middle + far
