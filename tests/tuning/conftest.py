"""Small plants that are cheap to compile, shared by the tests of tuning."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gsisio_jax as gx
from gsisio_jax.tuning import Records

A = np.array([[1.0, 0.1], [0.0, 1.0]])


@dataclass(frozen=True)
class Axis:
    """One axis of the double integrator: position and speed measured, acceleration unknown."""

    observer: gx.Observer
    initial: gx.Interval
    x: np.ndarray
    y: np.ndarray

    @property
    def records(self) -> Records:
        return Records(self.initial, self.y)


@pytest.fixture(scope="session")
def axis() -> Axis:
    system = gx.System(lambda x: jnp.asarray(A) @ x, lambda x: x, G=[[0.005], [0.1]], H=np.zeros((2, 1)))
    noise = gx.Noise(gx.Interval.symmetric([0.02, 0.05]), gx.Interval.symmetric([0.1, 0.05]))
    observer = gx.design_observer(system, noise, gx.Interval.entire(2), missing=False, sweeps=1)
    observer = observer.with_rounding("nearest")  # less to compile

    def one(key: Any) -> Any:
        keys = jax.random.split(key, 3)
        x0 = jax.random.uniform(keys[1], (2,), minval=-1, maxval=1)
        return gx.simulate(system, keys[0], x0, 3 * jax.random.normal(keys[2], (40, 1)), noise)

    run = jax.vmap(one)(jax.random.split(jax.random.key(0), 6))
    return Axis(observer, gx.Interval.symmetric(np.ones(2)), np.asarray(run.x), np.asarray(run.y))


@pytest.fixture(scope="session")
def small() -> gx.Observer:
    """One state, no unknown input: what costs the least to compile."""
    system = gx.System(lambda x: 0.9 * x, lambda x: x, G=np.zeros((1, 0)), H=np.zeros((1, 0)))
    noise = gx.Noise(gx.Interval.symmetric([0.05]), gx.Interval.symmetric([0.1]))
    return gx.design_observer(system, noise, gx.Interval.entire(1), missing=False, sweeps=1).with_rounding("nearest")
