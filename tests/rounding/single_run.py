"""Runs in float32 with everything around them in float64: the design, and the constants in f and g as NumPy arrays.

`test_single.py` also starts this file as a program, for a process in which 64-bit types are never switched on."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parent)]

from oracles.exact_plant import tight_records
from plants import LINEAR

import gsisio_jax as gx
from gsisio_jax import Interval

PLANT = LINEAR["constants"].astype(np.float32)
RUNS, STEPS = 12, 40


def f(x: Any) -> Any:
    return PLANT.A @ x + PLANT.a


def g(x: Any) -> Any:
    return jnp.stack([sum(float(c) * t for c, t in zip(row, x, strict=True)) for row in PLANT.C]) + PLANT.c


def design() -> gx.Observer:
    tiny = Interval.symmetric([1e-6, 1e-6])
    system = gx.System(f, g, G=PLANT.G, H=PLANT.H)
    return gx.design_observer(system, gx.Noise(tiny, tiny), Interval.entire(2), missing=False, gains=1, sweeps=1)


def check_tight_records(observer: gx.Observer, given: Any) -> None:
    """Records with the tightest noise are contained in boxes of float32, the data coming in the type `given`."""
    sizes, noise = [1.0, 1e3] * (RUNS // 2), [0.0, 1e-3] * (RUNS // 2)
    record = tight_records(np.random.default_rng(0), PLANT, RUNS, STEPS, sizes, noise, np.float32)
    start = record.x[:, 0].astype(given)
    boxes = [Interval.unchecked(*(side.astype(given) for side in pair)) for pair in (record.w, record.v)]
    one = jax.jit(jax.vmap(lambda x, y, w, v: gx.estimate(observer, Interval(x, x), y, noise=gx.Noise(w, v))))
    est = jax.device_get(one(start, record.y.astype(given), *boxes))
    for found, truth in ((est.state, record.x), (est.input, record.d[:, :-1])):
        assert found.lower.dtype == found.upper.dtype == np.float32
        assert (found.lower <= truth).all()
        assert (truth <= found.upper).all()
    assert np.isfinite(est.state.width).all()
    assert not (est.status & int(gx.Status.CONFLICT)).any()
    assert est.guaranteed


if __name__ == "__main__":
    check_tight_records(design(), np.float64)
    assert not jax.config.read("jax_enable_x64")
