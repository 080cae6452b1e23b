"""`python -m benchmarks.directions`: what results in extra directions would bring beside windows, before building them.

A set of states is kept as bounds of S x for the rows of S: a box, or a box with extra directions. Linear programs over
one step, or over the last N, give the best bounds of S x that any gains can give from the bounds before; widths of x
over those of the exact hull. "pairs" are the sums and differences of any two states, "window" the rows of A^-1 and
A^-2, which are what a window of three steps looks at.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.optimize import linprog

from benchmarks.record import keep, line, title
from benchmarks.tightness import Plant, chain, full_rank, rotation

STEPS, LAST = 24, 8


def one_measured() -> Plant:
    """A slow turn, hardly damped, of which one state is measured."""
    return replace(_turn(0.999), C=np.eye(1, 2))


def unseen() -> Plant:
    """A damped turn that no output sees: the spectral radius of |A| is 1.22, so boxes of x grow from step to step."""
    return replace(_turn(0.97), C=np.zeros((1, 2)))


def _turn(damping: float) -> Plant:
    c, s = damping * np.cos(0.3), damping * np.sin(0.3)
    none = np.zeros((2, 0))
    A = np.array([[c, -s], [s, c]])
    return Plant(A, np.eye(1, 2), none, np.zeros((1, 0)), np.full(2, 0.01), np.array([0.1]), np.full(2, 3.0))


def directions(kind: str, A: np.ndarray) -> np.ndarray:
    """Rows of S, the states first, and then all of them with the other sign."""
    rows = [np.eye(len(A))]
    if kind == "pairs":
        rows += [rows[0][i] + sign * rows[0][[j]] for i, j in combinations(range(len(A)), 2) for sign in (1, -1)]
    if kind == "window":
        back = np.linalg.inv(A)
        rows += [M / np.abs(M).max(1, keepdims=True) for M in (back, back @ back)]
    S = np.concatenate(rows)
    return np.concatenate([S, -S])


@dataclass
class Program:
    """Constraints ``A z <= b`` on the states and inputs of successive steps."""

    plant: Plant
    steps: int

    def __post_init__(self) -> None:
        self.n, self.p = self.plant.G.shape
        self.rows: list[np.ndarray] = []
        self.limits: list[float] = []

    def add(self, limit: float, **parts: tuple[int, np.ndarray]) -> None:
        """``sum of parts <= limit``; a part is a step and weights of its x or d."""
        row = np.zeros(self.steps * (self.n + self.p))
        for name, (step, weights) in parts.items():
            size = self.p if name == "d" else self.n
            begin = step * size + (self.steps * self.n if name == "d" else 0)
            row[begin : begin + size] += weights
        self.rows.append(row)
        self.limits.append(limit)

    def largest(self, weights: np.ndarray) -> float:
        """Of the last state."""
        cost = np.zeros(len(self.rows[0]))
        cost[(self.steps - 1) * self.n : self.steps * self.n] = -weights
        found = linprog(cost, np.array(self.rows), np.array(self.limits), bounds=(None, None))
        return -found.fun if found.status == 0 else np.inf


def widths(plant: Plant, y: np.ndarray, S: np.ndarray, window: int) -> np.ndarray:
    """Widths (T, n) of x, from bounds of S x at the steps of the window."""
    n, kept = len(plant.A), []
    for k in range(len(y)):
        first = max(k - window, 0)
        program = Program(plant, k - first + 1)
        for j in range(first, k + 1):
            at = j - first
            for sign in (1.0, -1.0):
                for i, limit in enumerate(plant.v):
                    seen = {"x": (at, sign * plant.C[i]), "d": (at, sign * plant.H[i])}
                    program.add(limit + sign * y[j, i], **seen)
                for i, unit in enumerate(np.eye(n)):
                    if j == 0:
                        program.add(plant.start[i], x=(0, sign * unit))
                    if at:
                        before = {"before": (at - 1, -sign * plant.A[i]), "d": (at - 1, -sign * plant.G[i])}
                        program.add(plant.w[i], x=(at, sign * unit), **before)
            for row, limit in zip(S, kept[j] if j < k else (), strict=False):
                if np.isfinite(limit):
                    program.add(limit, x=(at, row))
        kept.append([program.largest(row) for row in S])
    sides = np.array(kept)
    return sides[:, :n] + sides[:, len(S) // 2 : len(S) // 2 + n]


def main() -> None:
    plants = {
        "rotation": rotation(), "one measured": one_measured(), "unseen": unseen(), "full_rank": full_rank(),
        "chain": chain(),
    }  # fmt: skip
    kinds = ("box", 1), ("box", 3), ("box", 5), ("pairs", 1), ("window", 1)
    head = "Plant", *(f"{kind}, {window} step{'s' * (window > 1)}" for kind, window in kinds)
    rows = []
    print(title(head))
    for name, plant in plants.items():
        steps = STEPS if len(plant.A) < 6 else 16
        y = plant.record(0, hard=False)[1][:steps]
        hull = widths(plant, y, directions("box", plant.A), steps)[-LAST:]
        found = [(widths(plant, y, directions(kind, plant.A), window)[-LAST:] / hull).mean(0) for kind, window in kinds]
        rows.append([name, *(f"{ratio.min():.2f} to {ratio.max():.2f}" for ratio in found)])
        print(line(rows[-1]), flush=True)
    keep("directions", head, rows)


if __name__ == "__main__":
    main()
