"""Vehicles: a car, a quadrotor, a ship's heading that wraps around, and robots that find themselves by landmarks."""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np
from models.runner import Model, symmetric

import gsisio_jax as gx
from gsisio_jax import Interval

INF = np.inf


def bicycle() -> Model:
    """Kinematic bicycle: rear-left position, heading, speed; an unknown acceleration (slope, brakes).

    Kong et al., IEEE Intelligent Vehicles Symposium 2015: axles 1.105 m and 1.738 m from the centre of mass; 0.1 s.
    """
    dt, front, rear = 0.1, 1.105, 1.738

    def f(x, u):
        px, py, psi, v = x
        throttle, steer = u
        beta = jnp.arctan(rear / (front + rear) * jnp.tan(steer))
        return jnp.array([
            px + dt * v * jnp.cos(psi + beta),
            py + dt * v * jnp.sin(psi + beta),
            psi + dt * v / rear * jnp.sin(beta),
            v + dt * throttle,
        ])  # fmt: skip

    system = gx.System(f, lambda x: x, G=dt * np.eye(4)[:, 3:], H=np.zeros((4, 1)), m=2)
    return Model(
        system,
        gx.Noise(w=symmetric(0.005, 0.005, 0.001, 0.01), v=symmetric(0.3, 0.3, 0.02, 0.2)),
        initial=Interval([-1.0, -1.0, -0.1, 8.0], [1.0, 1.0, 0.1, 12.0]),
        region=Interval([-INF, -INF, -1.5, 0.0], [INF, INF, 1.5, 20.0]),
        d=lambda k: jnp.where(k % 60 < 10, -2.0, 0.3)[:, None],  # m/s2
        u=lambda k, x: jnp.array([0.5 * (10.0 - x[3]), 0.05 * jnp.sin(0.1 * k)]),
        u_region=Interval([-5.0, -0.1], [5.0, 0.1]),
        wide=[0.6, 0.6, 0.04, 0.4],
    )


def quadrotor() -> Model:
    """Planar quadrotor by the classical Runge-Kutta rule; wind accelerates it, the rate of pitch is not measured.

    0.5 kg, 2.3e-3 kg m2 (Mellinger and Kumar, ICRA 2011, a quadrotor of this size), 0.02 s.
    """
    mass, inertia, gravity, dt = 0.5, 2.3e-3, 9.81, 0.02

    def rates(x, u):
        _, _, pitch, vx, vz, rate = x
        thrust, torque = u
        return jnp.stack([
            vx, vz, rate, -thrust / mass * jnp.sin(pitch), thrust / mass * jnp.cos(pitch) - gravity, torque / inertia,
        ])  # fmt: skip

    def f(x, u):
        k1 = rates(x, u)
        k2 = rates(x + dt / 2 * k1, u)
        k3 = rates(x + dt / 2 * k2, u)
        k4 = rates(x + dt * k3, u)
        return x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)

    def controller(k, x):
        pitch = jnp.clip(0.1 * x[0] + 0.15 * x[3] + 0.1 * jnp.sin(0.05 * k), -0.3, 0.3)
        thrust = mass * (gravity - 2.0 * x[1] - 2.0 * x[4])
        return jnp.array([jnp.clip(thrust, 2.0, 8.0), inertia * (30.0 * (pitch - x[2]) - 8.0 * x[5])])

    wind = dt * np.eye(6)[:, 3:5] + dt**2 / 2 * np.eye(6)[:, :2]
    system = gx.System(f, lambda x: x[:5], G=wind, H=np.zeros((5, 2)), m=2)
    return Model(
        system,
        gx.Noise(w=symmetric(*[1e-4] * 2, 1e-4, 1e-3, 1e-3, 5e-3), v=symmetric(0.02, 0.02, 0.01, 0.05, 0.05)),
        initial=symmetric(0.2, 0.2, 0.1, 0.2, 0.2, 0.5),
        region=Interval([-INF, -INF, -0.6, -INF, -INF, -INF], [INF, INF, 0.6, INF, INF, INF]),
        d=lambda k: jnp.stack([jnp.sin(0.1 * k), 0.5 * jnp.cos(0.15 * k)], axis=1),  # m/s2
        u=controller,
        u_region=Interval([2.0, -0.1], [8.0, 0.1]),
        wide=[0.04, 0.04, 0.02, 0.1, 0.1, 1.0],
    )


