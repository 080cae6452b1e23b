"""The observer on the real flight: the oracle's alarms, and boxes as tight as the exact ones."""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np
import pytest

import gsisio_jax as gx
from gsisio_jax.examples import flight


@pytest.fixture(scope="module")
def estimate(config, grid):
    boxes = {name: gx.Interval(config[name]["lower"], config[name]["upper"]) for name in ("region", "initial")}
    noise = gx.Noise(*(gx.Interval.symmetric(config["noise"][name]["radius"]) for name in ("w", "v")))
    with jax.enable_x64(True):
        system = flight.system(**config["system"]["arguments"])
        observer = gx.design_observer(system, noise, boxes["region"], **config.get("design", {}))
        return gx.estimate(observer, boxes["initial"], grid, on_conflict=config["estimate"]["on_conflict"])


@pytest.fixture(scope="module")
def exact(oracle_run):
    """State boxes of the oracle in the order of the states, shape (T, 4)."""
    return tuple(x.transpose(0, 2, 1).reshape(len(x), 4) for x in (oracle_run.lower, oracle_run.upper))


def test_alarms_of_the_oracle_and_no_others(estimate, oracle_run):
    assert sorted({alarm.step for alarm in estimate.alarms()}) == np.flatnonzero(oracle_run.conflict).tolist()
    for alarm in estimate.alarms():
        # States are east, north, velocity east, velocity north; the oracle's gaps are the largest that can be proved.
        exact = oracle_run.gap[alarm.step, alarm.index % 2, alarm.index // 2]
        assert 0.9 * exact < alarm.gap <= exact + 1e-6


def test_the_first_page_names_these_alarms(estimate, config):
    page = (Path(__file__).parents[2] / "docs" / "README.md").read_text(encoding="utf-8")
    names, units = ([state[key] for state in config["signals"]["state"]] for key in ("name", "unit"))
    said = [alarm.describe(state_names=names, state_units=units) for alarm in estimate.alarms()]
    assert said
    assert [line for line in said if line not in page] == []
    assert f"conflicts     {len(said)}, at " in page


def test_state_boxes_are_the_exact_ones(estimate, exact):
    lower, upper = np.asarray(estimate.state.lower), np.asarray(estimate.state.upper)
    slack = 1e-6 * (1.0 + np.abs(np.stack(exact))).max(axis=0)
    # Never tighter than the exact hull of a step (that would be unsound), and not wider either.
    assert (lower <= exact[0] + slack).all()
    assert (upper >= exact[1] - slack).all()
    assert (lower >= exact[0] - slack).all()
    assert (upper <= exact[1] + slack).all()


def test_input_boxes_are_those_of_the_basic_left_inverses(estimate, oracle_run):
    width = np.asarray(estimate.input.width)
    exact = oracle_run.input_upper - oracle_run.input_lower
    finite = np.isfinite(exact)
    ratio = width[finite] / exact[finite]
    # Where a position returns before a velocity, the form that needs neither old velocity may be the tightest one.
    assert (ratio <= 1.0 + 1e-6).mean() > 0.999
    assert ratio.max() < 1.25


def test_state_boxes_stay_finite(estimate):
    assert np.isfinite(np.asarray(estimate.state.width)).all()
    assert not (np.asarray(estimate.status) & int(gx.Status.UNBOUNDED)).any()
