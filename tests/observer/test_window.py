"""Windows: as tight as the exact program nearly, and certain after conflicts, gaps and in every way of running."""

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import systems
from oracles.record_hull import exact_hull

import gsisio_jax as gx
from gsisio_jax import Interval
from gsisio_jax.observer.residuals import window_residual
from gsisio_jax.observer.window import Window

ANGLE = 0.3
TURN = 0.95 * np.array([[np.cos(ANGLE), -np.sin(ANGLE)], [np.sin(ANGLE), np.cos(ANGLE)]])
W, V, START = np.array([0.02, 0.02]), np.array([0.05, 2.0]), np.array([3.0, 3.0])
NOISE = gx.Noise(Interval.symmetric(W), Interval.symmetric(V))


@cache
def rotation(window):
    """A rotation, one of whose states is measured poorly: one step leaves out what the other states tell later."""
    system = gx.System(lambda x: TURN @ x, lambda x: x, G=np.zeros((2, 0)), H=np.zeros((2, 0)))
    return gx.design_observer(system, NOISE, Interval.symmetric([5.0, 5.0]), missing=False, window=window, sweeps=1)


def record(seed, steps=30, jump=None):
    """States and measurements; at step `jump` the state is moved to another place, against the model."""
    rng = np.random.default_rng(seed)
    x, states, seen = rng.uniform(-START, START), [], []
    for k in range(steps):
        if k == jump:
            x = x + np.array([4.0, -3.0])
        states.append(x)
        seen.append(x + rng.uniform(-V, V))
        x = TURN @ x + rng.uniform(-W, W)
    return np.array(states), np.array(seen)


def run(observer, y, **options):
    return gx.estimate(observer, Interval.symmetric(START).astype(y.dtype), y, **options)


def held(box, x):
    return (np.asarray(box.lower) <= x) & (x <= np.asarray(box.upper))


def test_widths_are_those_of_the_exact_program_nearly():
    ratios = {1: [], 4: []}
    for seed in (1, 2, 3):
        x, y = record(seed)
        exact = exact_hull(TURN, np.eye(2), W, V, START, y)
        for window, found in ratios.items():
            boxes = run(rotation(window), y).state
            assert held(boxes, x).all()
            found.append(np.asarray(boxes.width)[-1] / exact)
    assert np.min(ratios[4]) > 1 - 1e-6
    assert np.mean(ratios[4], 0).max() < 1.1
    assert np.mean(ratios[1], 0).max() > 1.5  # or a window would be of no use here


def test_the_certificate_counts_the_window():
    """The promise is that of the rows, no run exceeds it, and it scales with the noise."""
    one, four = (rotation(window).certificate for window in (1, 4))
    assert (four.steady_width <= one.steady_width * (1 + 1e-9)).all()
    assert four.steady_width[1] < 0.8 * one.steady_width[1]
    doubled = gx.Noise(Interval.symmetric(2 * W), Interval.symmetric(2 * V))
    np.testing.assert_allclose(four.widths(doubled), 2 * four.steady_width, rtol=1e-6)
    stacked = gx.Noise(Interval.symmetric(np.stack([W, 2 * W])), Interval.symmetric(np.stack([V, 2 * V])))
    np.testing.assert_allclose(four.widths(stacked), np.stack([four.steady_width, 2 * four.steady_width]), rtol=1e-6)
    rng = np.random.default_rng(7)
    x, seen = np.zeros((200, 2)), []
    for _ in range(40):  # at the vertices of the noise, where boxes are widest
        seen.append(x + V * rng.choice([-1, 1], x.shape))
        x = x @ TURN.T + W * rng.choice([-1, 1], x.shape)
    y = np.stack(seen, 1)
    y[0] = 0  # agrees with every state within the noise: the widest boxes of all
    width = np.asarray(jax.vmap(partial(run, rotation(4)))(y).state.width)[:, -1]
    assert (width <= four.steady_width * (1 + 1e-6)).all()
    assert width.max(0)[1] > 0.9 * four.steady_width[1]