def range_only() -> Model:
    """A boat under the distances to four beacons; the current is unknown. Compass course and log speed are known."""
    dt = 1.0
    beacons = np.array([[0.0, 0.0], [200.0, 0.0], [0.0, 200.0], [200.0, 200.0]])  # m

    def f(x, u):
        speed, course = u
        return x + dt * speed * jnp.stack([jnp.cos(course), jnp.sin(course)])

    def g(x):
        return jnp.linalg.norm(x - beacons, axis=1)

    harbour = Interval([0.0, 0.0], [200.0, 200.0])
    system = gx.System(
        f, g, G=dt * np.eye(2), H=np.zeros((4, 2)), m=2, input_bounds=symmetric(2.0, 2.0),
        state_bounds=harbour,
    )  # fmt: skip
    return Model(
        system,
        gx.Noise(w=symmetric(0.05, 0.05), v=symmetric(*[0.5] * 4)),
        initial=Interval([80.0, 80.0], [120.0, 120.0]),
        region=Interval([60.0, 60.0], [150.0, 150.0]),
        d=lambda k: 0.5 * jnp.stack([jnp.cos(0.05 * k), jnp.sin(0.05 * k)], axis=1),  # m/s
        u=lambda k, x: jnp.array([1.0, 0.1 * k]),
        u_region=Interval([1.0, 0.0], [1.0, 20.0]),
        design={"missing": True, "window": 1},
        wide=[15.0, 15.0],
    )


def range_bearing() -> Model:
    """Unicycle with distances of two landmarks and the bearing of one, modulo a turn; an unknown slip turns it.

    Thrun, Burgard, Fox, Probabilistic Robotics, section 6.6: range and bearing of landmarks.
    """
    dt = 0.1
    landmarks = np.array([[10.0, 0.0], [0.0, 12.0]])  # m

    def f(x, u):
        v, turn = u
        return [x[0] + dt * v * jnp.cos(x[2]), x[1] + dt * v * jnp.sin(x[2]), x[2] + dt * turn]

    def g(x):
        near, far = landmarks - x[:2]
        return [jnp.hypot(near[0], near[1]), jnp.arctan2(near[1], near[0]) - x[2], jnp.linalg.norm(far)]

    turn = 2 * math.pi
    system = gx.System(
        f, g, G=[[0.0], [0.0], [dt]], H=np.zeros((3, 1)), m=2, periodic={1: turn},
        input_bounds=symmetric(2.0), state_bounds=Interval([-5.0, -5.0, -INF], [5.0, 8.0, INF]),
    )  # fmt: skip
    return Model(
        system,
        gx.Noise(w=symmetric(0.005, 0.005, 0.002), v=symmetric(0.1, 0.02, 0.1)),
        initial=symmetric(0.5, 0.5, 0.3),
        region=Interval([-2.0, -1.0, -1.0], [2.0, 3.0, 20.0]),
        d=lambda k: 0.5 * jnp.sin(0.1 * k)[:, None],  # rad/s
        u=lambda k, x: jnp.array([0.5, 0.5]),
        u_region=Interval([0.5, 0.5], [0.5, 0.5]),
        design={"window": 1},  # what "auto" finds
        wide=[0.3, 0.3, 0.15],
    )


def heading() -> Model:
    """A ship by satellite and compass, which goes round: three turns in the record. The rudder's effect is unknown."""
    dt, speed = 1.0, 5.0  # s, m/s

    def f(x):
        return [x[0] + dt * speed * jnp.sin(x[2]), x[1] + dt * speed * jnp.cos(x[2]), x[2]]

    system = gx.System(
        f, lambda x: [x[0], x[1], x[2]], G=[[0.0], [0.0], [dt]], H=np.zeros((3, 1)), periodic={2: 2 * math.pi},
        input_bounds=symmetric(0.5),
    )  # fmt: skip
    return Model(
        system,
        gx.Noise(w=symmetric(0.2, 0.2, 0.002), v=symmetric(3.0, 3.0, math.radians(1.0))),
        initial=symmetric(10.0, 10.0, 0.3),
        region=Interval([-INF, -INF, -INF], [INF, INF, INF]),
        d=lambda k: 0.1 * (1 + jnp.sin(0.1 * k))[:, None],  # rad/s
        design={"window": 1},  # what "auto" finds
        wide=[6.0, 6.0, 0.04],
    )


MODELS = {
    "bicycle": bicycle,
    "quadrotor": quadrotor,
    "range_only": range_only,
    "range_bearing": range_bearing,
    "heading": heading,
}
