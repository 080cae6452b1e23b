"""Small plants of every kind that a design can hold; a module of its own, so that a fresh process can make them."""

import math
from dataclasses import replace
from functools import cache

import jax.numpy as jnp
import numpy as np
import systems

import gsisio_jax as gx
from gsisio_jax import Interval


def ball(*radius):
    return Interval.symmetric(np.array(radius))


NOISE = gx.Noise(ball(0.01, 0.02), ball(0.05, 0.1))


def bounded():
    """Bounds of states and inputs, a known input that f takes, a matrix D, a lambda and a table of numbers in g."""
    table = jnp.array([[1.0, 0.3], [0.1, 1.0]])
    return gx.System(
        lambda x, u: jnp.stack([0.8 * x[0] + 0.1 * jnp.sin(x[1]), 0.6 * x[1] + 0.2 * u[0] * x[0]]),
        lambda x: table @ x,
        G=[[1.0], [0.5]],
        H=np.zeros((2, 1)),
        D=[[0.1], [0.0]],
        state_bounds=Interval([0.1, -np.inf], [5.0, 7.3]),
        input_bounds=ball(1.7),
    )


def turning():
    """A periodic state and output."""
    turn = 2 * math.pi
    return gx.System(
        lambda x: jnp.stack([x[0] + jnp.cos(x[1]), x[1]]), lambda x: x, G=[[0.0], [1.0]], H=np.zeros((2, 1)),
        input_bounds=ball(0.5), periodic={1: turn}, periodic_states={1: turn},
    )  # fmt: skip


def plain():
    return gx.System(lambda x: 0.5 * x, lambda x: x, G=[[1.0], [0.0]], H=[[1.0], [0.0]])


def scalar():
    return gx.System(jnp.tanh, lambda x: x, G=[[0.5]], H=[[1.0]])


def late():
    """An input that shows one step later."""
    return gx.System(lambda x: jnp.stack([x[0] + 0.1 * x[1], 0.9 * x[1] - 0.1 * jnp.sin(x[0])]), lambda x: x[:1],
                     G=[[0.0], [0.1]], H=[[0.0]])  # fmt: skip


KINDS = {
    "window": lambda: systems.s1().system,
    "bounded": bounded,
    "turning": turning,
    "no promise": plain,
    "prediction": scalar,
    "planes": lambda: systems.s1().system,
    "nearest": plain,
    "single": plain,
    "delayed": late,
}


@cache
def system(kind):
    return KINDS[kind]()


@cache
def design(kind):
    plant, everywhere = system(kind), Interval.entire(2)
    match kind:
        case "window":
            return systems.s1().design(window=2, sweeps=1, missing=False)
        case "planes":
            return systems.s1().design(missing=False, sweeps=1, window=1, bounds=("affine", "abstraction"))
        case "bounded":
            return gx.design_observer(plant, NOISE, Interval([0.1, -2.0], [4.0, 2.0]), u_region=ball(1.0), window=1)
        case "turning":
            return gx.design_observer(plant, NOISE, everywhere, sweeps=1)
        case "prediction":
            noise = gx.Noise(ball(0.1), ball(0.1))
            return gx.design_observer(plant, noise, Interval.entire(1), "prediction", left_inverse="feedthrough")
        case "delayed":
            noise = gx.Noise(NOISE.w, ball(0.05))
            return gx.design_observer(plant, noise, ball(2.0, 2.0), delay=1, missing=False, sweeps=1)
    found = gx.design_observer(plant, NOISE, everywhere, missing=False, sweeps=1)
    match kind:
        case "no promise":
            return replace(found, certificate=found.certificate.without_promise("for a test"))
        case "nearest":
            return found.with_rounding("nearest")
    return found.astype(np.float32)


def measurements(rows=12, dtype=np.float64):
    y = np.random.default_rng(3).normal(size=(rows, 2))
    y[4, 0], y[7] = np.nan, np.nan
    return y.astype(dtype)


def start(dtype=np.float64):
    return ball(2.0, 2.0).astype(dtype)
