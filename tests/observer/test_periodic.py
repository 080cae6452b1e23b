"""Logged angles: against the same plant with a log that was never wrapped, and against fractions."""

from __future__ import annotations

import math
from fractions import Fraction

import angles
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from angles import TURN, batch, bits, known_inputs, same

import gsisio_jax as gx
from gsisio_jax import Interval, Status
from gsisio_jax.interval import rounding
from gsisio_jax.observer.periodic import MOST_TURNS, unwrap

RUNS = 4


@pytest.fixture(scope="module")
def robot():
    return angles.made("robot", states=False)


@pytest.fixture(scope="module")
def dial():
    return angles.made("dial", states=False)


# Against a log that was never wrapped ---------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("name", "mode", "dtype"),
    [
        ("robot", "outward", np.float64),
        ("robot", "outward", np.float32),
        ("robot", "nearest", np.float64),
        ("robot", "nearest", np.float32),
        ("spun", "outward", np.float64),
    ],
)
def test_boxes_are_those_of_a_log_that_was_never_wrapped(name, mode, dtype, robot):
    plant = robot if name == "robot" else angles.made(name, states=False)
    case, double = plant.case, dtype == np.float64
    # To nearest, noise on its very bounds leaves gaps of an ulp, and which box is then kept is a matter of chance.
    # Outward, wrapping a log rounds: noise on its very bounds would be beyond them by that.
    x, y, d = angles.records(plant.plain, RUNS, 1 - 1e-12 if double and mode == "outward" else 0.98)
    assert (np.ptp(x[:, :, angles.STATES[name][0]], axis=1) > 3 * TURN).any()
    logged = angles.wrapped(y, angles.OUTPUTS[name])
    assert (abs(logged[..., angles.OUTPUTS[name]]) <= np.pi).all()
    initial, u = case.initial.astype(dtype), known_inputs(case, dtype)
    found = batch(plant.observer, initial, logged.astype(dtype), u, rounding=mode)
    expected = batch(plant.plain_observer, initial, y.astype(dtype), u, rounding=mode)
    assert found.state.lower.dtype == dtype
    assert not bits(found, Status.CONFLICT | Status.AMBIGUOUS | Status.MISSING).any()
    slack = {"outward": 0.0, "nearest": -1e-9 if double else -1e-4}[mode]
    assert found.state.contains(x, slack).all()
    assert found.input.contains(d[:, :-1], slack).all()
    same(found, expected, 1e-9 if double else 3e-4)
    np.testing.assert_allclose(found.margin, expected.margin, atol=1e-11 if double else 1e-3)


def test_without_periods_the_log_alarms_and_then_misses(robot):
    """What `periodic` is for: at the first wrap, an alarm; after it, boxes that are a turn off."""
    case = robot.plain
    x, y, _ = angles.records(case, RUNS)
    est = batch(robot.plain_observer, case.initial, angles.wrapped(y, (2,)), known_inputs(case))
    first = int(np.argmax(bits(est, Status.CONFLICT)[0]))
    assert bits(est, Status.CONFLICT)[0, first]
    assert y[0, first, 2] > np.pi >= y[0, first - 1, 2]
    miss = np.maximum(est.state.lower - x, x - est.state.upper)[0, :, 2]
    assert miss[:first].max() <= 0
    assert miss.max() > 12.5


def test_a_heading_turned_by_a_bounded_input():
    def f(x):
        return x + 0.15

    def made(**periods):
        system = gx.System(f, lambda x: x, [[1.0]], [[0.0]], input_bounds=Interval([-1.0], [1.5]), **periods)
        noise = gx.Noise(Interval.symmetric([0.01]), Interval.symmetric([0.05]))
        # Of periodic outputs, the gains for missing entries are there either way.
        return system, gx.design_observer(system, noise, Interval.entire(1), sweeps=1, missing=not periods)

    system, plain = made()
    _, observer = made(periodic={0: TURN})
    d = np.random.default_rng(0).uniform(-1, 1.5, (200, 1))
    run = gx.simulate(system, jax.random.key(0), [0.3], d, plain.noise)
    initial = Interval([0.0], [1.0])
    found = gx.estimate(observer, initial, angles.wrapped(run.y, (0,)))
    same(found, gx.estimate(plain, initial, run.y), 1e-11)
    assert found.state.contains(run.x[:-1]).all()
    assert found.input.contains(d[:-1]).all()
    assert not bits(found, Status.CONFLICT | Status.AMBIGUOUS).any()


