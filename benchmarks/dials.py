"""`python -m benchmarks.dials [PLANT ...]`: what windows, gains and cells bring in width, and what they cost, by plant.

The plants of `benchmarks.tightness`, the spring under Euler (with a delay), the paper's example (S1), six tanks (S5).
Every setting is run on the same records; widths are means over the second half, relative to one step with one gain
(state by state: the median and the narrowest). Times are CPU times of one compiled program, all settings in turns;
operations are the numbers that a step computes, as it is traced.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np

import gsisio_jax as gx
from benchmarks.cells import operations
from benchmarks.plants import case, records
from benchmarks.record import keep_rows, line, title
from benchmarks.tightness import PLANTS, Plant
from gsisio_jax.observer.step import blank

SETTINGS: tuple[dict[str, Any], ...] = (
    {"window": 1}, {"window": 1, "gains": "auto"}, {}, {"window": 3}, {"gains": "auto"},
)  # fmt: skip
RECORDS, BOXES, TURNS = 20, 200, 4


class Task(NamedTuple):
    """How to design, and records to run on: initial boxes (b, n), y (b, T, l), u (T, m); more settings to try."""

    design: Callable[..., Any]
    initial: gx.Interval
    y: np.ndarray
    u: np.ndarray | None
    more: tuple[dict[str, Any], ...] = ()


def linear(plant: Plant, **more: Any) -> Task:
    ball = gx.Interval.symmetric
    system = gx.System(lambda x: plant.A @ x, lambda x: plant.C @ x, G=plant.G, H=plant.H)
    noise, region = gx.Noise(ball(plant.w), ball(plant.v)), gx.Interval.entire(len(plant.A))
    y = np.stack([plant.record(seed, False)[1] for seed in range(RECORDS)])
    start = np.tile(plant.start, (RECORDS, 1))
    return Task(
        lambda **dials: gx.design_observer(system, noise, region, missing=False, **more, **dials),
        gx.Interval(-start, start), y, None,
    )  # fmt: skip


def example(name: str) -> Task:
    plant = case(name, 60)
    initial, y, _ = records(plant, RECORDS)
    u = np.asarray(plant.u(plant.steps)) if plant.system.m else None
    cells = ({"cells": 16},) if name == "s1" else ()
    return Task(lambda **dials: plant.design(missing=False, **({"window": "auto"} | dials)), initial, y, u, cells)


def euler() -> Plant:
    plant = PLANTS["spring"]()
    moved = np.eye(2) + 0.1 * np.array([[0, 1], [-4, -0.4]])
    return replace(plant, A=moved, G=np.array([[0], [0.1]]))


TASKS: dict[str, Callable[[], Task]] = {
    **{name: lambda make=make: linear(make()) for name, make in PLANTS.items()},
    "spring, Euler": lambda: linear(euler(), delay="auto"),
    "S1": lambda: example("s1"),
    "S5": lambda: example("s5"),
}


def main(names: list[str]) -> int:
    jax.config.update("jax_enable_x64", True)
    head = (
        "Plant",
        "asked",
        "window, rows, gains",
        "width: median, narrowest",
        "operations",
        "CPU time of a step",
        "design s",
    )
    rows = []
    print(title(head))
    for name in names or TASKS:
        for cells in measured(TASKS[name]()):
            rows.append([name, *cells])
            print(line(rows[-1]), flush=True)
        keep_rows("dials", head, rows, list(TASKS))
    return 0


def measured(task: Task) -> list[list[str]]:
    """A row of the table for every setting that differs from those before."""
    found: dict[tuple[int, ...], tuple[str, float, int, Any, np.ndarray]] = {}
    for dials in (*SETTINGS, *task.more):
        began = time.process_time()
        observer = task.design(**dials)
        design = time.process_time() - began
        sizes = _sizes(observer)
        said = ", ".join(f"{key}={value!r}" for key, value in dials.items()) or "default"
        if sizes in found:
            found[sizes] = f"{found[sizes][0]}; {said}", *found[sizes][1:]
            continue
        run = jax.jit(jax.vmap(lambda box, y, observer=observer: gx.estimate(observer, box, y, task.u).state.width))
        width = np.asarray(run(task.initial, task.y))[:, task.y.shape[1] // 2 :].mean((0, 1))
        found[sizes] = said, design, operations_of(observer, task), run, width
    times = _in_turns([run for *_, run, _ in found.values()], task)
    base = next(iter(found.values()))[-1]
    lines = []
    for (sizes, (said, design, count, _, width)), seconds in zip(found.items(), times, strict=True):
        both = np.isinf(width) & np.isinf(base)  # a last row that a delay leaves open
        share = np.where(both, 1.0, width / np.where(both, 1.0, base))
        widths = f"{np.median(share):.3f}, {share.min():.3f}"
        times_first = f"{seconds / times[0]:.2f}"
        lines.append([said, ", ".join(map(str, sizes[:3])), widths, f"{count:,}", times_first, f"{design:.1f}"])
    return lines


def _sizes(observer: Any) -> tuple[int, ...]:
    inner = getattr(observer, "inner", observer)  # of a delayed one
    rows = 0 if inner.window is None else len(inner.window.targets)
    cells = int(np.prod(inner.cells))
    return (1 if inner.window is None else inner.window.length, rows, len(inner.gains.residual), cells)


def operations_of(observer: Any, task: Task) -> int:
    """Of one step; of a delayed observer, that of the lifted plant."""
    inner = getattr(observer, "inner", observer)
    box = jax.tree.map(lambda side: jax.numpy.asarray(side[0]), task.initial)
    u = jax.numpy.zeros(inner.system.m) if task.u is None else jax.numpy.asarray(task.u[0])
    return operations(inner, blank(inner, box), jax.numpy.zeros(inner.system.l), u)


def _in_turns(runs: list[Any], task: Task) -> list[float]:
    many = np.resize(np.arange(RECORDS), BOXES)
    initial, y = gx.Interval(task.initial.lower[many], task.initial.upper[many]), task.y[many]
    times = [[] for _ in runs]
    for turn in range(TURNS + 1):
        for run, spent in zip(runs, times, strict=True):
            began = time.process_time()
            jax.block_until_ready(run(initial, y))
            if turn:  # the first one compiles
                spent.append(time.process_time() - began)
    return [min(spent) for spent in times]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
