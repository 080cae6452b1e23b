"""Properties of the clock: on any grid with jitter, gaps, units, order and blocks, every index is recovered exactly."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsisio_jax.cli.errors import UserError
from gsisio_jax.cli.logs import TablePart, TableReader
from gsisio_jax.cli.logs.cells import Block
from gsisio_jax.cli.logs.read import filled, joined

PER_SECOND = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
PERIODS = [1 / 30, 0.1, 0.01, 1.0, 0.005, 60.0, 0.25, 1 / 7]
JITTER = 0.08  # of a step; with the rounding of the sample time, two of them stay below the two tolerances of a tenth


@st.composite
def grids(draw):
    """Period, indices of the rows and offsets of their stamps, in steps."""
    steps = draw(st.lists(st.sampled_from([1] * 8 + [2, 3, 40, 200]), min_size=2, max_size=60))
    index = np.concatenate([[0], np.cumsum(steps)])
    offsets = draw(st.lists(st.floats(-JITTER, JITTER), min_size=len(index), max_size=len(index)))
    return draw(st.sampled_from(PERIODS)), index, np.array(offsets)


def stamps_of(grid, unit="s", origin=0.0):
    period, index, offsets = grid
    values = (origin + period * (index + offsets)) * PER_SECOND[unit]
    return np.rint(values).astype(np.int64) if unit == "ns" else values


def block(values, first=0):
    """Rows whose `a` is their number."""
    number = np.arange(first, first + len(values))
    return Block("log.csv", {"t": values, "a": number.astype(float)}, number + 2)


def read(blocks, **options):
    part = TablePart(**{"file": "log", "time": "t", "y": ["a"], "sparse": True} | options)
    reader = TableReader("log.csv", part)
    found = [*map(reader.feed, blocks), reader.finish()]
    return filled(found), reader


def points(table):
    """The grid's points that have a row, and the rows."""
    there = np.flatnonzero(~np.isnan(table.y[:, 0]))
    return there, table.y[there, 0]


@settings(deadline=None)
@given(grids(), st.sampled_from(list(PER_SECOND)), st.sampled_from([0.0, 1.7e9, -50.0]), st.data())
def test_every_index_is_recovered(grid, unit, origin, data):
    period, index, _ = grid
    values = stamps_of(grid, unit, origin)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(values)), max_size=4)))
    parts = np.split(values, cuts)
    starts = [0, *cuts]
    blocks = [block(part, first) for part, first in zip(parts, starts, strict=True)]
    # A sample time that was written with five digits.
    table, _ = read(blocks, sample_time=float(f"{period:.5g}"), time={"column": "t", "unit": unit})
    there, rows = points(table)
    np.testing.assert_array_equal(there, index)
    np.testing.assert_array_equal(rows, np.arange(len(index)))
    np.testing.assert_array_equal(table.time[there], values / PER_SECOND[unit])
    assert (np.diff(table.time) > 0).all()


@settings(deadline=None)
@given(grids(), st.randoms(use_true_random=False))
def test_any_order_is_sorted(grid, random):
    period, index, _ = grid
    order = list(range(len(index)))
    random.shuffle(order)
    whole = block(stamps_of(grid)[order])
    halves = [
        Block(whole.name, {name: values[part] for name, values in whole.columns.items()}, whole.rows[part])
        for part in (slice(None, 7), slice(7, None))
    ]
    table, _ = read(joined(iter(halves)), sample_time=float(f"{period:.5g}"), on_unsorted="sort")
    there, rows = points(table)
    np.testing.assert_array_equal(there, index)
    np.testing.assert_array_equal(np.array(order)[rows.astype(int)], np.arange(len(index)))


