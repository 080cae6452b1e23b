"""The plants of the soak, and their observers.

Linear ones of one to three states, with and without unknown inputs, whose feedthrough has full rank, no rank, or a
smaller one (on an axis, and across, as in the paper); one with constants; one that is quadratic; and the shapes of the
paper's example and of the six tanks."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import jax.numpy as jnp
import numpy as np
from oracles.enclosed_plant import Nonlinear
from oracles.exact_plant import Plant

import gsisio_jax as gx
from gsisio_jax import Interval

_A = np.array([[0.7, 0.21, 0.0], [-0.33, 0.5, 0.1], [0.1, 0.0, 0.6]])
_C = np.array([[1.0, 0.3, 0.0], [0.2, 1.0, 0.4], [0.1, -0.7, 1.0]])

LINEAR: dict[str, Plant] = {
    "three states": Plant(
        _A, _C, np.array([[1.0, 0.0], [0.49, 0.0], [-0.3, 0.0]]), np.array([[0.0, 0.0], [0.0, 0.0], [0.0, 1.0]])
    ),
    # The feedthrough of the paper, whose rank is 1 as decimals and 2 as floats.
    "feedthrough of rank one": Plant(
        _A, _C, np.array([[1.0, 0.3], [0.49, -0.2], [-0.3, 0.7]]), np.array([[-2.0, 6.0], [5.0, -15.0], [0.0, 0.0]]), 20
    ),
    "constants": Plant(
        np.array([[0.9, 1 / 103], [-0.2, 0.7]]), np.array([[1.1, 0.3], [1 / 49, 1.0]]), np.array([[1.0], [0.3]]),
        np.zeros((2, 1)), a=[0.1, -1 / 3], c=[100.1, 0.0],
    ),
    "no unknown input": Plant(np.array([[0.95]]), np.array([[1.1]]), np.zeros((1, 0)), np.zeros((1, 0)), c=[1.0]),
}  # fmt: skip
QUADRATIC = Plant(
    np.array([[0.6, 0.21], [-0.33, 0.5]]), np.array([[1.0, 0.3], [0.2, 1.0]]), np.array([[1.0], [0.5]]),
    np.zeros((2, 1)), squares=[(0, 0, 1, 0.02), (1, 0, 0, -0.03)],
)  # fmt: skip


def narrow(value: float) -> float:
    return float(np.float32(value))


def _waves(xp: Any, x: Any, u: Any) -> list[Any]:
    a, b, c, d, e, f, g = (narrow(v) for v in (0.6, -0.12, 1.1, 0.3, -0.2, -0.2, -0.14))
    return [a * x[0] + b * x[1] + c * xp.sin(d * x[1] + e * x[0]), f * x[0] + g * x[1]]


def _seen_waves(xp: Any, x: Any) -> list[Any]:
    a, b, c, d, e = (narrow(v) for v in (0.2, 0.65, 0.8, 0.3, 0.2))
    return [a * x[0] + b * x[1] + c * xp.sin(d * x[0] + e * x[1]), xp.sin(x[0])]


_FLOW = narrow(0.5 * 0.015 * 19.62**0.5)


def _tanks(xp: Any, x: Any, u: Any) -> list[Any]:
    r = [xp.sqrt(t) for t in x]
    first, half = narrow(0.5 * 19.62**0.5), 0.5
    return [
        x[0] + (-_FLOW * r[0] + half * u[0]),
        x[1] + first * (r[0] - r[1]),
        x[2] + _FLOW * (r[1] - r[2]),
        x[3] + _FLOW * (r[2] - r[3]),
        x[4] + (_FLOW * (r[3] - r[4]) + half * u[1]),
        x[5] + _FLOW * (r[4] - r[5]),
    ]


def _tank_inputs(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    batch, steps = shape
    first = 0.1 + 2 * np.sin(0.1 * np.arange(steps))
    return np.stack([np.broadcast_to(first, shape), 5 * rng.standard_normal((batch, steps))], -1)


def _known_tank_inputs(steps: int) -> np.ndarray:
    return np.stack([0.1 + 0.1 * np.sin(0.03 * np.arange(steps)), np.full(steps, 0.125)], 1)


_G5, _H5 = np.zeros((6, 2)), np.zeros((3, 2))
_G5[3, 0], _H5[2, 1] = _FLOW, 1.0
NONLINEAR: dict[str, Nonlinear] = {
    "waves": Nonlinear(
        _waves, _seen_waves, np.float32([[0, -0.1], [0.2, -0.2]]).astype(float), np.array([[-2.0, 6.0], [5.0, -15.0]]),
        20.0, (np.array([-1.0, -1.0]), np.array([1.0, 1.0])),
        lambda rng, shape: rng.standard_normal((*shape, 2)) * rng.choice([0.1, 1, 30], (shape[0], 1, 1)),
    ),
    "tanks": Nonlinear(
        _tanks, lambda xp, x: [x[1], x[3], x[4]], _G5, _H5, 1.0, (np.full(6, 18.0), np.full(6, 22.0)),
        _tank_inputs, _known_tank_inputs,
    ),
}  # fmt: skip


@lru_cache
def linear_observer(name: str, dtype: Any) -> gx.Observer:
    """The observer of a plant whose numbers are those of that type, so that they are the same in every precision."""
    plant = (QUADRATIC if name == "quadratic" else LINEAR[name]).astype(dtype)
    A, C = plant.A.astype(dtype), plant.C.astype(dtype)
    a, c = (None if v is None else np.asarray(v, dtype) for v in (plant.a, plant.c))

    def f(x: Any) -> Any:
        moved = jnp.asarray(A) @ x if a is None else jnp.asarray(A) @ x + a
        for i, j, k, q in plant.squares:
            moved = moved.at[i].add(q * x[j] * x[k])
        return moved

    def g(x: Any) -> Any:
        return jnp.asarray(C) @ x if c is None else jnp.asarray(C) @ x + c

    n, l = len(A), len(C)
    noise = gx.Noise(Interval.symmetric(np.full(n, 1e-9)), Interval.symmetric(np.full(l, 1e-9)))
    region = Interval.symmetric(np.full(n, 4.0)) if plant.squares else Interval.entire(n)
    return gx.design_observer(gx.System(f, g, G=plant.G, H=plant.H), noise, region, missing=False, gains=2, window=3)


@lru_cache
def nonlinear_observer(name: str) -> gx.Observer:
    plant = NONLINEAR[name]

    def f(x: Any, u: Any) -> Any:
        return jnp.stack(plant.f(jnp, list(x), list(u)))

    def g(x: Any) -> Any:
        return jnp.stack(plant.g(jnp, list(x)))

    if name == "waves":
        system = gx.System(lambda x: f(x, []), g, G=plant.G, H=plant.H)
        noise = gx.Noise(Interval.symmetric(np.full(2, 0.01)), Interval.symmetric(np.full(2, 0.01)))
        return gx.design_observer(system, noise, Interval.symmetric([1.0, 1.5]), missing=False, gains=2, window=3)
    full = Interval(np.zeros(6), np.full(6, np.inf))
    system = gx.System(f, g, G=plant.G, H=plant.H, m=2, state_bounds=full)
    noise = gx.Noise(Interval.symmetric(np.full(6, 1e-3)), Interval.symmetric(np.full(3, 0.2)))
    region = Interval(np.full(6, 4.0), np.full(6, 26.0))
    return gx.design_observer(
        system, noise, region, u_region=Interval([0.0, 0.125], [0.2, 0.125]), missing=False, gains=2, window=3
    )
