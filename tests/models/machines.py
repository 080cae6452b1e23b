"""Machines: an arm, drives with Coulomb friction (written in two ways) and with tables, the attitude of a satellite."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from models.runner import Model, symmetric

import gsisio_jax as gx
from gsisio_jax import Interval

INF = np.inf


def arm() -> Model:
    """Two links in the vertical plane, angles and rates measured; pushes accelerate both joints.

    Spong, Hutchinson, Vidyasagar, Robot Modeling and Control, section 7.4: links of 0.5 m and 0.4 m, 1 kg each, thin
    rods; viscous friction 0.5 N m s; 5 ms a step.
    """
    dt, m1, m2, l1, c1, c2, gravity = 0.005, 1.0, 1.0, 0.5, 0.25, 0.2, 9.81
    i1, i2 = m1 * l1**2 / 12, m2 * 0.4**2 / 12

    def f(x, u):
        q, dq = x[:2], x[2:]
        c = jnp.cos(q[1])
        m12 = m2 * (c2**2 + l1 * c2 * c) + i2
        M = jnp.array([
            [m1 * c1**2 + m2 * (l1**2 + c2**2 + 2 * l1 * c2 * c) + i1 + i2, m12],
            [m12, m2 * c2**2 + i2],
        ])  # fmt: skip
        h = -m2 * l1 * c2 * jnp.sin(q[1])
        C = jnp.array([[h * dq[1], h * (dq[0] + dq[1])], [-h * dq[0], 0.0]])
        far = m2 * c2 * gravity * jnp.cos(q[0] + q[1])
        weight = jnp.array([(m1 * c1 + m2 * l1) * gravity * jnp.cos(q[0]) + far, far])
        ddq = jnp.linalg.solve(M, u - C @ dq - weight - 0.5 * dq)
        return jnp.concatenate([q + dt * dq, dq + dt * ddq])

    def controller(k, x):
        target = jnp.array([-1.2, 0.6]) + 0.3 * jnp.array([jnp.sin(0.03 * k), jnp.cos(0.04 * k)])
        hold = jnp.array([7.36 * jnp.cos(x[0]), 0.0]) + 1.96 * jnp.cos(x[0] + x[1])
        return jnp.clip(hold + 5.0 * (target - x[:2]) - 0.5 * x[2:], -15.0, 15.0)

    system = gx.System(f, lambda x: x, G=dt * np.eye(4)[:, 2:], H=np.zeros((4, 2)), m=2)
    return Model(
        system,
        gx.Noise(w=symmetric(1e-5, 1e-5, 1e-3, 1e-3), v=symmetric(2e-3, 2e-3, 0.05, 0.05)),
        initial=Interval([-1.3, 0.5, -0.1, -0.1], [-1.1, 0.7, 0.1, 0.1]),
        region=Interval([-2.0, -0.2, -1.0, -1.0], [-0.5, 1.5, 1.0, 1.0]),
        d=lambda k: jnp.stack([2.0 * jnp.sin(0.1 * k), jnp.where(k % 50 < 5, 5.0, 0.0)], axis=1),  # rad/s2
        u=controller,
        u_region=Interval([-15.0, -15.0], [15.0, 15.0]),
        design={"window": 1},  # what "auto" finds
        wide=[4e-3, 4e-3, 0.1, 0.1],
    )


def _drive(friction, w) -> Model:
    """Motor with inertia 0.01 kg m2, angle by an encoder, speed by a tachometer; the load is unknown. 1 ms a step.

    Dry friction of 0.5 N m: Armstrong-Hélouvry, Dupont, Canudas de Wit, Automatica 30 (1994).
    """
    dt, inertia = 1e-3, 0.01

    def f(x, u):
        angle, speed = x
        return [angle + dt * speed, friction(speed, dt / inertia) + dt / inertia * (u[0] - 0.01 * speed)]

    system = gx.System(f, lambda x: x, G=[[0.0], [dt / inertia]], H=np.zeros((2, 1)), m=1)
    return Model(
        system,
        gx.Noise(w=symmetric(1e-6, w), v=symmetric(1e-3, 0.1)),
        initial=symmetric(0.1, 0.5),
        region=Interval([-INF, -20.0], [INF, 20.0]),
        d=lambda k: 0.2 * jnp.sin(0.1 * k)[:, None],  # N m
        u=lambda k, x: jnp.array([1.0]) * jnp.sin(0.05 * k),
        u_region=Interval([-1.0], [1.0]),
        design={"window": 1},  # what "auto" finds
        wide=[2e-3, 0.2],
    )


def friction_ramp() -> Model:
    """Dry friction as a steep ramp through standstill."""
    return _drive(lambda v, step: v - step * 0.5 * jnp.sign(v) * jnp.minimum(jnp.abs(v) / 0.5, 1.0), 1e-3)


def friction_stop() -> Model:
    """Dry friction that takes away what speed there is, and no more: time stepping."""
    return _drive(lambda v, step: v - jnp.sign(v) * jnp.minimum(jnp.abs(v), step * 0.5), 1e-3)


def cogging() -> Model:
    """The angle of a motor whose magnets hold it back, six times a turn, by a table of the angle; a brake that takes
    hold from 3 rad/s on is a table with a step. 10 ms a step."""
    dt, sixth = 0.01, np.pi / 3
    angles = np.linspace(0, sixth, 9)[:-1]
    held = 0.4 * np.sin(6 * angles) + 0.2 * np.sin(12 * angles)  # N m, for an inertia of 1 kg m2
    speeds, brake = np.array([-100.0, -3.0, -3.0, 3.0, 3.0, 100.0]), np.array([-0.5, -0.2, 0.0, 0.0, 0.2, 0.5])

    def f(x):
        angle, speed = x
        torques = jnp.interp(angle, angles, held, period=sixth) + jnp.interp(speed, speeds, brake)
        return [angle + dt * speed, speed - dt * torques]

    system = gx.System(f, lambda x: x, G=[[0.0], [dt]], H=np.zeros((2, 1)))
    return Model(
        system,
        gx.Noise(w=symmetric(1e-4, 1e-3), v=symmetric(0.02, 0.3)),
        initial=Interval([0.0, 1.0], [1.0, 3.0]),
        region=Interval([-INF, -20.0], [INF, 20.0]),
        d=lambda k: 2.0 * jnp.sin(0.03 * k)[:, None],  # N m
        design={"window": 1, "certify": False},  # the brake jumps
        wide=[0.04, 0.6],
    )


def attitude() -> Model:
    """Unit quaternion of a satellite by its gyroscope; sun sensor and magnetometer give six outputs. No unknown input.

    Crassidis and Junkins, Optimal Estimation of Dynamic Systems, section 3.7; 1 s a step.
    """
    dt = 1.0
    sun, field = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.6, 0.8])

    def f(q, u):
        a, b, c = u  # rad/s
        omega = jnp.array([[0, -a, -b, -c], [a, 0, c, -b], [b, -c, 0, a], [c, b, -a, 0]])
        return q + dt / 2 * omega @ q

    def g(q):
        w, x, y, z = q
        R = jnp.array([
            [1 - 2 * (y**2 + z**2), 2 * (x * y + w * z), 2 * (x * z - w * y)],
            [2 * (x * y - w * z), 1 - 2 * (x**2 + z**2), 2 * (y * z + w * x)],
            [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x**2 + y**2)],
        ])  # fmt: skip
        return jnp.concatenate([R @ sun, R @ field])

    system = gx.System(f, g, G=np.zeros((4, 0)), H=np.zeros((6, 0)), m=3, state_bounds=symmetric(*[1.1] * 4))
    start = np.array([0.9, 0.2, -0.3, 0.2])
    start = start / np.linalg.norm(start)
    return Model(
        system,
        gx.Noise(w=symmetric(*[1e-4] * 4), v=symmetric(*[0.003] * 6)),
        initial=Interval(start - 0.03, start + 0.03),
        region=Interval(start - 0.07, start + 0.07),
        u=lambda k, x: 0.003 * jnp.array([jnp.sin(0.2 * k), jnp.cos(0.15 * k), jnp.sin(0.1 * k)]),
        u_region=symmetric(0.003, 0.003, 0.003),
        wide=[0.03] * 4,
    )


MODELS = {
    "arm": arm,
    "friction_ramp": friction_ramp,
    "friction_stop": friction_stop,
    "attitude": attitude,
    "cogging": cogging,
}
