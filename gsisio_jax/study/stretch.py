"""A stretch of a record, and a plant that is affine along it: what the programs of `tightness` are made of."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np


class Sides(NamedTuple):
    """Lower and upper bounds in NumPy, float64; empty where they are crossed."""

    lower: np.ndarray
    upper: np.ndarray

    def rows(self, rows: Any) -> Sides:
        return Sides(self.lower[rows], self.upper[rows])

    def clip(self, values: np.ndarray) -> np.ndarray:
        return np.clip(values, self.lower, self.upper)


class Affine(NamedTuple):
    """``f = A x + a`` and ``g = C x + c`` at every row: (s, n, n), (s, n), (s, l, n), (s, l)."""

    A: np.ndarray
    a: np.ndarray
    C: np.ndarray
    c: np.ndarray

    def rows(self, rows: slice) -> Affine:
        return Affine(*(part[rows] for part in self))


@dataclass(frozen=True)
class Stretch:
    """What is known of s successive rows of a record.

    Attributes:
        G, H: (n, p), (l, p).
        y: (s, l), without ``D u``; NaN where missing. push: ``B u``, (s, n). u: (s, m).
        w, v: bounds of the noise, (s, n) and (s, l).
        state: bounds of the states, (s, n), the first row being the box that the stretch begins in.
        input: bounds of the unknown inputs, (p,).
    """

    G: np.ndarray
    H: np.ndarray
    y: np.ndarray
    push: np.ndarray
    u: np.ndarray
    w: Sides
    v: Sides
    state: Sides
    input: Sides

    @property
    def length(self) -> int:
        return len(self.y)

    def cut(self, first: int, last: int, begin: Sides, measured: bool) -> Stretch:
        """Rows `first` to `last`, begun in a box, with or without the last measurement."""
        rows = slice(first, last + 1)
        y = self.y[rows].copy()
        if not measured:
            y[-1] = np.nan
        state = Sides(*(side[rows].copy() for side in (self.state.lower, self.state.upper)))
        state.lower[0] = np.maximum(state.lower[0], begin.lower)
        state.upper[0] = np.minimum(state.upper[0], begin.upper)
        return replace(
            self, y=y, push=self.push[rows], u=self.u[rows], w=self.w.rows(rows), v=self.v.rows(rows), state=state
        )
