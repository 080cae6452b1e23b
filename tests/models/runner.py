"""What every model of the gallery states, and one run of it: simulated with known noise and input, then estimated."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import gsisio_jax as gx
from gsisio_jax import Interval

STEPS = 200
INWARD = 1 - 1e-4  # of the drawn noise: room for the rounding of a record to float32


@dataclass(frozen=True)
class Model:
    """A plant as an engineer writes it, and a run of it.

    Designs make one sweep and have no gains for lost measurements, as compiling takes most of the time; models
    whose boxes need more say so in `design`.
    `d` takes the step (an integer array) and gives (steps, p); `u` takes step and true state and gives (m,): the
    controller of the simulation, whose inputs are recorded. `wide` bounds the last widths (n,): what a user expects.
    """

    system: gx.System
    noise: gx.Noise
    initial: Interval
    region: Interval
    wide: Any
    d: Callable[[Any], Any] = lambda k: jnp.zeros((len(k), 0))
    u: Callable[[Any, Any], Any] = lambda k, x: jnp.zeros(0)
    u_region: Interval | None = None
    missing: float = 0.0  # share of measurements that are lost
    design: dict[str, Any] = field(default_factory=dict)

    def observer(self) -> gx.Observer:
        options = {"missing": self.missing > 0, "sweeps": 1} | self.design
        return gx.design_observer(self.system, self.noise, self.region, u_region=self.u_region, **options)


def symmetric(*radius: float) -> Interval:
    return Interval.symmetric(np.asarray(radius, dtype=float))


@dataclass(frozen=True)
class Record:
    x: np.ndarray
    d: np.ndarray
    u: np.ndarray
    y: np.ndarray


def records(model: Model, seed: int = 0) -> list[Record]:
    """Two runs of `STEPS` steps: noise anywhere in its box, and noise at its vertices."""
    random = np.random.default_rng(seed)
    system = model.system
    d = np.asarray(model.d(jnp.arange(STEPS)), dtype=float)
    G, H, B, D = (jnp.asarray(matrix) for matrix in (system.G, system.H, system.B, system.D))

    @jax.jit
    def simulate(x0: Any, w: Any, v: Any) -> Any:
        def turn(x: Any, row: Any) -> Any:
            k, dk, wk, vk = row
            u = model.u(k, x).astype(jnp.float32).astype(x.dtype)  # the same in both precisions
            y = system.measurement(x, u) + D @ u + H @ dk + vk
            return system.dynamics(x, u) + B @ u + G @ dk + wk, (x, u, y)

        return jax.lax.scan(turn, x0, (jnp.arange(STEPS), d, w, v))[1]

    found = []
    for at_vertices in (False, True):
        share = [random.uniform(0, 1, (STEPS, box.shape[0])) for box in (model.noise.w, model.noise.v)]
        share = [np.round(s) if at_vertices else s for s in share]
        w, v = (_inside(box, s) for box, s in zip((model.noise.w, model.noise.v), share, strict=True))
        x0 = _inside(model.initial, random.uniform(0, 1, system.n))
        x, u, y = map(np.array, simulate(x0, w, v))
        y[random.uniform(size=y.shape) < model.missing] = np.nan
        for output, period in system.periodic:
            y[:, output] = np.mod(y[:, output] + period / 2, period) - period / 2
        found.append(Record(x, d, u, y))
    return found


def _inside(box: Interval, share: Any) -> Any:
    """The points of the box at these shares of its width, a little towards its centre."""
    return np.asarray(box.center) + INWARD * (share - 0.5) * np.asarray(box.width)


def estimate(model: Model, observer: gx.Observer, record: Record, dtype: Any = float, **options: Any) -> gx.Estimate:
    initial = model.initial.astype(dtype)
    u = record.u.astype(dtype) if model.system.m else None
    return gx.estimate(observer, initial, record.y.astype(dtype), u, **options)


def misses(record: Record, boxes: gx.Estimate) -> int:
    """Numbers of states and of unknown inputs that lie outside their boxes."""
    x = np.asarray(boxes.state.contains(record.x))
    d = np.asarray(boxes.input.contains(record.d[:-1]))
    return int((~x).sum() + (~d).sum())
