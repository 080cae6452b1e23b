"""Process plants: a reactor, a tank behind a valve with a dead zone, a building, an epidemic. Steps by Euler's rule."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from models.runner import Model, symmetric

import gsisio_jax as gx
from gsisio_jax import Interval
from gsisio_jax.examples import sir as epidemic


def cstr() -> Model:
    """Exothermic stirred tank; the temperature of the feed is disturbed, only the reactor's temperature is measured.

    Seborg, Edgar, Mellichamp, Process Dynamics and Control, 2nd ed., example 2.5: V = 100 L, q = 100 L/min,
    rho Cp = 239 J/(L K), -dH = 5e4 J/mol, E/R = 8750 K, k0 = 7.2e10 /min, UA = 5e4 J/(min K). At a coolant of 300 K it
    rests at 0.877 mol/L and 324.5 K.
    """
    dt, flow = 0.05, 1.0  # min, 1/min

    def f(x, u):
        c, T = x
        rate = 7.2e10 * jnp.exp(-8750.0 / T) * c  # mol/(L min)
        dc = flow * (1.0 - c) - rate
        dT = flow * (350.0 - T) + 5e4 / 239.0 * rate + 5e4 / (239.0 * 100.0) * (u[0] - T)
        return [c + dt * dc, T + dt * dT]

    system = gx.System(
        f, lambda x: [x[1]], G=[[0.0], [dt * flow]], H=[[0.0]], m=1, state_bounds=Interval([0.0, 280.0], [1.0, 400.0])
    )
    return Model(
        system,
        gx.Noise(w=symmetric(1e-4, 0.01), v=symmetric(0.1)),
        initial=Interval([0.7, 315.0], [1.0, 335.0]),
        region=Interval([0.8, 318.0], [0.95, 330.0]),
        d=lambda k: 3.0 * jnp.sin(0.1 * k)[:, None],  # K
        u=lambda k, x: jnp.array([300.0]) + 1.0 * jnp.sin(0.05 * k),
        u_region=Interval([299.0], [301.0]),
        design={"window": 1},  # what "auto" finds
        wide=[0.05, 0.25],
    )


def dead_zone_tank() -> Model:
    """A tank that a motor valve fills; the valve passes nothing up to a tenth of its travel. An inflow is unknown.

    Area 0.2 m2, outlet 8 cm2 (Torricelli), full valve 4 L/s, motor time constant 2 s; the valve is not measured.
    """
    dt, area, outlet = 0.5, 0.2, 8e-4

    def f(x, u):
        valve, level = x
        opening = jnp.where(valve > 0.1, valve - 0.1, 0.0)
        inflow = 4e-3 * opening / 0.9
        outflow = outlet * jnp.sqrt(2 * 9.81 * level)
        return [valve + dt / 2.0 * (u[0] - valve), level + dt / area * (inflow - outflow)]

    system = gx.System(
        f, lambda x: [x[1]], G=[[0.0], [dt / area]], H=[[0.0]], m=1, state_bounds=Interval([0.0, 0.0], [1.0, 2.0])
    )
    return Model(
        system,
        gx.Noise(w=symmetric(1e-3, 1e-4), v=symmetric(2e-3)),
        initial=Interval([0.0, 0.3], [1.0, 0.6]),
        region=Interval([0.05, 0.1], [0.95, 1.0]),
        d=lambda k: 1e-3 * (1 + jnp.sin(0.07 * k))[:, None],  # m3/s
        u=lambda k, x: jnp.array([0.3]) + 0.25 * jnp.sin(0.05 * k),
        u_region=Interval([0.0], [1.0]),
        design={"window": 1},  # what "auto" finds
        wide=[0.02, 0.005],
    )


def building() -> Model:
    """Five rooms in a row, each with a radiator behind a thermostat; the sun shines into the first. A fifth of the
    readings of the four sensors is lost, the room in the middle has none.

    RC model in the manner of Bacher and Madsen, Energy and Buildings 43 (2011): 1e6 J/K a room, 60 W/K to outside,
    100 W/K between neighbours, valves of 100 W/K up to 1 kW; one minute a step.
    """
    scale = 60.0 / 1e6  # K per W and step
    walls = np.diag([1.0, 2, 2, 2, 1]) - np.diag(np.ones(4), 1) - np.diag(np.ones(4), -1)

    def f(x, u):
        radiators = 100.0 * jnp.clip(21.0 - x, 0.0, 10.0)
        return x + scale * (60.0 * (u[0] - x) - 100.0 * walls @ x + radiators)

    seen = np.array([0, 1, 3, 4])
    system = gx.System(
        f, lambda x: x[seen], G=scale * np.eye(5, 1), H=np.zeros((4, 1)), m=1,
        state_bounds=Interval(np.full(5, -20.0), np.full(5, 50.0)),
    )  # fmt: skip
    return Model(
        system,
        gx.Noise(w=symmetric(*[2e-3] * 5), v=symmetric(*[0.1] * 4)),
        initial=Interval(np.full(5, 15.0), np.full(5, 25.0)),
        region=Interval(np.full(5, 14.0), np.full(5, 26.0)),
        d=lambda k: 1500.0 * jnp.maximum(jnp.sin(0.03 * k), 0.0)[:, None],  # W
        u=lambda k, x: jnp.array([5.0]) + 3.0 * jnp.sin(0.02 * k),
        u_region=Interval([0.0], [10.0]),
        missing=0.2,
        wide=[2.0, 0.3, 1.0, 0.3, 0.3],
    )


def sir() -> Model:
    """Susceptible and infected share of a population, one day a step; infections beyond the model are unknown."""
    return Model(
        epidemic.system(),
        epidemic.noise(),
        initial=Interval([0.9, 0.0], [1.0, 0.02]),
        region=Interval([0.0, 0.0], [1.0, 0.4]),
        d=lambda k: jnp.where((k > 30) & (k < 40), 2e-3, 2e-5)[:, None],  # of the population, a day
        wide=[0.015, 1.5e-3],
    )


MODELS = {"cstr": cstr, "dead_zone_tank": dead_zone_tank, "building": building, "sir": sir}
