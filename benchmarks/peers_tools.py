"""What `peers.py` is made of: tiles on threads, turns, a summary, and the process of another environment."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

import gsisio_jax as gx
from gsisio_jax import Interval

TILE, THREADS, ROUNDS = 2000, 2, 5
MISSING = (
    "not installed; `python -m venv peers && peers/bin/pip install immrax codac`, then `--peers peers/bin/python` here"
)
Program = Callable[[], Any]


def ours_compiled(observer: gx.Observer, initial: Interval, y: np.ndarray, shared: bool = False) -> tuple[Program, Any]:
    """A run over all boxes that keeps the last widths, and the boxes of all steps, computed apart; every box has a
    record (boxes, T, l), or all share one (T, l)."""
    batch = len(initial.lower)
    size, axes = min(TILE, batch), (0, None) if shared else (0, 0)

    def one(box: Interval, rows: Any, keep: Callable[[Any], Any]) -> Any:
        return keep(gx.estimate(observer, box, rows).state)

    def compiled(keep: Callable[[Any], Any]) -> Program:
        def part(tile: slice) -> Any:
            return jax.tree.map(lambda v: v[tile], initial), y if shared else y[tile]

        program = jax.jit(jax.vmap(partial(one, keep=keep), axes)).lower(*part(slice(size))).compile()
        return tiled(batch, lambda tile: program(*part(tile)), size)

    everything = compiled(lambda state: state)()
    fast = compiled(lambda state: state.width[-1])
    fast()
    return fast, jax.tree.map(lambda *parts: np.concatenate([np.asarray(part) for part in parts]), *everything)


def tiled(boxes: int, run: Callable[[slice], Any], size: int) -> Program:
    """Tiles on two threads."""
    if boxes % size:
        raise ValueError(f"benchmarks: {boxes} boxes are no multiple of {size}")
    tiles = [slice(start, start + size) for start in range(0, boxes, size)]

    def all_tiles() -> list[Any]:
        with ThreadPoolExecutor(THREADS) as pool:
            return list(pool.map(lambda tile: jax.block_until_ready(run(tile)), tiles))

    return all_tiles


def boxes_of(parts: list[Any]) -> np.ndarray:
    return np.stack(
        [np.concatenate([np.asarray(getattr(part, side)) for part in parts]) for side in ("lower", "upper")]
    )


def one_core() -> None:
    """This process and what it starts, from before JAX counts cores: so that other load falls on both sides alike."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


def turns(
    programs: dict[str, Program], peers: Peers | None, rounds: int = ROUNDS, clock: Program = time.perf_counter
) -> dict[str, float]:
    """Median seconds of each, one after the other in every round."""
    seconds: dict[str, list[float]] = {}
    for _ in range(rounds):
        for name, run in programs.items():
            started = clock()
            run()
            seconds.setdefault(name, []).append(clock() - started)
        for name, value in peers.timed().items() if peers is not None else ():
            seconds.setdefault(name, []).append(value)
    return {name: float(np.median(values)) for name, values in seconds.items()}


def summary_of(
    batch: int, steps: int, seconds: dict[str, float], counts: dict[str, int], found: dict[str, Any], x: np.ndarray,
    left_out: dict[str, str],
) -> dict[str, Any]:  # fmt: skip
    rates = {name: counts[name] * steps / seconds[name] for name in found}
    fewest = min(counts.values())
    missed = {
        name: int(((x[: len(low)] < low - 1e-12) | (x[: len(low)] > high + 1e-12)).sum())
        for name, (low, high) in found.items()
    }
    return {
        "batch": batch,
        "steps": steps,
        "seconds": seconds["ours"],
        "rate": rates["ours"],
        "rates": rates,
        "ratios": {name: rates["ours"] / rate for name, rate in rates.items() if name != "ours"},
        # Of the same records, over the second half.
        "mean_width": {n: (h - l)[:fewest, steps // 2 :].mean((0, 1)).tolist() for n, (l, h) in found.items()},
        "missed": missed,
        "left_out": left_out,
        "ok": not missed["ours"],
    }


class Peers:
    """The programs of another environment, in a process of its own.

    Attributes:
        found: the boxes of each, lower sides and upper ones.
    """

    def __init__(self, kind: str, python: str | None, **given: Any):
        self._kind, self._python, self._given = kind, python, given
        self.found: dict[str, np.ndarray] = {}
        self._process: Any = None
        self._error = ""

    def __enter__(self) -> Peers:
        package = {"bounds": "immrax", "step": "codac"}[self._kind]
        if self._python is None and importlib.util.find_spec(package) is None:
            return self
        self._folder = tempfile.TemporaryDirectory()
        source, target = (str(Path(self._folder.name) / name) for name in ("given.npz", "found.npz"))
        np.savez(source, **self._given)
        # Neither this checkout nor its packages; but the same flags of XLA, which are to the advantage of both.
        environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
        script = str(Path(__file__).with_name("peers_apart.py"))
        command = [self._python or sys.executable, script, self._kind, source, target]
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(
            command, stdin=pipe, stdout=pipe, stderr=pipe, text=True, env=environment, cwd=self._folder.name
        )
        if not self._process.stdout.readline():
            lines = self._process.communicate()[1].strip().splitlines()
            self._error, self._process = (lines[-1] if lines else "it ended without a word"), None
            return self
        self.found = dict(np.load(target))
        return self

    def timed(self) -> dict[str, float]:
        """Seconds of a run of each."""
        if self._process is None:
            return {}
        print(file=self._process.stdin, flush=True)
        return json.loads(self._process.stdout.readline())

    def left_out(self, package: str) -> dict[str, str]:
        """Why there is nothing to compare with."""
        return {} if self.found else {package: self._error or MISSING}

    def __exit__(self, *_: Any) -> None:
        if self._process is not None:
            self._process.communicate("")
        if hasattr(self, "_folder"):
            self._folder.cleanup()