def test_missing_entries_and_gaps(robot):
    case = robot.plain
    x, y, d = angles.records(case, RUNS)
    rng = np.random.default_rng(3)
    y[rng.random(y.shape) < 0.2] = np.nan
    y[:, 0], y[:, 40:60], y[:, 100:115, 2] = np.nan, np.nan, np.nan
    found = batch(robot.observer, case.initial, angles.wrapped(y, (2,)), known_inputs(case))
    expected = batch(robot.plain_observer, case.initial, y, known_inputs(case))
    assert found.state.contains(x).all()
    assert found.input.contains(d[:, :-1]).all()
    np.testing.assert_array_equal(found.status, expected.status)
    same(found, expected, 1e-10)


# None and several multiples -------------------------------------------------------------------------------------------
def test_no_multiple_fits(dial):
    """Half a turn off: a contradiction, of the size of what is left to the nearest multiple; and the run goes on."""
    case, u = dial.plain, known_inputs(dial.plain)
    x, y, _ = angles.records(case, RUNS)
    logged = angles.wrapped(y, (0,))
    logged[:, 80] += np.pi
    for on_conflict in ("restart", "hold"):
        est = batch(dial.observer, case.initial, logged, u, on_conflict=on_conflict)
        assert (np.flatnonzero(bits(est, Status.CONFLICT).any(0)) == [80]).all()
        assert bits(est, Status.CONFLICT)[:, 80].all()
        (alarm,) = jax.tree.map(lambda leaf: leaf[0], est).alarms()
        assert 2.5 < alarm.gap < np.pi
        # A heading that is not a periodic state stays unknown after a restart: nothing is left that knows the multiple.
        width = est.state.width[:, 80:]
        assert np.isinf(width).all() if on_conflict == "restart" else (width < 0.3).all()
        assert est.state.contains(x).all()


def test_the_alarm_of_an_angle_names_its_output():
    alarm = gx.Alarm(3, "periodic", 2, (2,), 0.5)
    assert alarm.describe(output_names=["east", "north", "course"], output_units=["m", "m", "rad"]) == (
        "course: with any number of whole periods, 0.5 rad outside of what the box of the state allows"
    )


def test_two_multiples_fit(dial):
    """A box of more than a turn: both multiples, and all between them; then the data decide nothing any more, and the
    box stays right."""
    case, u = dial.plain, known_inputs(dial.plain)
    x, y, _ = angles.records(case, RUNS)
    wide = Interval([0.1 - TURN], [0.9])
    est = batch(dial.observer, wide, angles.wrapped(y, (0,)), u)
    assert bits(est, Status.AMBIGUOUS)[:, 0].all()
    assert not bits(est, Status.CONFLICT | Status.MISSING).any()
    assert est.state.contains(x).all()
    low, high = y[:, 0] - TURN - case.noise.v.upper, y[:, 0] - case.noise.v.lower
    np.testing.assert_allclose(est.state.lower[:, 0], np.maximum(low, wide.lower), rtol=1e-12)
    np.testing.assert_allclose(est.state.upper[:, 0], np.minimum(high, wide.upper), rtol=1e-12)


