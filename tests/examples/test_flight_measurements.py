"""Which numbers of the raw table count as measured."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from gsisio_jax.examples import flight


def _table(rows) -> pd.DataFrame:
    names = ["time_s", "latitude_deg", "longitude_deg", "groundspeed_kt", "track_deg", "position_time_s"]
    return pd.DataFrame(rows, columns=names)


def _seen(rows) -> tuple[list[bool], list[bool]]:
    out = flight.measurements(_table(rows))
    assert out.east_m.isna().equals(out.north_m.isna())
    assert out.velocity_east_m_s.isna().equals(out.velocity_north_m_s.isna())
    return out.east_m.notna().tolist(), out.velocity_east_m_s.notna().tolist()


def test_a_stale_position_is_no_measurement():
    position, velocity = _seen(
        [[0, 50.0, 20.0, 400, 0.0, -0.5], [1, 50.0, 20.0, 400, 0.0, -0.5], [2, 50.1, 20.0, 400, 0.0, 1.4]]
    )
    assert position == [True, False, True]
    assert velocity == [False, False, True]  # nothing is known about the messages before the first row


def test_a_new_position_older_than_a_second_is_no_measurement():
    position, _ = _seen(
        [[0, 50.0, 20.0, 400, 0.0, -0.5], [3, 50.1, 20.0, 400, 0.0, 1.9], [4, 50.1, 20.0, 400, 0.0, 3.0]]
    )
    assert position == [True, False, True]


def test_a_changed_speed_or_track_is_a_measurement_without_a_position():
    rows = [[k, 50.0, 20.0, 400, 0.0, -0.5] for k in range(4)]
    rows[2][4] = rows[3][4] = 0.1
    assert _seen(rows)[1] == [False, False, True, False]


def test_a_repeated_velocity_after_a_long_silence_is_none():
    rows = [[0, 50.0, 20.0, 400, 0.0, -0.5], [1, 50.1, 20.0, 400, 0.0, 0.5]]
    assert _seen([*rows, [6, 50.2, 20.0, 400, 0.0, 5.5]])[1] == [False, True, True]
    assert _seen([*rows, [7, 50.2, 20.0, 400, 0.0, 6.5]])[1] == [False, True, False]
    assert _seen([*rows, [7, 50.2, 20.0, 401, 0.0, 6.5]])[1] == [False, True, True]


def test_a_velocity_needs_a_position_of_the_last_minute():
    rows = [[0, 50.0, 20.0, 400, 0.0, -0.5], [59, 50.0, 20.0, 401, 0.0, -0.5], [61, 50.0, 20.0, 402, 0.0, -0.5]]
    assert _seen(rows)[1] == [False, True, False]


def test_a_position_is_moved_on_by_its_age():
    rows = [[k, 50.0, 20.0, 400, 30.0, k - 0.25] for k in range(2)]
    out = flight.measurements(_table(rows)).iloc[1]
    point = flight.PLANE(np.array([50.0]), np.array([20.0]))
    assert out.east_m == pytest.approx(point.east[0] + 0.25 * out.velocity_east_m_s)
    assert out.north_m == pytest.approx(point.north[0] + 0.25 * out.velocity_north_m_s)


def test_rows_without_numbers_are_missing_and_rows_stay_rows():
    rows = [[0, 50.0, 20.0, 400, 0.0, -0.5], [1, np.nan, np.nan, 400, 0.0, np.nan], [9, 50.0, 20.0, np.nan, 0.0, 8.5]]
    out = flight.measurements(_table(rows))
    assert out.time_s.tolist() == [0.0, 1.0, 9.0]
    assert out.velocity_east_m_s.isna().all()


def test_counts_of_the_real_flight(measured, grid):
    assert len(measured) == 8681
    assert grid.shape == (8735, 4)
    assert np.isfinite(grid).sum(axis=0).tolist() == [4683, 4683, 4743, 4743]
    speed = np.hypot(measured.velocity_east_m_s, measured.velocity_north_m_s)
    assert speed.max() < 351.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda table: table.drop(columns="track_deg"), "track_deg"),
        (lambda table: table.iloc[::-1], "must increase"),
    ],
)
def test_unusable_tables_are_refused(table, change, message):
    with pytest.raises(ValueError, match=message):
        flight.measurements(change(table))
