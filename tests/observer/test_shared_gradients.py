"""Gradients through `jax.vmap` by what its cases share: noise, record, known input or initial box.

Each against forward mode, central differences and the sum of the gradients of single cases.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles.uncompiled import in_numpy

import gsisio_jax as gx
from gsisio_jax.tuning import fold

NAMES = ("lower", "upper", "w", "v", "y", "u")
CASES, ROWS = 3, 3
QUICK = {"u_region": gx.Interval.symmetric([1.0]), "sweeps": 1, "bounds": ["affine"]}


def scalar_plant():
    system = gx.System(
        lambda x, u: 0.9 * x + 0.1 * u, lambda x, u: x + 0.02 * x * x, G=np.zeros((1, 0)), H=np.zeros((1, 0)), m=1
    )
    noise = gx.Noise(gx.Interval.symmetric([0.02]), gx.Interval.symmetric([0.1]))
    return gx.design_observer(system, noise, gx.Interval.symmetric([1.5]), **QUICK), 1


def two_states():
    system = gx.System(
        lambda x, u: jnp.stack([0.9 * x[0] + 0.1 * x[1] + 0.1 * u[0], 0.8 * x[1] + 0.1 * jnp.sin(x[0])]),
        lambda x, u: x, G=[[0.0], [1.0]], H=[[0.0], [0.0]], m=1,
    )  # fmt: skip
    noise = gx.Noise(gx.Interval.symmetric([0.02, 0.03]), gx.Interval.symmetric([0.1, 0.15]))
    return gx.design_observer(system, noise, gx.Interval.symmetric([2.0, 2.0]), **QUICK), 2


@pytest.fixture(scope="module")
def plants():
    return scalar_plant(), two_states()


def through_estimate(observer, p):
    est = gx.estimate(observer, box(p), p["y"], u=p["u"], noise=noise(p))
    return jnp.concatenate([est.state.lower[-1], est.state.upper[-1], est.state.width[0]])


def through_steps(observer, p):
    carry, first = gx.start(observer, box(p), p["y"][0], u0=p["u"][0], noise=noise(p))
    out = first
    for k in range(1, ROWS):
        carry, out = gx.step(observer, carry, p["y"][k], u_k=p["u"][k], noise=noise(p))
    return jnp.concatenate([out.state.lower, out.state.upper, first.state.width])


def through_fold(observer, p):
    def update(state, out, k):
        return state + jnp.concatenate([out.state.lower * k, out.state.upper, out.state.width])

    start = jnp.zeros(3 * observer.system.n)
    return fold(observer, box(p), p["y"], update, start, u=p["u"], noise=noise(p))


def box(p):
    return gx.Interval(p["lower"], p["upper"])


def noise(p):
    return gx.Noise(gx.Interval(-p["w"], p["w"]), gx.Interval(-p["v"], p["v"]))


def drawn(random, n, name, lead):
    """The first row cuts nothing off the initial box, the last one cuts from above: every argument moves the result."""
    state = {"lower": np.full(n, 0.03), "upper": 0.12 + 0.02 * np.arange(n), "w": np.full(n, 0.02)}
    y = np.stack([np.full(n, 0.08), np.full(n, 0.06), np.full(n, 0.0)])
    middle = {**state, "v": np.full(n, 0.1), "y": y, "u": np.full((ROWS, 1), 0.1)}[name]
    return middle + 0.005 * random.uniform(-1, 1, (*lead, *middle.shape))


def check(plant, through, *levels, alone=False):
    """`levels`: the names that each batch maps over, the inner batch first. `alone`: also against single cases."""
    observer, n = plant
    random = np.random.default_rng(0)
    sizes = {name: tuple(CASES - i for i, mapped in list(enumerate(levels))[::-1] if name in mapped) for name in NAMES}
    point = {name: drawn(random, n, name, sizes[name]) for name in NAMES}
    along = {name: random.uniform(0.5, 1.5, value.shape) for name, value in point.items()}
    weights = random.uniform(0.5, 1.5, (*(CASES - i for i in range(len(levels))[::-1]), 3 * n))

    def mapped(function, *more):
        for names in levels:
            function = jax.vmap(function, ({name: 0 if name in names else None for name in NAMES}, *more))
        return function

    def total(p):
        return (weights * mapped(partial(through, observer))(p)).sum()

    def moved(t):
        return total({name: value + t[i] * along[name] for i, (name, value) in enumerate(point.items())})

    def single(p, weight):
        return weight @ through(observer, p)

    def derivatives(p):
        return jax.grad(total)(p), mapped(jax.grad(single), 0)(p, weights) if alone else None

    found, of_cases = in_numpy(derivatives)(point)
    forward = in_numpy(jax.jacfwd(moved))(np.zeros(len(NAMES)))
    value, h = in_numpy(moved), 1e-6
    central = [(value(h * unit) - value(-h * unit)) / (2 * h) for unit in np.eye(len(NAMES))]
    backward = [np.vdot(found[name], along[name]) for name in NAMES]
    np.testing.assert_allclose(backward, forward, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(backward, central, rtol=1e-5, atol=1e-7)
    for name in NAMES if alone else ():
        shared = [axis for axis, names in enumerate(levels[::-1]) if name not in names]
        np.testing.assert_allclose(found[name], np.sum(of_cases[name], tuple(shared)), rtol=1e-9, atol=1e-12)
    assert (np.abs(forward) > 1e-3).all(), "every argument moves the result"


@pytest.mark.parametrize("shared", [["lower", "upper"], ["w"], ["v"], ["y"], ["u"]])
def test_one_is_shared(plants, shared):
    check(plants[0], through_estimate, [name for name in NAMES if name not in shared])


@pytest.mark.parametrize("names", [["lower", "upper"], ["y"]])
def test_two_states(plants, names):
    """Many boxes for one record, and many records from one box."""
    check(plants[1], through_estimate, names, alone=True)


def test_nothing_is_shared(plants):
    check(plants[0], through_estimate, NAMES, alone=True)


def test_nested(plants):
    """Many records for each of many boxes, under one noise and one input."""
    check(plants[0], through_estimate, ["lower", "upper"], ["y"])


@pytest.mark.parametrize("through", [through_steps, through_fold])
def test_other_ways_to_run(plants, through):
    check(plants[0], through, ["lower", "upper"])
