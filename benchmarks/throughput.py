"""Boxes times steps per second on the paper's example: compiled, and the same step in NumPy."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np

import gsisio_jax as gx
from benchmarks.plants import case, from_tests, records
from gsisio_jax.observer.step import advance, blank

ROUNDING = 1e-12  # half of the records have noise on its very bounds, reached only up to rounding
LONG = 20.0  # seconds: calls that take longer are timed once after the warm one
REPEATS = 3
AGREEMENT = 1e-9


def final_widths(batch: int, steps: int) -> dict[str, Any]:
    """Only the widths of the last step leave the compiled program."""
    return _compiled(batch, steps, lambda est: est.state.width[-1])


def all_boxes(batch: int, steps: int) -> dict[str, Any]:
    """Every box and status is stored."""
    return _compiled(batch, steps, lambda est: (est.state, est.input, est.status))


def numpy(batch: int, steps: int) -> dict[str, Any]:
    """The same step, vmapped, operation by operation in NumPy; compared with the compiled one."""
    plant = case("s1", steps)
    observer = plant.design(missing=False)
    initial, y, x = records(plant, batch)
    u = np.zeros((batch, 0))
    arrays = observer.astype(np.float64)
    program = from_tests("oracles.numpy_program").numpy_function
    start = jax.tree.map(np.asarray, jax.vmap(partial(blank, arrays))(initial))
    step = program(jax.vmap(partial(_advance, arrays)), start, y[:, 0], u)

    def loop() -> tuple[list[Any], float, float]:
        started, cpu = time.perf_counter(), time.process_time()
        carry, boxes = start, []
        for k in range(steps):
            carry, out = step(carry, y[:, k], u)
            boxes.append(out.state)
        return boxes, time.perf_counter() - started, time.process_time() - cpu

    boxes, seconds, cpu_seconds = loop()
    loops = jax.tree.map(lambda *rows: np.stack(rows, axis=1), *boxes)
    compiled = jax.jit(jax.vmap(lambda box, y: gx.estimate(observer, box, y).state))(initial, y)
    gaps = [
        np.abs(a - b).max() / np.abs(b).max()
        for a, b in zip(jax.tree.leaves(loops), jax.tree.leaves(compiled), strict=True)
    ]
    return {
        "batch": batch,
        "steps": steps,
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
        "rate": batch * steps / seconds,
        "gap": float(max(gaps)),
        "sound": bool(loops.contains(x).all()),
        "ok": bool(max(gaps) < AGREEMENT and loops.contains(x).all()),
    }


def _advance(observer: Any, carry: Any, y: Any, u: Any) -> Any:
    return advance(observer, carry, y, u, observer.noise)


def _compiled(batch: int, steps: int, keep: Callable[[Any], Any]) -> dict[str, Any]:
    plant = case("s1", steps)
    observer = plant.design(missing=False)
    initial, y, x = records(plant, batch)
    run = jax.jit(jax.vmap(lambda box, y: keep(gx.estimate(observer, box, y))))
    before = peak()
    args = jax.device_put((initial, y))
    started = time.perf_counter()
    program = run.lower(*args).compile()
    compile_seconds = time.perf_counter() - started
    started = time.perf_counter()
    result = jax.block_until_ready(program(*args))
    repeats = 1 if time.perf_counter() - started > LONG else REPEATS
    _, seconds, cpu_seconds = min(
        (timed(lambda: jax.block_until_ready(program(*args))) for _ in range(repeats)), key=lambda all: all[1]
    )
    used = peak() - before
    return {
        "batch": batch,
        "steps": steps,
        "compile_seconds": compile_seconds,
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
        "rate": batch * steps / seconds,
        "peak_mebibytes": used / 2**20,
        **_checked(run, observer, args, x, result),
    }


def _checked(run: Any, observer: Any, args: Any, x: np.ndarray, result: Any) -> dict[str, Any]:
    """Boxes contain the truth. Where they were not kept, a small part of the batch is computed again, and its last
    widths compared with the kept ones."""
    if isinstance(result, tuple):
        sound = bool(np.asarray(result[0].contains(x, -ROUNDING)).all())
        return {"sound": sound, "ok": sound}
    part = jax.tree.map(lambda a: a[:1000], args)
    boxes = jax.jit(jax.vmap(lambda box, y: gx.estimate(observer, box, y).state))(*part)
    sound = bool(np.asarray(boxes.contains(x[:1000], -ROUNDING)).all())
    widths = np.asarray(boxes.width[:, -1])
    gap = float(np.abs(widths - np.asarray(result)[:1000]).max() / widths.max())
    return {"sound": sound, "gap": gap, "ok": sound and gap < AGREEMENT and bool(np.isfinite(result).all())}


def timed(call: Callable[[], Any]) -> tuple[Any, float, float]:
    """Result, wall and processor time; where the second is far below the first times the cores, others compute."""
    started, cpu = time.perf_counter(), time.process_time()
    result = call()
    return result, time.perf_counter() - started, time.process_time() - cpu


def peak() -> float:
    """Largest resident set of this process so far, in bytes (Linux counts kibibytes)."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024.0
