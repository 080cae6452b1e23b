"""An epidemic: susceptible and infected shares of a population, and infections that come from outside the model.

Tests count the infected, blood samples the recovered. Infections beyond the law of mass action (a carnival,
travellers) are the unknown input: its box tells when they happened, without any assumption on their number.

Source: W. O. Kermack, A. G. McKendrick, A contribution to the mathematical theory of epidemics, Proceedings of the
Royal Society A 115, 1927; contacts 0.3 and recovery 0.1 a day (a reproduction number of 3), one day a step.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gsisio_jax.examples.example import Example, Record, simulated
from gsisio_jax.interval import Interval
from gsisio_jax.plant import Noise, System

DAY = 86400.0  # s
CONTACTS, RECOVERY = 0.3, 0.1  # 1/day


def _f(x: Any) -> Any:
    susceptible, infected = x
    new = CONTACTS * susceptible * infected
    return [susceptible - new, infected + new - RECOVERY * infected]


def _g(x: Any) -> Any:
    return [x[1], 1 - x[0] - x[1]]


def system() -> System:
    """Shares of susceptible and infected [1]; measured infected and recovered [1]; unknown infections more [1/day]."""
    shares = Interval([0.0, 0.0], [1.0, 1.0])
    return System(_f, _g, G=[[-1.0], [1.0]], H=np.zeros((2, 1)), state_bounds=shares)


def noise() -> Noise:
    """Tests are right to 0.05 % of the population, blood samples to 0.5 %; the law of mass action to 1e-6 a day."""
    return Noise(Interval.symmetric([1e-6, 1e-6]), Interval.symmetric([5e-4, 5e-3]))


def record(seed: int = 0) -> Record:
    """Two hundred days; ten of them, from day 30 on, bring 0.2 % of the population in infections from outside."""
    day = np.arange(200)
    outside = np.where((day >= 30) & (day < 40), 2e-3, 2e-5)[:, None]
    return simulated(system(), noise(), [0.99, 1e-3], outside, sample_time=DAY, seed=seed)


def example() -> Example:
    return Example(
        name="sir",
        title="An epidemic, and infections from outside of the model",
        teaches="what a model leaves out can be an input: its box tells when it was at work, and states stay certain",
        source="Kermack, McKendrick, Proceedings of the Royal Society A 115, 1927",
        system=system(),
        noise=noise(),
        initial=Interval([0.9, 0.0], [1.0, 0.02]),
        region=Interval([0.0, 0.0], [1.0, 0.4]),
        states=(("susceptible", ""), ("infected", "")),
        inputs=(("outside_infections", "1/day"),),
        outputs=(("tested_infected", ""), ("recovered", "")),
        make_record=record,
        sample_time=DAY,
        time_unit=("d", DAY),
        design={"sweeps": 1, "missing": False},
    )
