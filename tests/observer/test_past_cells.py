"""Both boxes of the paper's example cut into cells: against the exact hull, at corners; gaps and conflicts."""

from __future__ import annotations

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import systems
from oracles.uncompiled import in_numpy

import gsisio_jax as gx
from benchmarks import example_hull
from gsisio_jax import Interval
from gsisio_jax.observer.free_rows import FreeRows

CASE = systems.s1(region=(1.0, 1.0))
STEPS, RUNS = 24, 40
G, H = np.asarray(CASE.system.G), np.asarray(CASE.system.H)
LOW, HIGH = np.asarray(CASE.initial.lower), np.asarray(CASE.initial.upper)


@pytest.fixture(scope="module")
def observer():
    found = CASE.design(missing=False, cells=36, sweeps=1)
    assert found.cells == found.past_cells == (6, 6)
    return found


def _simulated(scale):
    """From corners, faces and points of the initial box, noise at its vertices in half of the runs."""
    rng = np.random.default_rng(1)
    x = LOW + np.clip(rng.uniform(-1, 2, (RUNS, 2)), 0, 1) * (HIGH - LOW)
    vertices = rng.random((RUNS, 1)) < 0.5

    def noise():
        drawn = rng.uniform(-1, 1, (RUNS, 2))
        return 0.2 * np.where(vertices, np.sign(drawn) * (1 - 1e-9), drawn)

    states, inputs, seen = [], [], []
    for _ in range(STEPS):
        d = scale * rng.normal(size=(RUNS, 2))
        states.append(x)
        inputs.append(d)
        seen.append(example_hull.g(x) + d @ H.T + noise())
        x = example_hull.f(x) + d @ G.T + noise()
    return tuple(np.stack(part, 1) for part in (states, inputs, seen))


@pytest.fixture(scope="module")
def run(observer):
    """Boxes of every step, one record after the other in one program."""
    found = jax.vmap(lambda y: gx.estimate(observer, CASE.initial, y))
    return lambda y: jax.tree.map(np.asarray, found(jnp.asarray(y)))


def _outside(box, value):
    return ((value < box.lower) | (value > box.upper)).any(-1)


@pytest.mark.parametrize("scale", [1.0, 1e3])
def test_every_box_holds_the_truth(run, scale):
    x, d, y = _simulated(scale)
    out = run(y)
    assert not _outside(out.state, x).any()
    assert not _outside(out.input, d[:, :-1]).any()
    assert not (out.status & int(gx.Status.CONFLICT)).any()


def test_boxes_are_near_the_exact_hull(run):
    """The hull of the states that agree with a record, on a grid of its own (no box of the library enters it)."""
    x, y = (part[:, :STEPS] for part in example_hull._records(CASE, RUNS))
    hull = example_hull.last_hulls(x, y, LOW, HIGH, 25)
    width = run(y).state.width[:, -1]
    assert (width >= hull - 1e-9).all()
    assert (width.mean(0) <= 1.02 * hull.mean(0)).all(), width.mean(0) / hull.mean(0)
    whole = CASE.design(missing=False)
    wide = jax.vmap(lambda row: gx.estimate(whole, CASE.initial, row).state.width[-1])(y)
    assert (np.asarray(wide).mean(0) >= 1.04 * hull.mean(0)).all(), "without cells there is no room to gain"


def test_step_is_the_same(small):
    y = np.array([[1.0, 2.0, 0.6], [0.9, np.nan, 0.6], [1.2, 0.3, 0.4]])
    box = gx.estimate(small, Interval.symmetric([3.0]), y).state
    carry, out = gx.start(small, Interval.symmetric([3.0]), y[0])
    for k in range(3):
        np.testing.assert_allclose(out.state.lower, box.lower[k], rtol=0, atol=1e-12)
        np.testing.assert_allclose(out.state.upper, box.upper[k], rtol=0, atol=1e-12)
        if k < 2:
            carry, out = gx.step(small, carry, y[k + 1])


