"""Affine abstraction: how far f leaves its planes, seen at points and proved by bounds on sub-boxes."""

from __future__ import annotations

from typing import Any

import numpy as np

from gsisio_jax.design.abstraction_program import ROUNDING, VertexPlanes
from gsisio_jax.design.abstraction_sigma import on_boxes, refusal
from gsisio_jax.interval.box import Interval

_CLOSE = 1e-3  # the proof stops within this share of the gap
_VIOLATION = 1e-9  # beyond sigma by this share of the largest number is no rounding


def prove(
    f: Any, cells: Interval, planes: VertexPlanes, sigma: np.ndarray, theta: np.ndarray, tighten: bool, budget: int
) -> tuple[np.ndarray, np.ndarray]:
    """How far f leaves the planes (cells, 2, m): as seen at points, and as proved on the whole cell.

    Branch and bound on all cells at once: what may still hold the largest excess is split, until that is known.
    """
    seen, proved = np.zeros(planes.offset.shape), np.full(planes.offset.shape, -np.inf)
    most, rounding = sigma[:, None], planes.rounding[:, None]
    scale = np.where(cells.width > 0, cells.width, np.inf)
    low, high, cell = cells.lower, cells.upper, np.arange(len(sigma))
    left = np.full(len(sigma), budget - 1)
    while len(cell):
        bound, value = _leaving(f, low, high, planes.slope[cell], planes.offset[cell])
        _refuse_violation(value, (most + _VIOLATION / ROUNDING * rounding)[cell], low, high)
        np.maximum.at(seen, cell, value)
        enough = seen + _CLOSE * (seen.sum(1) + theta)[:, None] if tighten else most
        # The bounds of f may be rounded outward by more than the planes are.
        missing = (bound - (enough + 64 * rounding)[cell]).max(axis=(1, 2))
        rows = np.arange(len(cell))
        axis = np.argmax((high - low) / scale[cell], axis=1)
        cut = (0.5 * low + 0.5 * high)[rows, axis]
        chosen = (missing > 0) & (low[rows, axis] < cut) & (cut < high[rows, axis])
        # What is left of a cell's budget goes to its worst boxes.
        order = np.lexsort((-missing, ~chosen, cell))
        rank = rows - np.searchsorted(cell[order], cell[order])
        chosen[order] &= 2 * (rank + 1) <= left[cell[order]]
        np.maximum.at(proved, cell[~chosen], bound[~chosen])
        low, high, cell, axis, cut = low[chosen], high[chosen], cell[chosen], axis[chosen], cut[chosen]
        np.subtract.at(left, cell, 2)
        first, second = high.copy(), low.copy()
        first[np.arange(len(cell)), axis] = second[np.arange(len(cell)), axis] = cut
        low, high, cell = np.concatenate([low, second]), np.concatenate([first, high]), np.concatenate([cell, cell])
    return seen, proved


def _leaving(f: Any, low: np.ndarray, high: np.ndarray, slope: np.ndarray, offset: np.ndarray) -> tuple[Any, Any]:
    """Upper bounds of ``f - plane`` and ``plane' - f`` on boxes (boxes, 2, m), and their values at the centers."""
    form, at = on_boxes("bounds", f, low, high)
    bound, value = np.empty_like(offset), np.empty_like(offset)
    a, b, center = low[:, None, :], high[:, None, :], 0.5 * low + 0.5 * high
    tops = (1, form.offset.upper, form.range.upper), (-1, -form.offset.lower, -form.range.lower)
    for side, (sign, form_top, top) in enumerate(tops):
        plane, tilt = slope[:, side], sign * form.slope - slope[:, side]
        by_form = form_top + np.where(tilt > 0, tilt * b, tilt * a).sum(-1)
        bound[:, side] = np.fmin(by_form, top - np.where(plane > 0, plane * a, plane * b).sum(-1))
        value[:, side] = sign * at - np.einsum("bij,bj->bi", plane, center)
    return np.where(np.isnan(bound), np.inf, bound) - offset, value - offset


def _refuse_violation(value: np.ndarray, allowed: np.ndarray, low: np.ndarray, high: np.ndarray) -> None:
    if not (value <= allowed).all():
        box, side, i = np.argwhere(~(value <= allowed))[0]
        raise refusal(
            f"at x = {0.5 * low[box] + 0.5 * high[box]} component {i} of f is {value[box, side, i]:.6g} "
            f"{('above', 'below')[side]} the plane through the vertices, where sigma = {allowed[box, 0, i]:.6g} was "
            "promised; give a larger `constant` or `sigma`, or the smoothness class that f has"
        )