@pytest.mark.parametrize("on_conflict", ["restart", "hold"])
def test_a_conflict_throws_away_what_it_contradicts(on_conflict):
    """Restart believes the measurement: the truth may have jumped. Hold believes the past: that row was wrong."""
    for seed in range(4):
        x, y = record(seed, jump=12 if on_conflict == "restart" else None)
        if on_conflict == "hold":
            y[12] += [5, 8]
        est = run(rotation(4), y, on_conflict=on_conflict)
        status = np.asarray(est.status)
        assert status[12] & gx.Status.CONFLICT
        inside = held(est.state, x).all(-1)
        assert inside.all()
        assert not (np.delete(status, 12) & gx.Status.CONFLICT).any()
        # The window fills again.
        assert (
            np.asarray(est.state.width)[-1, 1] < 1.2 * np.asarray(run(rotation(4), record(seed)[1]).state.width)[-1, 1]
        )


def test_lost_measurements_say_nothing():
    rng = np.random.default_rng(5)
    y, x = [], []
    for seed in range(20):
        states, seen = record(seed)
        y.append(np.where(rng.random(seen.shape) < 0.3, np.nan, seen))
        x.append(states)
    est = jax.vmap(lambda y: run(rotation(4), y))(jnp.asarray(np.array(y)))
    assert held(est.state, np.array(x)).all()
    assert not (np.asarray(est.status) & gx.Status.CONFLICT).any()


def test_steps_equal_the_scan_and_go_on_from_a_carry():
    observer, (_, y) = rotation(4), record(7, steps=12)
    whole = run(observer, y)
    carry, out = gx.start(observer, Interval.symmetric(START), y[0])
    outs = [out]
    for row in y[1:8]:
        carry, out = gx.step(observer, carry, row)
        outs.append(out)
    carry = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)), carry)  # stored and read again
    for row in y[8:]:
        carry, out = gx.step(observer, carry, row)
        outs.append(out)
    for side in ("lower", "upper"):
        found = np.stack([getattr(out.state, side) for out in outs])
        np.testing.assert_allclose(found, getattr(whole.state, side), rtol=1e-12)  # a loop may round in other places


def test_gradients_are_those_of_differences():
    observer, (_, y) = rotation(4), record(8, steps=10)

    def width(scale):
        noise = gx.Noise(NOISE.w, Interval.symmetric(V * scale))
        return run(observer, y, noise=noise, rounding="nearest").state.width[-1].sum()

    slope, step = float(jax.grad(width)(1.0)), 1e-6
    difference = float(width(1 + step) - width(1 - step)) / (2 * step)
    assert slope == pytest.approx(difference, rel=1e-5)
    assert slope > 0.1


def test_six_tanks_with_unknown_inputs():
    """From one step y tells little of the first two levels: they are .4 to 3.5 wide without a window."""
    case = systems.s5()
    observer = case.design(missing=False, window=3)
    simulated, d = jax.vmap(case.simulate)(jax.random.split(jax.random.key(3), 50))
    est = jax.vmap(lambda y: gx.estimate(observer, case.initial, y, u=case.u(case.steps)))(simulated.y)
    assert held(est.state, np.asarray(simulated.x)[:, : case.steps]).all()
    assert held(est.input, np.asarray(d)[:, : est.input.shape[1]]).all()
    assert (np.asarray(est.state.width)[:, -1, :2].mean(0) < 0.2).all()


def test_float32():
    x, y = record(9)
    boxes = run(rotation(4), y.astype(np.float32)).state
    assert boxes.dtype == np.float32
    slack = 1e-6  # data rounded to float32 are other data
    assert (np.asarray(boxes.lower) <= x + slack).all()
    assert (x - slack <= np.asarray(boxes.upper)).all()
    np.testing.assert_allclose(boxes.width, run(rotation(4), y).state.width, rtol=2e-3)


