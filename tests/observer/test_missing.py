"""Missing measurements: what is left still acts, nothing is lost for good, and truth stays inside."""

from dataclasses import replace

import jax
import numpy as np
import pytest
import systems
import target as tg

import gsisio_jax as gx
from gsisio_jax import Interval

ROUNDING = 1e-9
GAP = slice(8, 58)  # fifty rows


@pytest.fixture(scope="module")
def holes():
    """Named records of one and the same run, each with its own holes."""
    patterns = {
        "none": (),
        "position": (20, 0),
        "velocity": (20, 1),
        "row": (20,),
        "first row": (0,),
        "last row": (tg.STEPS - 1,),
        "two rows": (slice(20, 22),),
        "position for long": (GAP, 0),
        "velocity for long": (GAP, 1),
        "gap": (GAP,),
        "positions": (slice(None), 0),
        "all": (slice(None),),
    }
    return {name: np.s_[where] for name, where in patterns.items()}


@pytest.fixture(scope="module")
def runs(target, holes):
    """name -> (truth, measurements, accelerations, estimate), all from the same run."""
    x, y, a = (rows[0] for rows in target.simulate(3, 1))
    records = np.repeat(y[None], len(holes), 0)
    for rows, (name, where) in zip(records, holes.items(), strict=True):
        if name != "none":
            rows[where] = np.nan
    est = target.run(records)
    return {name: (x, records[i], a, tg.record(est, i)) for i, name in enumerate(holes)}


def test_truth_is_inside_whatever_is_missing(runs):
    for name, (x, _, a, est) in runs.items():
        assert est.state.contains(x, -ROUNDING).all(), name
        assert est.input.contains(a[:-1, None], -ROUNDING).all(), name
        assert not (est.status & gx.Status.CONFLICT).any(), name


def test_missing_is_reported_exactly_where_an_entry_is_missing(runs):
    for name, (_, y, _, est) in runs.items():
        np.testing.assert_array_equal((est.status & gx.Status.MISSING) > 0, np.isnan(y).any(-1), err_msg=name)
        assert not (est.status & gx.Status.UNBOUNDED).any(), name


def test_no_box_is_smaller_than_the_exact_one(target, runs):
    """The oracle's boxes are the exact hull of a step from its own boxes: a sound observer cannot return less."""
    for name, (_, y, _, est) in runs.items():
        exact = target.oracle(y)
        assert (est.state.lower <= exact.lower[:, 0] + ROUNDING).all(), name
        assert (est.state.upper >= exact.upper[:, 0] - ROUNDING).all(), name
        assert (est.input.lower <= exact.input_lower + ROUNDING).all(), name
        assert (est.input.upper >= exact.input_upper - ROUNDING).all(), name


def test_random_patterns(target):
    for seed, share in ((11, 0.1), (12, 0.5), (13, 0.9)):
        x, y, a = target.simulate(seed)
        y[np.random.default_rng(seed).random(y.shape) < share] = np.nan
        est = target.run(y)
        assert est.state.contains(x, -ROUNDING).all()
        assert est.input.contains(a[:, :-1, None], -ROUNDING).all()
        np.testing.assert_array_equal((est.status & gx.Status.MISSING) > 0, np.isnan(y).any(-1))
        assert not (est.status & gx.Status.CONFLICT).any()


def test_other_entries_still_act(runs):
    width = {name: run[3].state.width[20] for name, run in runs.items()}
    before = runs["row"][3].state.width[19]
    for one in ("position", "velocity"):
        assert (width[one] <= width["row"] + ROUNDING).all()
        assert (width["none"] <= width[one] + ROUNDING).all()
    # Hand computation: a missing position costs the measured velocity's width, a missing row the speed limit's.
    half, (w_p, w_v) = tg.STEP / 2, tg.PROCESS_NOISE
    carried = before[0] + half * before[1] + 2 * (w_p + half * w_v)
    assert width["row"][0] == pytest.approx(carried + half * 2 * tg.SPEED, rel=1e-9)
    assert width["position"][0] <= carried + half * 2 * tg.VELOCITY_NOISE + ROUNDING
    assert width["position"][1] <= 2 * tg.VELOCITY_NOISE + ROUNDING
    assert width["velocity"][0] <= 2 * tg.POSITION_NOISE + ROUNDING


