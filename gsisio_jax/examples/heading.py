"""A robot whose first heading nobody knows: a state that means the same after a whole turn.

Its position is measured, and a compass that wraps around at half a turn. How fast it turns is unknown. The initial
box of the heading is the whole line; as the heading is declared periodic, the first reading of the compass settles
it, and the box stays on the real line after that: three whole turns are counted on.

Source: S. Thrun, W. Burgard, D. Fox, Probabilistic Robotics, MIT Press, 2005, section 5.4 (the kinematics); numbers
of a small robot at 0.5 m/s with a compass of one degree.
"""

from __future__ import annotations

import math
from typing import Any

import jax.numpy as jnp
import numpy as np

from gsisio_jax.examples.example import Example, Record, simulated
from gsisio_jax.interval import Interval
from gsisio_jax.plant import Noise, System

STEP = 0.5  # s
SPEED = 0.5  # m/s
TURN = 2 * math.pi


def _f(x: Any) -> Any:
    return [x[0] + STEP * SPEED * jnp.cos(x[2]), x[1] + STEP * SPEED * jnp.sin(x[2]), x[2]]


def _g(x: Any) -> Any:
    return [x[0], x[1], x[2]]


def system() -> System:
    """East, north [m], heading [rad], all measured; unknown rate of turn [rad/s], at most 1 rad/s."""
    return System(
        _f, _g, G=[[0.0], [0.0], [STEP]], H=np.zeros((3, 1)), periodic={2: TURN}, periodic_states={2: TURN},
        input_bounds=Interval.symmetric([1.0]),
    )  # fmt: skip


def noise() -> Noise:
    """Position to 5 cm, compass to one degree; 1 cm and 2 mrad a step for wheels that slip."""
    return Noise(Interval.symmetric([0.01, 0.01, 0.002]), Interval.symmetric([0.05, 0.05, math.radians(1.0)]))


def record(seed: int = 0) -> Record:
    """A hundred seconds, three turns to the left and one back."""
    k = np.arange(200)
    rate = np.where(k < 120, 0.32, -0.16)[:, None] * (1 + 0.3 * np.sin(0.1 * k))[:, None]
    return simulated(system(), noise(), [0.0, 0.0, 2.5], rate, sample_time=STEP, seed=seed)


def example() -> Example:
    return Example(
        name="heading",
        title="A heading that nobody knew at first",
        teaches="an angle that is logged modulo a turn is unwrapped with proof, and found where it was unknown",
        source="Thrun, Burgard, Fox, Probabilistic Robotics, 2005, section 5.4",
        system=system(),
        noise=noise(),
        initial=Interval([-1.0, -1.0, -np.inf], [1.0, 1.0, np.inf]),
        region=Interval.entire(3),
        states=(("east", "m"), ("north", "m"), ("heading", "rad")),
        inputs=(("rate_of_turn", "rad/s"),),
        outputs=(("sensor_east", "m"), ("sensor_north", "m"), ("compass", "rad")),
        make_record=record,
        sample_time=STEP,
        design={"sweeps": 1, "missing": False},
    )
