"""The plants of the benchmarks, with records simulated in NumPy; taken from the test systems of this checkout."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

TESTS = Path(__file__).resolve().parent.parent / "tests"


def from_tests(name: str) -> Any:
    """A helper module of tests/, which is no package: a source checkout is needed."""
    if not TESTS.is_dir():
        raise SystemExit(f"benchmarks: {TESTS} is missing; run from a source checkout of gsisio_jax")
    if str(TESTS) not in sys.path:
        sys.path.insert(0, str(TESTS))
    return __import__(name, fromlist=["*"])


def case(name: str, steps: int) -> Any:
    """A test system by its name in tests/systems.py (s1, s5, ...), runs of `steps` steps, the default design."""
    return replace(getattr(from_tests("systems"), name)(), steps=steps, sweeps=3)


def records(plant: Any, batch: int) -> tuple[Any, np.ndarray, np.ndarray]:
    """Initial boxes (batch, n), measurements (batch, T, l) and true states (batch, T, n) of `batch` runs.

    The initial boxes are those of the test system, moved and scaled a little around the true state.
    """

    @jax.jit
    @jax.vmap
    def draw(key: Any) -> tuple[Any, Any]:
        run, _ = plant.simulate(key)
        return run.y, run.x[:-1]

    y, x = map(np.asarray, draw(jax.random.split(jax.random.key(0), batch)))
    random = np.random.default_rng(0)
    low = x[:, 0] - random.uniform(0, 1, (batch, 1)) * plant.initial.width
    high = x[:, 0] + random.uniform(0, 1, (batch, 1)) * plant.initial.width
    return type(plant.initial)(low, high), y, x
