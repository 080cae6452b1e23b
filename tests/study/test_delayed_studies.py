"""Studies of observers with a delay: the boxes are those of `estimate`, and each meets the truth of its own step."""

import jax
import numpy as np
import pytest

import gsisio_jax as gx
from gsisio_jax import Interval

T, RUNS = 16, 3
FIRST = Interval.symmetric([1.0, 1.0])


def f(x):
    return jax.numpy.stack([x[0] + 0.1 * x[1], -0.4 * x[0] + 0.96 * x[1]])


def force(key, k, x):
    return 3 * jax.random.normal(key, (1,))


def close(got, expected):
    np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-12)


@pytest.fixture(scope="module")
def observer():
    """A mass on a spring, its position measured, the force unknown."""
    system = gx.System(f, lambda x: x[:1], G=[[0.0], [0.1]], H=[[0.0]])
    noise = gx.Noise(Interval.symmetric([1e-3, 1e-2]), Interval.symmetric([0.01]))
    return gx.design_observer(system, noise, Interval.entire(2), delay=1, missing=False, sweeps=1)


def test_a_sweep_is_estimate(observer):
    """Up to rounding, as every sweep; with a lost measurement, and noise that changes with time."""
    keys, scale = jax.random.split(jax.random.key(0), RUNS), np.array([0.7, 1.0, 1.3])[:, None, None]
    grow = scale * np.linspace(1, 2, T)[:, None]
    noise = gx.Noise(*(Interval(grow * box.lower, grow * box.upper) for box in (observer.noise.w, observer.noise.v)))
    d = jax.random.normal(jax.random.key(1), (RUNS, T, 1))
    runs = jax.vmap(lambda key, d: gx.simulate(observer.system, key, np.ones(2), d=d, noise=observer.noise))(keys, d)
    y = np.array(runs.y)
    y[1, 7] = np.nan
    kinds = ("boxes", "final", "max", "first_conflict", "coverage")
    data = gx.sweep(
        observer, FIRST, gx.grid("run", y), gx.grid("run", noise), truth=gx.grid("run", (runs.x, d)), reduce=kinds
    )
    est = jax.jit(jax.vmap(lambda y, noise: gx.estimate(observer, FIRST, y, noise=noise)))(y, noise)
    for side in ("lower", "upper"):
        close(data[f"state_{side}"], getattr(est.state, side))
        close(data[f"input_{side}"][:, :-1], getattr(est.input, side))
    np.testing.assert_array_equal(data["status"], est.status)
    # The last step lacks the measurement behind it.
    widths = np.asarray(est.state.width)
    assert np.isinf(widths[:, -1]).any(axis=1).all()
    close(data["state_width_final"], widths[:, -2])
    close(data["state_width_max"], widths[:, :-1].max(1))
    inside = np.asarray(est.state.contains(runs.x[:, :T]))[:, :-1]
    assert not inside.all()
    close(data["state_coverage"], inside.mean(1))
    close(data["input_coverage"], np.asarray(est.input.contains(d[:, :-1]))[:, :-1].mean(1))
    assert data.attrs["delay"] == 1


def test_simulated_runs_meet_their_own_boxes(observer):
    data = gx.monte_carlo(observer, 0, 50, T, FIRST, d=force, draw="vertices", reduce=("final",))
    assert data.attrs["missed"].startswith("0 of 50")
    assert (data["state_coverage"] == 1).all()
    assert (data["input_coverage"] == 1).all()
    assert np.isnan(data["broken_at"]).all()
    assert (data["state_width_final"] <= np.asarray(observer.certificate.steady_width) * (1 + 1e-9)).all()
