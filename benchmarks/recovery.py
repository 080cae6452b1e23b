"""`python -m benchmarks.recovery`: what the design of linear plants takes with recovery included, and after how many
rows boxes are finite again.

Seconds are of CPU, in this process, the first plant apart (it warms up); programs are linear ones, solved for rows of
windows and of recovery, and those that XLA compiled.
"""

from __future__ import annotations

import time
from typing import Any

import jax
import numpy as np

from benchmarks import record, tightness
from benchmarks.plants import from_tests
from gsisio_jax.design.row_solver import RowSolver


class Counted:
    """Counts linear programs and compilations while it is open."""

    def __enter__(self) -> Counted:
        self.programs, self.compiled, self.solve = 0, 0, RowSolver.multipliers
        RowSolver.multipliers = lambda *args: self._solved(*args)
        jax.monitoring.register_event_duration_secs_listener(self._listen)
        return self

    def __exit__(self, *_: object) -> None:
        RowSolver.multipliers = self.solve
        jax.monitoring.unregister_event_duration_listener(self._listen)

    def _solved(self, *args: Any) -> Any:
        self.programs += 1
        return self.solve(*args)

    def _listen(self, event: str, *_: Any, **__: Any) -> None:
        self.compiled += event.endswith("backend_compile_duration")


HEAD = "Plant", "n, l, p", "design s", "linear programs", "compiled", "from any state", "after 1, 2, 3 lost rows"


def plants() -> dict[str, tuple[np.ndarray, ...]]:
    """A, C, G, H and the magnitudes of w and v."""
    found = {}
    for make in (tightness.rotation, tightness.chain, tightness.network, tightness.full_rank):
        plant = make()
        found[make.__name__] = plant.A, plant.C, plant.G, plant.H, plant.w, plant.v
    ours = from_tests("recovery_plants").PLANTS
    return found | {name: plant for name, plant in ours.items() if name == "one output" or name.startswith("random")}


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    every, design = plants(), from_tests("recovery_plants").design
    design(every["rotation"])
    table = []
    print(record.title(HEAD))
    for name, plant in every.items():
        with Counted() as count:
            started = time.process_time()
            certificate = design(plant).certificate
            seconds = time.process_time() - started
        n, l, p = len(plant[0]), len(plant[1]), plant[2].shape[1]
        rows = [f"{certificate.rows_until_finite(lost).max():.0f}" for lost in (None, 1, 2, 3)]
        counts = f"{seconds:.1f}", str(count.programs), str(count.compiled)
        table.append([name, f"{n}, {l}, {p}", *counts, rows[0], ", ".join(rows[1:])])
        print(record.line(table[-1]), flush=True)
    record.keep("recovery", HEAD, table)


if __name__ == "__main__":
    main()
