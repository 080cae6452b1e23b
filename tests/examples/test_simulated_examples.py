"""Examples with a known truth: no box misses it, the picture is written, and the files describe the same problem."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np
import pytest

import gsisio_jax as gx
from gsisio_jax.cli.config import read_config
from gsisio_jax.cli.problem import build_problem

NAMES = [name for name in gx.examples.names() if name != "flight"]  # nobody knows where that airliner was
PAGE = (Path(__file__).parents[2] / "docs" / "examples.md").read_text("utf-8")
# Heat takes a minute to the sensor: until then the power that arrives is less than the one that was logged.
SETTLED = {"tclab": 3}
# What a user sees of a signal, at most, in the middle of the record; a design that got worse shows here.
MEDIAN = {
    "paper": {"x1": 1.7, "x2": 2.5},
    "double_integrator": {"east": 0.1, "acceleration_east": 0.83},
    "quadruple_tank": {"level_1": 0.09, "level_3": 0.6, "pump_1_offset": 2.8},
    "six_tanks": {"level_2": 0.41, "level_4": 0.41, "leak": 26.0},
    "unicycle": {"east": 0.3, "north": 0.3, "heading": 0.1, "slip": 1.8},
    "heading": {"east": 0.1, "heading": 0.04, "rate_of_turn": 0.15},
    "battery": {"charge": 1e-3, "bias": 0.041},
    "building": {"room_1": 0.21, "room_3": 0.42, "sun": 730.0},
    "sir": {"susceptible": 0.011, "outside_infections": 3.5e-3},
    "tclab": {"heater_sensor": 1.21, "power": 23.0},
}


@pytest.mark.parametrize("name", NAMES)
def test_example(name, tmp_path):
    example = gx.examples.load(name)
    assert example.name == name
    assert (len(example.states), len(example.inputs)) == (example.system.n, example.system.p)
    assert (len(example.outputs), len(example.known_inputs)) == (example.system.l, example.system.m)
    observer, record = example.observer(), example.record()
    found = observer.certificate
    promise = "empty" if not found.self_consistent else "in the region" if found.region_matters else "everywhere"
    assert re.search(rf"\| \[{name}\].* \| {promise} \|\n", PAGE), promise
    boxes = example.estimate(record, observer)
    assert boxes.guaranteed
    assert boxes.alarms() == []
    if record.x is not None:
        assert boxes.state.contains(gx.nearest(example.system, record.x, boxes.state)).all()
    assert record.d is not None
    held = np.asarray(boxes.input.contains(record.d[:-1]))[SETTLED.get(name, 0) :]
    assert held.all()
    table = example.dataset(record, boxes)
    for signal, widest in MEDIAN[name].items():
        width = table[f"{signal}_upper"] - table[f"{signal}_lower"]
        assert 0 < float(width.median()) <= widest, signal
    example.picture(tmp_path / "picture.png", record, boxes)
    assert (tmp_path / "picture.png").stat().st_size > 20_000


@pytest.mark.parametrize("name", [name for name in NAMES if name != "paper"])
def test_files_describe_the_same_problem(name):
    """What `gsisio estimate NAME` reads is what `load(NAME)` is."""
    example, path = gx.examples.load(name), gx.examples.config_path(name)
    problem = build_problem(read_config(path), path.name)
    for ours, theirs in (
        (example.noise.w, problem.noise.w),
        (example.noise.v, problem.noise.v),
        (example.initial, problem.initial),
        (example.region, problem.region),
        (example.u_region, problem.u_region),
    ):
        if ours is None:
            assert theirs is None
        else:
            np.testing.assert_array_equal([ours.lower, ours.upper], [theirs.lower, theirs.upper])
    assert problem.design == dict(example.design)
    record = example.record()
    with open(path.parent / f"{name}_record.csv", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    for index, (output, _) in enumerate(example.outputs):
        np.testing.assert_array_equal([float(row[output] or "nan") for row in rows], record.y[:, index])
    for index, (known, _) in enumerate(example.known_inputs):
        np.testing.assert_array_equal([float(row[known]) for row in rows], record.u[:, index])


def test_other_seeds_are_other_records():
    example = gx.examples.load("sir")
    assert not np.array_equal(example.record(0).y, example.record(1).y)


def test_the_heater_is_found_where_no_number_comes_from():
    """Seconds 500 to 1,000 of the real record were used for no bound and no parameter."""
    example = gx.examples.load("tclab")
    record = example.record()
    boxes = example.estimate(record)
    later = slice(25, 50)
    assert (record.d[later] == 50).all()
    assert np.asarray(boxes.input.contains(record.d[:-1]))[later].all()
    assert (np.asarray(boxes.input.lower)[later] > 30).all()
    assert (np.asarray(boxes.input.upper)[later] < 70).all()
    # And a bound that is half as wide would have been contradicted: the sensors step by 0.32 K.
    narrow = gx.Noise(example.noise.w, gx.Interval.symmetric([0.1, 0.1]))
    assert gx.estimate(example.observer(), example.initial, record.y, noise=narrow).alarms()
