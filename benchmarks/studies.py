"""A width study of the paper's example, many initial boxes times many noise bounds: `sweep` against the bare kernel."""

from __future__ import annotations

import time
from typing import Any

import jax
import numpy as np

import gsisio_jax as gx
from benchmarks.plants import case
from benchmarks.throughput import AGREEMENT, peak, timed
from gsisio_jax import scalar
from gsisio_jax.observer.scan import advance, begin

REDUCTIONS = ("final", "max", "mean")
PART = 0.05  # of the boxes, for the comparison
TURNS = 3


def sweep(boxes: int, levels: int, steps: int) -> dict[str, Any]:
    """Boxes x noise levels on one shared record, three reductions; then part of it against the bare recursion.

    The bare kernel keeps the widths of the last step only: a scan, mapped and compiled. Both run the same cases in
    tiles of one size, two at a time, in turns, so that other load falls on both.
    """
    plant = case("s1", steps)
    observer = plant.design(missing=False)
    run, _ = plant.simulate(jax.random.key(0))
    y = np.asarray(run.y)
    initial = scaled(plant.initial, np.linspace(1.0, 3.0, boxes))
    level = np.linspace(1.0, 2.0, levels)
    noise = gx.Noise(scaled(plant.noise.w, level), scaled(plant.noise.v, level))

    def study(initial: gx.Interval, batch: int | None = None) -> Any:
        axes = gx.grid("box", initial), y, gx.grid("level", noise)
        return gx.sweep(observer, *axes, reduce=REDUCTIONS, batch=batch, progress=False)

    before = peak()
    found, seconds, cpu_seconds = timed(lambda: study(initial))
    used = peak() - before

    part = max(1, round(boxes * PART))
    tile = -(-part * levels // 4)
    arrays = observer.astype(np.float64)

    @jax.jit
    @jax.vmap
    def bare(box: gx.Interval, noise: gx.Noise) -> Any:
        u = np.zeros(0)
        carry, _ = begin(arrays, box, y[0], u, noise, False)
        carry, _ = scalar.scan(lambda c, row: (advance(arrays, c, row, u, noise, False)[0], None), carry, y[1:])
        return carry.state.width

    cases = [np.minimum(np.arange(at, at + tile), part * levels - 1) for at in range(0, part * levels, tile)]
    tiles = [(initial[at // levels], jax.tree.map(lambda a, at=at: a[at % levels], noise)) for at in cases]
    started = time.perf_counter()
    program = bare.lower(*tiles[0]).compile()
    compile_seconds = time.perf_counter() - started

    def kernel() -> list[Any]:
        widths = [program(*tiles[0])]
        for inputs in tiles[1:]:
            widths.append(program(*inputs))
            widths[-2].block_until_ready()
        return [np.asarray(width) for width in widths]

    study(initial[:part], tile)  # compiled for this size
    turns = [(timed(lambda: study(initial[:part], tile)), timed(kernel)) for _ in range(TURNS)]
    to_bare = sum(bare[1] for _, bare in turns) / sum(own[1] for own, _ in turns)
    widths = np.concatenate(turns[0][1][0])[: part * levels]
    final = found.state_width_final.values[:part].reshape(-1, 2)
    gap = float(np.abs(final - widths).max() / final.max())
    return {
        "batch": boxes * levels,
        "steps": steps,
        "tile": found.attrs["tile"],
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
        "compile_seconds": compile_seconds,
        "rate": boxes * levels * steps / seconds,
        "to_bare": to_bare,
        "part_seconds": [(own[1], bare[1]) for own, bare in turns],
        "peak_mebibytes": used / 2**20,
        "whole_peak_mebibytes": (before + used) / 2**20,
        "gap": gap,
        "ok": bool(gap < AGREEMENT and np.isfinite(found.state_width_max).all()),
    }


def scaled(box: gx.Interval, scale: np.ndarray) -> gx.Interval:
    """Boxes with the same centre, (S, n)."""
    center, radius = np.asarray(box.center), np.asarray(box.radius)
    return gx.Interval(center - scale[:, None] * radius, center + scale[:, None] * radius)
