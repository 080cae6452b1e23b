"""Six tanks in a chain, three of them measured, a leak between two and a sensor that is off by anything.

Water runs from tank to tank by Torricelli's law. Nothing is known of what leaks from tank 3 to 4 besides the model,
nor of the bias of the third sensor. Tanks without a sensor are seen through their neighbours alone; one mode of the
plant is slow (0.996 a step), so some boxes settle slowly, at the rate that the certificate names.

Source: Torricelli's law with dimensionless levels; the numbers are those of test system S5, theory 12.4.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from gsisio_jax.examples.example import Example, Record, simulated
from gsisio_jax.interval import Interval
from gsisio_jax.plant import Noise, System

STEP = 0.5  # s
OUTLET = 0.015  # of the area of a tank
FALL = np.sqrt(2 * 9.81)
_RATE = STEP * OUTLET * FALL


def _f(x: Any, u: Any) -> Any:
    r = jnp.sqrt(x)
    flows = [
        STEP * (-OUTLET * FALL * r[0] + u[0]),
        STEP * FALL * (r[0] - r[1]),
        _RATE * (r[1] - r[2]),
        _RATE * (r[2] - r[3]),
        _RATE * (r[3] - r[4]) + STEP * u[1],
        _RATE * (r[4] - r[5]),
    ]
    return x + jnp.stack(flows)


def _g(x: Any) -> Any:
    return jnp.stack([x[1], x[3], x[4]])


def system() -> System:
    """Six levels [m], three measured; known inflows [m/s]; unknown: leak (in outlets), bias of a sensor [m]."""
    G, H = np.zeros((6, 2)), np.zeros((3, 2))
    G[3, 0], H[2, 1] = _RATE, 1.0
    return System(_f, _g, G=G, H=H, m=2, state_bounds=Interval(np.zeros(6), np.full(6, np.inf)))


def noise() -> Noise:
    """Sensors to 0.2 m, the model to 1 mm a step."""
    return Noise(Interval.symmetric(np.full(6, 1e-3)), Interval.symmetric(np.full(3, 0.2)))


def record(seed: int = 0) -> Record:
    """Eighty seconds; the leak swings, the bias is drawn at random."""
    k = np.arange(160)
    u = np.stack([0.1 + 0.1 * np.sin(0.03 * k), np.full(len(k), 0.1)], axis=1)
    bias = 5 * np.random.default_rng(seed).standard_normal(len(k))
    d = np.stack([0.1 + 2 * np.sin(0.1 * k), bias], axis=1)
    return simulated(system(), noise(), np.linspace(20.5, 16.5, 6), d, u, sample_time=STEP, seed=seed)


def example() -> Example:
    return Example(
        name="six_tanks",
        title="Six tanks, three sensors, a leak and a biased sensor",
        teaches="states that no sensor sees are bounded through the dynamics, at the rate that the certificate names",
        source="Torricelli's law; numbers of test system S5, theory 12.4",
        system=system(),
        noise=noise(),
        initial=Interval(np.full(6, 16.0), np.full(6, 24.0)),
        region=Interval(np.full(6, 4.0), np.full(6, 26.0)),
        u_region=Interval([0.0, 0.1], [0.2, 0.1]),
        states=tuple((f"level_{i}", "m") for i in range(1, 7)),
        inputs=(("leak", ""), ("bias", "m")),
        outputs=(("sensor_level_2", "m"), ("sensor_level_4", "m"), ("biased_sensor", "m")),
        known_inputs=(("inflow_1", "m/s"), ("inflow_5", "m/s")),
        make_record=record,
        sample_time=STEP,
        design={"sweeps": 1, "missing": False},
        shown=("level_1", "level_2", "level_5", "bias"),
    )
