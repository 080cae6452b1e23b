"""`python -m benchmarks.tightness_default`: how near the default comes to the exact hull of the whole record.

The plants of `benchmarks.tightness`, the spring under Euler (`delay="auto"`), a beam, a rod, and plants at random.
Five records each; inputs white and slow, noise uniform and at its vertices, k = 15..29. With noise uniform the mean of
width over hull. At the vertices the hull may be a point: mean width over mean width of the hull.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from scipy.linalg import expm

from benchmarks.__main__ import RESULTS
from benchmarks.dials import euler
from benchmarks.error_hulls import error_hulls
from benchmarks.random_plants import SEEDS, random_plant
from benchmarks.record import keep, line, title
from benchmarks.tightness import FROM, PLANTS, STEPS, Plant

RECORDS = 5
HEAD = (
    "Plant", "n, l, p", "window, rows", "uniform", "vertices", "one gain: uniform", "vertices", "least ratio - 1",
)  # fmt: skip


def beam() -> Plant:
    """Two modes of a beam that hardly damp, sampled at .1 s: both deflections at one point, at another one worse, and a
    rate gyro; an unknown force on the first mode."""
    continuous = np.zeros((5, 5))
    for mode, (omega, damping) in enumerate([(3.0, 0.02), (8.0, 0.02)]):
        rows = slice(2 * mode, 2 * mode + 2)
        continuous[rows, rows] = [[0, 1], [-(omega**2), -2 * damping * omega]]
    continuous[1, 4], continuous[3, 4] = 1.0, 0.6
    moved = expm(0.1 * continuous)
    C = np.array([[1, 0, 0.8, 0], [0.7, 0, -0.5, 0], [0, 1.0, 0, -0.7]])
    v = np.array([0.02, 0.1, 0.1])
    return Plant(moved[:4, :4], C, moved[:4, 4:], np.zeros((3, 1)), np.full(4, 0.005), v, np.full(4, 1.0))


def rod() -> Plant:
    """Six cells of a rod that conducts heat, warmed at one end by nobody knows how much; four thermometers."""
    A = np.eye(6) + 0.2 * (np.eye(6, k=1) + np.eye(6, k=-1) - 2 * np.eye(6))
    A[0, 0] = A[5, 5] = 0.8
    G = np.eye(6)[:, :1]
    v = np.array([0.05, 0.5, 0.05, 0.5])
    return Plant(A, np.eye(6)[[0, 1, 3, 5]], G, np.zeros((4, 1)), np.full(6, 0.01), v, np.full(6, 3.0))


TASKS: dict[str, Callable[[], Plant]] = {
    **PLANTS, "spring, Euler": euler, "beam": beam, "rod": rod,
    **{f"random {seed}": lambda seed=seed: random_plant(seed) for seed in SEEDS},
}  # fmt: skip


def main(names: list[str]) -> int:
    jax.config.update("jax_enable_x64", True)
    print(title(HEAD))
    file = RESULTS / "tightness_default.json"
    table = json.loads(file.read_text()).get("table", {}) if names and file.exists() else {}
    for name in names or TASKS:
        table[name] = measured(TASKS[name](), name)
        print(line([name, *cells(table[name])]), flush=True)
        # Kept after every plant: those that are named replace what there was.
        inner = {name: table[name] for name in TASKS if name in table}
        rows = [[name, *cells(found)] for name, found in inner.items()]
        keep("tightness_default", HEAD, rows, table=inner, overall=summary(inner))
    print(summary(table))
    return 0


def cells(found: dict[str, Any]) -> list[str]:
    def both(ratios: list[float]) -> str:
        return f"{np.median(ratios):.3f}, {max(ratios):.3f}"

    of = found["default"]
    one = [both(found["one"][kind]) for kind in ("uniform", "vertices")]
    return [
        ", ".join(map(str, found["sizes"])), ", ".join(map(str, of["window"])), both(of["uniform"]),
        both(of["vertices"]), *one, f"{min(of['least'], found['one']['least']) - 1:.0e}",
    ]  # fmt: skip


def summary(table: dict[str, Any]) -> dict[str, float]:
    """Medians over plants and states, and the largest mean."""
    kinds = {kind: [r for of in table.values() for r in of["default"][kind]] for kind in ("uniform", "vertices")}
    found = {f"{name} {kind}": of(values) for kind, values in kinds.items() for name, of in _OF.items()}
    found["median"] = float(np.median([*kinds["uniform"], *kinds["vertices"]]))
    return {name: round(float(value), 4) for name, value in found.items()}


_OF: dict[str, Callable[[Any], Any]] = {"median": np.median, "worst": np.max}


def measured(plant: Plant, name: str) -> dict[str, Any]:
    """Ratios of the states, by design and noise."""
    import gsisio_jax as gx

    ball = gx.Interval.symmetric
    system = gx.System(lambda x: plant.A @ x, lambda x: plant.C @ x, G=plant.G, H=plant.H)
    noise, region = gx.Noise(ball(plant.w), ball(plant.v)), gx.Interval.entire(len(plant.A))
    late: dict[str, Any] = {"delay": "auto"} if name == "spring, Euler" else {}
    drawn = {vertices: [drawn_noise(plant, seed, vertices) for seed in range(RECORDS)] for vertices in (False, True)}
    hulls: dict[bool, np.ndarray] = {}
    sizes = len(plant.A), len(plant.C), plant.G.shape[1]
    found: dict[str, Any] = {"sizes": sizes}
    designs: tuple[tuple[str, dict[str, Any]], ...] = (("default", {}), ("one", {"window": 1}))
    for label, dials in designs:
        observer = gx.design_observer(system, noise, region, missing=False, **late, **dials)
        inner, delay = getattr(observer, "inner", observer), getattr(observer, "delay", 0)
        run = jax.jit(jax.vmap(lambda y, of=observer: gx.estimate(of, ball(plant.start), y).state))
        window = (1, 0) if inner.window is None else (inner.window.length, len(inner.window.targets))
        row: dict[str, Any] = {"window": window, "least": np.inf}
        for vertices, kind in ((False, "uniform"), (True, "vertices")):
            widths = []
            for slow in (False, True):
                x, y = (
                    np.stack(part) for part in zip(*(run_of(plant, *one, slow) for one in drawn[vertices]), strict=True)
                )
                box = run(y)
                rounding = 1e-12 * (1 + np.abs(x))  # of the record itself
                inside = (np.asarray(box.lower) <= x + rounding) & (x - rounding <= np.asarray(box.upper))
                assert inside.all(), "a box misses the truth"
                widths.append(np.asarray(box.width)[:, FROM : STEPS - delay])
            steps = range(FROM, STEPS - delay)
            if vertices not in hulls:
                sides = np.stack([error_hulls(plant, drawn[vertices], k, delay) for k in steps], 1)
                hulls[vertices] = sides[:, :, 1] - sides[:, :, 0]
            hull = hulls[vertices]
            clear = hull > 1e-6  # below this the tolerance of the programs shows
            row["least"] = min(row["least"], *(float((w[clear] / hull[clear]).min(initial=np.inf)) for w in widths))
            ratios = [(w.mean((0, 1)) / hull.mean((0, 1))) if vertices else (w / hull).mean((0, 1)) for w in widths]
            row[kind] = [round(float(r), 4) for r in np.max(ratios, 0)]
        found[label] = row
    return found


def drawn_noise(plant: Plant, seed: int, vertices: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The first state, w (T, n) and v (T, l)."""
    rng = np.random.default_rng(seed)

    def draw(radius: np.ndarray, rows: int) -> np.ndarray:
        unit = rng.choice([-1.0, 1.0], (rows, len(radius))) if vertices else rng.uniform(-1, 1, (rows, len(radius)))
        return radius * unit

    return draw(plant.start, 1)[0], draw(plant.w, STEPS), draw(plant.v, STEPS)


def run_of(plant: Plant, first: np.ndarray, w: np.ndarray, v: np.ndarray, slow: bool) -> tuple[np.ndarray, np.ndarray]:
    """States and measurements, with inputs white or slow."""
    d = 3.0 * np.random.default_rng(99).standard_normal((STEPS, plant.G.shape[1]))
    d = np.cumsum(0.05 * d, 0) if slow else d
    x, states, seen = first, [], []
    for k in range(STEPS):
        states.append(x)
        seen.append(plant.C @ x + plant.H @ d[k] + v[k])
        x = plant.A @ x + plant.G @ d[k] + w[k]
    return np.array(states), np.array(seen)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
