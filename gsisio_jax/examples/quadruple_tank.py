"""The quadruple tank: four water levels, two of them measured, a fault in pump 1 and a bias on the second sensor.

Lower tanks 1 and 2 are fed by the upper tanks 3 and 4 and by two pumps, forward Euler with steps of one second. The
pump flow may be off by any amount at any time, and the second sensor may be off by any amount: both are unknown
inputs. Levels in cm, pump voltages and the offset in V.

Source: K. H. Johansson, The quadruple-tank process: a multivariable laboratory process with an adjustable zero, IEEE
Transactions on Control Systems Technology 8(3), 2000, the minimum-phase setting; theory 12.5.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.examples.example import Example, Record, simulated
from gsisio_jax.interval import Interval
from gsisio_jax.plant import Noise, System

AREA = np.array([28.0, 32.0, 28.0, 32.0])  # cm^2, of the tanks
OUTLET = np.array([0.071, 0.057, 0.071, 0.057])  # cm^2, of their outlets
GRAVITY = 981.0  # cm/s^2
PUMP = np.array([3.33, 3.35])  # cm^3/(V s)
SPLIT = np.array([0.7, 0.6])  # share of a pump's flow that goes into its lower tank
VOLTAGE = np.array([3.0, 3.0])  # V
SENSOR = 0.5  # V/cm

STEPS = 200
STATES, STATE_UNITS = ("level 1", "level 2", "level 3", "level 4"), ("cm",) * 4
INPUTS, INPUT_UNITS = ("pump 1 offset", "sensor 2 bias"), ("V", "V")


def _f(level: Any, voltage: Any) -> Any:
    outflow = jnp.asarray(OUTLET) * jnp.sqrt(2 * GRAVITY * level)
    first, second = PUMP[0] * voltage[0], PUMP[1] * voltage[1]
    flow = jnp.stack(
        [
            -outflow[0] + outflow[2] + SPLIT[0] * first,
            -outflow[1] + outflow[3] + SPLIT[1] * second,
            -outflow[2] + (1 - SPLIT[1]) * second,
            -outflow[3] + (1 - SPLIT[0]) * first,
        ]
    )
    return level + flow / jnp.asarray(AREA)


def _g(level: Any) -> Any:
    return SENSOR * level[:2]


def system() -> System:
    """Four levels, two unknown inputs (V), two outputs (V), two known pump voltages (V); levels cannot be negative."""
    G, H = np.zeros((4, 2)), np.zeros((2, 2))
    G[0, 0], G[3, 0] = SPLIT[0] * PUMP[0] / AREA[0], (1 - SPLIT[0]) * PUMP[0] / AREA[3]
    H[1, 1] = 1.0
    return System(_f, _g, G=G, H=H, m=2, state_bounds=Interval(np.zeros(4), np.full(4, np.inf)))


def noise() -> Noise:
    """Process noise within 0.01 cm, measurement noise within 0.02 V."""
    return Noise(Interval.symmetric(np.full(4, 0.01)), Interval.symmetric(np.full(2, 0.02)))


def initial() -> Interval:
    """The first levels are known to 1 cm in the lower and 0.5 cm in the upper tanks."""
    center, radius = np.array([12.4, 12.7, 1.8, 1.4]), np.array([1.0, 1.0, 0.5, 0.5])
    return Interval(center - radius, center + radius)


def region() -> Interval:
    """The levels for which the observer is designed: as wide as boxes of level 2 get, and nowhere near an empty tank,
    where slopes have no bound."""
    return Interval([8.0, 5.0, 0.6, 0.2], [20.0, 25.0, 4.0, 5.0])


def voltages(steps: int) -> np.ndarray:
    """Both pumps at 3 V, (steps, 2)."""
    return np.tile(VOLTAGE, (steps, 1))


def fault(key: Any, k: Any, x: Any) -> Any:
    """A pump that swings by 0.5 V, and a sensor bias that jumps at random; of the form that `monte_carlo` takes."""
    return jnp.stack([0.5 * jnp.sin(0.05 * k), jax.random.normal(key)])


def record(seed: int = 0) -> Record:
    """Two hundred seconds with the fault above."""
    k = np.arange(STEPS)
    bias = np.random.default_rng(seed).standard_normal(STEPS)
    d = np.stack([0.5 * np.sin(0.05 * k), bias], axis=1)
    return simulated(system(), noise(), initial().center, d, voltages(STEPS), sample_time=1.0, seed=seed)


def example() -> Example:
    def named(names: tuple[str, ...], units: tuple[str, ...]) -> tuple[tuple[str, str], ...]:
        return tuple((name.replace(" ", "_"), unit) for name, unit in zip(names, units, strict=True))

    return Example(
        name="quadruple_tank",
        title="Quadruple tank: a pump fault and a sensor bias",
        teaches="pump fault and sensor bias are told apart; what only the biased sensor sees widens, up to a promise",
        source="Johansson, IEEE Transactions on Control Systems Technology 8(3), 2000; theory 12.5",
        system=system(),
        noise=noise(),
        initial=initial(),
        region=region(),
        u_region=Interval(VOLTAGE, VOLTAGE),
        states=named(STATES, STATE_UNITS),
        inputs=named(INPUTS, INPUT_UNITS),
        outputs=(("sensor_1", "V"), ("sensor_2", "V")),
        known_inputs=(("pump_1", "V"), ("pump_2", "V")),
        make_record=record,
        design={"sweeps": 1, "missing": False, "split": 8},
        shown=("level_1", "level_2", "pump_1_offset", "sensor_2_bias"),
    )
