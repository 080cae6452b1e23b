"""How near the compiled step comes to what the processor can do: S1 in float64, outward, one record for all boxes.

In turns on the same boxes, on two threads each: this library in tiles; an older one in one call, if its interpreter is
given (`--against`); a step written by hand for this example; and the arithmetic of this library's step as a C program.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import gsisio_jax as gx
from benchmarks import handwritten
from benchmarks.c_program import CProgram, missing
from benchmarks.plants import case
from gsisio_jax.observer.fixed import Fixed
from gsisio_jax.observer.step import advance, blank
from gsisio_jax.scalar import scalar_program

TILE = 256  # as long studies of this plant are cut
THREADS = 2
ROUNDS = 3
WIDER = 1e-6  # that the older library's boxes may be narrower than ours, in the mean
AGREEMENT = 1e-9
Tiles = list[slice]


def final_widths(batch: int, steps: int, against: str | None) -> dict[str, Any]:
    """Only the widths of the last step are kept."""
    return _measure("final widths", batch, steps, against)


def all_boxes(batch: int, steps: int, against: str | None) -> dict[str, Any]:
    """Boxes of states and inputs, and the status, of every step are kept (in C without the status)."""
    return _measure("all boxes", batch, steps, against)


def _measure(kind: str, batch: int, steps: int, against: str | None) -> dict[str, Any]:
    plant = case("s1", steps)
    observer = plant.design(missing=False)
    run, _ = plant.simulate(jax.random.key(0))
    y, random = np.asarray(run.y), np.random.default_rng(0)
    parts = [random.uniform(0.05, 1, (batch, 2)) * plant.initial.width for _ in range(2)]
    lower, upper = np.asarray(run.x[0]) - parts[0], np.asarray(run.x[0]) + parts[1]
    with tempfile.TemporaryDirectory() as folder:
        programs = {"ours": _ours(kind, observer, lower, upper, y)}
        programs["handwritten"] = _handwritten(kind, lower, upper, y)
        reason = missing()
        if not reason:
            programs["C"] = _c_program(kind, observer, plant, lower, upper, y, Path(folder))
        if against:
            region = np.stack([plant.region.lower, plant.region.upper])
            np.savez(f"{folder}/given.npz", lower=lower, upper=upper, y=y, region=region)
            programs["older"] = _older(kind, against, folder)
        widths = {name: program.widths() for name, program in programs.items()}
        seconds: dict[str, list[float]] = {name: [] for name in programs}
        for _ in range(ROUNDS):
            for name, program in programs.items():
                seconds[name].append(program.timed())
        if against:
            programs["older"].close()
    ours = widths["ours"]
    means = {name: (found if found.ndim == 2 else found[:, -1]).mean(0) for name, found in widths.items()}
    rates = {name: batch * steps / min(times) for name, times in seconds.items()}
    result = {
        "batch": batch,
        "steps": steps,
        "seconds": min(seconds["ours"]),
        "compile_seconds": programs["ours"].compile_seconds,
        "compile_seconds_of": {name: program.compile_seconds for name, program in programs.items()},
        "rate": rates["ours"],
        "rates": rates,
        "ratios": {name: rates["ours"] / rate for name, rate in rates.items() if name != "ours"},
        "left_out": {"C": reason} if reason else {},
        "mean_width": {name: mean.tolist() for name, mean in means.items()},
        "same_on_threads": programs["ours"].same(),
    }
    good = [np.isfinite(ours).all(), result["same_on_threads"]]
    if "C" in widths:
        result["gap"] = float(np.abs(widths["C"] - ours).max() / ours.max())
        good.append(result["gap"] < AGREEMENT)
    if "older" in widths:
        result["wider_than_older"] = (means["ours"] / means["older"] - 1).tolist()
        good.append(max(result["wider_than_older"]) <= WIDER)
    return {**result, "ok": bool(all(good))}


class _Program:
    """Runs one compiled tile after the other on some threads.

    Attributes:
        compile_seconds: that the tile took.
    """

    def __init__(self, batch: int, tile: Callable[[slice], Any], widths: Callable[[Any], Any], compile_seconds: float):
        """`widths` takes those of the last step, (boxes, n), or of all, from what a tile returns."""
        size = min(TILE, batch)
        if batch % size or size % 8:
            raise ValueError(f"benchmarks: {batch} boxes are no multiple of {size}")
        self._tiles = [slice(start, start + size) for start in range(0, batch, size)]
        self._tile, self._widths, self.compile_seconds = tile, widths, compile_seconds

    def run(self, threads: int = THREADS) -> list[Any]:
        with ThreadPoolExecutor(threads) as pool:
            return list(pool.map(self._tile, self._tiles))

    def widths(self) -> np.ndarray:
        """Of the last step, or of all; warms up."""
        return np.concatenate([np.asarray(self._widths(found)) for found in self.run()])

    def timed(self) -> float:
        started = time.perf_counter()
        self.run()
        return time.perf_counter() - started

    def same(self) -> bool:
        """The results are those of one thread, bit by bit."""
        one, two = self.run(1), self.run()
        return all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True))


def _compiled(kind: str, function: Callable[..., Any], lower: Any, upper: Any, y: Any, widths: Any) -> _Program:
    size = min(TILE, len(lower))
    started = time.perf_counter()
    program = jax.jit(function).lower(lower[:size], upper[:size], y).compile()
    seconds = time.perf_counter() - started

    def tile(boxes: slice) -> Any:
        return jax.block_until_ready(program(lower[boxes], upper[boxes], y))

    return _Program(len(lower), tile, widths if kind == "all boxes" else lambda found: found, seconds)


def _ours(kind: str, observer: gx.Observer, lower: Any, upper: Any, y: Any) -> _Program:
    def one(lower: Any, upper: Any, y: Any) -> Any:
        found = gx.estimate(observer, gx.Interval(lower, upper), y)
        return found.state.width[-1] if kind == "final widths" else (found.state, found.input, found.status)

    return _compiled(kind, jax.vmap(one, (0, 0, None)), lower, upper, y, lambda found: found[0].width)


def _handwritten(kind: str, lower: Any, upper: Any, y: Any) -> _Program:
    def boxes(lower: Any, upper: Any, y: Any) -> Any:
        return handwritten.run(lower.T, upper.T, y, kind == "final widths")

    return _compiled(kind, boxes, lower, upper, y, lambda found: np.stack([(b[1] - b[0]).T for b in found[0]], -1))


def _c_program(kind: str, observer: gx.Observer, plant: Any, lower: Any, upper: Any, y: Any, folder: Path) -> _Program:
    fixed, noise = Fixed(observer).value, jax.tree.map(jnp.asarray, plant.noise)
    everything = kind == "all boxes"

    def step(carry: Any, y_k: Any) -> Any:
        carry, out = advance(fixed, carry, y_k, jnp.zeros(0), noise)
        return carry, (out.state, out.input) if everything else ()

    start = blank(fixed, jax.tree.map(jnp.asarray, plant.initial))
    program = scalar_program(jax.make_jaxpr(step)(start, jnp.zeros(2)))
    entries = [np.asarray(entry) for leaf in jax.tree.leaves(start) for entry in leaf.ravel()]
    compiled = CProgram(program, len(entries), len(program.outputs) - len(entries), set(range(4)), folder)

    def tile(boxes: slice) -> Any:
        return compiled([*lower[boxes].T, *upper[boxes].T, *entries[4:]], y)

    def widths(found: Any) -> Any:
        """The carry, and what is kept, begin with the box of x: lower sides, then upper ones."""
        own, kept = found
        return (kept[:, 2:4] - kept[:, :2]).transpose(2, 0, 1) if everything else (own[2:4] - own[:2]).T

    return _Program(len(lower), tile, widths, compiled.seconds)


class _Older:
    """Another environment's library, in a process of its own."""

    def __init__(self, process: Any, folder: str):
        self._process, self._folder = process, folder
        self.compile_seconds = self._line()

    def _line(self) -> Any:
        line = self._process.stdout.readline()
        if not line:
            raise SystemExit(f"benchmarks: --against failed with status {self._process.wait()}")
        return float(line)

    def widths(self) -> np.ndarray:
        self._process.stdout.readline()
        return np.load(f"{self._folder}/older.npz")["widths"]

    def close(self) -> None:
        self._process.stdin.close()
        self._process.wait()

    def timed(self) -> float:
        print(file=self._process.stdin, flush=True)
        return self._line()


def _older(kind: str, python: str, folder: str) -> Any:
    script = Path(__file__).with_name("limit_older.py")
    # Plainly, as it was used: neither this checkout nor its flags.
    environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "XLA_FLAGS")}
    command = [python, str(script), f"{folder}/given.npz", kind, f"{folder}/older.npz"]
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment, cwd=folder
    )
    return _Older(process, folder)
