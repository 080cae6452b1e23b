"""A position from ranges and a bearing, in a box as large as the distances: cut into cells, against the set itself."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

import gsisio_jax as gx
from gsisio_jax import Interval
from gsisio_jax.design.cells import _moved_freely, _straight
from gsisio_jax.design.problem import GainProblem
from gsisio_jax.observer.cells import counts

BEACONS = 30 * np.array([[1.0, 0.0], [0.0, 1.0], [-0.8, -0.7]])  # m
NOISE = np.array([0.05, 0.05, 0.05, 0.02])  # m, and rad
STEPS, LOST, WRONG = 30, 12, 20


def _outputs(x):
    away = BEACONS - x
    return [*jnp.hypot(away[:, 0], away[:, 1]), jnp.arctan2(away[0, 1], away[0, 0])]


@pytest.fixture(scope="module")
def run():
    """A position that moves by an unknown velocity; nothing but y[k] says where it is."""
    system = gx.System(
        lambda x: x, _outputs, G=0.1 * np.eye(2), H=np.zeros((4, 2)), state_bounds=Interval.symmetric([20.0, 20.0])
    )
    noise = gx.Noise(Interval.symmetric([0.002, 0.002]), Interval.symmetric(NOISE))
    observer = gx.design_observer(system, noise, Interval.symmetric([10.0, 10.0]), missing=False, sweeps=1)
    assert observer.cells == (8, 8)  # by default: see `with_cells`
    assert "cells=64, chosen as outputs are bent: the box of state 1 would stay 40 wide" in str(observer.certificate)
    generator = np.random.default_rng(0)
    x = np.array([6.0, -3.0]) + np.cumsum(generator.uniform(-1, 1, (STEPS, 2)), axis=0)
    y = np.array([np.asarray(_outputs(row)) for row in x]) + generator.uniform(-1, 1, (STEPS, 4)) * NOISE
    y[LOST, 1] = np.nan
    y[WRONG, 0] += 5.0
    return x, y, gx.estimate(observer, Interval.entire(2), y), observer


def _hull(y, around):
    """Widths of the set of positions that agree with y, on a grid of 2 mm."""
    grid = np.arange(-0.25, 0.25, 0.002)
    px, py = np.meshgrid(around[0] + grid, around[1] + grid, indexing="ij")
    away = [np.stack([b[0] - px, b[1] - py]) for b in BEACONS]
    seen = [*(np.hypot(*a) for a in away), np.arctan2(away[0][1], away[0][0])]
    agrees = np.all([~(abs(s - value) > bound) for s, value, bound in zip(seen, y, NOISE, strict=True)], axis=0)
    return np.ptp(px[agrees]), np.ptp(py[agrees])


def test_boxes_are_near_the_set_that_agrees(run):
    x, y, found, _ = run
    for k in range(STEPS):
        if k in (LOST, WRONG):
            continue
        # At k = WRONG + 1 a conflict may still be felt in d, not in x: y[k] alone says all.
        assert (found.state.lower[k] <= x[k]).all()
        assert (x[k] <= found.state.upper[k]).all()
        assert (np.asarray(found.state.width[k]) <= 1.5 * np.array(_hull(y[k], x[k])) + 0.002).all(), k


def test_boxes_of_a_few_metres_in_small_bounds_are_cut_as_well():
    """2 m are less than a tenth of bounds of 30 m, but far more than the .13 m that ranges of 5 cm leave."""
    beacons = np.array([[0.0, 0.0], [40.0, 5.0], [10.0, 45.0]])

    def outputs(x):
        away = x - beacons
        return [*jnp.hypot(away[:, 0], away[:, 1]), jnp.arctan2(away[0, 1], away[0, 0])]

    bounds = Interval([5.0, 5.0], [35.0, 35.0])
    system = gx.System(lambda x: x, outputs, G=np.eye(2), H=np.zeros((4, 2)), state_bounds=bounds)
    noise = gx.Noise(Interval.symmetric([0.01, 0.01]), Interval.symmetric(NOISE))
    region = Interval([10.0, 10.0], [30.0, 30.0])
    observer = gx.design_observer(system, noise, region, missing=False, sweeps=1, window=1)
    assert observer.cells == (8, 8)
    # What straight outputs leave, against the set that agrees: outputs are nearly straight on a tenth of a metre.
    at = np.array([20.0, 20.0])
    grid = np.arange(-0.25, 0.25, 0.001)
    px, py = np.meshgrid(at[0] + grid, at[1] + grid, indexing="ij")
    seen = [*(np.hypot(px - b[0], py - b[1]) for b in beacons), np.arctan2(py - beacons[0, 1], px - beacons[0, 0])]
    y = np.array([np.asarray(value) for value in outputs(at)])
    agrees = np.all([abs(s - value) <= bound for s, value, bound in zip(seen, y, NOISE, strict=True)], axis=0)
    set_width = [np.ptp(px[agrees]), np.ptp(py[agrees])]
    np.testing.assert_allclose(_straight(observer, Interval.entire(0)), set_width, atol=0.003)


def test_a_lost_range_widens_and_a_wrong_one_is_found(run):
    x, _, found, _ = run
    assert (found.state.lower[LOST] <= x[LOST]).all()
    assert (x[LOST] <= found.state.upper[LOST]).all()
    assert np.flatnonzero(np.asarray(found.status) & gx.Status.CONFLICT).tolist() == [WRONG]


def test_in_single_precision(run):
    x, y, found, observer = run
    y = y[:LOST].astype(np.float32)
    everything = np.full(2, np.inf, np.float32)
    single = gx.estimate(observer, Interval(-everything, everything), y).state
    assert single.lower.dtype == np.float32
    for k in range(LOST):
        assert (single.lower[k] <= x[k]).all()
        assert (x[k] <= single.upper[k]).all()
        assert (single.width[k] <= 1.1 * found.state.width[k]).all()


def test_only_bent_states_are_cut():
    assert counts(64, np.array([True, True, False])) == (8, 8, 1)
    assert counts(64, np.array([True, True, True])) == (4, 4, 4)
    assert counts(1, np.array([True])) == ()
    assert counts(64, np.array([False, False])) == ()


def test_a_choice_is_only_tried_where_nothing_but_the_outputs_of_the_step_says_where_a_state_is():
    none = np.zeros(0)

    def problem(G, H, free):
        two, T2 = np.eye(2), np.eye(len(H))
        zero = np.zeros((len(H), 2))
        return GainProblem(two, 0 * two, zero, zero, T2, zero, zero, G, H, free, none, none, none, none)

    G, bounded = np.array([[0.1], [0.0]]), np.array([False])
    assert _moved_freely(problem(G, np.zeros((1, 1)), ~bounded)).tolist() == [True, False]
    assert not _moved_freely(problem(G, np.ones((1, 1)), ~bounded)).any()  # it shows at once
    assert not _moved_freely(problem(G, np.zeros((1, 1)), bounded)).any()


def test_affine_outputs_are_not_cut():
    system = gx.System(lambda x: x, lambda x: x, G=[[0.1]], H=[[0.0]], state_bounds=Interval([-20.0], [20.0]))
    noise = gx.Noise(Interval.symmetric([0.01]), Interval.symmetric([0.1]))
    assert gx.design_observer(system, noise, Interval([-1.0], [1.0]), missing=False, window=1).cells == ()
