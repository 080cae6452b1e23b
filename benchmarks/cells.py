"""`python -m benchmarks.cells`: the boxes of the paper's example (noise .2) by the number of cells, and what they cost.

Widths are those of the last state, means over records of `benchmarks.example_hull`, whose exact hull is printed with
them. Times are CPU times of one compiled program of many boxes, all settings in turns; operations are the numbers
that a step computes. `--steps 1e6` instead looks for states and inputs outside of their boxes, with
d = s N(0, 1), s from 1 to 1,000, and noise at the vertices of its box in half of the records.
"""

from __future__ import annotations

import argparse
import sys
import time
from typing import Any

import jax
import numpy as np

import gsisio_jax as gx
from benchmarks.example_hull import NOISE, _records, f, g, last_hulls
from benchmarks.plants import from_tests
from benchmarks.record import line, title
from gsisio_jax.observer.fixed import Fixed
from gsisio_jax.observer.step import advance, blank

CELLS = (1, 4, 16, 36, 64)
REGION = (1.0, 1.0)
LENGTH, RECORDS, TURNS = 100, 250, 3
SCALES = (1.0, 10.0, 100.0, 1000.0)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.cells", description=__doc__)
    parser.add_argument("--records", type=int, default=40)
    parser.add_argument("--steps", type=float, default=0, help="look for violations in so many steps")
    parser.add_argument("--cells", type=int, default=36, help="for --steps")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    plant = from_tests("systems").s1(region=REGION)
    if options.steps:
        return violations(plant, options.cells, int(options.steps))
    x, y = _records(plant, options.records)
    hull = last_hulls(x, y, np.asarray(plant.initial.lower), np.asarray(plant.initial.upper), 25).mean(0)
    runs, widths, sizes = [], [], []
    for cells in CELLS:
        observer = plant.design(missing=False, sweeps=3, window="auto", cells=cells)
        run = jax.jit(jax.vmap(lambda y, of=observer: gx.estimate(of, plant.initial, y).state))
        box = run(y)
        assert ((np.asarray(box.lower) <= x) & (x <= np.asarray(box.upper))).all(), "a box misses the truth"
        runs.append(run)
        widths.append(np.asarray(box.width)[:, -1].mean(0))
        start = blank(observer, jax.tree.map(jax.numpy.asarray, plant.initial))
        sizes.append(operations(observer, start, jax.numpy.asarray(y[0, 0]), jax.numpy.zeros(0)))
    spent = np.full(len(runs), np.inf)
    for _ in range(TURNS):
        for i, run in enumerate(runs):
            began = time.process_time()
            jax.block_until_ready(run(y))
            spent[i] = min(spent[i], time.process_time() - began)
    print(title(("cells", "width x1, x2", "over the hull", "operations a step", "microseconds a step", "rate")))
    for cells, width, size, seconds in zip(CELLS, widths, sizes, spent, strict=True):
        widths_of, ratios = (", ".join(f"{part:.3f}" for part in parts) for parts in (width, width / hull))
        times = f"{seconds / y[..., 0].size * 1e6:.1f}", f"{spent[0] / seconds:.3f}"
        print(line((str(cells), widths_of, ratios, f"{size:,}", *times)))
    print(f"hull: {hull.round(4)}")
    return 0


def operations(observer: Any, carry: Any, y: Any, u: Any) -> int:
    """Numbers that one step computes, as it is traced; nothing is compiled."""
    fixed, noise = Fixed(observer).value, jax.tree.map(jax.numpy.asarray, observer.noise)
    return _numbers(jax.make_jaxpr(lambda *args: advance(fixed, *args))(carry, y, u, noise).jaxpr)


def _numbers(jaxpr: Any) -> int:
    total = 0
    for eqn in jaxpr.eqns:
        inner = [v for v in eqn.params.values() if hasattr(v, "jaxpr") or hasattr(v, "eqns")]
        times = eqn.params["length"] if eqn.primitive.name == "scan" else 1
        for part in inner:
            total += times * _numbers(getattr(part, "jaxpr", part))
        if not inner and eqn.primitive.name not in _MOVES:
            total += sum(int(np.prod(out.aval.shape)) for out in eqn.outvars)
    return total


_MOVES = {
    "broadcast_in_dim", "reshape", "squeeze", "slice", "concatenate", "transpose", "convert_element_type", "copy",
    "dynamic_slice", "gather", "split", "expand_dims", "stop_gradient",
}  # fmt: skip


def violations(plant: Any, cells: int, steps: int) -> int:
    """Count states and inputs outside of their boxes."""
    observer = plant.design(missing=False, sweeps=3, window="auto", cells=cells)
    G, H = np.asarray(plant.system.G), np.asarray(plant.system.H)
    run = jax.jit(jax.vmap(lambda box, y: gx.estimate(observer, box, y)))
    rng, done, missed, closest, conflicts = np.random.default_rng(0), 0, 0, np.inf, 0
    low, high = np.asarray(plant.initial.lower), np.asarray(plant.initial.upper)
    while done < steps:
        x = rng.uniform(low, high, (RECORDS, 2))
        scale = rng.choice(SCALES, (RECORDS, 1))
        at_vertices = rng.random((RECORDS, 1)) < 0.5
        states, inputs, seen = [], [], []

        def noise(at_vertices: np.ndarray = at_vertices) -> np.ndarray:
            drawn = rng.uniform(-NOISE, NOISE, (RECORDS, 2))
            # A little inside: the record rounds its numbers, too.
            return np.where(at_vertices, np.sign(drawn) * NOISE * (1 - 1e-9), drawn)

        for _ in range(LENGTH):
            d = scale * rng.normal(size=(RECORDS, 2))
            states.append(x)
            inputs.append(d)
            seen.append(g(x) + d @ H.T + noise())
            x = f(x) + d @ G.T + noise()
        true, d, y = (np.stack(part, 1) for part in (states, inputs, seen))
        found = run(gx.Interval(np.tile(low, (RECORDS, 1)), np.tile(high, (RECORDS, 1))), y)
        for box, value in ((found.state, true), (found.input, d[:, : np.shape(found.input.lower)[1]])):
            lower, upper = np.asarray(box.lower), np.asarray(box.upper)
            value = value[:, : lower.shape[1]]
            room = np.minimum(value - lower, upper - value)
            missed += int((room < 0).any(-1).sum())
            closest = min(closest, float(room.min()))
        conflicts += int((np.asarray(found.status) & int(gx.Status.CONFLICT) != 0).sum())
        done += RECORDS * LENGTH
        if done % 100_000 == 0:
            print(f"{done:,} steps: {missed} outside, {conflicts} conflicts, nearest {closest:.2g}", flush=True)
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