@pytest.fixture(scope="module")
def small():
    """A small plant with a measured input; two outputs are bent, so data may contradict each other."""
    plant = gx.System(
        lambda x: 0.8 * x + 0.1 * jnp.sin(x), lambda x: jnp.stack([x[0] + 0.3 * jnp.sin(x[0]), x[0], jnp.cos(x[0])]),
        G=[[1.0]], H=[[0.0], [1.0], [0.0]],
    )  # fmt: skip
    noise = gx.Noise(Interval.symmetric([0.2]), Interval.symmetric([0.3, 0.3, 0.1]))
    found = gx.design_observer(plant, noise, Interval.symmetric([3.0]), window=1, sweeps=1, cells=3)
    assert found.cells == found.past_cells == (3,)
    return found


def test_gaps_and_conflicts(small):
    """Lost outputs and rows leave boxes right; a wrong output is found, and boxes are right behind it."""
    rng = np.random.default_rng(2)
    runs, steps, wrong = 200, 30, 20
    x, d = rng.uniform(-3, 3, runs), rng.normal(size=(runs, steps))
    states, seen = [], []
    for k in range(steps):
        states.append(x)
        v = rng.uniform(-1, 1, (runs, 3)) * [0.3, 0.3, 0.1]
        seen.append(np.stack([x + 0.3 * np.sin(x), x + d[:, k], np.cos(x)], -1) + v)
        x = 0.8 * x + 0.1 * np.sin(x) + d[:, k] + rng.uniform(-0.2, 0.2, runs)
    true, y = np.stack(states, 1), np.stack(seen, 1)
    y[rng.random(y.shape) < 0.1] = np.nan
    y[:, 10] = np.nan
    y[:100, wrong, 2] = 5.0  # a cosine
    found = jax.vmap(lambda row: gx.estimate(small, Interval.symmetric([3.0]), row))(y)
    box = jax.tree.map(np.asarray, found.state)
    inside = ((box.lower[..., 0] <= true) & (true <= box.upper[..., 0])) | (np.arange(steps) == wrong)
    assert inside.all()
    conflict = (np.asarray(found.status) & int(gx.Status.CONFLICT)) != 0
    assert conflict[:100, wrong].all()
    assert not conflict[100:].any()
    assert np.isfinite(box.width[:, -1]).mean() > 0.8


def test_the_gradient_is_that_of_differences(small):
    """Of the last width by the noise."""
    y = np.array([[1.0, 2.0, 0.6], [0.9, 1.1, 0.6], [1.2, 0.3, 0.4], [1.1, 1.4, 0.5]])

    def width(share):
        scaled = jax.tree.map(lambda side: share * side, small.noise)
        return gx.estimate(small, Interval.symmetric([3.0]), y, noise=scaled).state.width[-1, 0]

    step = 1e-6
    difference = (width(1.0 + step) - width(1.0 - step)) / (2 * step)
    assert difference > 0.1
    np.testing.assert_allclose(in_numpy(jax.grad(width))(1.0), difference, rtol=1e-5)


def test_free_rows_cancel_the_input(observer):
    """In fractions: what is left is at most what the design says, and parallel rows are multiples to that bound."""
    free = FreeRows.of(observer)
    assert len(free.directions) == 1
    assert len(free.weights) >= 4
    stacked = [[Fraction(v) for v in row] for row in np.vstack([G, H])]
    for row, lost, share, error in zip(free.weights, free.lost, free.shares, free.errors, strict=True):
        exact = [Fraction(v) for v in row]
        for j in range(2):
            assert abs(sum(a * line[j] for a, line in zip(exact, stacked, strict=True))) <= Fraction(lost[j])
        for a, b, e in zip(row[:2], free.directions[0], error, strict=True):
            assert abs(Fraction(a) - Fraction(share) * Fraction(b)) <= Fraction(e)


def test_an_affine_plant_is_not_cut():
    plant = gx.System(lambda x: 0.9 * x, lambda x: x, G=[[1.0], [0.0]], H=np.zeros((2, 1)))
    noise = gx.Noise(Interval.symmetric([0.1, 0.1]), Interval.symmetric([0.1, 0.1]))
    found = gx.design_observer(plant, noise, Interval.entire(2), missing=False, window=1, cells=16)
    assert found.cells == found.past_cells == ()
