"""The figures that the noise bounds in ``flight.toml`` are reasoned from, recomputed from seconds 0 to 2,400."""

from __future__ import annotations

import numpy as np
import pytest

from gsisio_jax.examples import flight

UNDISTURBED = 2400.0


@pytest.fixture(scope="module")
def raw(table):
    """Times, time stamps, plane positions and plane velocities as they stand in the table."""
    column = {name: table[name].to_numpy(dtype=float) for name in table.columns}
    point = flight.PLANE(column["latitude_deg"], column["longitude_deg"])
    velocity = flight.PLANE.velocity(point, column["groundspeed_kt"] * flight.KNOT, column["track_deg"])
    return column["time_s"], column["position_time_s"], np.stack([point.east, point.north], -1), np.stack(velocity, -1)


@pytest.fixture(scope="module")
def velocities(measured):
    names = ["velocity_east_m_s", "velocity_north_m_s"]
    return measured[names].to_numpy()


def test_time_stamps_err_by_up_to_101_m_along_the_track(raw, measured, velocities):
    time, stamp, position, _ = raw
    rows = np.flatnonzero(measured.east_m.notna() & (time < UNDISTURBED))
    a, b = rows[:-1], rows[1:]
    close = (time[b] - time[a] <= 3.0) & np.isfinite(velocities[a] + velocities[b]).all(-1)
    a, b = a[close], b[close]
    mean = 0.5 * (velocities[a] + velocities[b])
    residual = position[b] - position[a] - mean * (stamp[b] - stamp[a])[:, None]
    direction = mean / np.linalg.norm(mean, axis=-1, keepdims=True)
    along = np.abs((residual * direction).sum(-1))
    across = np.abs(residual[:, 1] * direction[:, 0] - residual[:, 0] * direction[:, 1])
    assert along.max() == pytest.approx(100.65, abs=0.1)
    assert time[b][np.argmax(along)] == 2369.0
    assert np.percentile(along, 99) == pytest.approx(56.2, abs=0.1)
    assert across[time[b] > 500.0].max() == pytest.approx(7.93, abs=0.05)


def test_worst_old_velocity_moves_a_position_by_121_m(raw, velocities):
    time, stamp, _, reported = raw
    row = int(np.flatnonzero(time == 313.0)[0])
    assert np.isnan(velocities[row]).all()  # it does not count as measured there
    error = np.linalg.norm(reported[row + 1] - reported[row])
    assert error == pytest.approx(165.3, abs=0.1)
    assert error * (time[row] - stamp[row]) == pytest.approx(120.7, abs=0.1)


def test_largest_step_between_neighbouring_velocities_is_14_m_s(raw, velocities):
    time = raw[0]
    rows = np.flatnonzero(np.isfinite(velocities).all(-1) & (time < UNDISTURBED))
    near = np.diff(time[rows]) <= flight.MAX_SILENCE
    step = np.abs(np.diff(velocities[rows], axis=0)).max(-1) * near
    assert step.max() == pytest.approx(13.77, abs=0.01)
    assert time[rows[1:]][np.argmax(step)] == 64.0


def test_smallest_consistent_position_noise_is_34_m(oracle, by_axis, config):
    before = by_axis[: int(UNDISTURBED)]
    options = {
        "velocity_noise": config["noise"]["v"]["radius"][2],
        "process_noise": (1.0, 0.0),
        "speed_bound": config["system"]["arguments"]["speed_bound"],
    }
    low, high = 1.0, 150.0
    while high - low > 0.1:
        middle = 0.5 * (low + high)
        conflict = oracle.observe(before, position_noise=middle, **options).conflict.any()
        low, high = (middle, high) if conflict else (low, middle)
    assert high == pytest.approx(33.7, abs=0.2)


def test_direction_of_north_turns_by_less_than_a_third_of_a_degree_in_21_km(raw):
    speed = 351.0 * flight.MAX_DIRECTION_AGE
    position, convergence = raw[2], flight.PLANE(np.linspace(42.0, 57.0, 16), np.full(16, 22.0)).convergence
    assert speed == pytest.approx(21_060.0)
    degrees_east = 21.06 / (111.2 * np.cos(np.radians(np.linspace(42.0, 57.0, 16))))
    turned = flight.PLANE(np.linspace(42.0, 57.0, 16), 22.0 + degrees_east).convergence
    assert np.degrees(np.abs(turned - convergence)).max() < 0.31
    assert np.isfinite(position).any()
