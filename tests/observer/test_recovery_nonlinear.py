"""Nonlinear plants come back from anything, from their state bounds: boxes are never infinite, and settle again."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gsisio_jax as gx
from gsisio_jax import Interval, Status

ROWS, FAULT, RUNS = 80, 10, 50


def pendulum(x):
    """Angle and rate; the angle is measured."""
    return jnp.stack([x[0] + 0.1 * x[1], 0.9 * x[1] - 0.6 * jnp.sin(x[0])])


def tanks(x):
    """Levels; an unknown inflow into the first, and the second is filled by the first. Both are measured, roughly."""
    return jnp.stack([x[0] - 0.2 * jnp.sqrt(x[0]), x[1] + 0.2 * (jnp.sqrt(x[0]) - jnp.sqrt(x[1]))])


# f, measured states, G, bounds of the state and of w and v, inflow (least, most), start
PLANTS = {
    "pendulum": (pendulum, [0], np.zeros((2, 0)), ([-3.0, -8.0], [3.0, 8.0]), 0.005, 0.02, (0, 0), [0.5, 0.0]),
    "tanks": (tanks, [0, 1], np.array([[0.2], [0.0]]), ([0.1, 0.1], [9.0, 9.0]), 0.001, 0.05, (0.6, 2.0), [2.0, 2.0]),
}


def records(name, count):
    f, measured, G, _, w, v, inflow, start = PLANTS[name]
    rng, f = np.random.default_rng(0), jax.vmap(f)
    x, states, seen = np.array(start) + rng.uniform(-0.3, 0.3, (count, 2)), [], []
    for _ in range(ROWS):
        states.append(x)
        seen.append(x[:, measured] + rng.uniform(-v, v, (count, len(measured))))
        d = rng.uniform(*inflow, (count, G.shape[1]))
        x = np.asarray(f(x)) + d @ G.T + rng.uniform(-w, w, (count, 2))
    return np.stack(states, 1), np.stack(seen, 1)


@pytest.mark.parametrize("name", PLANTS)
def test_boxes_are_finite_at_once_and_become_as_narrow_as_before(name):
    f, measured, G, bounds, w, v, _, _ = PLANTS[name]
    l, bounds = len(measured), Interval(*map(np.array, bounds))
    system = gx.System(f, lambda x: x[np.array(measured)], G=G, H=np.zeros((l, G.shape[1])), state_bounds=bounds)
    noise = gx.Noise(Interval.symmetric([w, w]), Interval.symmetric(np.full(l, v)))
    observer = gx.design_observer(system, noise, bounds, sweeps=1, certify=False)
    for lost in (None, 1, 3):
        np.testing.assert_array_equal(observer.certificate.rows_until_finite(lost), [0, 0])
    x, y = records(name, RUNS)
    assert bounds.contains(x).all()
    faulty, gap, moved = y.copy(), y.copy(), y.copy()
    faulty[:, FAULT, 0] += 100
    gap[:, FAULT : FAULT + 3] = np.nan
    moved[:, FAULT, 0] += 1.0  # inside of the state bounds
    near, far = x[:, 0], np.full((RUNS, 2), np.inf)
    starts = Interval(*(
        np.concatenate([near + sign * 0.3, sign * far, *[near + sign * 0.3] * 3]) for sign in (-1, 1)
    ))  # fmt: skip
    est = jax.vmap(lambda box, y: gx.estimate(observer, box, y))(starts, np.concatenate([y, y, faulty, gap, moved]))
    width, status = (np.asarray(part).reshape(5, RUNS, ROWS, -1) for part in (est.state.width, est.status))
    held = np.asarray(est.state.contains(np.tile(x, (5, 1, 1)))).reshape(5, RUNS, ROWS, -1).all(-1)
    assert np.isfinite(width).all()
    conflict = (status[..., 0] & Status.CONFLICT) != 0
    assert conflict[2, :, FAULT].all()
    for run in (1, 2, 3, 4):
        np.testing.assert_allclose(width[run, :, -1], width[0, :, -1], rtol=0.05)
    assert held[[0, 1, 3]].all()
    # A miss lies at the fault or under a conflict, and none after it; what an inflow explains is no fault.
    at = np.arange(ROWS) == FAULT
    for run in (2,) if G.size else (2, 4):
        assert (held[run] | conflict[run] | at).all()
        assert held[run, :, FAULT + 3 :].all()