def test_an_unknown_heading_stays_unknown_and_harms_nothing_else(robot):
    case, u = robot.plain, known_inputs(robot.plain)
    x, y, _ = angles.records(case, RUNS)
    unknown = Interval([-1.0, -1.0, -np.inf], [1.0, 1.0, np.inf])
    est = batch(robot.observer, unknown, angles.wrapped(y, (2,)), u)
    assert bits(est, Status.AMBIGUOUS).all()
    assert not bits(est, Status.CONFLICT | Status.MISSING).any()
    assert np.isinf(est.state.width[..., 2]).all()
    assert est.state.contains(x).all()
    assert (est.state.width[..., :2] < 0.2).all()


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("mode", ["outward", "nearest"])
def test_multiples_against_fractions(robot, dtype, mode):
    """Every multiple that fits, for the period and both its neighbours, is in the bounds; and they are no wider."""
    system, rng = robot.case.system, np.random.default_rng(5)
    count = 3000
    scale = 10.0 ** rng.uniform(-2, 3 if dtype == np.float32 else 5, count)
    low = rng.normal(size=count) * scale
    high = low + rng.choice([0.0, 0.5, TURN, 3 * TURN], count) * rng.random(count)
    y = np.where(rng.random(count) < 0.3, low + 2 * np.pi * rng.integers(-9, 9, count), rng.uniform(-7, 7, count))
    v = np.sort(rng.normal(size=(2, count)) * rng.choice([0, 1e-3, 0.1], count), axis=0)
    low, high, y, v = (a.astype(dtype) for a in (low, high, y, v))

    def one(low, high, y, a, b):
        zero = jnp.zeros(3, dtype)
        box = Interval.unchecked(zero.at[2].set(a), zero.at[2].set(b))
        nothing = Interval.unchecked(zero, zero)
        with rounding.using(mode):
            found = unwrap(
                system, Interval.unchecked(low[None], high[None]), zero.at[2].set(y), jnp.zeros(1, dtype),
                gx.Noise.unchecked(nothing, box),
            )  # fmt: skip
        side = found.noise.v
        return found.y[2], side.lower[2], side.upper[2], found.open[0], found.slack[2]

    found = [np.asarray(a) for a in jax.jit(jax.vmap(one))(low, high, y, v[0], v[1])]
    kinds = set()
    for i in range(count):
        turned, a, b, several, slack = (leaf[i] for leaf in found)
        assert turned.dtype == dtype
        exact = [Fraction(float(t)) for t in (y[i], low[i], high[i], v[0, i], v[1, i])]
        fits = set()
        for period in map(Fraction, (np.nextafter(TURN, 0), TURN, np.nextafter(TURN, 9))):
            first = math.ceil((exact[1] + exact[3] - exact[0]) / period)
            last = math.floor((exact[2] + exact[4] - exact[0]) / period)
            for k in range(first, last + 1):
                fits.add(k)
                # y + k P - v, for all v, is in what y and noise become.
                loose = 0 if mode == "outward" else Fraction(64 * float(np.finfo(dtype).eps)) * (1 + abs(exact[1]))
                assert Fraction(float(turned)) - Fraction(float(b)) <= exact[0] + k * period - exact[4] + loose
                assert Fraction(float(turned)) - Fraction(float(a)) >= exact[0] + k * period - exact[3] - loose
        size = float(abs(low[i]) + abs(high[i]) + abs(y[i]) + 10)
        close = 300 * float(np.finfo(dtype).eps) * size
        spread = (max(fits) - min(fits)) * TURN if fits else 0.0
        assert (b - a) - (v[1, i] - v[0, i]) <= (spread + close if not several else spread + 2 * TURN + close)
        if len(fits) > 1:
            assert several
        if turned == y[i] and not several:
            assert (a, b) == (v[0, i], v[1, i])
        if slack < 0:
            assert not fits
            near = round(((exact[1] + exact[2]) / 2 - exact[0]) / Fraction(TURN))
            values = [exact[0] + k * Fraction(TURN) for k in range(near - 2, near + 3)]
            gap = min(max(exact[1] + exact[3] - value, value - exact[2] - exact[4]) for value in values)
            assert -slack == pytest.approx(float(gap), abs=close)
        kinds.add((len(fits) > 1, bool(several), bool(slack < 0)))
    assert {(False, False, True), (False, False, False), (True, True, False)} <= kinds


def test_too_many_turns_count_as_unknown(dial):
    """Where the number of the turn is no whole number of single precision any more, the entry says nothing."""
    far = MOST_TURNS * TURN * 1.5
    initial = Interval([far], [far + 0.1])
    est = gx.estimate(dial.observer, initial, angles.wrapped([[far + 0.05]], (0,)), np.zeros((1, 1)))
    assert bits(est, Status.AMBIGUOUS).all()
    assert not bits(est, Status.CONFLICT | Status.MISSING).any()
    np.testing.assert_allclose(est.state.lower[0], initial.lower)
    np.testing.assert_allclose(est.state.upper[0], initial.upper)


