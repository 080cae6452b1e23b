"""Other programs for the same job, in turns with this library in one run: immrax, codac, NumPy, a linear program.

immrax and codac come from an environment of their own (`--peers PYTHON`), where `peers_apart.py` calls them. Each gets
what it is made for: immrax the bounds of f and g; codac a step without unknown input; NumPy the contractors of a step
written by hand, vectorised over boxes; HiGHS the exact hull of the last ten rows of a linear plant. Times are medians
of turns.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import gsisio_jax as gx
from benchmarks import handwritten
from benchmarks.peers_tools import Peers, Program, boxes_of, one_core, ours_compiled, summary_of, turns
from benchmarks.plants import case, from_tests, records
from benchmarks.tightness import chain
from gsisio_jax import Interval, inclusion

TILES = 1_000, 2_000, 10_000  # boxes that immrax gets at a time: the fastest of these sizes, for each of its methods
TILES_OF_OURS = 10  # inside, boxes are bounded in chunks; the results of larger ones cost fresh pages of memory
ROUNDS_OF_BOUNDS = 25  # each takes a second
LOOSER = 1e-6  # relative; what counts as bounds of equal width
HORIZON = 10


def bounds(boxes: int, peers: str | None) -> dict[str, Any]:
    """Bounds of f and g of S1 on many boxes, by every method of both libraries; a core each, in processor time."""
    one_core()
    system, rng = case("s1", 1).system, np.random.default_rng(0)
    centre, radius = rng.uniform(-2, 2, (boxes, 2)), rng.uniform(0.05, 1, (boxes, 2))
    lower, upper, none = centre - radius, centre + radius, np.zeros(0)
    methods = {
        "natural": inclusion.natural(system.maps),
        "affine": lambda *args: inclusion.affine(system.maps)(*args).range,
        "natural, nearest": inclusion.natural(system.maps, "nearest"),  # as immrax rounds
        "affine, nearest": lambda *args: inclusion.affine(system.maps, "nearest")(*args).range,
    }

    size = boxes // TILES_OF_OURS
    starts = range(0, boxes, size)
    parts = [Interval.unchecked(*(jnp.asarray(side[i : i + size]) for side in (lower, upper))) for i in starts]

    def program(method: Callable[..., Any]) -> tuple[Program, np.ndarray]:
        many = inclusion.batched(method)

        def run() -> None:
            for part in parts:  # bounds are used and dropped
                jax.block_until_ready(many(part, none))

        return run, boxes_of([many(part, none) for part in parts])

    both = {name: program(method) for name, method in methods.items()}
    ours, sides = ({name: pair[i] for name, pair in both.items()} for i in (0, 1))
    with Peers("bounds", peers, lower=lower, upper=upper, tiles=np.array(TILES)) as other:
        seconds = turns(ours, other, ROUNDS_OF_BOUNDS, time.process_time)
        sides |= other.found
    points = rng.uniform(lower, upper)
    values = np.asarray(jax.vmap(lambda x: system.maps(x, none))(points))
    widths = {name: np.asarray(found[1] - found[0]).mean(0) for name, found in sides.items()}
    rates = {name: boxes / time for name, time in seconds.items()}
    ratios = {}
    for name in other.found:  # against the fastest of ours that is nowhere wider
        tight = [mine for mine in ours if (widths[mine] <= widths[name] * (1 + LOOSER)).all()]
        for best in {max((m for m in tight if "nearest" not in m), key=rates.__getitem__), "affine, nearest"}:
            ratios[f"{name} (by {best})"] = rates[best] / rates[name]
    missed = {name: int(((values < found[0]) | (values > found[1])).sum()) for name, found in sides.items()}
    return {
        "batch": boxes,
        "steps": 1,
        "seconds": seconds["affine"],
        "rate": rates["affine"],
        "rates": rates,
        "ratios": ratios,
        "mean_width": {name: width.tolist() for name, width in widths.items()},
        "missed": missed,
        "left_out": other.left_out("immrax"),
        "ok": not any(missed[name] for name in ours if "nearest" not in name),
    }


def step(batch: int, steps: int, alone: int, peers: str | None) -> dict[str, Any]:
    """S1 without unknown input: a step of ours for many boxes, and one of codac for `alone` records of them. Ours has
    four gains: with one alone, boxes that begin outside of its region stay wide here."""
    plant = case("s1", steps)
    none = np.zeros((2, 0))
    system = gx.System(plant.system.f, plant.system.g, G=none, H=none)
    quiet = _replaced(plant, system)
    initial, y, x = records(quiet, batch)
    programs, found = {}, {}
    for name, gains in (("ours", 4), ("ours, one gain", 1)):
        programs[name], boxes = ours_compiled(quiet.design(missing=False, gains=gains), initial, y)
        found[name] = np.asarray(boxes.lower), np.asarray(boxes.upper)
    bound = float(np.asarray(plant.noise.w.upper)[0])
    given = {"w": bound, "v": bound, "y": y[:alone], "lower": initial.lower[:alone], "upper": initial.upper[:alone]}
    with Peers("step", peers, **given) as other:
        seconds = turns(programs, other)
    counts = {name: (batch if name in programs else alone) for name in (*programs, *other.found)}
    found |= other.found
    return summary_of(batch, steps, seconds, counts, found, x, other.left_out("codac"))


def numpy(batch: int, steps: int, few: int) -> dict[str, Any]:
    """S1, one record: this library's step for many boxes, and `handwritten.py` run by NumPy over `few` of them, number
    by number with a vector of boxes each, so that no operation is spent on small axes."""
    plant = case("s1", steps)
    observer = plant.design(missing=False)
    run, _ = plant.simulate(jax.random.key(0))
    y, x, rng = np.asarray(run.y), np.asarray(run.x[:-1]), np.random.default_rng(0)
    below, above = (rng.uniform(0.05, 1, (batch, 2)) * plant.initial.width for _ in range(2))
    initial = Interval(x[0] - below, x[0] + above)
    ours, boxes = ours_compiled(observer, initial, y, shared=True)
    by_numpy = from_tests("oracles.numpy_program").numpy_function

    def wide(carry: Any) -> Any:
        return jax.tree.map(lambda value: jnp.broadcast_to(jnp.asarray(value, float), (few,)), carry)

    def begin(lower: Any, upper: Any, row: Any) -> Any:
        state = [(lower[i], upper[i]) for i in range(2)]
        return wide({"x": state, "h": handwritten._on_box(state), "y": [row[0], row[1]]})

    def advance(carry: Any, row: Any) -> Any:
        carry, out = handwritten.step(carry, [row[0], row[1]])
        return wide(carry), wide(out)

    sides = initial.lower[:few].T, initial.upper[:few].T
    begun = by_numpy(begin, *sides, y[0])
    start = begun(*sides, y[0])
    step = by_numpy(advance, start, y[1])

    def loop() -> list[Any]:
        carry, kept = begun(*sides, y[0]), []
        for row in y[1:]:
            carry, (state, _, _) = step(carry, row)
            kept.append(state)
        return kept

    other = np.array(loop())  # (steps - 1, n, 2, boxes)
    seconds = turns({"ours": ours, "NumPy": loop}, None)
    found = {
        "ours": (boxes.lower[:, 1:], boxes.upper[:, 1:]),
        "NumPy": (other[:, :, 0].transpose(2, 0, 1), other[:, :, 1].transpose(2, 0, 1)),
    }
    summary = summary_of(batch, steps - 1, seconds, {"ours": batch, "NumPy": few}, found, x[1:], {})
    return {**summary, "ok": not any(summary["missed"].values())}


def horizon(batch: int, steps: int, solved: int) -> dict[str, Any]:
    """Three masses (n = 6, p = 2, linear): a step of ours, plain and with a window of five, and the exact hull of the
    last ten rows from the observer's box before them, two linear programs a state, at `solved` steps."""
    from gsisio_jax.study.hulls import _record, _sides, affine_plant
    from gsisio_jax.study.record_program import exact_hull

    plant, ball = chain(), Interval.symmetric
    system = gx.System(lambda x: plant.A @ x, lambda x: plant.C @ x, G=plant.G, H=plant.H)
    noise = gx.Noise(ball(plant.w), ball(plant.v))
    observers = {
        name: gx.design_observer(system, noise, Interval.entire(6), missing=False, window=window)
        for name, window in (("ours", 1), ("ours, window 5", 5))
    }
    both = [plant.record(seed, False) for seed in range(batch)]
    x, y = (np.array([record[i] for record in both])[:, :steps] for i in (0, 1))
    start = Interval(np.tile(-plant.start, (batch, 1)), np.tile(plant.start, (batch, 1)))
    programs, found = {}, {}
    for name, observer in observers.items():
        programs[name], boxes = ours_compiled(observer, start, y)
        found[name] = (np.asarray(boxes.lower), np.asarray(boxes.upper))
    u = np.zeros((steps, 0))
    record, affine = _record(system, y[0], u, noise), affine_plant(system, u)
    chosen = np.linspace(HORIZON, steps - 1, solved).round().astype(int)
    alone = _sides(Interval(found["ours"][0][0], found["ours"][1][0]))

    def solve() -> np.ndarray:
        hulls = []
        for k in chosen:
            first = k - HORIZON
            stretch = record.cut(first, k, alone.rows(first), measured=True)
            hulls.append(exact_hull(stretch, affine.rows(slice(first, k + 1))))
        return np.array([[hull.lower for hull in hulls], [hull.upper for hull in hulls]])

    exact = solve()
    seconds = turns({**programs, "HiGHS": solve}, None)
    rates = {name: batch * steps / seconds[name] for name in programs} | {"HiGHS": len(chosen) / seconds["HiGHS"]}
    widths = {name: (high - low)[0, chosen].mean(0).tolist() for name, (low, high) in found.items()}
    widths["HiGHS"] = (exact[1] - exact[0]).mean(0).tolist()
    missed = {name: int(((x < low - 1e-12) | (x > high + 1e-12)).sum()) for name, (low, high) in found.items()}
    missed["HiGHS"] = int(((x[0, chosen] < exact[0] - 1e-8) | (x[0, chosen] > exact[1] + 1e-8)).sum())
    return {
        "batch": batch,
        "steps": steps,
        "seconds": seconds["ours"],
        "rate": rates["ours"],
        "rates": rates,
        "ratios": {f"HiGHS ({name})": rates[name] / rates["HiGHS"] for name in programs},
        "mean_width": widths,
        "missed": missed,
        "ok": not any(missed.values()),
    }


def _replaced(plant: Any, system: gx.System) -> Any:
    return replace(plant, system=system, d=lambda key, steps: np.zeros((steps, 0)))
