"""Exact one-step boxes of the flight: two alarms, finite through every silence, narrow at once when messages return."""

from __future__ import annotations

import numpy as np
import pytest


def test_certified_alarms(oracle_run):
    assert np.flatnonzero(oracle_run.conflict).tolist() == [5717, 6825]
    gap = oracle_run.gap[[5717, 6825], :, 0]
    np.testing.assert_allclose(gap, [[21_455.0, 0.0], [126_712.0, 224_389.0]], atol=1.0)


@pytest.mark.parametrize("position", [75.0, 100.0, 200.0])
@pytest.mark.parametrize("velocity", [5.0, 10.0, 20.0])
def test_alarms_do_not_hang_on_the_noise_bounds(oracle, by_axis, config, position, velocity):
    speed = config["system"]["arguments"]["speed_bound"]
    run = oracle.observe(by_axis, position, velocity, (1.0, 0.0), speed)
    assert np.flatnonzero(run.conflict).tolist() == [5717, 6825]


def test_boxes_are_finite_and_shrink_at_once(oracle_run):
    width = oracle_run.upper - oracle_run.lower
    assert np.isfinite(width).all()
    # 1,085 s of silence, at 2 x 351 m/s and 2 m of process noise a second.
    assert width[4798, :, 0] == pytest.approx(764_140.0)
    assert width[6824, :, 0] == pytest.approx(439_964.0)
    assert (width[[4799, 5717, 6825], :, 0] <= 300.0).all()


def test_position_grows_at_the_speed_limit_in_a_silence(oracle_run):
    width = (oracle_run.upper - oracle_run.lower)[3800:4798, :, 0]
    np.testing.assert_allclose(np.diff(width, axis=0), 2.0 * 351.0 + 2.0)


def test_boxes_hold_a_simulated_target(oracle):
    random = np.random.default_rng(3)
    steps, noise = 400, np.array([20.0, 2.0])
    acceleration = random.uniform(-8.0, 8.0, (steps, 2))
    truth = np.zeros((steps, 2, 2))
    for k in range(steps - 1):
        p, v = truth[k, :, 0], truth[k, :, 1]
        a = acceleration[k] = np.clip(acceleration[k], -200.0 - v, 200.0 - v)
        truth[k + 1] = np.stack([p + v + 0.5 * a + random.uniform(-1.0, 1.0, 2), v + a], -1)
    measured = truth + noise * random.uniform(-1.0, 1.0, truth.shape)
    measured[random.uniform(size=truth.shape) < 0.4] = np.nan
    measured[200:260] = np.nan
    run = oracle.observe(measured, *noise, (1.0, 0.0), 200.0, 1e3)
    assert not run.conflict.any()
    assert ((run.lower <= truth + 1e-9) & (truth <= run.upper + 1e-9)).all()
    assert (run.input_lower <= acceleration[:-1] + 1e-9).all()
    assert (acceleration[:-1] <= run.input_upper + 1e-9).all()


def test_state_boxes_are_the_exact_hull_of_one_step(oracle):
    optimize = pytest.importorskip("scipy.optimize")
    random = np.random.default_rng(5)
    measured = np.cumsum(random.normal(0.0, 3.0, (12, 1, 2)), axis=0)
    measured[random.uniform(size=measured.shape) < 0.3] = np.nan
    noise, w, speed = np.array([6.0, 5.0]), (0.3, 0.2), 15.0
    run = oracle.observe(measured, *noise, w, speed, 50.0)
    for k in range(1, 12):
        if run.conflict[k]:
            continue
        # Unknowns p, v, a, w_p, w_v; the new state is linear in them.
        new = np.array([[1.0, 1.0, 0.5, 1.0, 0.0], [0.0, 1.0, 1.0, 0.0, 1.0]])
        low = np.where(np.isnan(measured[k, 0]), -np.inf, measured[k, 0] - noise)
        high = np.where(np.isnan(measured[k, 0]), np.inf, measured[k, 0] + noise)
        low, high = np.maximum(low, [-np.inf, -speed]), np.minimum(high, [np.inf, speed])
        rows = np.concatenate([new, -new])
        limits = np.concatenate([high, -low])
        finite = np.isfinite(limits)
        bounds = [
            *zip(run.lower[k - 1, 0], run.upper[k - 1, 0], strict=True),
            (None, None),
            (-w[0], w[0]),
            (-w[1], w[1]),
        ]
        acceleration = np.array([0.0, 0.0, 1.0, 0.0, 0.0])
        found = [
            sign * optimize.linprog(sign * cost, rows[finite], limits[finite], bounds=bounds).fun
            for cost in (*new, acceleration)
            for sign in (1.0, -1.0)
        ]
        box = np.stack([run.lower[k, 0], run.upper[k, 0]], -1).ravel()
        np.testing.assert_allclose(found[:4], box, atol=1e-7)
        # The acceleration's box rests on boxes of both states, so it may be wider than the hull.
        assert run.input_lower[k - 1, 0] <= found[4] + 1e-7
        assert found[5] <= run.input_upper[k - 1, 0] + 1e-7
