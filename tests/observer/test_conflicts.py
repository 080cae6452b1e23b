"""Data that contradict the bounds: what is said, what is returned, and how the run goes on."""

import io
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import target as tg

import gsisio_jax as gx
from gsisio_jax import Interval
from gsisio_jax.observer.estimation import collect, resume

ROUNDING = 1e-9
K, JUMP = 30, 40.0
NAMES = ("none", "jump", "impossible", "impossible and far")


@pytest.fixture(scope="module")
def target(target):
    """To nearest there is less to compile."""
    return replace(target, observer=target.observer.with_rounding("nearest"))


@pytest.fixture(scope="module")
def truth(target):
    x, y, a = (rows[0] for rows in target.simulate(8, 1))
    return x, y, a


@pytest.fixture(scope="module")
def records(truth):
    """The target jumps from row K on; its measured speed at row K is beyond the limit (alone, or with the position)."""
    y = np.repeat(truth[1][None], len(NAMES), 0)
    y[1, K:, 0] += JUMP
    y[2:, K, 1] = 3 * tg.SPEED
    y[3, K, 0] += JUMP
    return y


@pytest.fixture(scope="module")
def restarted(target, records):
    return {name: tg.record(target.run(records), i) for i, name in enumerate(NAMES)}


@pytest.fixture(scope="module")
def held(target, records):
    """Beside each record the one without those entries of row K that contradict the past."""
    missing = records.copy()
    for i, j in ((1, 0), (2, 1), (3, 0), (3, 1)):
        missing[i, K, j] = np.nan
    est = target.run(np.concatenate([records, missing]), "hold")
    return {name: (tg.record(est, i), tg.record(est, i + len(NAMES))) for i, name in enumerate(NAMES)}


def conflicts(est: gx.Estimate) -> list[int]:
    return np.flatnonzero(est.status & gx.Status.CONFLICT).tolist()


def test_a_jump_is_an_alarm_with_its_gap(restarted, records):
    """The gap by hand: how far the measured position lies beyond the reach of the box before and both speeds."""
    assert conflicts(restarted["none"]) == []
    assert restarted["none"].alarms() == []
    est, y = restarted["jump"], records[1]
    assert conflicts(est) == [K]
    half, (w_p, w_v) = tg.STEP / 2, tg.PROCESS_NOISE
    fastest = min(y[K, 1] + tg.VELOCITY_NOISE, tg.SPEED)
    reach = est.state.upper[K - 1] @ [1, half] + half * fastest + w_p + half * w_v
    gap = y[K, 0] - tg.POSITION_NOISE - reach
    assert gap > 30
    assert est.margin[K] == pytest.approx(-gap, rel=1e-9)
    (alarm,) = est.alarms()
    assert (alarm.step, alarm.kind, alarm.index, alarm.outputs) == (K, "state", 0, ())
    assert alarm.gap == pytest.approx(gap, rel=1e-9)
    expected = f"east: no value agrees with both the past and the measurements now, they are {gap:.5g} m apart"
    assert alarm.describe(["east", "speed"], state_units=["m", "m/s"]) == expected
    assert (est.margin[np.arange(tg.STEPS) != K] >= 0).all()


def test_a_measurement_beyond_the_state_bounds_is_an_alarm_of_that_output(restarted):
    (alarm,) = restarted["impossible"].alarms()
    assert (alarm.step, alarm.kind, alarm.index, alarm.outputs) == (K, "output", 1, (1,))
    gap = 3 * tg.SPEED - tg.VELOCITY_NOISE - tg.SPEED
    assert alarm.gap == pytest.approx(gap, rel=1e-12)
    expected = f"speed: the measurement lies {gap:.5g} m/s outside of what the box of the state allows"
    assert alarm.describe(output_names=["east", "speed"], output_units=["m", "m/s"]) == expected
    assert alarm.describe().startswith("output 2: the measurement lies")


