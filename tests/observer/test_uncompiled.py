"""What most tests run in NumPy is what XLA computes: observers of many kinds, whole records, single steps, batches."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import systems
import target
from models.gallery import MODELS
from models.runner import records
from oracles import uncompiled as oracle
from oracles.uncompiled import uncompiled

import gsisio_jax as gx
from gsisio_jax import Interval

COMPILED = True


def _plant(name, **options):
    """A plant of the gallery and a record of it that loses measurements and is struck once."""
    model = MODELS[name]()
    options = model.design | {"sweeps": 1, "missing": False} | options
    observer = gx.design_observer(model.system, model.noise, model.region, u_region=model.u_region, **options)
    run = records(model)[0]
    y = run.y[:12].copy()
    y[4] = np.nan
    y[9, 0] += 1e3
    return observer, model.initial, y, run.u[:12] if model.system.m else None


def _cart(delay=None, lost=False, **known):
    system = gx.System(lambda x: [x[0] + 0.1 * x[1], x[1]], lambda x: x[:1], [[0.005], [0.1]], [[0.0]], **known)
    noise = gx.Noise(Interval.symmetric([1e-3, 1e-3]), Interval.symmetric([0.1]))
    options = {} if delay is None else {"delay": delay}
    observer = gx.design_observer(system, noise, Interval.symmetric([5.0, 5.0]), missing=lost, **options)
    y = np.cumsum(np.full((12, 1), 0.05), axis=0)
    y[5] = np.nan
    y[9] += 30
    return observer, Interval.symmetric([1.0, 1.0]), y, None


def _target():
    mover = target.design()
    y = mover.simulate(0, 1)[1][0, :12]
    y[4, 0], y[6], y[9] = np.nan, np.nan, 1e3
    return mover.observer, mover.initial, y, None


@cache
def _s1(**options):
    case = systems.s1()
    run, _ = case.simulate(jax.random.key(0))
    return case.design(missing=False, **options), case.initial, np.asarray(run.y)[:12], None


def _bent():
    """Both boxes are cut into cells; small, as XLA takes most of the time of this module."""
    system = gx.System(
        lambda x: jnp.stack([0.9 * x[0] + 0.1 * x[1], 0.8 * x[1] + 0.1 * jnp.sin(x[0])]),
        lambda x: jnp.stack([x[0] + 0.3 * jnp.sin(x[0] + x[1]), x[1] + 0.3 * jnp.cos(x[0]), x[0]]),
        [[0.0], [1.0]], np.zeros((3, 1)),
    )  # fmt: skip
    noise = gx.Noise(Interval.symmetric([0.05] * 2), Interval.symmetric([0.2] * 3))
    options = {"missing": False, "window": 1, "sweeps": 1}
    observer = gx.design_observer(system, noise, Interval.symmetric([2.0, 2.0]), cells=4, **options)
    assert observer.cells == observer.past_cells == (2, 2)
    y = np.tile([0.0, 0.3, 0.0], (12, 1))
    y[4], y[9, 0] = np.nan, 30.0
    return observer, Interval.symmetric([1.0, 1.0]), y, None


def _one_state():
    system = gx.System(lambda x: 0.8 * x + 0.1 * jnp.sin(x), lambda x: jnp.stack([x[0] + 0.3 * jnp.sin(x[0]), x[0]]),
                       [[1.0]], [[0.0], [1.0]])  # fmt: skip
    noise = gx.Noise(Interval.symmetric([0.2]), Interval.symmetric([0.3, 0.3]))
    options = {"missing": False, "window": 1, "sweeps": 1}
    observer = gx.design_observer(system, noise, Interval.symmetric([3.0]), **options)
    return observer, Interval.symmetric([3.0]), np.array([[0.5, 0.2], [9.0, 0.3]])


CASES = {
    "one gain": _s1,
    "two sweeps": lambda: _s1(sweeps=2),
    "bank, window": _target,
    "delay": lambda: _cart(delay="auto"),
    "input in blocks": lambda: _cart(delay="auto", input_constant=3),
    "periodic": partial(_plant, "heading"),
    "table": partial(_plant, "battery"),
    "arrays": partial(_plant, "network_tanh"),
    "cells": _bent,
}


def _same(own, other):
    """Equal, but for sums that are taken in another order."""
    for a, b in zip(jax.tree.leaves(own), jax.tree.leaves(other), strict=True):
        a, b = np.asarray(a), np.asarray(b)
        assert a.dtype == b.dtype
        if a.dtype.kind == "f":
            near = 2.0**13 * np.finfo(a.dtype).eps
            np.testing.assert_allclose(a, b, rtol=near, atol=near)
        else:
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("name", CASES)
def test_records(name):
    observer, initial, y, u = CASES[name]()
    compiled = gx.estimate(observer, initial, y, u)
    assert np.asarray(compiled.status).any() or name in ("one gain", "two sweeps")
    with uncompiled():
        _same(gx.estimate(observer, initial, y, u), compiled)


def test_single_precision_and_steps():
    observer, initial, y = _one_state()
    initial, y = initial.astype(np.float32), y.astype(np.float32)

    def run():
        carry, first = gx.start(observer, initial, y[0])
        return first, gx.step(observer, carry, y[1], on_conflict="hold")

    compiled = run()
    assert compiled[1][1].status & gx.Status.CONFLICT
    with uncompiled():
        _same(run(), compiled)


@pytest.mark.parametrize("most", [oracle.MOST_SECONDS, 0])
def test_batches(most, monkeypatch):
    """One by one, and as arrays."""
    monkeypatch.setattr(oracle, "MOST_SECONDS", most)
    count = 3
    observer, initial, y, _ = _s1()
    rows = jnp.asarray(y[:4] + np.linspace(-0.1, 0.1, count)[:, None, None])
    boxes = Interval(*(jnp.linspace(1, 1.2, count)[:, None] * side for side in (initial.lower, initial.upper)))

    def run():
        return jax.vmap(partial(gx.estimate, observer))(boxes, rows)

    compiled = run()
    with uncompiled():
        _same(run(), compiled)
