"""A lithium cell: state of charge through a table of open-circuit voltages, under a current sensor with unknown bias.

The charger knows its current; the sensor of the pack is off by any amount at any time, and a box of that bias is what
a monitor wants. The table enters by ``jnp.interp``: piecewise linear functions are bounded exactly.

Source: G. L. Plett, Battery Management Systems, volume I, Artech House, 2015, chapter 2: a cell as an open-circuit
voltage, a resistor and one RC pair. 2.3 A h, R0 = 10 mOhm, R1 = 15 mOhm, R1 C1 = 60 s; a table of seven rounded
points of a cell with a nickel-manganese-cobalt cathode.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from gsisio_jax.examples.example import Example, Record, simulated
from gsisio_jax.interval import Interval
from gsisio_jax.plant import Noise, System

STEP = 10.0  # s
CAPACITY = 2.3 * 3600.0  # A s
R0, R1 = 0.010, 0.015  # Ohm
KEEP = float(np.exp(-STEP / 60.0))  # of the polarisation in a step
CHARGE = np.array([0.0, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0])  # state of charge
VOLTAGE = np.array([3.0, 3.35, 3.5, 3.65, 3.85, 4.02, 4.2])  # V, open circuit


def _f(x: Any, u: Any) -> Any:
    charge, polarisation = x
    return [charge - STEP / CAPACITY * u[0], KEEP * polarisation + R1 * (1 - KEEP) * u[0]]


def _g(x: Any, u: Any) -> Any:
    charge, voltage = (jnp.asarray(column, x.dtype) for column in (CHARGE, VOLTAGE))
    return [jnp.interp(x[0], charge, voltage) - x[1] - R0 * u[0], u[0]]


def system() -> System:
    """State of charge [1] and polarisation [V]; outputs terminal voltage [V] and sensed current [A]; known current [A];
    unknown bias of the current sensor [A]."""
    physics = Interval([0.0, -0.5], [1.0, 0.5])
    return System(_f, _g, G=np.zeros((2, 1)), H=[[0.0], [1.0]], m=1, state_bounds=physics)


def noise() -> Noise:
    """Voltage to 1 mV, current to 20 mA; 1e-6 of the charge and 10 uV of polarisation a step for what is left out."""
    return Noise(Interval.symmetric([1e-6, 1e-5]), Interval.symmetric([1e-3, 0.02]))


def record(seed: int = 0) -> Record:
    """An hour of a load that swings between -0.5 A and 1.5 A; the bias jumps from 0.1 A to -0.2 A half-way."""
    k = np.arange(360)
    current = 0.5 + np.sin(0.05 * k)[:, None]
    bias = np.where(k < 180, 0.1, -0.2)[:, None]
    return simulated(system(), noise(), [0.8, 0.0], bias, current, sample_time=STEP, seed=seed)


def example() -> Example:
    return Example(
        name="battery",
        title="State of charge through a table, and the bias of a current sensor",
        teaches="a look-up table (jnp.interp) is bounded as it is; a sensor off by anything is a column of H",
        source="Plett, Battery Management Systems I, 2015, chapter 2",
        system=system(),
        noise=noise(),
        initial=Interval([0.3, -0.1], [1.0, 0.1]),
        region=Interval([0.1, -0.1], [0.95, 0.1]),
        u_region=Interval([-5.0], [5.0]),
        states=(("charge", ""), ("polarisation", "V")),
        inputs=(("bias", "A"),),
        outputs=(("voltage", "V"), ("sensed_current", "A")),
        known_inputs=(("current", "A"),),
        make_record=record,
        sample_time=STEP,
        design={"sweeps": 1},
    )
