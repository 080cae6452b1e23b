"""Whole runs in rational arithmetic, with the tightest noise bounds that floating numbers leave possible."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from oracles.exact_plant import tight_record

import gsisio_jax as gx
from gsisio_jax import Interval

A = np.array([[0.7, 0.21, 0.0], [-0.33, 0.5, 0.1], [0.1, 0.0, 0.6]])
C = np.array([[1.0, 0.3, 0.0], [0.2, 1.0, 0.4], [0.1, -0.7, 1.0]])
G, H = np.array([[1.0, 0.0], [0.49, 0.0], [-0.3, 0.0]]), np.array([[0.0, 0.0], [0.0, 0.0], [0.0, 1.0]])
STEPS, BATCH = 40, 8


@lru_cache
def observer(dtype: Any) -> gx.Observer:
    """The plant whose matrices are numbers of that type, so that they are what they are in every precision."""
    a, c, g = (m.astype(dtype) for m in (A, C, G))
    system = gx.System(lambda x: jnp.asarray(a) @ x, lambda x: jnp.asarray(c) @ x, G=g.astype(float), H=H)
    ball = Interval.symmetric(np.full(3, 1e-9))
    return gx.design_observer(system, gx.Noise(ball, ball), Interval.entire(3), missing=False, gains=2)


def misses(dtype: Any, d_size: float, noise: float, rounding: Any, seed: int, steps: int = STEPS, start: float = 0.0):
    """Numbers of state and input bounds that miss the truth, and the estimate."""
    a, c, g = (m.astype(dtype) for m in (A, C, G))
    record = tight_record(np.random.default_rng(seed), a, c, g, H, steps, d_size, noise, dtype)
    bounds = gx.Noise(Interval(*record.w), Interval(*record.v))
    initial = Interval(record.x[0] - dtype(start), record.x[0] + dtype(start))
    est = gx.estimate(observer(dtype), initial, record.y, noise=bounds, rounding=rounding)
    assert est.state.lower.dtype == dtype
    state = np.asarray(est.state.contains(record.x))
    return int((~state).sum()), int((~np.asarray(est.input.contains(record.d[:-1]))).sum()), est


@pytest.mark.parametrize(("dtype", "sizes"), [(np.float64, (1.0, 1e6, 1e12)), (np.float32, (1.0, 1e3))])
def test_no_bound_misses_the_truth(dtype, sizes):
    for i, d_size in enumerate(sizes):
        of_x, of_d, est = misses(dtype, d_size, 0.0, "outward", i)
        assert (of_x, of_d) == (0, 0), d_size
        assert est.guaranteed
        # No alarm by rounding alone, and no wider than rounding makes it.
        assert not np.asarray(est.status).any()
        size = d_size * 1e3 * np.finfo(dtype).eps
        assert np.asarray(est.state.width[5:]).max() < size


def test_rounded_to_nearest_the_same_run_fails():
    of_x, of_d, est = misses(np.float64, 1.0, 0.0, "nearest", 0)
    assert min(of_x, of_d) > 10
    assert not est.guaranteed


def test_noise_beside_rounding():
    of_x, of_d, est = misses(np.float64, 1e6, 1e-3, "outward", 7, start=2.0)
    assert (of_x, of_d) == (0, 0)
    assert not np.asarray(est.status).any()


def test_outputs_with_a_constant():
    """An affine output map is not linear: its constant must be taken off."""
    system = gx.System(lambda x: 0.5 * x, lambda x: x + 1.0, G=[[1.0]], H=[[0.0]])
    ball = Interval([-0.1], [0.1])
    plant = gx.design_observer(system, gx.Noise(ball, ball), Interval.entire(1), missing=False)
    rng, x, y = np.random.default_rng(0), [0.3], []
    for _ in range(20):
        y.append([x[-1] + 1 + rng.uniform(-0.1, 0.1)])
        x.append(0.5 * x[-1] + rng.normal() + rng.uniform(-0.1, 0.1))
    est = gx.estimate(plant, Interval([-1.0], [1.0]), np.array(y))
    assert not np.asarray(est.status).any()
    assert np.asarray(est.state.contains(np.array(x[:-1])[:, None])).all()


@pytest.mark.soak
@pytest.mark.parametrize(("dtype", "sizes"), [(np.float64, (1e-3, 1.0, 1e6, 1e12)), (np.float32, (1e-2, 1.0, 1e3))])
def test_long_runs(dtype, sizes):
    """The nightly size: records of 10,000 steps."""
    total = 0
    for seed in range(6):
        for d_size in sizes:
            for noise in (0.0, 1e-3):
                of_x, of_d, _ = misses(dtype, d_size, noise, "outward", 1000 + seed, 10_000)
                assert (of_x, of_d) == (0, 0), (d_size, noise, seed)
                total += 10_000
    print(f"\n{np.dtype(dtype).name}: {total} observer steps, no miss")
