"""How long a user waits before the first box: import, design, first compilation. Each in a process of its own."""

from __future__ import annotations

import time
from typing import Any

LIMITS = {"import": 1.5, "design": 20.0, "compile": 20.0}


def importing() -> dict[str, Any]:
    """What `import gsisio_jax` takes beyond the JAX that it needs."""
    started = time.perf_counter()
    import jax  # noqa: F401

    between = time.perf_counter()
    import gsisio_jax  # noqa: F401

    seconds = time.perf_counter() - between
    return {"jax_seconds": between - started, "seconds": seconds, "ok": seconds < LIMITS["import"]}


def tanks(steps: int) -> dict[str, Any]:
    """`design_observer` with its defaults and the first `estimate` (trace, compile and run) for the six tanks."""
    import jax

    import gsisio_jax as gx
    from benchmarks.plants import case

    plant = case("s5", steps)
    record, _ = plant.simulate(jax.random.key(0))
    started = time.perf_counter()
    observer = plant.design()
    designed = time.perf_counter()
    est = jax.block_until_ready(gx.estimate(observer, plant.initial, record.y, plant.u(steps)))
    first = time.perf_counter()
    jax.block_until_ready(gx.estimate(observer, plant.initial, record.y, plant.u(steps)))
    again = time.perf_counter() - first
    sound = bool(est.state.contains(record.x[:-1]).all())
    design_seconds, compile_seconds = designed - started, first - designed - again
    return {
        "steps": steps,
        "gains": len(observer.gains.residual),
        "design_seconds": design_seconds,
        "compile_seconds": compile_seconds,
        "seconds": again,
        "sound": sound,
        "ok": sound and design_seconds < LIMITS["design"] and compile_seconds < LIMITS["compile"],
    }
