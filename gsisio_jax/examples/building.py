"""Five rooms in a row behind thermostats, four sensors that lose a fifth of their readings, and the sun.

The room in the middle has no sensor. The sun's heat in the first room is unknown; radiators open below 21 degrees and
are full open at 11, which is a piecewise linear function of the state. Readings are lost entry by entry.

Source: P. Bacher, H. Madsen, Identifying suitable models for the heat dynamics of buildings, Energy and Buildings
43(7), 2011: rooms as capacities between resistances. The numbers are those of a light building: 1e6 J/K a room, 60
W/K to outside, 100 W/K between neighbours, valves of 100 W/K up to 1 kW.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from gsisio_jax.examples.example import Example, Record, simulated
from gsisio_jax.interval import Interval
from gsisio_jax.plant import Noise, System

ROOMS = 5
STEP = 600.0  # s
CAPACITY = 1e6  # J/K, of a room
TO_OUTSIDE, BETWEEN, VALVE = 60.0, 100.0, 100.0  # W/K
SET_POINT, RANGE = 21.0, 10.0  # degC where a valve shuts, K below that where it is full open
SENSORS = (0, 1, 3, 4)
_WALLS = np.diag([1.0, 2, 2, 2, 1]) - np.diag(np.ones(4), 1) - np.diag(np.ones(4), -1)
_SCALE = STEP / CAPACITY  # K per W, in a step


def _f(x: Any, u: Any) -> Any:
    radiators = VALVE * jnp.clip(SET_POINT - x, 0.0, RANGE)
    return x + _SCALE * (TO_OUTSIDE * (u[0] - x) - BETWEEN * _WALLS @ x + radiators)


def _g(x: Any) -> Any:
    return [x[room] for room in SENSORS]


def system() -> System:
    """Five temperatures [degC], four of them measured; outside temperature known [degC]; unknown sun in room 1
    [W], between nothing and 3 kW, which is what four square metres of glass let in at most."""
    return System(
        _f, _g, G=_SCALE * np.eye(ROOMS, 1), H=np.zeros((4, 1)), m=1,
        state_bounds=Interval(np.full(ROOMS, -20.0), np.full(ROOMS, 50.0)), input_bounds=Interval([0.0], [3000.0]),
    )  # fmt: skip


def noise() -> Noise:
    """Sensors to 0.1 K; 0.02 K in ten minutes (33 W) for people, doors and what else the model leaves out."""
    return Noise(Interval.symmetric(np.full(ROOMS, 0.02)), Interval.symmetric(np.full(4, 0.1)))


def record(seed: int = 0) -> Record:
    """A cold day and a half from six in the morning, a fifth of the readings lost."""
    k = np.arange(216)
    day = 2 * np.pi * k * STEP / 86400.0
    outside = (4.0 + 4.0 * np.sin(day - 0.8))[:, None]
    sun = 1500.0 * np.maximum(np.sin(day), 0.0)[:, None]
    x0 = [18.0, 19.0, 19.5, 19.0, 18.5]
    return simulated(system(), noise(), x0, sun, outside, sample_time=STEP, seed=seed, missing=0.2)


def example() -> Example:
    return Example(
        name="building",
        title="Five rooms, a room without a sensor, a fifth of the readings lost",
        teaches="lost readings are NaN and nothing else: boxes grow where too little is seen, and close again",
        source="Bacher, Madsen, Energy and Buildings 43(7), 2011",
        system=system(),
        noise=noise(),
        initial=Interval(np.full(ROOMS, 15.0), np.full(ROOMS, 25.0)),
        region=Interval(np.full(ROOMS, 14.0), np.full(ROOMS, 26.0)),
        u_region=Interval([0.0], [10.0]),
        states=tuple((f"room_{i}", "degC") for i in range(1, ROOMS + 1)),
        inputs=(("sun", "W"),),
        outputs=tuple((f"sensor_room_{i + 1}", "degC") for i in SENSORS),
        known_inputs=(("outside", "degC"),),
        make_record=record,
        sample_time=STEP,
        time_unit=("h", 3600.0),
        design={"sweeps": 1},
        shown=("room_1", "room_3", "room_4", "sun"),
    )
