"""A compass beside ranges: outputs that are bounded over arrays, where choosing the multiple is a loop of two turns."""

from __future__ import annotations

import angles
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from angles import TURN

import gsisio_jax as gx
from gsisio_jax import Interval, Status
from gsisio_jax.observer.maps import Maps

BEACONS = np.array([[0.0, 0.0], [60.0, 0.0], [0.0, 60.0]])  # m
STEPS, LOST = 5, 3


def _outputs(x):
    return jnp.stack([*(jnp.hypot(x[0] - a, x[1] - b) for a, b in BEACONS), x[2]])


@pytest.fixture(scope="module")
def plant():
    """A boat that any current moves; its heading, which the compass wraps, is known to drift slowly."""
    return gx.System(
        lambda x: x, _outputs, G=[[0.1, 0], [0, 0.1], [0, 0]], H=np.zeros((4, 2)), periodic={3: TURN},
        periodic_states={2: TURN}, state_bounds=Interval([-100, -100, -np.inf], [100, 100, np.inf]),
    )  # fmt: skip


@pytest.mark.parametrize(("cells", "sweeps"), [("auto", 1), (1, 2), (16, 1)])
def test_a_position_and_a_heading_are_held(plant, cells, sweeps):
    noise = gx.Noise(Interval.symmetric([0.01, 0.01, 0.005]), Interval.symmetric([0.3, 0.3, 0.3, 0.1]))
    region = Interval([5, 5, -4], [50, 50, 4.0])
    observer = gx.design_observer(plant, noise, region, missing=False, cells=cells, sweeps=sweeps)
    assert Maps.of(observer, np.float64).expansion is None  # what this is about
    assert bool(observer.cells) == (cells != 1)
    d = np.random.default_rng(0).uniform(-20, 20, (STEPS, 2))
    run = gx.simulate(plant, jax.random.key(1), [20.0, 30.0, 3.1], d, noise)
    x, y = np.asarray(run.x)[:-1], angles.wrapped(run.y, (3,))
    y[LOST, 3] = np.nan
    assert abs(y[~np.isnan(y[:, 3]), 3]).max() <= np.pi
    est = gx.estimate(observer, Interval([5, 5, 2], [50, 50, 4.0]), y, rounding="outward")
    assert not angles.bits(est, Status.CONFLICT).any()
    assert est.state.contains(np.asarray(gx.nearest(observer, x, est)), -1e-12).all()
    width = np.asarray(est.state.width)
    assert np.isfinite(width).all()
    assert (width[:, 2] <= 0.3).all()  # two bounds of the compass, and a row without it
    assert (width[:, :2] < (4.0 if cells != 1 else 200.1)).all()
