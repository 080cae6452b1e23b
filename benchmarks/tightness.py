"""`python -m benchmarks.tightness`: widths over those of the exact hull, and what they cost, by window and gains, for
linear plants that are hard.

The exact hull of x[k] takes all measurements so far into account (two linear programs a state). Widths are means over
the last fifteen of thirty steps and over records: noise uniform and d white, then noise near its vertices (99 %, or the
hull may be a point) and d slow.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import expm

from benchmarks.plants import from_tests
from benchmarks.record import keep

STEPS, FROM = 30, 15


@dataclass(frozen=True)
class Plant:
    """``x+ = A x + G d + w, y = C x + H d + v`` and the magnitudes of w, v and x0."""

    A: np.ndarray
    C: np.ndarray
    G: np.ndarray
    H: np.ndarray
    w: np.ndarray
    v: np.ndarray
    start: np.ndarray

    def record(self, seed: int, hard: bool) -> tuple[np.ndarray, np.ndarray]:
        """States (T, n) and measurements (T, l)."""
        rng = np.random.default_rng(seed)
        d = 3.0 * rng.standard_normal((STEPS, self.G.shape[1]))
        d = np.cumsum(0.05 * d, 0) if hard else d

        def draw(radius: np.ndarray) -> np.ndarray:
            return 0.99 * radius * rng.choice([-1.0, 1.0], len(radius)) if hard else rng.uniform(-radius, radius)

        x, states, seen = draw(self.start), [], []
        for k in range(STEPS):
            states.append(x)
            seen.append(self.C @ x + self.H @ d[k] + draw(self.v))
            x = self.A @ x + self.G @ d[k] + draw(self.w)
        return np.array(states), np.array(seen)


def rotation() -> Plant:
    """A slow turn, one of whose two states is measured forty times worse than the other."""
    c, s = 0.95 * np.cos(0.3), 0.95 * np.sin(0.3)
    none = np.zeros((2, 0))
    return Plant(
        np.array([[c, -s], [s, c]]), np.eye(2), none, none, np.full(2, 0.02), np.array([0.05, 2]), np.full(2, 3.0)
    )


def rotation_input() -> Plant:
    """The same turn, with an unknown input in the state that is measured badly."""
    turn = rotation()
    return Plant(turn.A, turn.C, np.array([[0], [1.0]]), np.zeros((2, 1)), turn.w, np.array([0.05, 1]), turn.start)


def spring() -> Plant:
    """A mass on a damped spring, sampled exactly at .1 s; its position is measured, the force is unknown."""
    moved = expm(0.1 * np.array([[0, 1, 0], [-4, -0.4, 1], [0, 0, 0]]))
    return Plant(
        moved[:2, :2], np.array([[1.0, 0]]), moved[:2, 2:], np.zeros((1, 1)), np.array([1e-3, 1e-2]), np.array([0.01]),
        np.full(2, 1.0),
    )  # fmt: skip


def chain() -> Plant:
    """Three masses in a row between springs, sampled at .2 s; a force on the middle one, a fault of a second sensor."""
    stiffness = 3.0 * np.array([[-2, 1, 0], [1, -2, 1], [0, 1, -2]])
    continuous = np.zeros((7, 7))
    continuous[:3, 3:6], continuous[3:6, :3], continuous[3:6, 3:6] = np.eye(3), stiffness, -0.3 * np.eye(3)
    continuous[4, 6] = 1
    moved = expm(0.2 * continuous)
    C = np.eye(6)[[0, 1, 2, 4, 0]]
    G = np.column_stack([moved[:6, 6], np.zeros(6)])
    H = np.zeros((5, 2))
    H[4, 1] = 1
    return Plant(moved[:6, :6], C, G, H, np.full(6, 0.01), np.full(5, 0.1), np.full(6, 2.0))


def network() -> Plant:
    """Eight states that act on some of the others, six outputs, three unknown inputs."""
    rng = np.random.default_rng(8)
    A = rng.normal(size=(8, 8)) * (rng.random((8, 8)) < 0.4)
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    C = np.eye(8)[[0, 1, 3, 4, 6, 7]] + 0.3 * rng.normal(size=(6, 8)) * (rng.random((6, 8)) < 0.2)
    G, H = np.zeros((8, 3)), np.zeros((6, 3))
    G[[0, 4, 3], [0, 1, 1]] = 1, 0.5, -0.4
    H[[2, 5], [1, 2]] = 0.7, 1
    return Plant(A, C, G, H, np.full(8, 0.02), np.full(6, 0.1), np.full(8, 2.0))


def full_rank() -> Plant:
    """Three states, five outputs, an input in each of the first three."""
    A = np.array([[0.8, 0.2, 0], [-0.1, 0.9, 0.3], [0.05, -0.2, 0.7]])
    C = np.vstack([np.eye(3), [[1, 1, 0], [0, 1, -1]]])
    G = np.array([[0.5, 0, 1], [0, 1, 0], [0, 0, 0.4]])
    return Plant(A, C, G, np.eye(5, 3), np.full(3, 0.02), np.full(5, 0.1), np.full(3, 2.0))


PLANTS: dict[str, Callable[[], Plant]] = {
    "rotation": rotation, "rotation_input": rotation_input, "spring": spring, "chain": chain, "network": network,
    "full_rank": full_rank,
}  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.tightness", description=__doc__)
    parser.add_argument("--windows", type=_dial, nargs="+", default=[1, 2, 3, 5, "auto"])
    parser.add_argument("--gains", type=_dial, nargs="+", default=[1])
    parser.add_argument("--records", type=int, default=3)
    parser.add_argument("--only", default="")
    options = parser.parse_args()
    table = {}
    for name, make in PLANTS.items():
        if options.only in name:
            table[name] = measured(make(), options.windows, options.gains, options.records)
            print(name)
            for dials, row in table[name].items():
                print(f"  {dials}: " + ", ".join(f"{key} {value}" for key, value in row.items()), flush=True)
    head = "Plant", "window", "gains", "ratios, least to most", "rows", "design s", "µs a step and box"
    keep("tightness", head, [_cells(name, row) for name, rows in table.items() for row in rows.values()], table=table)
    return 0


def _cells(name: str, row: dict[str, Any]) -> list[str]:
    ratios = [f"{min(row[kind]):.2f} to {max(row[kind]):.2f}" for kind in ("uniform", "vertices")]
    sizes = str(row["length"]), str(row["gains"])
    return [name, *sizes, f"{ratios[0]} ({ratios[1]})", str(row["rows"]), f"{row['design_s']:.1f}", f"{row['us']:.2f}"]


def _dial(text: str) -> int | str:
    return text if text == "auto" else int(text)


def measured(plant: Plant, windows: list[Any], gains: list[Any], records: int) -> dict[str, dict[str, Any]]:
    """Ratios of widths, rows of the window, operations of a step over single numbers, seconds to design, microseconds a
    step and box, for every window and number of gains."""
    import gsisio_jax as gx

    ball = gx.Interval.symmetric
    system = gx.System(lambda x: plant.A @ x, lambda x: plant.C @ x, G=plant.G, H=plant.H)
    noise = gx.Noise(ball(plant.w), ball(plant.v))
    region = gx.Interval.entire(len(plant.A))
    found = {}
    for window, count in itertools.product(windows, gains):
        began = time.perf_counter()
        observer = gx.design_observer(system, noise, region, missing=False, window=window, gains=count)
        design = time.perf_counter() - began
        row: dict[str, Any] = {}
        for hard, label in ((False, "uniform"), (True, "vertices")):
            against = []
            for seed in range(records):
                x, y = plant.record(seed, hard)
                assert gx.estimate(observer, ball(plant.start), y).state.contains(x).all(), "a box misses the truth"
                against.append(gx.tightness(observer, ball(plant.start), y, steps=range(FROM, STEPS, 7)))
            width, hull = (np.mean([getattr(one, name) for one in against], (0, 1)) for name in ("width", "hull_width"))
            row[label] = [round(float(value), 3) for value in width / hull]
        row["length"] = 1 if observer.window is None else observer.window.length
        row["gains"] = len(observer.gains.residual)
        row["rows"] = 0 if observer.window is None else len(observer.window.targets)
        row["design_s"] = round(design, 2)
        row["us"] = _step_time(observer, plant)
        row["operations"] = _operations(observer, plant)
        found[f"window {window}, gains {count}"] = row
    return found


def _operations(observer: Any, plant: Plant) -> int:
    """Operations of one step written out over single numbers, whether or not it runs so."""
    import gsisio_jax as gx

    sizes = from_tests("sizes")
    noise = jax.tree.map(jnp.asarray, observer.noise)
    start = jax.tree.map(jnp.asarray, gx.Interval.symmetric(plant.start))
    first = sizes.blank(observer, start), jnp.zeros(len(plant.C)), jnp.zeros(0), noise
    return sum(sizes.step_program(observer, first).count().values())


def _step_time(observer: Any, plant: Plant, boxes: int = 2_000) -> float:
    """Microseconds a step and box, of a batch that shares a record."""
    import gsisio_jax as gx

    _, y = plant.record(0, False)
    start = gx.Interval(np.tile(-plant.start, (boxes, 1)), np.tile(plant.start, (boxes, 1)))
    run = jax.jit(jax.vmap(lambda box: gx.estimate(observer, box, y).state.width[-1]))
    jax.block_until_ready(run(start))
    times = []
    for _ in range(3):
        began = time.perf_counter()
        jax.block_until_ready(run(start))
        times.append(time.perf_counter() - began)
    return round(min(times) / boxes / STEPS * 1e6, 3)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sys.exit(main())