@pytest.mark.parametrize(("w", "worth"), [(W, True), ([50.0, 50.0], False)])
def test_auto_takes_a_window_only_where_it_is_worth_it(w, worth):
    """Where noise moves the state farther than its measurement errs, what was known of it before is worth nothing."""
    system = gx.System(lambda x: TURN @ x, lambda x: x, G=np.zeros((2, 0)), H=np.zeros((2, 0)))
    noise = gx.Noise(Interval.symmetric(w), NOISE.v)
    observer = gx.design_observer(system, noise, Interval.symmetric([5.0, 5.0]), missing=False)
    assert (observer.window is not None) == worth


def test_what_rows_leave_of_states_and_inputs_is_counted():
    """Multipliers that are off by a thousandth still make correct rows, as what they leave is bounded with the box of
    the input of each step. It is large every third step, so that of another step would not do."""
    A, G, C = np.array([[0.9, 0.3], [-0.3, 0.8]]), np.array([[1.0], [0.5]]), np.array([[1.0, 0.0], [0.2, 1.0], [1, 1]])
    system = gx.System(lambda x: A @ x, lambda x: C @ x, G=G, H=np.zeros((3, 1)))
    bounds = gx.Noise(Interval.symmetric(np.full(2, 1e-3)), Interval.symmetric(np.full(3, 1e-2)))
    observer = gx.design_observer(system, bounds, Interval.entire(2), missing=False, window=3)
    rng = np.random.default_rng(0)
    rows = jax.tree.map(lambda leaf: np.asarray(leaf) * (1 + 1e-3 * rng.standard_normal(leaf.shape)), observer.window)
    left = window_residual(rows, system, observer.C, observer.bounded_inputs, np.zeros((3, 1)))
    rows = replace(rows, output=rows.remainder @ observer.T2, left_x=left[0], left_d=left[1])
    assert left[1].max() > 1e-5
    x, states, seen = np.zeros(2), [], []
    for k in range(30):
        states.append(x)
        seen.append(C @ x + rng.uniform(-1e-2, 1e-2, 3))
        x = A @ x + G @ rng.uniform(1e5, 2e5, 1) * (k % 3 == 0) + rng.uniform(-1e-3, 1e-3, 2)
    est = gx.estimate(replace(observer, window=rows), Interval.symmetric(np.ones(2)), np.array(seen))
    assert held(est.state, np.array(states)).all()
    assert not (np.asarray(est.status) & gx.Status.CONFLICT).any()


def test_a_constant_meets_the_rounding_of_all_lags():
    """x = 1 always. Each of 39 lags adds .49 ulp, which is lost beside the 1 of the first one, and the last takes all
    of them away. Any multipliers are a correct row, as f has no slope; no design chooses these."""
    steps, ulp = 40, np.finfo(float).eps
    system = gx.System(lambda x: 0 * x + 1, lambda x: x, G=np.zeros((1, 0)), H=np.zeros((1, 0)))
    noise = gx.Noise(Interval.symmetric([0.0]), Interval.symmetric([1.0]))
    observer = gx.design_observer(system, noise, Interval.symmetric([5.0]), missing=False)
    multipliers = np.zeros((steps, 1, 2))
    multipliers[:, 0, 0] = [1, *(-0.49 * ulp * np.arange(1, steps))]
    nothing = np.zeros((1, 1))
    row = Window(
        multipliers, nothing, nothing, np.zeros((steps, 1, 0)), nothing, np.zeros((steps, 1, 0)), (0,), (1,) * steps
    )
    one = Interval([1.0], [1.0])
    box = gx.estimate(replace(observer, window=row), one, np.ones((steps + 2, 1))).state
    assert held(box, np.ones(1)).all()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"window": 0}, "at least 1"),
        ({"window": "long"}, "whole number"),
        ({"window": 2.0}, "whole number"),
        ({"window": 2, "form": "prediction"}, "prediction form"),
    ],
)
def test_windows_that_cannot_be(options, words):
    system = gx.System(lambda x: TURN @ x, lambda x: x, G=np.zeros((2, 0)), H=np.zeros((2, 0)))
    with pytest.raises(ValueError, match=words):
        gx.design_observer(system, NOISE, Interval.symmetric([5.0, 5.0]), **options)