@settings(deadline=None)
@given(
    grids(), st.lists(st.integers(0, 60), min_size=1, max_size=9), st.sampled_from(["first", "last", "mean"]), st.data()
)
def test_duplicates_are_merged_over_any_blocks(grid, again, how, data):
    period, index, _ = grid
    counts = 1 + np.bincount([number % len(index) for number in again], minlength=len(index))
    values = np.repeat(stamps_of(grid), counts)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(values)), max_size=4)))
    blocks = [block(part, first) for part, first in zip(np.split(values, cuts), [0, *cuts], strict=True)]
    table, reader = read(blocks, sample_time=period, on_duplicate=how)
    there, rows = points(table)
    ends = np.cumsum(counts)
    expected = {"first": ends - counts, "last": ends - 1, "mean": ends - (counts + 1) / 2}[how]
    np.testing.assert_array_equal(there, index)
    np.testing.assert_allclose(rows, expected, atol=1e-12)
    assert reader.merged == len(values) - len(index)


@settings(deadline=None)
@given(st.sampled_from([*PERIODS, 0.103, 1 / 50, 0.004]), st.integers(0, 2**32), st.sampled_from([0.0, 1.7e9]))
def test_the_sample_time_is_found(period, seed, origin):
    rng = np.random.default_rng(seed)
    index = np.cumsum(rng.choice([1, 2, 7, 100], size=400, p=[0.9, 0.07, 0.02, 0.01]))
    index -= index[0]
    values = stamps_of((period, index, rng.uniform(-JITTER, JITTER, len(index))), origin=origin)
    table, reader = read([block(values)], sample_time="auto")
    np.testing.assert_array_equal(points(table)[0], index)
    assert reader.clock is not None
    assert reader.clock.sample_time == pytest.approx(period, rel=1e-2)
    assert reader.clock.gaps == np.count_nonzero(np.diff(index) > 1)
    assert reader.clock.jitter <= 2.2 * JITTER * period


def test_a_jitter_beyond_the_usual_is_told_as_a_tolerance():
    rng = np.random.default_rng(5)
    index = np.delete(np.arange(500), [100, 101])
    values = 0.01 * index + rng.uniform(-0.0015, 0.0015, len(index))
    with pytest.raises(UserError, match=r"only 8\d% .*; set time.tolerance = 0.001[5-8], give sample_time") as error:
        read([block(values)], sample_time="auto")
    told = float(str(error.value).partition("time.tolerance = ")[2].partition(",")[0])
    table, reader = read([block(values)], sample_time="auto", time={"column": "t", "tolerance": told})
    np.testing.assert_array_equal(points(table)[0], index)
    assert reader.clock is not None
    assert reader.clock.sample_time == pytest.approx(0.01, rel=1e-4)
    # Rows on no grid, many or few, and such as could belong to either neighbour.
    rare, near = [0, 1.3, 2.1, 3.4], np.arange(300) + rng.uniform(-0.3, 0.3, 300)
    for uneven in (np.cumsum(rng.uniform(0.5, 1.5, 300)), rare, near):
        with pytest.raises(UserError, match="on such a grid; give sample_time, or"):
            read([block(np.asarray(uneven))], sample_time="auto")


def test_an_even_clock_is_found_to_the_last_digit():
    for period in PERIODS:
        values = np.rint(period * np.arange(3000) * 1e6)  # whole microseconds
        _, reader = read([block(values)], sample_time="auto", time={"column": "t", "unit": "us"})
        assert reader.clock is not None
        assert reader.clock.sample_time == period
        assert f"{len(values):,} rows on {len(values):,} steps (100 %), 0 gaps" in reader.clock.describe()


@pytest.mark.parametrize(("written", "gap"), [(0.0333333, 90_000), (0.0333, 1_000), (1 / 30, 100_000)])
def test_a_long_log_of_thirty_hertz_does_not_drift(written, gap):
    index = np.concatenate([np.arange(100_000), np.arange(100_000, 200_000) + gap])
    values = 1_395_837_505_000_000 + np.rint(index * 1e6 / 30).astype(np.int64)
    for blocks in ([block(values)], [block(part) for part in np.array_split(values, 7)]):
        table, reader = read(blocks, sample_time=written, time={"column": "t", "unit": "us"})
        np.testing.assert_array_equal(points(table)[0], index)
        assert reader.clock is not None
        assert (reader.clock.gaps, reader.clock.rows) == (1, len(index))