def test_a_gap_grows_the_position_box_at_the_speed_limit(runs):
    """Joint elimination: d computed first and x second would grow it at twice the limit."""
    est = runs["gap"][3]
    inner = slice(GAP.start, GAP.stop)
    np.testing.assert_allclose(est.state.lower[inner, 1], -tg.SPEED, rtol=1e-12)
    np.testing.assert_allclose(est.state.upper[inner, 1], tg.SPEED, rtol=1e-12)
    per_side = tg.SPEED * tg.STEP + tg.PROCESS_NOISE[0] + tg.STEP / 2 * tg.PROCESS_NOISE[1]
    np.testing.assert_allclose(np.diff(est.state.upper[inner, 0]), per_side, rtol=1e-9)
    np.testing.assert_allclose(np.diff(est.state.lower[inner, 0]), -per_side, rtol=1e-9)
    # The first row after the gap stands on its own measurement again.
    assert (est.state.width[GAP.stop] <= 2 * np.array([tg.POSITION_NOISE, tg.VELOCITY_NOISE]) + ROUNDING).all()


def test_the_step_after_a_lost_row_uses_a_gain_without_the_lost_row(target, runs):
    """Such a gain is in the bank, and the input box of that step is finite."""
    y_before = target.observer.gains.residual[:, :, target.observer.system.n :]
    assert (np.abs(y_before).max((1, 2)) == 0).any()
    est = runs["row"][3]
    assert np.isfinite(est.input.lower[19:22]).all()
    assert np.isfinite(est.input.upper[19:22]).all()
    # The new position comes from the past and both velocities, not from the speed limit.
    assert (est.state.width[21] <= runs["two rows"][3].state.width[21] - 1e-3).all()


def test_first_row_missing_is_the_initial_box_met_with_the_state_bounds(target):
    y = np.full((2, tg.STEPS, 2), np.nan)
    initial = Interval(
        np.array([[-3.0, -2 * tg.SPEED], [-np.inf, -np.inf]]), np.array([[5.0, tg.SPEED / 2], [np.inf, np.inf]])
    )
    est = target.run(y, initial=initial)
    np.testing.assert_array_equal(est.state.lower[:, 0], [[-3.0, -tg.SPEED], [-np.inf, -tg.SPEED]])
    np.testing.assert_array_equal(est.state.upper[:, 0], [[5.0, tg.SPEED / 2], [np.inf, tg.SPEED]])
    np.testing.assert_array_equal(est.status[0], gx.Status.MISSING)
    np.testing.assert_array_equal(est.status[1], gx.Status.MISSING | gx.Status.UNBOUNDED)
    assert not any(np.isnan(leaf).any() for leaf in jax.tree.leaves(est))


@pytest.mark.parametrize(("name", "recovers"), [("S4b", True), ("S1", False)])
def test_a_lost_row_without_state_bounds(name, recovers):
    """Unbounded along G V2 at the lost row; afterwards for as long as that is the truth, as the design says."""
    case = systems.s4(True) if name == "S4b" else systems.s1()
    observer = case.design()
    assert observer.certificate.recoverable is recovers
    assert f"is {'' if recovers else 'NOT '}recovered" in str(observer.certificate)
    steps, lost = case.system.n + 5, 3
    record, d = replace(case, steps=steps).simulate(jax.random.key(5))
    y = np.array(record.y)
    y[lost] = np.nan
    # As many rows as the design itself tried, and no mark of its answer: what it compiled serves here too.
    observer = replace(observer, certificate=replace(observer.certificate, recoverable=None))
    est = gx.estimate(observer, case.initial, y)
    assert est.state.contains(record.x[:-1], -ROUNDING).all()
    assert est.input.contains(d[:-1], -ROUNDING).all()
    unbounded = (np.asarray(est.status) & gx.Status.UNBOUNDED) > 0
    np.testing.assert_array_equal(unbounded, np.arange(steps) == lost if recovers else np.arange(steps) >= lost)
    assert not any(np.isnan(leaf).any() for leaf in jax.tree.leaves(est))
