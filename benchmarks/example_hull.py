"""`python -m benchmarks.example_hull`: the exact hull of the last state of the paper's example, and its boxes.

Two of the four equations of a step are free of d: ``t'(y - g(x) - v) = 0`` with t'H = 0, and ``c'x+ = c'(f(x) + w) +
a'(y - g(x) - v)`` with c'G = a'H. So all that y[0..k-1] say of x[k] is an interval of c'x, and the states that agree
with y[0..k] are those with c'x in it and t'g(x) in that of t'(y - v). The interval is carried from step to step by its
values on a grid over these two. Every point belongs to a run that agrees with the record, so the hull that is found is
a *lower bound* of what any observer can return.
"""

from __future__ import annotations

import argparse
import sys
from typing import Any

import jax
import numpy as np

import gsisio_jax as gx
from benchmarks.plants import from_tests

C, A = np.array([4.0, 1.0]), np.array([-0.2, 0.5]) * 4 / 2.9  # c'G = a'H, a orthogonal to t
T, ALONG = np.array([2.5, 1.0]), np.array([1.0, -2.5])  # t'H = 0, and the direction of H d
NOISE = 0.2  # bound of w and v
START = 201  # points a side of the first grid
WIDE = 3  # steps until the first box is forgotten
SLACK = 1e-2  # by which the grid may miss the true state


def f(x: np.ndarray) -> np.ndarray:
    a, b = x[..., 0], x[..., 1]
    return np.stack([0.6 * a - 0.12 * b + 1.1 * np.sin(0.3 * b - 0.2 * a), -0.2 * a - 0.14 * b], -1)


def g(x: np.ndarray) -> np.ndarray:
    a, b = x[..., 0], x[..., 1]
    return np.stack([0.2 * a + 0.65 * b + 0.8 * np.sin(0.3 * a + 0.2 * b), np.sin(a)], -1)


def state(along: np.ndarray, seen: np.ndarray, near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """x with ``c'x = along`` and ``t'g(x) = seen`` by Newton steps, and where they have converged to 1e-9."""
    x = np.broadcast_to(near, (*along.shape, 2)).copy()
    for _ in range(12):
        bend = np.cos(0.3 * x[..., 0] + 0.2 * x[..., 1])
        s = T[0] * (0.2 + 0.24 * bend) + T[1] * np.cos(x[..., 0]), T[0] * (0.65 + 0.16 * bend)
        left, right = x @ C - along, g(x) @ T - seen
        det = C[0] * s[1] - C[1] * s[0]
        x -= np.stack([s[1] * left - C[1] * right, C[0] * right - s[0] * left], -1) / det[..., None]
    return x, (np.abs(x @ C - along) < 1e-9) & (np.abs(g(x) @ T - seen) < 1e-9)


def last_hulls(x: np.ndarray, y: np.ndarray, low: np.ndarray, high: np.ndarray, points: int) -> np.ndarray:
    """Widths (b, 2) of the hull of x[-1] for records y (b, T, 2) of runs x (b, T, 2) from the box low..high."""
    reach = np.abs(C) @ (high - low) / 2
    below, above = (np.full(len(y), C @ (low + high) / 2 + side * reach) for side in (-1, 1))
    hull = np.zeros((len(y), 2))
    for k in range(y.shape[1]):
        share = np.linspace(0, 1, points if k else START)
        along, now = np.broadcast_arrays(
            (below[:, None] + (above - below)[:, None] * share)[:, :, None],
            ((y[:, k] @ T)[:, None] + NOISE * np.abs(T).sum() * (2 * share - 1))[:, None, :],
        )
        found, agrees = state(along, now, x[:, k, None, None])
        if k == 0:
            agrees &= ((low <= found) & (found <= high)).all(-1)
        hull = _range(found, agrees[..., None])
        # H d = y - g - v for some v in its box: how far along its only direction.
        left = y[:, k, None, None] - g(found)
        ends = np.sort(np.stack([(left - NOISE) / ALONG, (left + NOISE) / ALONG]), 0)
        first, last = ends[0].max(-1), ends[1].min(-1)
        agrees &= first <= last
        moved = np.stack([f(found) @ C + (A @ ALONG) * side for side in (first, last)], -1)
        least = np.where(agrees[..., None], moved, np.inf).min((1, 2, 3))
        most = np.where(agrees[..., None], moved, -np.inf).max((1, 2, 3))
        below, above = least - NOISE * np.abs(C).sum(), most + NOISE * np.abs(C).sum()
        if WIDE < k < y.shape[1] - 1:
            truth = x[:, k + 1] @ C
            assert ((below - SLACK <= truth) & (truth <= above + SLACK)).all(), "the grid misses the true state"
    return hull


def _range(values: np.ndarray, used: np.ndarray) -> np.ndarray:
    return np.where(used, values, -np.inf).max((1, 2)) - np.where(used, values, np.inf).min((1, 2))


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.example_hull", description=__doc__)
    parser.add_argument("--records", type=int, default=200)
    parser.add_argument("--points", type=int, default=25, help="of the grid, a side")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    plants = from_tests("systems")
    plant = plants.s1()
    assert np.abs(C @ np.asarray(plant.system.G) - A @ np.asarray(plant.system.H)).max() < 1e-12
    x, y = _records(plant, options.records)
    hull = last_hulls(x, y, np.asarray(plant.initial.lower), np.asarray(plant.initial.upper), options.points)
    print(f"hull: {hull.mean(0).round(4)}")
    for half in ((1.0, 1.0), (1.0, 1.5)):
        observer = plants.s1(region=half).design(missing=False, sweeps=3, window="auto")
        width = jax.jit(jax.vmap(lambda y, of=observer: gx.estimate(of, plant.initial, y).state.width[-1]))(y)
        assert (np.asarray(width) >= hull - 1e-9).all(), "a box is narrower than its hull"
        print(f"boxes with the region {half}: {np.asarray(width).mean(0).round(4)}", flush=True)
    return 0


def _records(plant: Any, count: int) -> tuple[np.ndarray, np.ndarray]:
    rng, steps = np.random.default_rng(0), plant.steps
    G, H = np.asarray(plant.system.G), np.asarray(plant.system.H)
    x, states, seen = rng.uniform(plant.initial.lower, plant.initial.upper, (count, 2)), [], []
    for _ in range(steps):
        w, v = rng.uniform(-NOISE, NOISE, (2, count, 2))
        d = rng.normal(size=(count, 2))
        states.append(x)
        seen.append(g(x) + d @ H.T + v)
        x = f(x) + d @ G.T + w
    return np.stack(states, 1), np.stack(seen, 1)


if __name__ == "__main__":
    sys.exit(main())
