"""`python -m benchmarks.tuning`: one common scale of the noise bounds, from 20 records of the test systems."""

from __future__ import annotations

import sys
import time
from dataclasses import replace

import jax
import numpy as np

from benchmarks.plants import from_tests
from gsisio_jax.tuning import Records, tune_noise

SETTINGS = {"s4b": ("s4", {"full_state_measured": True}, 500), "s5": ("s5", {}, 200)}


def main() -> int:
    jax.config.update("jax_enable_x64", True)
    good = True
    for name, (system, options, steps) in SETTINGS.items():
        case = replace(getattr(from_tests("systems"), system)(**options), steps=steps)
        run, _ = jax.jit(jax.vmap(case.simulate))(jax.random.split(jax.random.key(1), 25))
        u = np.asarray(case.u(steps)) if case.system.m else None
        observer = case.design(missing=False, sweeps=3)
        start = time.perf_counter()
        found = tune_noise(observer, Records(case.initial, np.asarray(run.y), u), None, "scale", tolerance=1e-4)
        scale = found.factors["scale"]
        good &= 0.9 <= scale <= 1 + 1e-4
        print(f"{name}: 20 records of {steps} steps: scale {scale:.5f} of the true bounds, "
              f"{time.perf_counter() - start:.0f} s; held out: {found.held_out}", flush=True)  # fmt: skip
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
