"""Affine abstraction: planes that hold at the vertices of every cell, from a linear program."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from gsisio_jax.design.abstraction_sigma import refusal
from gsisio_jax.design.gains import solve

_COLUMNS = 2**14  # entries of the vertex table per linear program
ROUNDING = 16 * np.finfo(float).eps  # of the planes' evaluation, in units of the largest number in it


class VertexPlanes(NamedTuple):
    """Planes above f, then planes above -f: slope (cells, 2, m, n) and offset (cells, 2, m)."""

    slope: np.ndarray
    offset: np.ndarray
    rounding: np.ndarray  # (cells, m), what evaluating them in float64 may lose


def planes_at_vertices(
    corners: np.ndarray, values: np.ndarray, signs: np.ndarray, width: np.ndarray, slopes: str, sigma: np.ndarray
) -> VertexPlanes:
    """Planes that hold at the vertices and touch there."""
    (cells, vertices, n), m = corners.shape, values.shape[-1]
    slope = np.zeros((cells, 2, m, n))
    if slopes == "free":
        # On the cube [-1, 1]^n all cells share one program matrix; one column per cell and component.
        flat = values.transpose(1, 0, 2).reshape(vertices, cells * m)
        up, low = _best_slopes(signs, flat)
        half = 0.5 * width[:, None, None, :]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            slope = np.stack([part.T.reshape(cells, m, n) for part in (up, -low)], axis=1) / half
        slope = np.where(half == 0, 0.0, slope)
    if not np.isfinite(slope).all():
        raise refusal("the slopes overflow, the region is too small for the change of f on it; give a wider region")
    # Only the slopes are the solver's: the offsets are evaluated, so that the planes hold at every vertex.
    offset = (np.stack([values, -values], axis=1) - np.einsum("isjk,ivk->isvj", slope, corners)).max(axis=2)
    size = np.einsum("isjk,ik->isj", np.abs(slope), np.abs(corners).max(1)).max(1)
    return VertexPlanes(slope, offset, ROUNDING * (np.abs(values).max(1) + size + sigma))


def _best_slopes(signs: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Slopes (n, columns) of the planes above and below with the smallest gap at the vertices of the cube."""
    spread = np.maximum(values.max(0) - values.min(0), np.finfo(float).tiny)
    scaled = (values - values.mean(0)) / spread
    # Least squares are exact for affine functions, where an interior-point method is not.
    up = signs.T @ scaled / len(signs)
    low, theta = up.copy(), _cube_gap(signs, scaled, up, up)
    hard = np.flatnonzero(theta > 1e-12)
    share = max(1, _COLUMNS // len(signs))
    for columns in (hard[start : start + share] for start in range(0, len(hard), share)):
        found = _solve(signs, scaled[:, columns])
        better = _cube_gap(signs, scaled[:, columns], *found) < theta[columns]
        up[:, columns] = np.where(better, found[0], up[:, columns])
        low[:, columns] = np.where(better, found[1], low[:, columns])
    return up * spread, low * spread


def _solve(signs: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(eq:abstraction) with sigma = 0, one program for many columns that share nothing but the vertices."""
    import cvxpy as cp

    table = np.column_stack([signs, np.ones(len(signs))])
    above, below = (cp.Variable((table.shape[1], values.shape[1])) for _ in range(2))
    theta = cp.Variable((1, values.shape[1]))
    constraints: list[Any] = [
        table @ above >= values,
        table @ below <= values,
        table @ (above - below) <= np.ones((len(signs), 1)) @ theta,
    ]
    if not solve(cp.Problem(cp.Minimize(cp.sum(theta)), constraints)) or above.value is None or below.value is None:
        raise refusal("the solver failed on the linear program; rescale f and x to similar magnitudes")
    return above.value[:-1], below.value[:-1]


def _cube_gap(signs: np.ndarray, values: np.ndarray, up: np.ndarray, low: np.ndarray) -> np.ndarray:
    """theta of these slopes, with the best offsets: evaluated, not taken from the solver."""
    above, below = signs @ up, signs @ low
    return (above - below).max(0) + (values - above).max(0) + (below - values).max(0)


def gap(planes: VertexPlanes, corners: np.ndarray) -> np.ndarray:
    """Largest distance of the two planes on each cell (cells, m); it is reached at a vertex."""
    height = np.einsum("ijk,ivk->ivj", planes.slope.sum(1), corners) + planes.offset.sum(1)[:, None, :]
    return np.maximum(height.max(1), 0.0)
