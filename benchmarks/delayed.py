"""`python -m benchmarks.delayed`: widths over those of the exact hull for observers with a delay, by window.

The plants of `tests/oracles/delayed_plants.py`, records as in `benchmarks.tightness`: noise uniform and d white, then
noise near its vertices and d slow. The exact hull of x[k] takes y[0..k+L] into account.
"""

from __future__ import annotations

import sys
from pathlib import Path

import jax
import numpy as np

import gsisio_jax as gx
from benchmarks.record import keep, line, title
from benchmarks.tightness import FROM, STEPS, Plant

RECORDS = 5


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "oracles"))
    from delayed_plants import PLANTS

    head, rows = ("Plant", "L", "window", "uniform, white", "at vertices, slow"), []
    print(title(head))
    for name, ((A, C, G, H, w, v, start), delay) in PLANTS.items():
        plant = Plant(A, C, G, H / 10, *map(np.asarray, (w, v, start)))
        for window in (1, 3, 5):
            rows.append([name, str(delay), str(window), *_ratios(plant, delay, window)])
            print(line(rows[-1]), flush=True)
    keep("delay", head, rows)


def _ratios(plant: Plant, delay: int, window: int) -> list[str]:
    """For easy and for hard records the least and the largest mean ratio of a state, and the worst of all steps."""
    ball = gx.Interval.symmetric
    system = gx.System(lambda x: plant.A @ x, lambda x: plant.C @ x, G=plant.G, H=plant.H)
    noise, region = gx.Noise(ball(plant.w), ball(plant.v)), gx.Interval.entire(len(plant.A))
    observer = gx.design_observer(system, noise, region, delay="auto", missing=False, sweeps=1, window=window)
    said = []
    for hard in (False, True):
        found = []
        for seed in range(RECORDS):
            x, y = plant.record(seed, hard)
            assert gx.estimate(observer, ball(plant.start), y).state.contains(x).all(), "a box misses the truth"
            found.append(gx.tightness(observer, ball(plant.start), y, steps=range(FROM, STEPS - delay, 4)))
        assert min(one.ratio.min() for one in found) > 1 - 1e-9
        width, hull = (np.mean([getattr(one, name) for one in found], (0, 1)) for name in ("width", "hull_width"))
        worst = max(one.ratio.max() for one in found)
        said.append(f"{(width / hull).min():.2f} to {(width / hull).max():.2f} ({worst:.3g})")
    return said


if __name__ == "__main__":
    main()
