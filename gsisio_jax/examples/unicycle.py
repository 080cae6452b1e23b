"""A unicycle that finds itself by two landmarks, though its wheels slip in the turn.

It measures how far both landmarks are and in which direction it sees the first one; it keeps that one in view, so the
direction is counted on over whole turns (one that wraps around would be declared ``periodic``, see `heading`). The
slip turns it by an unknown rate, of which only physics is known: no more than 2 rad/s.

Source: S. Thrun, W. Burgard, D. Fox, Probabilistic Robotics, MIT Press, 2005, sections 5.4 and 6.6 (kinematics, range
and bearing of landmarks); a small robot at 0.5 m/s that turns by 0.5 rad/s, landmarks ten metres away.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from gsisio_jax.examples.example import Example, Record, simulated
from gsisio_jax.interval import Interval
from gsisio_jax.plant import Noise, System

STEP = 0.1  # s
LANDMARKS = np.array([[10.0, 0.0], [0.0, 12.0]])  # m, east and north


def _f(x: Any, u: Any) -> Any:
    speed, rate = u
    return [x[0] + STEP * speed * jnp.cos(x[2]), x[1] + STEP * speed * jnp.sin(x[2]), x[2] + STEP * rate]


def _g(x: Any) -> Any:
    near, far = LANDMARKS - x[:2]
    return [jnp.hypot(near[0], near[1]), jnp.arctan2(near[1], near[0]) - x[2], jnp.hypot(far[0], far[1])]


def system() -> System:
    """East, north [m], heading [rad]; range [m] and bearing [rad] of landmark 1, range of landmark 2; known speed [m/s]
    and rate of turn [rad/s]; unknown slip [rad/s]. The robot stays in its arena, 10 m by 13 m."""
    return System(
        _f, _g, G=[[0.0], [0.0], [STEP]], H=np.zeros((3, 1)), m=2,
        input_bounds=Interval.symmetric([2.0]),
        state_bounds=Interval([-5.0, -5.0, -np.inf], [5.0, 8.0, np.inf]),
    )  # fmt: skip


def noise() -> Noise:
    """Ranges to 10 cm, bearing to 20 mrad; 5 mm and 2 mrad a step for the wheels."""
    return Noise(Interval.symmetric([0.005, 0.005, 0.002]), Interval.symmetric([0.1, 0.02, 0.1]))


def record(seed: int = 0) -> Record:
    """Twenty seconds, a turn and a half; the slip comes and goes."""
    k = np.arange(200)
    slip = 0.5 * np.sin(0.1 * k)[:, None]
    command = np.full((len(k), 2), 0.5)
    return simulated(system(), noise(), [0.2, -0.1, 0.1], slip, command, sample_time=STEP, seed=seed)


def example() -> Example:
    return Example(
        name="unicycle",
        title="A unicycle among landmarks, its wheels slipping",
        teaches="outputs that are nonlinear in several states (ranges, a bearing) are solved jointly for the position",
        source="Thrun, Burgard, Fox, Probabilistic Robotics, 2005, sections 5.4 and 6.6",
        system=system(),
        noise=noise(),
        initial=Interval.symmetric([0.5, 0.5, 0.3]),
        region=Interval([-2.0, -1.0, -1.0], [2.0, 3.0, 20.0]),
        u_region=Interval([0.5, 0.5], [0.5, 0.5]),
        states=(("east", "m"), ("north", "m"), ("heading", "rad")),
        inputs=(("slip", "rad/s"),),
        outputs=(("range_1", "m"), ("bearing_1", "rad"), ("range_2", "m")),
        known_inputs=(("speed", "m/s"), ("rate_of_turn", "rad/s")),
        make_record=record,
        sample_time=STEP,
        design={"sweeps": 1, "missing": False},
    )
