"""Studies as users run them, compiled: they hold the truth, and are those that the other modules run in NumPy."""

import jax
import numpy as np
import pytest
from oracles.uncompiled import uncompiled
from oracles.uncompiled_calls import FEW

import gsisio_jax as gx
from gsisio_jax import Interval

COMPILED = True
RUNS, T = FEW + 8, 10
LEVELS = np.array([0.5, 1.0])
SYSTEM = gx.System(lambda x: 0.9 * x, lambda x: x, G=np.zeros((1, 0)), H=np.zeros((1, 0)))
NOISE = gx.Noise(Interval.symmetric([0.05]), Interval.symmetric([0.1]))
KINDS = ("boxes", "final", "max", "coverage", "first_conflict")


@pytest.fixture(scope="module")
def observer():
    return gx.design_observer(SYSTEM, NOISE, Interval.entire(1), missing=False, sweeps=1)


def close(one, other):
    assert set(one.data_vars) == set(other.data_vars)
    for name in one.data_vars:
        np.testing.assert_allclose(one[name], other[name], rtol=1e-12, atol=1e-12, err_msg=name)


def test_simulated_runs(observer):
    """Two batches: one of few cases, which NumPy runs one by one, and one of many, side by side."""

    def study(runs):
        return gx.monte_carlo(observer, 3, runs, T, Interval.symmetric([1.0]), reduce=None, progress=False)

    for runs in (5, RUNS):
        found = study(runs)
        assert (found.state_lower <= found.state_true).all()
        assert (found.state_true <= found.state_upper).all()
        assert found.attrs["missed"].startswith(f"0 of {runs} runs")
        with uncompiled():
            close(found, study(runs))


def test_a_sweep(observer):
    keys = jax.random.split(jax.random.key(0), 4)
    run = jax.jit(lambda key: gx.simulate(SYSTEM, key, np.zeros(1), np.zeros((T, 0)), NOISE))
    x, y = (np.stack([getattr(run(key), name) for key in keys]) for name in ("x", "y"))
    scale = LEVELS[:, None]
    noise = gx.Noise(*(Interval(scale * box.lower, scale * box.upper) for box in (NOISE.w, NOISE.v)))

    def study():
        levels = gx.grid("level", noise, coordinate=LEVELS)
        return gx.sweep(observer, Interval.symmetric([0.5]), y, noise=levels, truth=(x, None), reduce=KINDS)

    found = study()
    assert (found.state_coverage.isel(level=1) == 1).all()
    for record in range(len(y)):
        est = gx.estimate(observer, Interval.symmetric([0.5]), y[record])
        one = found.isel(run=record, level=1)
        np.testing.assert_allclose(one.state_lower, est.state.lower, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(one.state_upper, est.state.upper, rtol=1e-12, atol=1e-12)
    with uncompiled():
        close(found, study())
