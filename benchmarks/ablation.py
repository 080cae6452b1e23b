"""`python -m benchmarks.ablation`: what every contractor of a step is worth in width, and what it costs in operations.

Each is taken out by itself; 40 simulated runs, widths averaged from step 10 on. A contractor that changes no width here
may still be needed: the certified bound keeps the promise of the design, the exact rows of d its exactness.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import gsisio_jax as gx
from benchmarks.plants import from_tests
from benchmarks.record import keep
from gsisio_jax.observer import step

RUNS, SETTLED = 40, 10


def _without_rows(states: Any, form: Any, z: Any) -> Any:
    n = states.center.shape[0]
    return gx.Interval.unchecked(jnp.full((0, n), -jnp.inf), jnp.full((0, n), jnp.inf)), jnp.zeros(0)


def _without_boxes(
    N_z: Any, right: Any, *rest: Any, solve: Callable[..., tuple[Any, Any]] = step.solve_remainder
) -> tuple[Any, Any]:
    """Without the box, but with what the certified bound needs of its solution."""
    return jax.tree.map(lambda side: jnp.full_like(side, jnp.nan), right), solve(N_z, right, *rest)[1]


TAKEN_OUT: dict[str, dict[str, Callable[..., Any]]] = {
    "nothing": {},
    "output rows": {"contract_affine_rows": _without_rows},
    "gains on the box (solve)": {"solve_remainder": _without_boxes},
    "dynamics": {"dynamics": lambda maps, domain, moved, d: domain},
    "certified bound": {"certified": lambda maps, domain, *_: (domain, None)},
    "exact rows of d": {"exact_from_box": lambda maps, domain, moved, carry, terms, d, lost: (d, domain)},
}


@contextmanager
def taken_out(names: dict[str, Callable[..., Any]]) -> Iterator[None]:
    """The step with functions replaced."""
    old = {name: getattr(step, name) for name in names}
    jax.clear_caches()
    try:
        for name, function in names.items():
            setattr(step, name, function)
        yield
    finally:
        for name, function in old.items():
            setattr(step, name, function)
        jax.clear_caches()


def main(systems: list[str]) -> int:
    jax.config.update("jax_enable_x64", True)
    plants = from_tests("systems")
    table: dict[str, list[str]] = {}
    for name in systems:
        plant = replace(plants.s4(True) if name == "s4" else getattr(plants, name)(), sweeps=3)
        observer = plant.design()
        cases = [(f"without {what}" if names else "all of it", observer, names) for what, names in TAKEN_OUT.items()]
        everything = np.ones(plant.system.n)
        cases += [(f"{k} sweeps", replace(observer, sweeps=k), {}) for k in (1, 2, 4)]
        for what, changed, names in cases:
            with taken_out(names):
                count, x, d = measured(changed, plant)
            print(f"{name:<4}{what:<36}{count:>8,}  x {_row(x)}  d {_row(d)}", flush=True)
            everything = x if what == "all of it" else everything
            table.setdefault(what, []).append(f"{count:,}{_worse(x / everything)}")
    keep("ablation", ["", *(name.upper() for name in systems)], [[what, *row] for what, row in table.items()])
    return 0


def _worse(ratios: np.ndarray) -> str:
    """The factor by which the state that suffers most grows, where it does."""
    worst = ratios.max()
    return "" if worst < 1.01 else ", diverges" if not worst < 1e3 else f", {worst:.2f}"


def measured(observer: gx.Observer, plant: Any) -> tuple[int, np.ndarray, np.ndarray]:
    """Operations of a step, and mean widths of x and d."""
    run, _ = jax.jit(jax.vmap(plant.simulate))(jax.random.split(jax.random.key(0), RUNS))
    u = jnp.asarray(plant.u(plant.steps)) if plant.system.m else None
    estimate = jax.jit(jax.vmap(lambda y: gx.estimate(observer, plant.initial, y, u)))(run.y)
    sizes = from_tests("sizes")
    count = sum(sizes.step_program(observer, sizes.first_arguments(observer, plant)).count().values())
    x, d = (np.asarray(box.width)[:, SETTLED:].mean((0, 1)) for box in (estimate.state, estimate.input))
    return count, x, d


def _row(values: np.ndarray) -> str:
    return " ".join(f"{value:.4g}" for value in values)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:] or ["s1", "s4", "s5", "s7", "s9"]))
