"""Nonlinear plants whose equations hold as they stand, and noise bounds that are hardly wider than the noise.

x, y, d and u are floating numbers. What the equations leave for w and v is enclosed in crival's interval arithmetic,
some ulps wide, and that enclosure, rounded outward to the type of the run, is the bound."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import ival
import numpy as np
from ival import Interval as I
from oracles.exact_plant import Record


@dataclass(frozen=True)
class Nonlinear:
    """``x+ = f(x, u) + G d + w``, ``y = g(x) + H d + v`` with ``H = H_whole / H_over``.

    f and g take lists of numbers, and a module with the functions (`jnp`, `numpy` or `ival`) first; what they are made
    of are Python floats that float32 knows, too, so that both precisions mean the same plant.
    """

    f: Callable[[Any, Any, Any], list[Any]]
    g: Callable[[Any, Any], list[Any]]
    G: np.ndarray
    H_whole: np.ndarray
    H_over: float
    start: tuple[np.ndarray, np.ndarray]
    d: Callable[[np.random.Generator, tuple[int, int]], np.ndarray]
    u: Callable[[int], np.ndarray] = lambda steps: np.zeros((steps, 0))

    @property
    def H(self) -> np.ndarray:
        return self.H_whole / self.H_over


def enclosed_records(
    rng: np.random.Generator, plant: Nonlinear, batch: int, steps: int, noise: Any, dtype: Any
) -> tuple[Record, np.ndarray]:
    """Runs of a plant, and its known inputs; `noise` is a number, or one for every run."""
    n, l = len(plant.G), len(plant.H)
    sizes = np.broadcast_to(np.asarray(noise, float), (batch,))[:, None]
    x, y = np.zeros((batch, steps, n), dtype), np.zeros((batch, steps, l), dtype)
    u, d = plant.u(steps).astype(dtype), plant.d(rng, (batch, steps)).astype(dtype)
    low, high = plant.start
    x[:, 0] = low + rng.random((batch, n)) * (high - low)
    for k in range(steps):
        now, known = list(x[:, k].astype(np.float64).T), [np.float64(v) for v in u[k]]
        given = d[:, k].astype(np.float64)
        y[:, k] = np.stack(plant.g(np, now), 1) + given @ plant.H.T + sizes * rng.uniform(-1, 1, (batch, l))
        if k + 1 < steps:
            moved = np.stack(plant.f(np, now, known), 1) + given @ plant.G.T
            x[:, k + 1] = moved + sizes * rng.uniform(-1, 1, (batch, n))
    now, given = ([I(side[..., i].astype(np.float64)) for i in range(side.shape[-1])] for side in (x, d))
    known = [I(np.broadcast_to(u[:, i].astype(np.float64), (batch, steps)).copy()) for i in range(u.shape[1])]
    seen, moved = plant.g(ival, now), plant.f(ival, now, known)
    v = [I(y[..., i].astype(np.float64)) - seen[i] - image(plant.H_whole[i], given) / plant.H_over for i in range(l)]
    following = np.concatenate([x[:, 1:], x[:, -1:]], 1).astype(np.float64)
    w = [I(following[..., i]) - moved[i] - image(plant.G[i], given) for i in range(n)]
    return Record(x, y, d, _outward(w, dtype), _outward(v, dtype)), u


def image(row: Any, d: Any) -> Any:
    """A row of floats times interval entries."""
    return sum((float(m) * t for m, t in zip(row, d, strict=True)), I(0.0))


def _outward(boxes: list[Any], dtype: Any) -> tuple[np.ndarray, np.ndarray]:
    lower, upper = np.stack([b.lo for b in boxes], -1), np.stack([b.hi for b in boxes], -1)
    a, b = lower.astype(dtype), upper.astype(dtype)
    return (
        np.where(a > lower, np.nextafter(a, dtype(-np.inf)), a),
        np.where(b < upper, np.nextafter(b, dtype(np.inf)), b),
    )
