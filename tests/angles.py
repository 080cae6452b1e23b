"""Plants with headings that are logged in (-pi, pi]: what turns them, and how much of it is known, differs.

`wrapped` is the log of a sensor, by NumPy; every plant also exists without `periodic`, which is the oracle for a log
that was never wrapped.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from systems import Case, ball, s9

import gsisio_jax as gx
from gsisio_jax import Interval

TURN = 2 * np.pi


def _unicycle_f(x, u):
    return jnp.stack([x[0] + 0.3 * jnp.cos(x[2]), x[1] + 0.3 * jnp.sin(x[2]), x[2] + u[0]])


def _identity(x):
    return x


def robot(**periods: Any) -> Case:
    """A unicycle, its turn rate known, that slips by any distance; position and heading are measured."""
    slip = np.eye(3)[:, :2]
    return Case(
        system=gx.System(_unicycle_f, _identity, G=slip, H=np.zeros((3, 2)), m=1, **periods),
        noise=gx.Noise(w=ball([0.01, 0.01, 0.01]), v=Interval([-0.05, -0.05, -0.03], [0.05, 0.05, 0.06])),
        initial=Interval([-1.0, -1.0, 0.2], [1.0, 1.0, 0.8]),
        region=Interval.entire(3),
        steps=200,
        d=lambda key, steps: jax.random.normal(key, (steps, 2)),
        u=lambda steps: 0.2 + 0.15 * np.sin(np.arange(steps) / 7)[:, None],
        u_region=Interval([0.0], [0.4]),
    )


def _spun_f(x):
    return jnp.stack([x[0] + 0.1 * x[1], x[1]])


def _spun_g(x):
    return jnp.stack([x[0], x[1], x[0] + 0.05 * jnp.sin(x[0])])


def spun(**periods: Any) -> Case:
    """A heading and its rate, turned by any torque; a gyroscope, and two compasses, of which one deviates."""
    return Case(
        system=gx.System(_spun_f, _spun_g, G=[[0.005], [0.1]], H=np.zeros((3, 1)), **periods),
        noise=gx.Noise(w=ball([1e-3, 1e-3]), v=ball([0.05, 0.02, 0.04])),
        initial=Interval([2.0, -1.0], [4.0, 3.0]),
        region=Interval.entire(2),
        steps=200,
        d=lambda key, steps: 3 * jax.random.normal(key, (steps, 1)),
    )


def _dial_f(x, u):
    return x + u


def dial(**periods: Any) -> Case:
    """A heading with a known rate and no unknown input: small to compile."""
    return Case(
        system=gx.System(_dial_f, _identity, G=np.zeros((1, 0)), H=np.zeros((1, 0)), m=1, **periods),
        noise=gx.Noise(w=ball([0.01]), v=Interval([-0.03], [0.06])),
        initial=Interval([0.2], [0.8]),
        region=Interval.entire(1),
        steps=200,
        d=lambda key, steps: jnp.zeros((steps, 0)),
        u=lambda steps: 0.2 + 0.15 * np.sin(np.arange(steps) / 7)[:, None],
        u_region=Interval([0.0], [0.4]),
    )


def bearings(**periods: Any) -> Case:
    """S9 with logged bearings: the unknown input turns the heading, by any angle."""
    case = s9()
    plant = case.system
    system = gx.System(plant.f, plant.g, plant.G, plant.H, state_bounds=plant.state_bounds, **periods)
    return replace(case, system=system)


OUTPUTS = {"dial": (0,), "robot": (2,), "spun": (0, 2), "bearings": (1, 3)}
STATES = {"dial": (0,), "robot": (2,), "spun": (0,), "bearings": (2,)}


@dataclass
class Plant:
    """A plant whose log wraps, and the same without `periodic`."""

    name: str
    case: Case
    plain: Case
    observer: gx.Observer

    @cached_property
    def plain_observer(self) -> gx.Observer:
        return self.plain.design()


@cache
def made(name: str, states: bool) -> Plant:
    """Its gains are those for missing entries either way; what a lost row takes is not looked at here."""
    make = {"dial": dial, "robot": robot, "spun": spun, "bearings": bearings}[name]
    periods: dict[str, Any] = {"periodic": dict.fromkeys(OUTPUTS[name], TURN)}
    if states:
        periods["periodic_states"] = dict.fromkeys(STATES[name], TURN)
    case, plain = make(**periods), make()
    return Plant(name, case, plain, case.design(missing=False))


def wrapped(y: Any, outputs: tuple[int, ...]) -> np.ndarray:
    """The log in (-pi, pi]."""
    y = np.array(y)
    for j in outputs:
        y[..., j] = np.pi - np.mod(np.pi - y[..., j], TURN)
    return y


def records(case: Case, count: int, share: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x (count, T, n), y (count, T, l), unwrapped, and d (count, T, p), with noise in that share of its bounds."""
    noise = jax.tree.map(lambda side: share * side, case.noise)
    keys = jax.random.split(jax.random.key(7), count)
    runs, d = jax.vmap(lambda key: case.simulate(key, noise))(keys)
    return np.array(runs.x)[:, :-1], np.array(runs.y), np.array(d)


def batch(observer, initial, y, u=None, **options):
    """`estimate` of many records, in NumPy."""

    def one(y):
        return gx.estimate(observer, initial, y, u, **options)

    return jax.tree.map(np.asarray, jax.vmap(one)(y))


def known_inputs(case, dtype=np.float64) -> Any:
    return np.asarray(case.u(case.steps), dtype) if case.system.m else None


def same(a, b, tolerance):
    for got, expected in zip(jax.tree.leaves((a.state, a.input)), jax.tree.leaves((b.state, b.input)), strict=True):
        np.testing.assert_allclose(got, expected, rtol=tolerance, atol=tolerance)


def held(plant, x, est):
    """Up to whole periods, which round where they are added to the truth."""
    return est.state.contains(np.asarray(gx.nearest(plant.observer, x, est)), -1e-12)


def bits(est, status):
    return (np.asarray(est.status) & status) > 0
