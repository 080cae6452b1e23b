"""Periodic states: the number of turns is chosen anew where it was lost, and boxes hold up to whole turns."""

from __future__ import annotations

from fractions import Fraction

import angles
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from angles import TURN, batch, bits, held, known_inputs, same
from oracles.uncompiled import in_numpy

import gsisio_jax as gx
from gsisio_jax import Interval, Status
from gsisio_jax.observer.estimation import collect, resume

RUNS = 4


@pytest.fixture(scope="module")
def dial():
    return angles.made("dial", states=False)


@pytest.fixture(scope="module")
def free_dial():
    return angles.made("dial", states=True)


def test_a_periodic_state_changes_nothing_while_the_turn_is_known(free_dial, dial):
    case, u = dial.plain, known_inputs(dial.plain)
    _, y, _ = angles.records(case, RUNS)
    logged = angles.wrapped(y, (0,))
    same(batch(free_dial.observer, case.initial, logged, u), batch(dial.observer, case.initial, logged, u), 1e-13)


@pytest.mark.parametrize("heading", [(-np.inf, np.inf), (-np.pi, np.pi), (3.0, np.inf)])
def test_an_unknown_heading_is_found(free_dial, heading):
    """At the first measurement, up to whole turns."""
    case, u = free_dial.plain, known_inputs(free_dial.plain)
    x, y, _ = angles.records(case, RUNS)
    if heading[0] == -np.pi:  # near the cut, where two multiples fit
        x, y = x + 2.8, y + 2.8
    logged = angles.wrapped(y, (0,))
    est = batch(free_dial.observer, Interval([heading[0]], [heading[1]]), logged, u)
    assert not bits(est, Status.CONFLICT | Status.AMBIGUOUS | Status.UNBOUNDED).any()
    assert held(free_dial, x, est).all()
    known = batch(free_dial.observer, Interval([0.2], [3.6]), logged, u)
    np.testing.assert_allclose(est.state.width[:, 5:], known.state.width[:, 5:], atol=1e-9)
    assert (est.state.width[:, 0] <= 0.0901).all()


def test_a_heading_that_any_input_turns():
    """S9 with logged bearings: whole turns of the heading are lost at every step, and with them the input that turned
    it, but the heading itself is not."""
    plant = angles.made("bearings", states=True)
    case = plant.case
    x, y, d = angles.records(plant.plain, RUNS)
    assert (np.ptp(y[..., 1], axis=1) > 4).all()
    logged = angles.wrapped(y, angles.OUTPUTS["bearings"])
    logged[:, 10], logged[:, 20, 1], logged[:, 30, 3] = np.nan, np.nan, np.nan
    est = batch(plant.observer, case.initial, logged)
    assert held(plant, x, est).all()
    assert est.input.contains(d[:, :-1]).all()
    assert not bits(est, Status.CONFLICT).any()
    assert np.isinf(est.input.width[..., 0]).all()
    assert (np.delete(est.state.width[..., 2], 10, 1) < 1.0).all()


def test_a_restart_finds_the_heading_again(free_dial):
    case, u = free_dial.plain, known_inputs(free_dial.plain)
    x, y, _ = angles.records(case, RUNS)
    logged = angles.wrapped(y, (0,))
    logged[:, 80] += np.pi
    est = batch(free_dial.observer, case.initial, logged, u)
    # The lie, and what contradicts it, once it is believed.
    np.testing.assert_array_equal(np.flatnonzero(bits(est, Status.CONFLICT).any(0)), [80, 81])
    inside = held(free_dial, x, est)
    assert np.delete(inside, 80, axis=1).all()
    assert not inside[:, 80].any()
    assert (est.state.width < 0.7).all()


def test_a_gap_of_everything_loses_the_turn_and_not_the_heading(free_dial):
    """Noise of 40 steps of .2 per side: the box is longer than a turn, and is kept at one."""
    case, u = free_dial.plain, known_inputs(free_dial.plain)
    x, y, _ = angles.records(case, RUNS)
    logged = angles.wrapped(y, (0,))
    logged[:, 20:60] = np.nan
    noise = gx.Noise(Interval([-0.2], [0.2]), case.noise.v)
    est = batch(free_dial.observer, case.initial, logged, u, noise=noise)
    assert (est.state.width <= TURN + 1e-9).all()
    assert (est.state.width[:, 59] > TURN - 1e-9).all()
    assert (est.state.width[:, 60:] < 0.1).all()
    assert not bits(est, Status.CONFLICT | Status.UNBOUNDED).any()
    assert held(free_dial, x, est).all()


def test_far_from_zero_the_box_moves_back(free_dial):
    """100 turns on, and with single precision: numbers stay small, so digits are not lost."""
    case, u = free_dial.plain, known_inputs(free_dial.plain)
    x, y, _ = angles.records(case, RUNS, 0.98)
    initial = Interval(case.initial.lower + 100 * TURN - 1e-3, case.initial.upper + 100 * TURN + 1e-3)
    logged = angles.wrapped(y, (0,)).astype(np.float32)
    est = batch(free_dial.observer, initial.astype(np.float32), logged, np.float32(u))
    assert est.state.lower.dtype == np.float32
    assert (abs(est.state.center[:, 0]) < 2).all()
    assert (abs(est.state.center) < 50).all()
    assert held(free_dial, x, est).all()
    assert not bits(est, Status.CONFLICT | Status.AMBIGUOUS).any()