@pytest.mark.parametrize("period", PERIODS)
def test_a_wrong_sample_time_is_never_taken(period):
    values = np.arange(100) * period
    for factor in (0.98, 0.99, 1.01, 1.02, 1.1):
        with pytest.raises(UserError, match=r"apart on average, not sample_time|is not on the grid"):
            read([block(values)], sample_time=period * factor)


@settings(deadline=None)
@given(st.lists(st.floats(1e-3, 1e3), min_size=1, max_size=30), st.data())
def test_time_steps_are_those_to_the_next_row(steps, data):
    values = np.concatenate([[5.0], 5.0 + np.cumsum(steps)])
    cuts = sorted(data.draw(st.lists(st.integers(0, len(values)), max_size=4)))
    blocks = [block(part, first) for part, first in zip(np.split(values, cuts), [0, *cuts], strict=True)]
    table, _ = read(blocks, dt="as_input", u=["a"])
    assert table.u is not None
    np.testing.assert_array_equal(table.time, values)
    np.testing.assert_array_equal(table.u[:, 0], np.arange(len(values)))
    np.testing.assert_allclose(table.u[:-1, 1], steps, rtol=1e-9, atol=1e-12)
    assert table.u[-1, 1] == table.u[-2, 1]


@pytest.mark.parametrize(("unit", "second"), PER_SECOND.items())
def test_the_unit_of_an_epoch_is_told_by_its_size(unit, second):
    values = (1_714_557_600 + np.arange(4)) * int(second)
    table, reader = read([block(values)], sample_time=1.0, time={"column": "t", "unit": "epoch"})
    assert reader.stamps is not None
    assert reader.stamps.unit == unit
    np.testing.assert_array_equal(table.time, 1_714_557_600 + np.arange(4))


@pytest.mark.parametrize(
    ("stamps", "time", "zone"),
    [
        (["2024-05-01T10:00:00", "2024-05-01T10:00:01"], {}, ""),
        (["2024-05-01T10:00:00", "2024-05-01T10:00:01"], {"zone": "Europe/Berlin"}, "Europe/Berlin"),
        (["2024-05-01T10:00:00Z", "2024-05-01T10:00:01Z"], {}, "UTC"),
        (["2024-05-01T10:00:00+02:00", "2024-05-01T10:00:01+02:00"], {}, "+02:00"),
        (["01.05.2024 10:00:00", "01.05.2024 10:00:01"], {"format": "%d.%m.%Y %H:%M:%S"}, ""),
        (["10:00:00", "10:00:01"], {"format": "%H:%M:%S"}, None),
        ([1714557600, 1714557601], {"unit": "epoch"}, "UTC"),
        ([1714557600, 1714557601], {}, None),
    ],
)
def test_the_zone_of_dates(stamps, time, zone):
    _, reader = read([block(np.array(stamps, dtype=object))], sample_time=1.0, time={"column": "t"} | time)
    assert reader.stamps is not None
    assert reader.stamps.zone == zone


def test_a_clock_goes_on_where_a_copy_of_it_was():
    from dataclasses import asdict

    from gsisio_jax.cli.logs.clock import Clock

    index = np.array([0, 1, 2, 5, 6, 7, 11, 12])
    values = 0.1 * index
    _, reader = read([block(values[:5])], sample_time=0.1)
    assert reader.clock is not None
    assert reader.stamps is not None
    again = Clock(**asdict(reader.clock))
    np.testing.assert_array_equal(again.place(reader.stamps.read(block(values[5:]))), index[5:])
    assert (again.rows, again.gaps) == (len(index), 2)