def test_restart_goes_on_from_the_measurement_and_the_state_bounds(restarted, records, truth, target):
    est, y, x = restarted["jump"], records[1], truth[0].copy()
    noise = np.array([tg.POSITION_NOISE, tg.VELOCITY_NOISE])
    np.testing.assert_allclose(est.state.lower[K], np.maximum(y[K] - noise, target.bounds.lower), rtol=1e-12)
    np.testing.assert_allclose(est.state.upper[K], np.minimum(y[K] + noise, target.bounds.upper), rtol=1e-12)
    x[K:, 0] += JUMP
    assert est.state.contains(x, -ROUNDING).all()
    # Of the input during the jump nothing is known; before and after it is inside.
    assert np.isneginf(est.input.lower[K - 1]).all()
    assert np.isposinf(est.input.upper[K - 1]).all()
    inside = est.input.contains(truth[2][:-1, None], -ROUNDING)
    assert inside.all()
    assert np.isfinite(np.delete(est.input.width, K - 1, 0)).all()


@pytest.mark.parametrize("name", NAMES[2:])
def test_an_output_that_contradicts_the_state_bounds_is_not_used_and_the_other_one_is(restarted, target, records, name):
    est, position = restarted[name], records[NAMES.index(name), K, 0]
    # Where the position was wrong as well, the next row tells.
    assert conflicts(est) == ([K] if name == "impossible" else [K, K + 1])
    for side, noise in (("lower", -tg.POSITION_NOISE), ("upper", tg.POSITION_NOISE)):
        wanted = [position + noise, getattr(target.bounds, side)[1]]
        np.testing.assert_allclose(getattr(est.state, side)[K], wanted, rtol=1e-12)
    assert est.status[K] == gx.Status.CONFLICT | gx.Status.MISSING


@pytest.mark.parametrize("name", NAMES[1:])
def test_hold_is_the_step_without_the_outputs_that_contradict_the_past(held, name):
    est, missing = held[name]
    last = K if name == "jump" else tg.STEPS  # a target that has really jumped contradicts what was held, again
    assert conflicts(est)[0] == K
    for got, expected in zip(*(jax.tree.leaves((e.state, e.current_input)) for e in (est, missing)), strict=True):
        np.testing.assert_array_equal(got[: last + 1], expected[: last + 1])
    for got, expected in zip(*(jax.tree.leaves(e.input) for e in (est, missing)), strict=True):
        np.testing.assert_array_equal(np.delete(got, K - 1, 0)[: last - 1], np.delete(expected, K - 1, 0)[: last - 1])
    assert np.isinf(est.input.lower[K - 1]).all()
    if name != "jump":
        assert conflicts(est) == [K]
        np.testing.assert_array_equal(np.delete(est.status, K), np.delete(missing.status, K))


def test_hold_keeps_the_truth_where_the_data_lied(held, truth):
    for name in NAMES[2:]:
        assert held[name][0].state.contains(truth[0], -ROUNDING).all()


def test_conflict_at_the_first_row(target, truth):
    """An initial box beyond the state bounds; then a first measurement outside of the initial box."""
    beyond = Interval([truth[0][0, 0] - 1, 2 * tg.SPEED], [truth[0][0, 0] + 1, 3 * tg.SPEED])
    noise = np.array([tg.POSITION_NOISE, tg.VELOCITY_NOISE])
    far = Interval([100.0, -1.0], [101.0, 1.0])
    y = truth[1]
    alone = np.maximum(y[0] - noise, target.bounds.lower), np.minimum(y[0] + noise, target.bounds.upper)
    cases = (
        (beyond, "initial", 1, tg.SPEED, (target.bounds.lower, target.bounds.upper)),
        (far, "output", 0, 100.0 - y[0, 0] - tg.POSITION_NOISE, (far.lower, far.upper)),
    )
    for initial, kind, index, gap, kept in cases:
        for on_conflict, box in (("restart", alone), ("hold", kept)):
            est = tg.record(target.run(y[None], on_conflict, initial), 0)
            alarm = est.alarms()[0]
            assert (alarm.step, alarm.kind, alarm.index) == (0, kind, index)
            assert alarm.gap == pytest.approx(gap, rel=1e-12)
            np.testing.assert_allclose(est.state.lower[0], box[0], rtol=1e-12)
            np.testing.assert_allclose(est.state.upper[0], box[1], rtol=1e-12)
        est = tg.record(target.run(y[None], "restart", initial), 0)
        assert est.state.contains(truth[0], -ROUNDING).all()
    expected = f"speed: the initial box lies {tg.SPEED:.5g} outside of the state bounds"
    assert tg.record(target.run(y[None], initial=beyond), 0).alarms()[0].describe(["east", "speed"]) == expected


