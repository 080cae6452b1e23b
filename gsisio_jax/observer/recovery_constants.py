"""What the rows of `Recovery` leave by rounding, bounded by what is measured. NumPy, offline.

All equations of a window, plant and outputs, are ``M X = r``: X are the states and free inputs of its steps, r what is
known of each equation. A row m gives ``X_c = m r + (e_c - m M) X``. With one row for every entry of X that matters,
``|X| <= b size + rho |X|`` where rho is of the size of rounding, so ``|X| <= 2 b size``: however large X is, the
measurements say how large. Source: theory 5.8.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gsisio_jax.interval.box import Interval
from gsisio_jax.observer.enclosures import BoundsOfBox
from gsisio_jax.observer.recovery import Recovery

_UP = 1 + 1e-9  # covers float64 sums of nonnegative numbers
_DETERMINED = 1e-9  # what a row may miss of the entry that it is for, in units of typical widths
_DUST = 1e-12  # entries of a pseudo-inverse below this share of a row's largest one are what rounding left
_EPS = float(np.finfo(np.float64).eps)


@dataclass(frozen=True)
class AffineMaps:
    """f, g and T2 g on the state bounds are ``slope x + center``, up to `radius` and ``slack |x|``; n + l + q rows."""

    slope: np.ndarray
    slack: np.ndarray
    center: np.ndarray
    radius: np.ndarray

    @classmethod
    def of(cls, bounds: BoundsOfBox | None, state_bounds: Interval) -> AffineMaps | None:
        """From `Enclosures.maps`; None where there are no such bounds."""
        if bounds is None:
            return None
        form, slack = bounds(state_bounds)
        slope, lower, upper = (np.asarray(x, np.float64) for x in (form.slope, form.offset.lower, form.offset.upper))
        if not all(np.isfinite(x).all() for x in (slope, slack, lower, upper)):
            return None
        center = lower + (upper - lower) / 2
        return cls(slope, slack, center, np.maximum(upper - center, center - lower) * _UP + 4 * _EPS * np.abs(center))


@dataclass(frozen=True)
class Equations:
    """``M X = r`` over N steps, the oldest first.

    Rows: n of the plant and l of the outputs for each of the N steps, then q of T2 y at the last, and n of the box of
    the first state where there is one. Columns: n states for each of N + 1 steps, then the free inputs of N steps.

    Attributes:
        matrix, radius: M, and what its slopes are off by.
        rows, columns: units of r and X.
    """

    matrix: np.ndarray
    radius: np.ndarray
    rows: np.ndarray
    columns: np.ndarray

    @classmethod
    def of(
        cls, maps: AffineMaps, G: np.ndarray, H: np.ndarray, steps: int, x: np.ndarray, y: np.ndarray, z: np.ndarray
    ) -> Equations:
        """From affine bounds of a plant and its free inputs; x, y, z are units of states, outputs and T2 y."""
        n, l, q, p = len(x), len(y), len(maps.slope) - len(x) - len(y), G.shape[1]
        size = steps * (n + l) + q, (steps + 1) * n + steps * p
        M, radius = np.zeros(size), np.zeros(size)
        F, E, Z = np.split(maps.slope, [n, n + l])
        F_slack, E_slack, Z_slack = np.split(maps.slack, [n, n + l])
        for j in range(steps):
            plant, outputs = slice(j * (n + l), j * (n + l) + n), slice(j * (n + l) + n, (j + 1) * (n + l))
            x_j, x_next = slice(j * n, (j + 1) * n), slice((j + 1) * n, (j + 2) * n)
            d_j = slice((steps + 1) * n + j * p, (steps + 1) * n + (j + 1) * p)
            M[plant, x_j], radius[plant, x_j] = -F, F_slack
            M[plant, x_next], M[plant, d_j] = np.eye(n), -G
            M[outputs, x_j], radius[outputs, x_j], M[outputs, d_j] = E, E_slack, H
        if q:
            M[-q:, steps * n : (steps + 1) * n] = Z
            radius[-q:, steps * n : (steps + 1) * n] = Z_slack
        d = 1 / np.abs(np.vstack([G / x[:, None], H / y[:, None]])).max(0, initial=0.0)
        rows = np.concatenate([*[np.concatenate([x, y])] * steps, z])
        return cls(M, radius, rows, np.concatenate([*[x] * (steps + 1), *[d] * steps]))

    def without(self, lost: np.ndarray) -> Equations:
        """Those in the mask (rows,) say nothing."""
        return replace(
            self, matrix=np.where(lost[:, None], 0, self.matrix), radius=np.where(lost[:, None], 0, self.radius)
        )

    def anchored(self, n: int) -> Equations:
        """With the first n states known."""
        matrix = np.vstack([self.matrix, np.eye(n, self.matrix.shape[1])])
        radius = np.vstack([self.radius, np.zeros((n, self.matrix.shape[1]))])
        return replace(self, matrix=matrix, radius=radius, rows=np.concatenate([self.rows, self.columns[:n]]))

    def determined(self) -> tuple[np.ndarray, np.ndarray]:
        """A row m (columns, rows) for every entry of X, and which of them give it."""
        scaled = self.matrix / self.rows[:, None] * self.columns
        inverse = np.where(scaled.any(1), np.linalg.pinv(scaled, rcond=1e-11), 0.0)  # what says nothing counts nothing
        # Nor does what rounding left: it would ask for entries that nothing determines.
        inverse[np.abs(inverse) < _DUST * np.abs(inverse).max(1, keepdims=True, initial=0.0)] = 0
        given = np.abs(np.eye(scaled.shape[1]) - inverse @ scaled).max(1, initial=0.0) < _DETERMINED
        return inverse * self.columns[:, None] / self.rows, given

    def missed(self, weights: np.ndarray, targets: np.ndarray, slack: np.ndarray) -> np.ndarray:
        """Upper bound of ``|e_c - m M|`` (k, columns), for rows m (k, rows) of entries c; `slack` (rows, columns) is
        what M may be off by besides."""
        sizes = np.abs(weights) @ np.abs(self.matrix)
        ideal = np.eye(self.matrix.shape[1])[targets]
        left = np.abs(ideal - weights @ self.matrix) + (len(self.rows) + 8) * _EPS * (sizes + ideal)
        # A column that no weight touches is missed by nothing.
        return np.where((sizes > 0) | (ideal > 0), left, 0.0) * _UP + np.abs(weights) @ (self.radius + slack) * _UP


def with_constants(
    found: Recovery, system: Any, maps: AffineMaps, T2: np.ndarray, H_slack: np.ndarray, free: np.ndarray, dtype: Any
) -> Recovery | None:
    """The rows, their multipliers being what they are in `dtype`, with all that rounding asks for.

    Args:
        found: rows in float64 numbers of `dtype`.
        system: the plant as it was given.
        maps: affine bounds of f, g and T2 g on the state bounds, in `dtype`.
        T2: (q, l) in `dtype`.
        H_slack: (l, p), how far the H of the promise may be from the one that is written.
        free: (p,) inputs without bounds.

    Returns:
        None where what is left is too large to be bounded.
    """
    n, l, N, R = system.n, system.l, found.length, len(found.targets)
    G, H, slack = (np.asarray(M, np.float64)[:, free] for M in (system.G, system.H, H_slack))
    weight = found.scales.max(0)
    units = np.where(weight > 0, 1 / np.where(weight > 0, weight, 1.0), 1.0)
    z = np.abs(T2) @ units[n:]
    equations = Equations.of(maps, G, H, N, units[:n], units[n:], z)
    unused = found.scales == 0  # not to be relied on: a measurement that may be missing
    lost = np.concatenate([unused[:N][::-1].ravel(), (T2[:, unused[N, n:]] != 0).any(1)])
    equations = equations.without(lost)
    if found.anchor is not None:
        equations = equations.anchored(n)
    off = np.zeros_like(equations.matrix)  # what M is off by because H is
    for j in range(N):
        d_j = (N + 1) * n + j * slack.shape[1]
        off[j * (n + l) + n : (j + 1) * (n + l), d_j : d_j + slack.shape[1]] = slack
    off[: len(lost)][lost] = 0
    # Rows in the order of the equations: what multiplies g has the other sign.
    weights = found.multipliers[::-1] * np.concatenate([np.ones(n), -np.ones(l)])
    weights = np.concatenate([weights.transpose(1, 0, 2).reshape(R, -1), found.remainder], 1)
    if found.anchor is not None:
        weights = np.concatenate([weights, found.anchor], 1)
    left = equations.missed(weights, N * n + np.array(found.targets), off)
    every, given = equations.determined()
    rho = equations.missed(every, np.arange(len(given)), off)
    needed = _reached(np.asarray(left.any(0)), rho > 0)
    scaled = rho[needed] * equations.columns / equations.columns[needed, None]
    if not given[needed].all() or scaled.sum(1).max(initial=0.0) > 0.5:
        return None
    # In units of its entries |X| is at most this times |r|, which is at most `size` and what is known offline.
    entry = 4 * (np.abs(every[needed]) @ equations.rows / equations.columns[needed]).max(initial=0.0) * _UP

    used = (np.concatenate([every[needed], weights]) != 0).any(0)
    used, used_now, used_box = np.split(used, [N * (n + l), N * (n + l) + len(T2)])
    now = np.concatenate([np.zeros(n, bool), (T2[used_now] != 0).any(0)])
    by_entry = np.vstack([used.reshape(N, n + l)[::-1], now])
    sign = np.concatenate([np.ones(n), -np.ones(l + len(T2))])
    offset, around = (
        np.concatenate([*[part[: n + l]] * N, part[n + l :], np.zeros(len(used_box))])
        for part in (maps.center * sign, maps.radius)
    )
    constant = weights @ offset
    terms = len(offset) + 16
    error = np.abs(weights) @ (around + terms * float(np.finfo(dtype).eps) * np.abs(offset)) * _UP
    bounded = np.maximum(np.abs(system.input_bounds.lower), np.abs(system.input_bounds.upper))[~free]
    fixed = np.abs(np.vstack([system.G, system.H]))[:, ~free] @ bounded if len(bounded) else np.zeros(n + l)
    fixed = np.concatenate([*[fixed] * N, np.abs(T2) @ fixed[n:], np.zeros(len(used_box))])
    floor = ((np.abs(offset) + around + fixed) / equations.rows).max(initial=0.0)
    return replace(
        found,
        constant=Interval.unchecked(constant - error, constant + error),
        slack=left @ equations.columns * entry * _UP,
        scales=np.where(by_entry, 1 / units, 0.0) * (1 + 1e-6),
        floor=np.asarray(floor * (1 + 1e-6)),
        anchor_scales=None if found.anchor is None else np.where(used_box, 1 / units[:n], 0.0) * (1 + 1e-6),
    )


def _reached(start: np.ndarray, links: np.ndarray) -> np.ndarray:
    """Entries that are needed, and those that these need."""
    needed = start.copy()
    while (more := needed | links[needed].any(0)).sum() > needed.sum():
        needed = more
    return needed
