"""Look-up tables and networks: a battery, an engine map, learned dynamics, twenty coupled states."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from models.runner import Model, symmetric

import gsisio_jax as gx
from gsisio_jax import Interval

INF = np.inf


def battery() -> Model:
    """Lithium cell under a charger whose current is known; the pack's own current sensor has an unknown bias d.

    Plett, Battery Management Systems, vol. I, chapter 2: open-circuit voltage from a table, one RC pair. 2.3 A h,
    R0 = 10 mOhm, R1 = 15 mOhm, 60 s; 10 s a step.
    """
    dt, capacity, r0, r1 = 10.0, 2.3 * 3600.0, 0.01, 0.015
    soc = jnp.array([0.0, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0])
    ocv = jnp.array([3.0, 3.35, 3.5, 3.65, 3.85, 4.02, 4.2])  # V
    keep = float(np.exp(-dt / 60.0))

    def f(x, u):
        charge, polarisation = x
        return [charge - dt / capacity * u[0], keep * polarisation + r1 * (1 - keep) * u[0]]

    def g(x, u):
        return [jnp.interp(x[0], soc, ocv) - x[1] - r0 * u[0], u[0]]

    system = gx.System(f, g, G=np.zeros((2, 1)), H=[[0.0], [1.0]], m=1, state_bounds=Interval([0.0, -0.5], [1.0, 0.5]))
    return Model(
        system,
        gx.Noise(w=symmetric(1e-6, 1e-5), v=symmetric(1e-3, 0.02)),
        initial=Interval([0.3, -0.1], [1.0, 0.1]),
        region=Interval([0.1, -0.1], [0.95, 0.1]),
        d=lambda k: jnp.where(k < 100, 0.1, -0.2)[:, None],  # A
        u=lambda k, x: jnp.array([0.5]) + jnp.sin(0.2 * k),
        u_region=Interval([-5.0], [5.0]),
        wide=[0.01, 0.001],
    )


def engine() -> Model:
    """Mean-value engine: manifold pressure (bar) and speed (1000/min), maps of breathing and torque; unknown load.

    Heywood, Internal Combustion Engine Fundamentals, section 7.6, for the form; maps of a 2 L engine, rounded. 20 ms.
    """
    dt = 0.02
    speeds = np.array([0.8, 1.5, 2.5, 4.0, 5.5, 6.5])
    breathing = np.array([0.70, 0.78, 0.86, 0.92, 0.88, 0.80])  # volumetric efficiency
    pressures = np.array([0.2, 0.4, 0.6, 0.8, 1.0])
    torque = np.array([-10.0, 35.0, 80.0, 120.0, 150.0])  # N m

    def f(x, u):
        p, n = x
        filling = jnp.interp(n, speeds, breathing)
        dp = 8.0 * u[0] * jnp.sqrt(jnp.maximum(1.05 - p, 0.0)) - 2.5 * filling * n * p / 2.0
        dn = (jnp.interp(p, pressures, torque) - 12.0 * n) * 60 / (2 * np.pi) / 0.2 / 1000
        return [p + dt * dp, n + dt * dn]

    system = gx.System(
        f, lambda x: [x[0], x[1]], G=[[0.0], [-dt * 60 / (2 * np.pi) / 0.2 / 1000]], H=np.zeros((2, 1)), m=1,
        state_bounds=Interval([0.1, 0.0], [1.05, 7.0]),
    )  # fmt: skip
    return Model(
        system,
        gx.Noise(w=symmetric(1e-3, 1e-3), v=symmetric(0.01, 0.02)),
        initial=Interval([0.3, 1.5], [0.7, 3.0]),
        region=Interval([0.2, 0.8], [1.0, 6.0]),
        d=lambda k: 20.0 + 15.0 * jnp.sin(0.1 * k)[:, None],  # N m
        u=lambda k, x: jnp.array([0.5]) + 0.1 * jnp.sin(0.03 * k),
        u_region=Interval([0.3], [0.7]),
        design={"window": 1},  # what "auto" finds
        wide=[0.02, 0.04],
    )


def _network(activation) -> Model:
    """Residual network x + W2 activation(W1 x + b), one of three states not measured, the first one pushed by d."""
    random = np.random.default_rng(7)
    W1 = random.normal(size=(8, 3)) / np.sqrt(3)
    W2 = 0.1 * random.normal(size=(3, 8)) / np.sqrt(8)
    b = 0.3 * random.normal(size=8)

    def f(x):
        return 0.8 * x + W2 @ activation(W1 @ x + b)

    system = gx.System(f, lambda x: x[:2], G=0.5 * np.eye(3, 1), H=np.zeros((2, 1)))
    return Model(
        system,
        gx.Noise(w=symmetric(*[1e-3] * 3), v=symmetric(0.02, 0.02)),
        initial=symmetric(1.0, 1.0, 1.0),
        region=symmetric(2.0, 2.0, 2.0),
        d=lambda k: jnp.sin(0.2 * k)[:, None],
        wide=[0.04, 0.04, 0.1],
    )


def network_tanh() -> Model:
    return _network(jnp.tanh)


def network_elu() -> Model:
    return _network(jax.nn.elu)


def coupled() -> Model:
    """Twenty states on a ring, each bound to its neighbours by tanh and sine; one input unknown, every second seen."""
    n = 20

    def f(x):
        return 0.7 * x + 0.15 * jnp.tanh(jnp.roll(x, 1)) + 0.1 * jnp.sin(jnp.roll(x, -1))

    seen = np.arange(0, n, 2)
    system = gx.System(f, lambda x: x[seen], G=np.eye(n, 1), H=np.zeros((len(seen), 1)))
    return Model(
        system,
        gx.Noise(w=symmetric(*[0.01] * n), v=symmetric(*[0.05] * len(seen))),
        initial=symmetric(*[1.0] * n),
        region=symmetric(*[3.0] * n),
        d=lambda k: jnp.sin(0.2 * k)[:, None],
        wide=[0.2] * n,
    )


MODELS = {
    "battery": battery,
    "engine": engine,
    "network_tanh": network_tanh,
    "network_elu": network_elu,
    "coupled": coupled,
}
