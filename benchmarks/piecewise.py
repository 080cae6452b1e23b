"""Tables as sums of clips and as `interp`: how long design and first call take, and how much memory.

``python -m benchmarks --only piecewise`` runs each in a process of its own.
"""

from __future__ import annotations

import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import gsisio_jax as gx
from benchmarks.throughput import peak
from gsisio_jax import Interval

KINDS = ("clips", "interp", "battery")
PIECES = 50
STEPS = 50


def case(kind: str) -> dict[str, Any]:
    """CPU seconds of the design and of the first call, and the peak of the process.

    Args:
        kind: "clips" (g has a sum of 50 clips of one of two states), "interp" (a table with 50 knots there), or
            "battery" (4 states, the voltage a sum of 11 clips of the charge, minus what three states drop).
    """
    system, noise, x0 = plant(kind)
    box = system.state_bounds
    began = time.process_time()
    observer = gx.design_observer(system, noise, box, certify=False)
    design = time.process_time() - began
    run = gx.simulate(system, jax.random.key(0), x0, np.zeros((STEPS, 1)), noise)
    began = time.process_time()
    est = jax.block_until_ready(gx.estimate(observer, box, run.y))
    first = time.process_time() - began
    return {
        "batch": 1,
        "steps": STEPS,
        "design_seconds": design,
        "first_call_seconds": first,
        "peak_mebibytes": peak() / 2**20,
        "ok": bool(np.asarray(est.state.contains(run.x[:STEPS])).all()),
    }


def plant(kind: str) -> tuple[gx.System, gx.Noise, np.ndarray]:
    """System, noise and first state."""
    if kind == "battery":
        knots, slopes = np.linspace(0, 1, 11), [3, 1, 0.5, 0.4, 0.3, 0.3, 0.3, 0.4, 0.5, 1, 2]
        A = np.array([[1, 0, 0, -0.001], [0, 0.9, 0, 0.01], [0, 0, 0.98, 0.005], [0, 0, 0, 0.95]])
        bounds = Interval([0.0, -1.0, -1.0, -5.0], [1.0, 1.0, 1.0, 5.0])

        def g(x: Any) -> Any:
            open_circuit = sum(s * jnp.clip(x[0] - k, 0, 0.1) for s, k in zip(slopes, knots, strict=True))
            return jnp.stack([3.0 + open_circuit - x[1] - x[2] - x[3], x[3]])
    else:
        knots, A = np.linspace(-2, 2, PIECES), np.array([[1, 0.1], [-0.1, 0.95]])
        bounds = Interval.symmetric([2.0, 2.0])

        def g(x: Any) -> Any:
            if kind == "interp":
                return jnp.stack([jnp.interp(x[0], knots, knots + 0.2 * np.sin(3 * knots)), x[1]])
            return jnp.stack([x[0] + 0.1 * x[1] + sum(0.1 * jnp.clip(x[0] - k, 0, 0.08) for k in knots), x[1]])

    n = len(A)
    G = np.zeros((n, 1))
    G[-1] = 1.0 if kind == "battery" else 0.1
    system = gx.System(lambda x: A @ x, g, G, np.zeros((2, 1)), state_bounds=bounds)
    noise = gx.Noise(Interval.symmetric(np.full(n, 1e-3)), Interval.symmetric([0.01, 0.01]))
    return system, noise, np.array([0.5, 0.0, 0.0, 0.1])[:n]
