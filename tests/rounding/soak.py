"""The checks at any size, and the figures to record: primitives, sums and whole observer runs of one precision.

`test_soak` runs them under pytest, ``python -m benchmarks.soak`` in fresh processes, with two settings of XLA."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from checks import Tally, check, check_forms
from oracles.exact_sums import product, sign
from oracles.real_all import FUNCTIONS
from plants import LINEAR, NONLINEAR, QUADRATIC
from runs import Runs, estimator, run

from gsisio_jax import Interval, inclusion, linear_image
from gsisio_jax.interval.rounding import Rounding

BOXES, POINTS = 8192, 24
# Whose oracle is slow: fewer boxes.
RARE = {
    "power": 16, "atan2": 16, "remainder": 2, "modulo": 2, "power 2.5": 4, "power 0.25": 4, "power -1.5": 4,
    "sinc": 16, "gelu": 16, "wrapped angle": 16, "softmax of three": 16, "spread": 8, "dead zone": 8,
}  # fmt: skip
# Plant: share of all steps, runs of a batch, steps of a run.
SHARES = {
    "no unknown input": (0.36, 500, 10_000),
    "constants": (0.28, 100, 10_000),
    "three states": (0.14, 100, 10_000),
    "feedthrough of rank one": (0.1, 100, 10_000),
    "quadratic": (0.06, 100, 2_000),
    "waves": (0.04, 100, 2_000),
    "tanks": (0.02, 100, 200),
}
SIZES = {np.dtype(np.float64): (1e-3, 1.0, 1e3, 1e6, 1e9, 1e12), np.dtype(np.float32): (1e-2, 1.0, 30.0, 1e3)}
assert set(SHARES) == {*LINEAR, *NONLINEAR, "quadratic"}
assert QUADRATIC.squares


def _tell(what: str, done: int, misses: int, examples: list[Any], started: float) -> None:
    """Progress, for who waits."""
    line = f"  {what}: {done:,}, {misses:,} misses, {time.perf_counter() - started:.0f} s"
    print(line, *examples[:3], sep="\n    ", file=sys.stderr, flush=True)


def primitives(
    dtype: Any, points: float, seed: int, rounding: Rounding = "outward", names: Sequence[str] = tuple(FUNCTIONS)
) -> dict[str, Any]:
    """Every function in turn until so many (function, box, point) were looked at."""
    total, started, turns, blind = Tally(), time.perf_counter(), 0, set(names)
    many = int(min(BOXES, max(points / (POINTS * len(names)), 64)))
    while total.points < points:
        for name in names:
            found = check(name, seed + turns, max(many // RARE.get(name, 1), 64), POINTS, dtype, rounding)
            blind -= {name} if found.misses else set()
            total.add(found)
        turns += 1
        _tell("primitives", total.points, total.misses, total.examples, started)
    closest = {name: float(f"{room:.3g}") for name, room in total.closest.items() if np.isfinite(room)}
    least = sorted((room, name) for name, room in closest.items() if room > 0)[:5]
    return {
        "what": "primitives",
        "functions": len(names),
        "without_a_miss": sorted(blind) if rounding == "nearest" else len(blind),
        "points": total.points,
        "checks": total.checks,
        "misses": total.misses,
        "by_balls": total.balls,
        "undecided": total.skipped,
        "turns": turns,
        "closest_eps": closest,
        "closest": [f"{name}: {room} eps of the value" for room, name in least],
        "examples": [str(example) for example in total.examples[:5]],
        "seconds": round(time.perf_counter() - started),
    }


def forms(dtype: Any, points: float, seed: int, rounding: Rounding = "outward") -> dict[str, Any]:
    """Mean-value form, decomposition, remainder form and their best, for every third function."""
    total, started, names = Tally(), time.perf_counter(), list(FUNCTIONS)[1::3]
    many = int(max(64, min(4096, points / (4 * POINTS * len(names)))))
    while total.points < points:
        for name in names:
            total.add(check_forms(name, seed, max(many // RARE.get(name, 1), 64), POINTS, dtype, rounding))
        seed += 1
        _tell("forms", total.points, total.misses, total.examples, started)
    return {
        "what": "forms",
        "functions": names,
        "points": total.points,
        "checks": total.checks,
        "misses": total.misses,
        "undecided": total.skipped,
        "examples": [str(example) for example in total.examples[:5]],
        "seconds": round(time.perf_counter() - started),
    }


def observers(dtype: Any, steps: float, seed: int, rounding: Rounding = "outward") -> dict[str, Any]:
    """Runs of every plant, with unknown inputs of all sizes, until so many steps were looked at."""
    started, plants, total = time.perf_counter(), {}, Runs()
    for name, (share, batch, length) in SHARES.items():
        part, turn = Runs(), 0
        batch = int(min(batch, max(share * steps / min(length, 1000), 12)))
        length = int(min(length, max(share * steps / batch, 50)))
        while part.steps < share * steps:
            sizes = (0.1, 0.5) if name == "quadratic" else SIZES[np.dtype(dtype)]
            part.add(run(name, seed + turn, batch, length, dtype, sizes, rounding))
            turn += 1
        estimator.cache_clear()
        total.add(part)
        _tell(name, part.steps, part.misses + part.alarms, [], started)
        plants[name] = {
            "steps": part.steps,
            "runs": turn * batch,
            "steps_of_a_run": length,
            "misses": part.misses,
            "conflicts": part.alarms,
            "closest_eps": float(f"{part.closest:.3g}"),
        }
    return {
        "what": "observers",
        "steps": total.steps,
        "checks": total.checks,
        "misses": total.misses,
        "conflicts": total.alarms,
        "plants": plants,
        "seconds": round(time.perf_counter() - started),
    }


def sums(dtype: Any, count: float, seed: int, rounding: Rounding = "outward") -> dict[str, Any]:
    """Dot products of 2 to 500 terms that cancel to a remainder of the last digits, as an image, a form and a range."""
    started, done, misses, batch = time.perf_counter(), 0, 0, 512
    rng = np.random.default_rng(seed)
    ways = {
        "image": lambda m, v: linear_image(m[None], Interval.unchecked(v, v)),
        "form": lambda m, v: inclusion.affine(lambda t: jnp.sum(m * t), rounding)(Interval.unchecked(v, v)).range,
        "range": lambda m, v: inclusion.natural(lambda t: m @ t, rounding)(Interval.unchecked(v, v)),
        "running": lambda m, v: inclusion.natural(lambda t: jnp.cumsum(m * t)[-1], rounding)(Interval.unchecked(v, v)),
    }
    if rounding == "nearest":
        del ways["image"]
    for n in (2, 20, 120, 500):
        compiled = {name: jax.jit(jax.vmap(way)) for name, way in ways.items()}
        for _ in range(max(1, int(count / (4 * len(ways) * batch)))):
            m, v = (rng.standard_normal((batch, n)).astype(dtype) for _ in range(2))
            m[:, ::2], v[:, ::2] = m[:, 1::2], -v[:, 1::2] * dtype(1 + 3 * np.finfo(dtype).eps)
            terms = [part for i in range(n) for part in product(m[:, i].astype(float), v[:, i].astype(float))]
            for way in compiled.values():
                lower, upper = (np.ravel(side).astype(float) for side in jax.tree.leaves(way(m, v)))
                misses += int((sign([*terms, -lower]) < 0).sum() + (sign([*terms, -upper]) > 0).sum())
                done += batch
    return {"what": "sums", "sums": done, "misses": misses, "seconds": round(time.perf_counter() - started)}
