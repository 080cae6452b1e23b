"""Cells together with logged headings and periodic states, with a delay, and with outputs that may be wrong."""

from __future__ import annotations

from dataclasses import replace

import angles
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from angles import TURN
from oracles import uncompiled

import gsisio_jax as gx
from gsisio_jax import Interval, Status
from gsisio_jax.observer import cells

RUNS, STEPS = 64, 12
ball = Interval.symmetric


@pytest.fixture(autouse=True, scope="module")
def all_records_at_once():
    """A step of cells takes ten milliseconds by itself, and hardly more over arrays of all records."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(uncompiled, "MOST_SECONDS", 0)
        yield


def draws(rng, radius, vertices):
    unit = rng.uniform(-1, 1, (RUNS, len(radius)))
    return np.asarray(radius) * np.where(vertices, np.sign(unit) * (1 - 1e-9), unit)


def simulated(f, g, G, noise, start, size):
    """x, y, d (RUNS, STEPS, .), noise at its vertices in half of the runs; f and g of rows, in NumPy."""
    rng = np.random.default_rng(4)
    vertices = (np.arange(RUNS) % 2 == 0)[:, None]
    x = start.center + draws(rng, start.width / 2, vertices)
    w, v = noise.w.width / 2, noise.v.width / 2
    xs, ys, ds = [], [], []
    for _ in range(STEPS):
        d = size * rng.normal(size=(RUNS, G.shape[1]))
        xs.append(x)
        ys.append(g(x) + draws(rng, v, vertices))
        ds.append(d)
        x = f(x) + d @ G.T + draws(rng, w, vertices)
    return tuple(np.stack(part, 1) for part in (xs, ys, ds))


def boxes(observer, start, y):
    run = jax.vmap(lambda y: gx.estimate(observer, start, y))
    return jax.tree.map(np.asarray, run(jnp.asarray(y)))


def mean_widths(est):
    return est.state.width[:, STEPS // 2 : -1].mean((0, 1))  # a delay leaves the last row open


def exact_hulls(grid, start, agrees, moved, w):
    """Hulls (RUNS, STEPS) of the points of a grid that agree with the record so far: none of them may be left out. NaN
    where no point does, as noise at a vertex leaves a set that falls between them.

    Args:
        grid: points in steps of one size.
        start: box of the first state.
        agrees: (RUNS, STEPS, points), with the measurements of a step.
        moved: f at the points.
        w: bound of the noise; less than that, by the size of a step, is added.
    """
    alive = np.tile((start.lower <= grid) & (grid <= start.upper), (RUNS, 1))
    low, high = [], []
    near = (abs(moved[:, None] - grid) <= w - (grid[1] - grid[0])).astype(np.float32)  # whole numbers are exact
    for k in range(STEPS):
        if k:
            alive = (alive.astype(np.float32) @ near) > 0
        alive = alive & agrees[:, k]
        low.append(np.where(alive.any(1), grid[alive.argmax(1)], np.nan))
        high.append(np.where(alive.any(1), grid[len(grid) - 1 - alive[:, ::-1].argmax(1)], np.nan))
    return np.stack(low, 1), np.stack(high, 1)


def assert_tight(lower, upper, low, high, ratio):
    """The hull is in the box, which on average is not so much wider, once the first steps are over."""
    some = np.isfinite(low)
    assert some.mean() > 0.4
    assert (lower[some] <= low[some]).all()
    assert (high[some] <= upper[some]).all()
    some[:, :2] = False
    assert (upper - lower)[some].mean() < ratio * (high - low)[some].mean()


# A heading that drifts; a compass logs it in (-pi, pi], and a sensor of six times its sine is better.


def _compass_g(x):
    return jnp.stack([x[0], jnp.sin(6 * x[0])])


COMPASS_NOISE = gx.Noise(ball([0.02]), ball([0.4, 0.1]))


@pytest.fixture(scope="module")
def compass():
    """A run, jitted over the first box."""
    none = np.zeros((1, 0))
    system = gx.System(
        lambda x: x, _compass_g, G=none, H=np.zeros((2, 0)), periodic={0: TURN}, periodic_states={0: TURN}
    )
    observer = gx.design_observer(system, COMPASS_NOISE, Interval.entire(1), cells=8, window=1)
    assert observer.cells == (8,)
    return jax.vmap(lambda start, y: gx.estimate(observer, start, y), (None, 0))


@pytest.mark.parametrize("start", [Interval([2.5], [3.3]), Interval([-np.inf], [np.inf])])
def test_logged_headings_and_a_periodic_state(compass, start):
    def g(x):
        return np.hstack([x, np.sin(6 * x)])

    x, y, _ = simulated(lambda x: x, g, np.zeros((1, 0)), COMPASS_NOISE, Interval([2.5], [3.3]), 0.0)
    est = jax.tree.map(np.asarray, compass(start, jnp.asarray(angles.wrapped(y, (0,)))))
    assert not (est.status & int(Status.CONFLICT)).any()
    turns = TURN * np.round((est.state.center - x) / TURN)
    assert est.state.contains(x + turns).all()
    grid = np.linspace(2.9 - np.pi, 2.9 + np.pi, 3000)
    agrees = (abs(y[:, :, None] - g(grid[:, None])) <= [0.4, 0.1]).all(-1)
    low, high = exact_hulls(grid, start, agrees, grid, 0.02)
    lower, upper = (side[..., 0] - turns[..., 0] for side in (est.state.lower, est.state.upper))
    assert_tight(lower, upper, low, high, 1.25)


# A pendulum under Euler, pushed by anybody; its angle is measured, and a sine of it better.


def _pendulum_f(x):
    return jnp.stack([x[0] + 0.1 * x[1], 0.98 * x[1] - 0.4 * jnp.sin(2 * x[0])])


PENDULUM_G = np.array([[0.0], [0.1]])
PENDULUM_NOISE = gx.Noise(ball([1e-3, 1e-2]), ball([0.4, 0.02]))
PENDULUM_START = ball([0.8, 1.0])


def _pendulum_g(x):
    return jnp.stack([x[0], jnp.sin(2 * x[0])])


def test_with_a_delay():
    def f(x):
        return np.stack([x[:, 0] + 0.1 * x[:, 1], 0.98 * x[:, 1] - 0.4 * np.sin(2 * x[:, 0])], 1)

    def g(x):
        return np.stack([x[:, 0], np.sin(2 * x[:, 0])], 1)

    x, y, d = simulated(f, g, PENDULUM_G, PENDULUM_NOISE, PENDULUM_START, 1.0)
    system = gx.System(_pendulum_f, _pendulum_g, G=PENDULUM_G, H=np.zeros((2, 1)))
    observer = gx.design_observer(
        system, PENDULUM_NOISE, ball([1.5, 3.0]), delay=1, cells=6, missing=False, certify=False
    )
    inner = observer.inner
    assert max(inner.cells) > 1
    est = boxes(observer, PENDULUM_START, y)
    whole = boxes(replace(observer, inner=replace(inner, cells=(), past_cells=())), PENDULUM_START, y)
    assert est.state.contains(x).all()
    assert est.input.contains(d[:, : est.input.lower.shape[1]]).all()
    assert (mean_widths(est) <= mean_widths(whole) * (1 + 1e-9)).all()
    assert (mean_widths(est) < 0.95 * mean_widths(whole)).any()


# A position on a line and three bent outputs, one of which may be wrong in any step.


def _line_g(x):
    return jnp.stack([x[0], jnp.sin(x[0]), x[0] + 0.5 * jnp.cos(2 * x[0])])


def test_with_outputs_that_may_be_wrong():
    def g(x):
        return np.hstack([x, np.sin(x), x + 0.5 * np.cos(2 * x)])

    noise, G, start = gx.Noise(ball([0.1]), ball([0.1, 0.1, 0.1])), np.zeros((1, 0)), ball([1.0])
    x, y, _ = simulated(lambda x: 0.9 * x, g, G, noise, start, 0.0)
    rng = np.random.default_rng(5)
    wrong = (rng.random((RUNS, STEPS)) < 0.4)[..., None] & (rng.integers(3, size=(RUNS, STEPS))[..., None] == range(3))
    y = np.where(wrong, y + 10 ** rng.uniform(-1.5, 1.5, y.shape), y)
    system = gx.System(lambda x: 0.9 * x, _line_g, G=G, H=np.zeros((3, 0)))
    observer = gx.design_observer(system, noise, ball([1.5]), tolerate=1, cells=4)
    est = boxes(observer, start, y)
    assert est.state.contains(x).all()
    grid = np.linspace(-1.5, 1.5, 3001)
    agrees = (abs(y[:, :, None] - g(grid[:, None])) <= 0.1).sum(-1) >= 2
    low, high = exact_hulls(grid, start, agrees, 0.9 * grid, 0.1)
    assert_tight(est.state.lower[..., 0], est.state.upper[..., 0], low, high, 1.4)


def test_an_infinite_box_has_cells():
    """One state is not cut where its box is infinite, the other one is; no corner is NaN."""
    box = Interval(jnp.array([-jnp.inf, 0.0, 0.0]), jnp.array([jnp.inf, 1.0, jnp.inf]))
    lower, upper = map(np.asarray, cells.cut_up(box, (2, 2, 2)))
    assert (lower == [[-np.inf, half, 0] for half in (0, 0, 0.5, 0.5) * 2]).all()
    assert (upper == [[np.inf, half, np.inf] for half in (0.5, 0.5, 1, 1) * 2]).all()
