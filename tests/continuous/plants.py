"""Continuous plants, and what an accurate integration says of a discrete map of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from oracles.uncompiled import in_numpy
from scipy.integrate import solve_ivp

import gsisio_jax as gx
from gsisio_jax import Interval

ACCURACY = 2e-12  # of the integration, in the units of these states


def pendulum(x):
    return jnp.stack([x[1], -9.81 * jnp.sin(x[0]) - 0.3 * x[1]])


def lorenz(x):
    return jnp.stack([10 * (x[1] - x[0]), x[0] * (28 - x[2]) - x[1], x[0] * x[1] - 8 / 3 * x[2]])


def tanks(x, u):
    return jnp.stack([u[0] - 0.3 * jnp.sqrt(x[0]), 0.3 * jnp.sqrt(x[0]) - 0.2 * jnp.sqrt(x[1])])


def drag(x):
    return jnp.stack([x[1], -0.4 * x[1] * jnp.abs(x[1]) - jnp.maximum(x[0], 0)])


def motor(x, u):
    return jnp.stack([x[1], -2.0 * x[0] - 0.5 * x[1] + 3.0 * u[0]])


def reactor(x, u):
    """Biomass and substrate, growth with inhibition: a pole at a substrate below 0, which an enclosure soon reaches."""
    growth = 0.4 * x[1] / (0.5 + x[1] + x[1] ** 2 / 20) * x[0]
    return jnp.stack([growth - u[0] * x[0], -2 * growth - u[0] * x[1]])


@dataclass
class Case:
    """Arguments of `gx.discretize`, and how the plant is driven."""

    f: Callable[..., Any]
    dt: float
    method: str
    region: Interval
    options: dict[str, Any] = field(default_factory=dict)
    most: float = np.inf  # the bound over the largest error that is ever seen, at most

    def model(self, **more: Any) -> gx.Discretization:
        return gx.discretize(self.f, self.dt, self.method, region=self.region, **self.options, **more)


def _box(*sides: float) -> Interval:
    return Interval(np.array(sides[::2]), np.array(sides[1::2]))


SWING, ATTRACTOR = _box(-1, 1, -2, 2), _box(-15, 15, -20, 20, 5, 40)
LEVELS, FLOW = {"u_bounds": _box(0.2, 0.5)}, _box(1, 4, 1, 4)
PUSHED = {"G": [[0.0], [1.0]], "input_bounds": _box(-2, 3)}
SHAKEN = {"disturbance": _box(-0.02, 0.05, -0.5, 0.3)}
NOT_NEGATIVE = Interval(np.zeros(2), np.full(2, np.inf))
FED = {"u_bounds": _box(0, 0.4), "G": [[0.0], [1.0]], "input_bounds": _box(0, 6), "state_bounds": NOT_NEGATIVE}
CASES = {
    "pendulum, Euler": Case(pendulum, 0.01, "euler", SWING, most=1.2),
    "pendulum, Taylor": Case(pendulum, 0.01, "taylor", SWING, most=1.8),
    "pendulum, Taylor 3, cells": Case(pendulum, 0.02, "taylor", SWING, {"order": 3, "cells": [2, 1]}, most=1.8),
    "pendulum, Runge-Kutta": Case(pendulum, 0.02, "rk4", SWING, most=40),
    "pendulum, pushed, Euler": Case(pendulum, 0.01, "euler", SWING, PUSHED, most=1.4),
    "pendulum, pushed, Taylor": Case(pendulum, 0.01, "taylor", SWING, PUSHED, most=2.5),
    "pendulum, pushed, Runge-Kutta": Case(pendulum, 0.02, "rk4", SWING, PUSHED, most=60),
    "pendulum, shaken": Case(pendulum, 0.01, "taylor", SWING, {**SHAKEN, **PUSHED}, most=1.5),
    "Lorenz, Euler": Case(lorenz, 0.005, "euler", ATTRACTOR, most=2.2),
    "Lorenz, Taylor": Case(lorenz, 0.005, "taylor", ATTRACTOR, most=3),
    "tanks, Taylor": Case(tanks, 0.1, "taylor", FLOW, LEVELS, most=6),
    "tanks, Runge-Kutta": Case(tanks, 0.1, "rk4", FLOW, LEVELS),
    "drag, Euler": Case(drag, 0.02, "euler", _box(-1, 1, -3, 3), most=2.5),
    "reactor, Euler, cells": Case(reactor, 0.1, "euler", _box(1, 8, 0.05, 6), {**FED, "cells": [2, 4]}, most=16),
    "motor, hold": Case(motor, 0.1, "zoh", SWING, {"u_bounds": _box(-1, 1), **PUSHED}),
    "motor, hold, shaken": Case(motor, 0.1, "zoh", SWING, {"u_bounds": _box(-1, 1), **PUSHED, **SHAKEN}, most=1.5),
}
# Left to the soak, which takes all cases.
SLOW = (
    "pendulum, Runge-Kutta",
    "pendulum, pushed, Taylor",
    "tanks, Runge-Kutta",
    "pendulum, pushed, Euler",
    "Lorenz, Euler",
)


def errors(case: Case, model: gx.Discretization, count: int, seed: int = 0) -> np.ndarray:
    """``x(t + dt) - f(x, u) - G d`` for random states, inputs and disturbances, half of them at the ends of what
    they may be.
    """
    rng, n = np.random.default_rng(seed), model.region.shape[0]

    def draw(box: Interval | None) -> np.ndarray:
        if box is None:
            return np.zeros((count, 0))
        low, high = np.asarray(box.lower), np.asarray(box.upper)
        inner = rng.uniform(low, high, (count, len(low)))
        ends = np.where(rng.random(inner.shape) < 0.5, low, high)
        return np.where(rng.random(inner.shape) < 0.5, ends, inner)

    x, u, d = draw(model.region), draw(model.u_bounds), draw(model.input_bounds)
    G = np.asarray(case.options.get("G", np.zeros((n, 0))))
    call = jax.vmap(case.f) if model.u_bounds is None else jax.vmap(case.f, (0, 0))
    args = () if model.u_bounds is None else (u,)
    rate = in_numpy(call)
    disturbance, end, parts = case.options.get("disturbance"), x, 1
    if disturbance is not None:
        parts = 3  # w(t) jumps twice within a step
    for _ in range(parts):
        w = draw(disturbance) if disturbance is not None else 0.0
        pushed = d @ G.T + w

        def flow(t: float, flat: np.ndarray, pushed: Any = pushed) -> np.ndarray:
            return (rate(flat.reshape(x.shape), *args) + pushed).ravel()

        found = solve_ivp(flow, (0, case.dt / parts), end.ravel(), method="DOP853", rtol=1e-13, atol=1e-14)
        end = found.y[:, -1].reshape(x.shape)
    step = in_numpy(jax.vmap(model.f))(x, *args)
    entered = 0 if model.G is None else d @ model.G.T
    return end - step - entered


def check(case: Case, model: gx.Discretization, count: int, seed: int = 0) -> np.ndarray:
    """The bound holds, and is no larger than said; returns its size over that of the largest error, state by state."""
    found = errors(case, model, count, seed)
    low, high = np.asarray(model.error.lower), np.asarray(model.error.upper)
    outside = np.maximum(low - found, found - high).max(0)
    assert (outside <= ACCURACY).all(), f"an error lies outside of its bound by {outside}"
    ratio = np.maximum(-low, high) / np.maximum(abs(found).max(0), ACCURACY)
    assert (ratio <= case.most).all(), f"the bound is {ratio} times the largest error"
    return ratio


def broken(model: gx.Discretization, by: float) -> gx.Discretization:
    """The model with a bound that is too small."""
    return replace(model, error=Interval(by * np.asarray(model.error.lower), by * np.asarray(model.error.upper)))
