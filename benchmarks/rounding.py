"""What outward rounding costs and how much wider it makes the boxes: the same run rounded outward and to nearest."""

from __future__ import annotations

import time
from typing import Any

import jax
import numpy as np

import gsisio_jax as gx
from benchmarks.plants import case, records

REPEATS = 3


def compare(plant: str, dtype: str, batch: int, steps: int) -> dict[str, Any]:
    """One plant in one precision; `rate` is that of the outward run, `cost` the time it takes over the nearest one."""
    system = case(plant, steps)
    observer = system.design(missing=False)
    initial, y, _ = records(system, batch)
    u = np.broadcast_to(np.asarray(system.u(steps)), (batch, steps, system.system.m))
    narrow = np.dtype(dtype)
    args = jax.device_put((initial.astype(narrow), y.astype(narrow), u.astype(narrow)))
    found: dict[str, Any] = {"batch": batch, "steps": steps}
    programs, widths, seconds = {}, {}, {}
    for mode in ("nearest", "outward"):

        def one(box: Any, y: Any, u: Any, mode: Any = mode) -> Any:
            return gx.estimate(observer, box, y, u, rounding=mode).state.width[-1]

        started = time.perf_counter()
        program = jax.jit(jax.vmap(one)).lower(*args).compile()
        found[f"{mode}_compile_seconds"] = time.perf_counter() - started
        jax.block_until_ready(program(*args))
        widths[mode] = np.asarray(program(*args), np.float64)
        programs[mode], seconds[mode] = program, []
    for _ in range(REPEATS):  # in turn, so that what else runs here meets both
        for mode, program in programs.items():
            started = time.process_time()
            jax.block_until_ready(program(*args))
            seconds[mode].append(time.process_time() - started)
    best = {mode: min(times) for mode, times in seconds.items()}
    finite = np.isfinite(widths["nearest"])
    inflation = float((widths["outward"] / widths["nearest"] - 1)[finite].max())
    return found | {
        "seconds": best["outward"],
        "cpu_seconds": best["outward"],
        "compile_seconds": found["outward_compile_seconds"],
        "rate": batch * steps / best["outward"],
        "cost": best["outward"] / best["nearest"],
        "inflation": inflation,
        "ok": bool(inflation > -1e-6 and (widths["outward"] >= widths["nearest"])[finite].all()),
    }
