"""A width study of the paper's example, many initial boxes times many noise bounds: `sweep` against the bare kernel."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import jax
import numpy as np

import gsisio_jax as gx
from benchmarks.plants import case
from benchmarks.throughput import AGREEMENT, peak, timed
from gsisio_jax.recursion import advance, begin

REDUCTIONS = ("final", "max", "mean")


def sweep(boxes: int, levels: int, steps: int) -> dict[str, Any]:
    """Boxes x noise levels on one shared record, three reductions; then the same cases through the bare recursion.

    The bare kernel keeps the widths of the last step only: a scan, mapped and compiled, in calls of the same size as
    the tiles of the sweep, over as many cases as take about a tenth of the sweep.
    """
    plant = case("s1", steps)
    observer = plant.design(missing=False)
    run, _ = plant.simulate(jax.random.key(0))
    y = np.asarray(run.y)
    initial = scaled(plant.initial, np.linspace(1.0, 3.0, boxes))
    level = np.linspace(1.0, 2.0, levels)
    noise = gx.Noise(scaled(plant.noise.w, level), scaled(plant.noise.v, level))
    study = partial(
        gx.sweep, observer, gx.grid("box", initial), y, gx.grid("level", noise), reduce=REDUCTIONS, progress=False
    )

    # Compile time is that of a call with as many boxes as a full tile has, less the time it runs.
    before = peak()
    found, seconds, cpu_seconds = timed(study)
    used = peak() - before
    tile = found.attrs["tile"]

    arrays = observer.astype(np.float64)

    @jax.jit
    @jax.vmap
    def bare(box: gx.Interval, noise: gx.Noise) -> Any:
        u = np.zeros(0)
        carry, _ = begin(arrays, box, y[0], u, noise)
        carry, _ = jax.lax.scan(lambda c, row: (advance(arrays, c, row, u, noise)[0], None), carry, y[1:])
        return carry.state.width

    at = np.arange(tile)
    part = jax.device_put((initial[at // levels % boxes], jax.tree.map(lambda a: a[at % levels], noise)))
    started = time.perf_counter()
    program = bare.lower(*part).compile()
    compile_seconds = time.perf_counter() - started
    program(*part)[0].block_until_ready()
    calls = max(1, round(0.1 * boxes * levels / tile))
    # Two calls at a time, as the sweep does.
    widths, bare_seconds, _ = timed(lambda: jax.block_until_ready([program(*part) for _ in range(calls)]))
    rate, bare_rate = boxes * levels * steps / seconds, calls * tile * steps / bare_seconds

    final = found.state_width_final.values.reshape(-1, 2)[:tile]
    gap = float(np.abs(final - np.asarray(widths[0])[: len(final)]).max() / final.max())
    return {
        "batch": boxes * levels,
        "steps": steps,
        "tile": tile,
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
        "compile_seconds": compile_seconds,
        "rate": rate,
        "bare_rate": bare_rate,
        "to_bare": rate / bare_rate,
        "peak_mebibytes": used / 2**20,
        "whole_peak_mebibytes": peak() / 2**20,
        "gap": gap,
        "ok": bool(gap < AGREEMENT and np.isfinite(found.state_width_max).all()),
    }


def scaled(box: gx.Interval, scale: np.ndarray) -> gx.Interval:
    """Boxes with the same centre, (S, n)."""
    center, radius = np.asarray(box.center), np.asarray(box.radius)
    return gx.Interval(center - scale[:, None] * radius, center + scale[:, None] * radius)
