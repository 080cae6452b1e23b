"""The test systems of docs/theory.md, section 12, with the regions they are designed on and signals to run them with.

Each `Case` can simulate runs in which the unknown input is known, so that containment can be checked.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import gsisio_jax as gx
from gsisio_jax import Interval


@dataclass(frozen=True)
class Case:
    """A plant, its noise and initial box, the region of the design, and the inputs of a run of `steps` steps."""

    system: gx.System
    noise: gx.Noise
    initial: Interval
    region: Interval
    steps: int
    d: Callable[[Any, int], Any]  # (key, steps) -> (steps, p)
    u: Callable[[int], Any] = lambda steps: np.zeros((steps, 0))
    u_region: Interval | None = None
    sweeps: int = 1  # contractions of a step; one, as compiling takes most of the time of a test

    def design(self, **options: Any) -> gx.Observer:
        # One step, too: windows have tests of their own, and more to compile.
        options = {"sweeps": self.sweeps, "window": 1} | options
        return gx.design_observer(self.system, self.noise, self.region, u_region=self.u_region, **options)

    def simulate(self, key: Any, noise: gx.Noise | None = None, d_scale: Any = 1.0) -> tuple[gx.Simulation, Any]:
        """One run from a random point of the initial box (its faces and corners included). In half of the runs the
        noise lies on the vertices of its box at every step, in the others anywhere in it."""
        noise = noise or self.noise
        key_s, key_d, x0, w, v = _draws(self.steps, key, self.initial, noise.w, noise.v)
        d = d_scale * self.d(key_d, self.steps)
        return gx.simulate(self.system, key_s, x0, d, gx.Noise(w, v), self.u(self.steps)), d


@partial(jax.jit, static_argnums=0)
def _draws(steps: int, key: Any, initial: Interval, w: Interval, v: Interval) -> tuple[Any, ...]:
    """Two keys, a point of the initial box, and boxes of the noise: one program instead of twenty."""
    key_x, key_s, key_d, key_w, key_v, key_kind = jax.random.split(key, 6)
    share = jnp.clip(jax.random.uniform(key_x, initial.shape, minval=-0.2, maxval=1.2), 0, 1)
    at_vertices = jax.random.bernoulli(key_kind)
    noise = (_maybe_vertices(at_vertices, key, box, steps) for key, box in ((key_w, w), (key_v, v)))
    return key_s, key_d, initial.lower + share * initial.width, *noise


def _maybe_vertices(chosen: Any, key: Any, box: Interval, steps: int) -> Interval:
    up = jax.random.bernoulli(key, shape=(steps, *box.shape))
    corner = jnp.where(up, box.upper, box.lower)
    return Interval(jnp.where(chosen, corner, box.lower), jnp.where(chosen, corner, box.upper))


def ball(radius: Any) -> Interval:
    return Interval.symmetric(np.asarray(radius, dtype=float))


# S1, the paper's example ----------------------------------------------------------------------------------------------
def _s1_f(x):
    return jnp.stack([0.6 * x[0] - 0.12 * x[1] + 1.1 * jnp.sin(0.3 * x[1] - 0.2 * x[0]), -0.2 * x[0] - 0.14 * x[1]])


def _s1_g(x):
    return jnp.stack([0.2 * x[0] + 0.65 * x[1] + 0.8 * jnp.sin(0.3 * x[0] + 0.2 * x[1]), jnp.sin(x[0])])


def s1(noise: float = 0.2, region: tuple[float, float] = (1.0, 1.5)) -> Case:
    return Case(
        system=gx.System(_s1_f, _s1_g, G=[[0, -0.1], [0.2, -0.2]], H=[[-0.1, 0.3], [0.25, -0.75]]),
        noise=gx.Noise(w=ball([noise] * 2), v=ball([noise] * 2)),
        initial=Interval([-1.1, -2.0], [2.0, 1.1]),
        region=ball(region),
        steps=60,
        d=lambda key, steps: jax.random.normal(key, (steps, 2)),
    )


# S4, planar double integrator -----------------------------------------------------------------------------------------
_DT = 0.1
_S4_A = np.block([[np.eye(2), _DT * np.eye(2)], [np.zeros((2, 2)), np.eye(2)]])


def _s4_f(x):
    return jnp.asarray(_S4_A) @ x


def s4(full_state_measured: bool) -> Case:
    """(b) everything measured, or (a) positions only: the negative control, invariant zeros at -1."""
    C = np.eye(4) if full_state_measured else np.eye(4)[:2]
    return Case(
        system=gx.System(
            _s4_f,
            lambda x: jnp.asarray(C) @ x,
            G=np.vstack([0.005 * np.eye(2), 0.1 * np.eye(2)]),
            H=np.zeros((len(C), 2)),
        ),
        noise=gx.Noise(w=ball([1e-3] * 4), v=ball([0.1] * len(C))),
        initial=ball(np.ones(4)),
        region=Interval.entire(4),
        steps=100,
        d=lambda key, steps: 3 * jax.random.normal(key, (steps, 2)),
    )


# S5, six tanks --------------------------------------------------------------------------------------------------------
_H5, _K5, _S5 = 0.5, 0.015, np.sqrt(19.62)


def _s5_f(x, u):
    r = jnp.sqrt(x)
    hks = _H5 * _K5 * _S5
    return x + jnp.stack(
        [
            _H5 * (-_K5 * _S5 * r[0] + u[0]),
            _H5 * _S5 * (r[0] - r[1]),
            hks * (r[1] - r[2]),
            hks * (r[2] - r[3]),
            hks * (r[3] - r[4]) + _H5 * u[1],
            hks * (r[4] - r[5]),
        ]
    )


def _s5_g(x):
    return jnp.stack([x[1], x[3], x[4]])


def s5(unknown_inputs: bool = True) -> Case:
    G, H = np.zeros((6, 2)), np.zeros((3, 2))
    G[3, 0], H[2, 1] = _H5 * _K5 * _S5, 1.0
    if not unknown_inputs:
        G, H = G[:, :0], H[:, :0]

    def u(steps):
        k = np.arange(steps)
        return np.stack([0.1 + 0.1 * np.sin(0.03 * k), np.full(steps, 0.1)], axis=1)

    def d(key, steps):
        if not unknown_inputs:
            return jnp.zeros((steps, 0))
        return jnp.stack([0.1 + 2 * jnp.sin(0.1 * jnp.arange(steps)), jax.random.normal(key, (steps,)) * 5], axis=1)

    return Case(
        system=gx.System(_s5_f, _s5_g, G=G, H=H, m=2, state_bounds=Interval(np.zeros(6), np.full(6, np.inf))),
        noise=gx.Noise(w=ball([1e-3] * 6), v=ball([0.2] * 3)),
        initial=Interval(np.full(6, 16.0), np.full(6, 24.0)),
        region=Interval(np.full(6, 4.0), np.full(6, 26.0)),
        steps=200,
        d=d,
        u=u,
        u_region=Interval([0.0, 0.1], [0.2, 0.1]),
    )


# S7, quadruple tank ---------------------------------------------------------------------------------------------------
_AREA = np.array([28.0, 32.0, 28.0, 32.0])
_OUTLET = np.array([0.071, 0.057, 0.071, 0.057])
_S7_START = np.array([12.4, 12.7, 1.8, 1.4])
_S7_SPREAD = np.array([1.0, 1.0, 0.5, 0.5])


def _s7_f(gamma, gain, pumps_known):
    def f(h, u):
        q = jnp.asarray(_OUTLET) * jnp.sqrt(2 * 981.0 * h)
        flow = jnp.stack([-q[0] + q[2], -q[1] + q[3], -q[2], -q[3]])
        if pumps_known:
            first, second = gain[0] * u[0], gain[1] * u[1]
            flow = flow + jnp.stack(
                [gamma[0] * first, gamma[1] * second, (1 - gamma[1]) * second, (1 - gamma[0]) * first]
            )
        return h + flow / jnp.asarray(_AREA)

    return f


def s7() -> Case:
    """Pump-1 offset and a bias on the second output are unknown."""
    G, H = np.zeros((4, 2)), np.zeros((2, 2))
    G[0, 0], G[3, 0], H[1, 1] = 0.08325, 0.03122, 1.0
    positive = Interval(np.zeros(4), np.full(4, np.inf))
    return Case(
        system=gx.System(
            _s7_f((0.7, 0.6), (3.33, 3.35), True), lambda h: 0.5 * h[:2], G=G, H=H, m=2, state_bounds=positive
        ),
        noise=gx.Noise(w=ball([0.01] * 4), v=ball([0.02] * 2)),
        initial=Interval(_S7_START - _S7_SPREAD, _S7_START + _S7_SPREAD),
        region=Interval([8.0, 8.0, 0.6, 0.3], [20.0, 20.0, 4.0, 4.0]),
        steps=200,
        d=lambda key, steps: jnp.stack(
            [0.5 * jnp.sin(0.05 * jnp.arange(steps)), jax.random.normal(key, (steps,))], axis=1
        ),
        u=lambda steps: np.full((steps, 2), 3.0),
        u_region=Interval([3.0, 3.0], [3.0, 3.0]),
    )


def s7_negative() -> Case:
    """Both pumps unknown, no feedthrough: the rank condition holds, an invariant zero lies at 1.0128."""
    gamma, gain = (0.43, 0.34), (3.14, 3.29)
    G = np.array(
        [[gamma[0] * gain[0], 0], [0, gamma[1] * gain[1]], [0, (1 - gamma[1]) * gain[1]], [(1 - gamma[0]) * gain[0], 0]]
    )
    base = s7()
    known = _s7_f(gamma, gain, False)
    return Case(
        system=gx.System(
            lambda h: known(h, None), lambda h: 0.5 * h[:2], G=G / _AREA[:, None], H=np.zeros((2, 2)),
            state_bounds=base.system.state_bounds,
        ),
        noise=base.noise,
        initial=base.initial,
        region=base.region,
        steps=50,
        d=lambda key, steps: 3.0 + 0.3 * jax.random.normal(key, (steps, 2)),
    )  # fmt: skip


# S9, unicycle ---------------------------------------------------------------------------------------------------------
def _s9_f(x):
    return jnp.stack([x[0] + 0.3 * jnp.cos(x[2]), x[1] + 0.3 * jnp.sin(x[2]), x[2] + 0.15])


def _s9_g(x):
    def seen(east, north):
        dx, dy = east - x[0], north - x[1]
        return jnp.sqrt(dx**2 + dy**2), x[2] - jnp.arctan(dy / dx)

    return jnp.stack([*seen(5.0, 15.0), *seen(15.0, 15.0)])


def s9() -> Case:
    G, H = np.zeros((3, 2)), np.zeros((4, 2))
    G[2, 0], H[0, 1] = 1.0, 1.0
    start = np.array([0.1, 0.2, 1.0])
    arena = Interval([-6.0, -5.0, -np.inf], [4.0, 6.0, np.inf])
    return Case(
        system=gx.System(_s9_f, _s9_g, G=G, H=H, state_bounds=arena),
        noise=gx.Noise(w=ball([0.02] * 3), v=Interval([-0.01, -0.01, -0.02, -0.03], [0.01, 0.02, 0.01, 0.02])),
        initial=Interval(start * [0.9, 0.9, 0.8], start * [1.1, 1.1, 1.2]),
        region=Interval([-2.0, -2.0, 0.0], [2.0, 5.0, 12.0]),
        steps=40,
        d=lambda key, steps: jnp.stack(
            [0.05 * jnp.sin(0.2 * jnp.arange(steps)), jax.random.normal(key, (steps,))], axis=1
        ),
    )
