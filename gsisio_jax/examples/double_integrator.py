"""A target in the plane whose acceleration is unknown: the smallest example with a certificate that holds everywhere.

Position and velocity are measured, nothing is assumed about the acceleration, not even a bound. Everything is linear,
so there is no region to leave: the boxes settle from any initial box. With positions alone there is no such observer
(the plant has invariant zeros at -1), and the design says so.

Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with Applications to Tracking and Navigation, Wiley, 2001,
section 6.3.2 (acceleration constant over a step); theory 12.3.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from gsisio_jax.examples.example import Example, Record, simulated
from gsisio_jax.interval import Interval
from gsisio_jax.plant import Noise, System

STEP = 0.1  # s
_TRANSITION = np.block([[np.eye(2), STEP * np.eye(2)], [np.zeros((2, 2)), np.eye(2)]])


def _f(x: Any) -> Any:
    return jnp.asarray(_TRANSITION, x.dtype) @ x


def _g(x: Any) -> Any:
    return x


def system() -> System:
    """State east, north [m] and their rates [m/s]; unknown acceleration east, north [m/s^2]; all states measured."""
    return System(_f, _g, G=np.vstack([STEP**2 / 2 * np.eye(2), STEP * np.eye(2)]), H=np.zeros((4, 2)))


def noise() -> Noise:
    """Positions to 0.1 m, velocities to 0.02 m/s, and 1 mm, 1 mm/s a step for what the model leaves out."""
    return Noise(Interval.symmetric(np.full(4, 1e-3)), Interval.symmetric([0.1, 0.1, 0.02, 0.02]))


def record(seed: int = 0) -> Record:
    """Ten seconds: straight on, a turn with 5 m/s^2, and a full stop."""
    k = np.arange(100)
    turn = np.stack([-5.0 * np.sin(0.1 * k), 5.0 * np.cos(0.1 * k)], axis=1)
    d = np.where((k < 30)[:, None], 0.0, np.where((k < 70)[:, None], turn, [[0.0, -8.0]]))
    return simulated(system(), noise(), [0.0, 0.0, 5.0, 0.0], d, sample_time=STEP, seed=seed)


def example() -> Example:
    return Example(
        name="double_integrator",
        title="A target with unknown acceleration",
        teaches="an input without any bound is reconstructed, and a linear plant gets a promise from any initial box",
        source="Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, 6.3.2",
        system=system(),
        noise=noise(),
        initial=Interval.symmetric([20.0, 20.0, 20.0, 20.0]),
        region=Interval.entire(4),
        states=(("east", "m"), ("north", "m"), ("velocity_east", "m/s"), ("velocity_north", "m/s")),
        inputs=(("acceleration_east", "m/s^2"), ("acceleration_north", "m/s^2")),
        outputs=(
            ("sensor_east", "m"), ("sensor_north", "m"), ("sensor_velocity_east", "m/s"),
            ("sensor_velocity_north", "m/s"),
        ),
        make_record=record,
        sample_time=STEP,
        design={"missing": False},
        shown=("east", "velocity_east", "acceleration_east", "acceleration_north"),
    )  # fmt: skip
