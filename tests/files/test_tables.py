"""Estimates as tables: every number where its name says, on the user's clock."""

import jax
import numpy as np
import pandas as pd
import pytest
from files import plants

import gsisio_jax as gx


@pytest.fixture(scope="module")
def boxes():
    return gx.estimate(plants.design("nearest"), plants.start(), plants.measurements())


def test_a_table_of_an_estimate(boxes):
    y = plants.measurements()
    table = boxes.to_pandas(dt=0.25, y=y, state_names=["level", "speed"], input_names=["leak"])
    assert list(table.columns) == [
        "level_lower", "level_upper", "speed_lower", "speed_upper", "leak_lower", "leak_upper", "measured_y1",
        "measured_y2", "status", "margin",
    ]  # fmt: skip
    np.testing.assert_array_equal(table.index, 0.25 * np.arange(12))
    for index, name in enumerate(("level", "speed")):
        np.testing.assert_array_equal(table[f"{name}_lower"], boxes.state.lower[:, index])
        np.testing.assert_array_equal(table[f"{name}_upper"], boxes.state.upper[:, index])
    np.testing.assert_array_equal(table["leak_upper"][:-1], boxes.input.upper[:, 0])
    assert np.isnan(table["leak_upper"].iloc[-1])
    np.testing.assert_array_equal(table["measured_y1"], y[:, 0])
    np.testing.assert_array_equal(table["status"], boxes.status)
    np.testing.assert_array_equal(boxes.to_pandas().index, np.arange(12))
    clock = np.linspace(3.0, 9.0, 12)
    np.testing.assert_array_equal(boxes.to_xarray(time=clock)["time"], clock)


@pytest.mark.parametrize("zone", [None, "Europe/Berlin", "UTC"])
def test_dates_are_taken_as_they_are(boxes, zone):
    """Over the night in which clocks go back, with the zone of the index."""
    index = pd.date_range("2024-10-27 00:00", periods=12, freq="15min", tz=zone)
    for clock in (index, pd.Series(index)):
        found = boxes.to_pandas(time=clock).index
        assert (list(found), str(found.tz)) == (list(index), str(index.tz))
        labelled = boxes.to_xarray(time=clock)
        in_utc = index if zone is None else index.tz_convert("UTC").tz_localize(None)
        np.testing.assert_array_equal(labelled["time"], in_utc)
        assert labelled["time"].attrs.get("zone") == zone
        assert "units" not in labelled["time"].attrs
    plain = index.tz_localize(None) if zone is None else in_utc
    np.testing.assert_array_equal(boxes.to_xarray(time=plain.to_numpy())["time"], plain)


@pytest.mark.parametrize(
    ("labels", "words"),
    [
        ({"time": pd.date_range("2024", periods=3)}, r"`time` must have shape \(12,\), got \(3,\)"),
        ({"time": pd.DatetimeIndex([*pd.date_range("2024", periods=11), pd.NaT])}, "`time` has no date in row 11"),
        ({"dt": 0.1, "time": np.arange(12)}, "give either `time` or `dt`, got both"),
        ({"dt": 0.0}, "`dt` must be a number of seconds above 0, got 0.0"),
        ({"dt": "1 s"}, "`dt` must be a number of seconds above 0, got '1 s'"),
        ({"state_names": ["one"]}, "`state_names` has 1 entries, the estimate has 2"),
    ],
)
def test_wrong_labels(boxes, labels, words):
    with pytest.raises(ValueError, match=f"to_dataset: .*{words}"):
        boxes.to_pandas(**labels)


def test_many_records_are_no_table(boxes):
    many = jax.tree.map(lambda leaf: np.stack([leaf, leaf]), boxes)
    with pytest.raises(ValueError, match="one record"):
        many.to_pandas()
