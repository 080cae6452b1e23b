"""Input boxes are exact for the box of [G; H] d (paper, Lemma 3 as it should be): against linear programs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import systems
from oracles.input_hull import feasibility_slack, input_hull

import gsisio_jax as gx
from gsisio_jax import Interval
from gsisio_jax.interval.image import image
from gsisio_jax.observer.domain import Domain
from gsisio_jax.observer.input_boxes import exact_input


def plant(input_bounds=None):
    """Three states, three outputs, two inputs that enter nearly everything: a tall [G; H] without zeros."""
    A = np.array([[0.5, 0.1, 0.0], [0.2, 0.4, 0.1], [0.0, 0.3, 0.6]])
    system = gx.System(
        lambda x: jnp.asarray(A, x.dtype) @ x, lambda x: x,
        G=[[1.0, 0.5], [0.2, -1.0], [-0.4, 0.3]], H=[[0.7, 0.0], [0.3, 1.0], [1.0, -0.6]], input_bounds=input_bounds,
    )  # fmt: skip
    return system, gx.Noise(systems.ball([0.05, 0.1, 0.02]), systems.ball([0.1, 0.03, 0.2]))


def explained(observer, lower, upper):
    """The observer's box of d and its conflict for a given box of [G; H] d."""
    domain = Domain.of(Interval.entire(observer.system.n), jnp.asarray(1.0))
    known = image(observer.bounded_inputs, observer.system.input_bounds)
    box, domain = exact_input(
        observer, domain, Interval.unchecked(lower, upper), known, observer.system.input_bounds, None, jnp.asarray(True)
    )
    return box, domain.conflict


@pytest.mark.parametrize("bound", [None, 0.4])
def test_exact_for_boxes_of_every_kind(bound):
    known = None if bound is None else Interval([-np.inf, -bound], [np.inf, bound])
    system, noise = plant(known)
    observer = gx.design_observer(system, noise, Interval.entire(3), missing=False, sweeps=1, window=1)
    assert observer.exact.complete
    S = np.vstack([system.G, system.H])
    random = np.random.default_rng(2)
    count = 150
    center = random.uniform(-0.5, 0.5, (count, 2)) @ S.T + 0.3 * random.standard_normal((count, 6))
    radius = random.exponential(0.4, (count, 6))
    radius[random.random((count, 6)) < 0.2] = np.inf
    lower, upper = center - radius, center + radius
    boxes, conflicts = jax.vmap(lambda a, b: explained(observer, a, b))(lower, upper)
    limits = [(None, None), (None if bound is None else -bound, bound)]
    rows = S if bound is None else np.vstack([S, [0.0, 1.0]])
    feasible = 0
    for i in range(count):
        full = (lower[i], upper[i]) if bound is None else (np.append(lower[i], -bound), np.append(upper[i], bound))
        slack = feasibility_slack(rows, *full)
        if abs(slack) < 1e-6:
            continue
        assert bool(conflicts[i]) == (slack < 0)
        if slack > 0:
            feasible += 1
            low, high = input_hull(S, lower[i], upper[i], limits)
            np.testing.assert_allclose(boxes.lower[i], low, rtol=1e-7, atol=1e-7)
            np.testing.assert_allclose(boxes.upper[i], high, rtol=1e-7, atol=1e-7)
    assert 20 < feasible < count - 20


def test_rows_that_say_the_same_may_contradict_each_other():
    """No two bounds of d need to cross for that: every one of them also stands on a row that says next to nothing."""
    system = gx.System(lambda x: 0.5 * x, lambda x: x, G=[[1.0, 1.0], [2.0, 2.0]], H=[[1.0, 0.0], [0.0, 0.0]])
    noise = gx.Noise(systems.ball([0.1, 0.1]), systems.ball([0.1, 0.1]))
    observer = gx.design_observer(system, noise, Interval.entire(2), missing=False, sweeps=1, window=1)
    for second, possible in ((1.0, True), (6.0, False)):
        lower = np.array([0.0, second, -100.0, -100.0])
        box, conflict = explained(observer, lower, np.array([1.0, second + 1, 100.0, 100.0]))
        assert bool(conflict) == (not possible)
        assert (box.lower <= box.upper).all()


def test_boxes_of_a_run_are_no_wider_than_the_linear_program():
    """From the observer's own state boxes; joint bounds can only make them smaller."""
    system, noise = plant()
    observer = gx.design_observer(system, noise, Interval.entire(3), missing=False, sweeps=1, window=1)
    d = 2 * np.random.default_rng(3).standard_normal((12, 2))
    sim = gx.simulate(system, jax.random.key(0), np.zeros(3), d, noise)
    estimate = gx.estimate(observer, systems.ball([0.5] * 3), sim.y)
    assert estimate.input.contains(d[:-1], -1e-12).all()
    A, S = np.asarray(jax.jacobian(system.f)(jnp.zeros(3))), np.vstack([system.G, system.H])
    low, up = np.asarray(estimate.state.lower), np.asarray(estimate.state.upper)
    for k in range(1, 12):
        f_low, f_up = np.minimum(A * low[k - 1], A * up[k - 1]).sum(1), np.maximum(A * low[k - 1], A * up[k - 1]).sum(1)
        h_low = np.concatenate([low[k] - f_up - noise.w.upper, sim.y[k - 1] - up[k - 1] - noise.v.upper])
        h_up = np.concatenate([up[k] - f_low - noise.w.lower, sim.y[k - 1] - low[k - 1] - noise.v.lower])
        hull_low, hull_up = input_hull(S, h_low, h_up, [(None, None)] * 2)
        assert (estimate.input.lower[k - 1] >= hull_low - 1e-7).all()
        assert (estimate.input.upper[k - 1] <= hull_up + 1e-7).all()


def test_an_impossible_balance_is_an_alarm():
    """Four numbers, three unknown: a step of x that the measured inputs exclude."""
    noise = gx.Noise(systems.ball([0.01]), systems.ball([0.01, 0.01]))
    system = gx.System(lambda x: 0.0 * x, lambda x: jnp.stack([x[0], 0.0 * x[0]]), G=[[1.0]], H=[[0.0], [1.0]])
    observer = gx.design_observer(system, noise, Interval.entire(1), missing=False, sweeps=1)
    estimate = gx.estimate(observer, systems.ball([1.0]), [[0.0, 0.5], [0.5, 0.1], [0.6, 0.0]])
    alarms = estimate.alarms()
    assert [alarm.step for alarm in alarms] == [2]  # d[1] = .1 was seen, but x[2] = .6
    assert "input" in alarms[0].describe() or "agrees" in alarms[0].describe()
    assert alarms[0].gap == pytest.approx(0.5 - 0.03, abs=1e-9)
