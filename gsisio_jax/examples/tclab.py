"""A real device: the heating power of a temperature control lab, from two thermometers that step by 0.32 K.

The device is an Arduino with two transistors as heaters and two thermometers. A thousand seconds of a step test are
shipped with this package: heater 1 at 50 % from second 0 on. The observer is not told so: the power is its unknown
input, and the log of it is what the box is checked against.

Model: the heated transistor loses heat by convection and by radiation to the room at 21.2 degC; the other thermometer
is warmed through the board. Rows of every 20th second, Euler's rule. What the numbers rest on:

- Heat capacity 2 J/K (4 g of 500 J/(kg K)), as the makers of the device state; radiation from 10 cm^2 with an
  emissivity of 0.9 (they count 12 cm^2 with the side that faces the other heater).
- POWER, CONVECTION, THROUGH_BOARD, LOSS_2: least squares on seconds 100 to 500 (those of sensor 2 on 0 to 500). Their
  simulation then stays within 0.55 K of the measurements over all 1,000 s.
- v, +-0.6 K: the converter steps by 0.32 K. From parabolas over 31 s the measurements deviate by up to 0.55 K, 99 %
  of them by less than 0.38 K.
- w, +-0.05 K: with v as stated seconds 0 to 500 are free of a contradiction for w2 = 0 even (with v of 0.35 K they
  need 0.0075 K). For w1 there is no evidence, as the unknown input covers the same equation; it is a guess.

Check: seconds 500 to 1,000 were used for no number. No alarm is raised there, and the logged 50 % lie in every box.
In the first 60 s they do not: heat takes that long to the sensor, and what the box holds is the power that arrives.
All of this is evidence from one run of one device, and no proof.

Source: J. Kantor, TCLab, https://github.com/jckantor/TCLab, notebooks/step_test_data.csv as of 4 January 2018 (MIT
licence, see data/README.md). Device: J. D. Hedengren and others, APMonitor.com, Arduino temperature control lab.
"""

from __future__ import annotations

from importlib.resources import files
from typing import Any

import numpy as np

from gsisio_jax.examples.example import Example, Record
from gsisio_jax.interval import Interval
from gsisio_jax.plant import Noise, System

EVERY = 20  # rows of the log, one a second
STEP = 20.0  # s
ROOM = 21.2  # degC
CAPACITY = 2.0  # J/K
RADIATION = 0.9 * 5.67e-8 * 1e-3  # W/K^4
POWER = 0.0104  # W per % of the heater's range
CONVECTION = 0.00528  # W/K
THROUGH_BOARD, LOSS_2 = 0.00298, 0.00584  # 1/s
_KELVIN = 273.15


def _f(x: Any) -> Any:
    radiated = RADIATION * ((x[0] + _KELVIN) ** 4 - (ROOM + _KELVIN) ** 4)
    heater = -(CONVECTION * (x[0] - ROOM) + radiated) / CAPACITY
    other = THROUGH_BOARD * (x[0] - x[1]) - LOSS_2 * (x[1] - ROOM)
    return [x[0] + STEP * heater, x[1] + STEP * other]


def _g(x: Any) -> Any:
    return x


def system() -> System:
    """Temperatures of both sensors [degC], measured; the power of heater 1 [%] is unknown, and unbounded."""
    physics = Interval([0.0, 0.0], [120.0, 120.0])
    return System(_f, _g, G=[[STEP * POWER / CAPACITY], [0.0]], H=np.zeros((2, 1)), state_bounds=physics)


def noise() -> Noise:
    """As reasoned above."""
    return Noise(Interval.symmetric([0.05, 0.05]), Interval.symmetric([0.6, 0.6]))


def record(seed: int = 0) -> Record:
    """Every 20th row of the log; the seed changes nothing. The truth of the input is the logged power, none is known of
    the temperatures."""
    with (files("gsisio_jax.examples") / "data" / "tclab_step.csv").open("rb") as stream:
        _, time, power, first, second = np.loadtxt(stream, delimiter=",", skiprows=1).T[:, ::EVERY]
    # The clock of the log is up to half a second late; its rows are one second apart.
    time = STEP * np.arange(len(time))
    return Record(time, np.stack([first, second], axis=1), d=power[:, None])


def example() -> Example:
    return Example(
        name="tclab",
        title="A real heater: its power from two coarse thermometers",
        teaches="a real record: what nobody told the observer is found, with bounds that are reasoned from the data",
        source="Kantor, TCLab (MIT licence), step test of 4 January 2018",
        system=system(),
        noise=noise(),
        initial=Interval([15.0, 15.0], [30.0, 30.0]),
        region=Interval([15.0, 15.0], [75.0, 75.0]),
        states=(("heater_sensor", "degC"), ("other_sensor", "degC")),
        inputs=(("power", "%"),),
        outputs=(("reading_heater_sensor", "degC"), ("reading_other_sensor", "degC")),
        make_record=record,
        sample_time=STEP,
        design={"sweeps": 1, "missing": False},
    )