def test_boxes_for_display(free_dial):
    """Moved by whole periods, outward; what is infinite or not periodic stays."""
    boxes = Interval([[40.0], [-np.inf], [3.0], [1.0], [-41.0]], [[40.5], [3.0], [4.0], [2.0], [-35.0]])
    found = gx.wrapped(free_dial.observer, boxes)
    turns = np.array([6, 0, 1, 0, -6])
    for got, side, outward in ((found.lower, boxes.lower, -1), (found.upper, boxes.upper, 1)):
        for value, before, count in zip(np.asarray(got)[:, 0], np.asarray(side)[:, 0], turns, strict=True):
            if np.isinf(before) or count == 0:
                assert value == before
                continue
            for period in (np.nextafter(TURN, 0), TURN, np.nextafter(TURN, 9)):
                exact = Fraction(float(before)) - int(count) * Fraction(float(period))
                assert 0 < outward * (Fraction(float(value)) - exact) < 1e-13
    x = np.array([[40.2 - 5 * TURN], [2.0], [3.5 + 9 * TURN], [1.5], [-38.0 + TURN]])
    assert boxes.contains(np.asarray(gx.nearest(free_dial.observer, x, boxes))).all()
    plain = free_dial.plain.system
    assert gx.wrapped(plain, boxes) is boxes
    assert gx.nearest(plain, x, boxes) is x


def test_online_runs_equal_the_estimate(free_dial):
    case, u = free_dial.case, known_inputs(free_dial.case)
    _, y, _ = angles.records(free_dial.plain, 1)
    logged = angles.wrapped(y, (0,))[0]
    logged[30] += 1.5
    whole = gx.estimate(free_dial.observer, case.initial, logged, u)
    assert bits(whole, Status.CONFLICT)[30]
    carry, out = gx.start(free_dial.observer, case.initial, logged[0], u[0])
    outs = [out]
    for k in range(1, 35):
        carry, out = gx.step(free_dial.observer, carry, logged[k], u[k])
        outs.append(out)
    _, out = resume(free_dial.observer, carry, logged[35:], u[35:])
    joined = collect(free_dial.observer, [*outs, out])
    for got, expected in zip(jax.tree.leaves(joined), jax.tree.leaves(whole), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-12)


def test_gradients(free_dial):
    """Of all sides, by noise bounds, initial box and record: central differences, and finite where no multiple or
    several fit."""
    case, steps = free_dial.plain, 40
    _, y, _ = angles.records(case, 1)
    logged, u = angles.wrapped(y, (0,))[0, :steps], known_inputs(case)[:steps]
    assert (abs(np.diff(logged[:, 0])) > 5).any()
    weights = np.random.default_rng(1).normal(size=(2, steps, 1))

    def total(scale, shift, y, initial):
        noise = jax.tree.map(lambda side: scale * side, case.noise)
        box = Interval.unchecked(initial.lower - shift, initial.upper + shift)
        est = gx.estimate(free_dial.observer, box, y, u, noise)
        finite = [jnp.where(jnp.isfinite(side), side, 0) for side in (est.state.lower, est.state.upper)]
        return (weights[0] * finite[0]).sum() + (weights[1] * finite[1]).sum()

    off = logged.copy()
    off[3], off[9] = off[3] + np.pi, np.nan
    unknown = Interval(np.array([-np.inf]), np.array([np.inf]))
    direction = np.random.default_rng(2).normal(size=logged.shape)
    value, gradient, h = in_numpy(total), in_numpy(jax.grad(total, argnums=(0, 1, 2))), 1e-6
    for initial, y in ((case.initial, logged), (case.initial, off), (unknown, logged)):
        point = (1.1, 0.01, y)
        found = gradient(*point, initial)
        assert all(np.isfinite(leaf).all() for leaf in found)
        for i, step in enumerate((1.0, 1.0, direction)):
            there = [tuple(p + s * h * step if j == i else p for j, p in enumerate(point)) for s in (1, -1)]
            central = float((value(*there[0], initial) - value(*there[1], initial)) / (2 * h))
            assert (np.asarray(found[i]) * step).sum() == pytest.approx(central, rel=1e-5, abs=1e-6)


def test_simulated_records_are_wrapped(free_dial):
    plain, _ = free_dial.plain.simulate(jax.random.key(1))
    run, _ = free_dial.case.simulate(jax.random.key(1))
    np.testing.assert_array_equal(run.x, plain.x)
    assert np.ptp(plain.y) > 3 * TURN
    np.testing.assert_allclose(run.y, angles.wrapped(plain.y, (0,)), atol=1e-13)


def test_studies(free_dial):
    """`monte_carlo` wraps what it simulates, and both compare a truth up to whole turns."""
    case, u = free_dial.case, known_inputs(free_dial.case)
    unknown = Interval([-np.inf], [np.inf])
    runs = gx.monte_carlo(
        free_dial.observer, 2, 20, 60, x0=case.initial, initial=unknown, u=u[:60], draw="vertices",
        reduce=("final", "status"), progress=False,
    )  # fmt: skip
    assert runs.attrs["missed"].startswith("0 of 20")
    assert (runs.state_width_final < 0.2).all()
    x, y, d = angles.records(free_dial.plain, 3)
    study = gx.sweep(
        free_dial.observer, unknown, angles.wrapped(y, (0,)), u=u, truth=(x, d), reduce=("coverage",), progress=False
    )
    assert (study.state_coverage == 1).all()