def test_consistent_data_never_conflict(target):
    steps = 0
    for seed in range(100, 106):
        x, y, _ = target.simulate(seed)
        est = target.run(y)
        assert not (est.status & gx.Status.CONFLICT).any()
        assert est.state.contains(x, -ROUNDING).all()
        steps += est.status.size
    assert steps >= 10_000
    with pytest.raises(ValueError, match="alarms: one record"):
        est.alarms()


# Online runs ----------------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def small():
    """x+ = .5 x + d + w, y = (x, x + d) + v: d is seen directly, one step before it is felt."""
    system = gx.System(lambda x: 0.5 * x, lambda x: jnp.stack([x[0], x[0]]), G=[[1.0]], H=[[0.0], [1.0]])
    noise = gx.Noise(Interval([-0.1], [0.2]), Interval([-0.3, -0.2], [0.3, 0.2]))
    observer = gx.design_observer(system, noise, Interval.entire(1), sweeps=1)
    d = np.random.default_rng(2).normal(size=(20, 1)) * 5
    run = gx.simulate(system, jax.random.key(4), [0.5], d, noise)
    y = np.array(run.y)
    y[3], y[8, 1], y[9, 0], y[12, 0], y[16] = np.nan, np.nan, np.nan, y[12, 0] + 50, np.nan
    return observer, Interval([-1.0], [1.0]), y


@pytest.mark.parametrize("on_conflict", ["restart", "hold"])
def test_online_runs_equal_the_estimate(small, on_conflict):
    """start, step and resume, with the carry written to a file in between."""
    observer, initial, y = small
    est = jax.tree.map(np.asarray, gx.estimate(observer, initial, y, on_conflict=on_conflict))
    # The restart believes the lie, which the next measurement contradicts.
    assert conflicts(est) == ([12, 13] if on_conflict == "restart" else [12])
    carry, out = gx.start(observer, initial, y[0], on_conflict=on_conflict)
    outputs = [out]
    for k in range(1, 14):
        carry, out = gx.step(observer, carry, y[k], on_conflict=on_conflict)
        outputs.append(out)
        if k == 12:
            assert carry.believed == (on_conflict == "restart")
        if k in (5, 12):
            file = io.BytesIO()
            leaves, tree = jax.tree.flatten(carry)
            np.savez(file, *leaves)
            file.seek(0)
            carry = jax.tree.unflatten(tree, np.load(file).values())
    carry, out = resume(observer, carry, y[14:], on_conflict=on_conflict)
    joined = collect(observer, [*outputs, out])
    np.testing.assert_array_equal(carry.y, y[-1])
    for got, expected in zip(jax.tree.leaves(joined), jax.tree.leaves(est), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-12)
    assert joined.output_rows == est.output_rows


def test_the_gap_by_hand_without_a_velocity(small):
    """x[k] = .5 x[k-1] + (y2[k-1] - x[k-1] - v2) + w must meet y1[k] +- .3."""
    observer, initial, y = small
    est = jax.tree.map(np.asarray, gx.estimate(observer, initial, y))
    highest = -0.5 * est.state.lower[11, 0] + y[11, 1] + 0.2 + 0.2
    assert est.margin[12] == pytest.approx(highest - (y[12, 0] - 0.3), rel=1e-9)
    assert est.alarms()[0].kind == "state"