# Elsewhere ------------------------------------------------------------------------------------------------------------
def test_the_prediction_form():
    def made(**periods):
        case = angles.robot(**periods)
        plant = case.system
        G, H = np.zeros((3, 1)), np.array([[1.0], [0.0], [0.0]])
        system = gx.System(lambda x, u: plant.f(x, u) * jnp.array([0.5, 0.5, 1.0]), plant.g, G, H, m=1, **periods)
        region = Interval([-50.0] * 3, [50.0] * 3)
        return case, gx.design_observer(system, case.noise, region, "prediction", u_region=case.u_region)

    case, plain = made()
    _, observer = made(periodic={2: TURN})
    u = known_inputs(case)
    run = gx.simulate(plain.system, jax.random.key(0), [0.1, 0.2, 0.5], np.ones((200, 1)), case.noise, u)
    assert np.ptp(run.y[:, 2]) > 3 * TURN
    initial = Interval([-1.0, -1.0, 0.2], [1.0, 1.0, 0.8])
    found = gx.estimate(observer, initial, angles.wrapped(run.y, (2,)), u)
    same(found, gx.estimate(plain, initial, run.y, u), 1e-9)
    assert found.state.contains(run.x[:-1], -1e-9).all()


# Errors ---------------------------------------------------------------------------------------------------------------
ERRORS = {
    "no mapping": ({"periodic": 6.28}, r"`periodic` must be a mapping \{index of the output: period\}"),
    "index": ({"periodic": {3: 6.28}}, r"`periodic` has the index 3; .* one of the 3 outputs, 0 to 2"),
    "negative index": ({"periodic": {-1: 6.28}}, "has the index -1"),
    "index of a state": ({"periodic_states": {"theta": 6.28}}, "has the index 'theta'; .* one of the 3 states"),
    "zero": ({"periodic": {2: 0}}, r"`periodic`\[2\] must be a positive, finite period"),
    "infinite": ({"periodic": {2: math.inf}}, "positive, finite period"),
    "nan": ({"periodic_states": {2: math.nan}}, "positive, finite period"),
    "word": ({"periodic": {2: "2 pi"}}, "positive, finite period.*got '2 pi'"),
    "in degrees": ({"periodic": {2: 360}, "periodic_states": {2: 360}}, "state 2 is not periodic: .* entry [01] of f"),
    "output left out": ({"periodic_states": {2: TURN}}, "state 2 is not periodic: .* changes entry 2 of g by 6.28.*"),
    "no angle": ({"periodic": {0: TURN}, "periodic_states": {0: 1.0}}, "state 0 is not periodic: .* entry 0 of g by 1"),
}  # fmt: skip


@pytest.mark.parametrize(("periods", "message"), ERRORS.values(), ids=ERRORS.keys())
def test_what_cannot_be(periods, message):
    with pytest.raises(ValueError, match="System: .*" + message):
        angles.robot(**periods)


def test_no_bounds_for_a_periodic_state():
    plant = angles.robot().system
    bounds = Interval([-np.inf, -np.inf, -np.pi], [np.inf, np.inf, np.pi])
    with pytest.raises(ValueError, match=r"state 2 is periodic .* state bounds \[-3.14159, 3.14159\]"):
        gx.System(
            plant.f, plant.g, plant.G, plant.H, m=1, state_bounds=bounds, periodic={2: TURN}, periodic_states={2: TURN}
        )


def test_feedthrough_of_an_angle_needs_bounds():
    def made(bounds):
        return gx.System(
            lambda x: x + 0.1, lambda x: jnp.stack([x[0], x[0]]), [[0.0, 0.0]], [[0.0, 0.5], [1.0, 0.0]],
            input_bounds=bounds, periodic={0: TURN},
        )  # fmt: skip

    with pytest.raises(ValueError, match=r"output 0 is periodic, and the unknown input 1 enters it at once .*bounds"):
        made(None)
    with pytest.raises(ValueError, match=r"H\[0, 1\] = 0.5"):
        made(Interval([-np.inf, -np.inf], [np.inf, 3.0]))
    system = made(Interval([-np.inf, -0.5], [np.inf, 2.5]))
    noise = gx.Noise(Interval.symmetric([0.01]), Interval.symmetric([0.02, 0.02]))
    observer = gx.design_observer(system, noise, Interval.entire(1), sweeps=1, missing=False)
    d = np.stack([np.random.default_rng(0).normal(size=150), np.random.default_rng(1).uniform(-0.5, 2.5, 150)], 1)
    run = gx.simulate(system, jax.random.key(1), [0.2], d, noise)
    est = gx.estimate(observer, Interval([0.0], [0.4]), run.y)
    assert est.state.contains(run.x[:-1]).all()
    assert est.input.contains(d[:-1]).all()
    assert not bits(est, Status.CONFLICT | Status.AMBIGUOUS).any()
    assert run.x[-1, 0] > 2 * TURN
