"""Whole runs of an observer with the tightest possible noise: how many boxes miss the truth."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import jax
import numpy as np
from ival import Interval as I
from oracles.enclosed_plant import enclosed_records, image
from oracles.exact_plant import tight_records
from plants import LINEAR, NONLINEAR, QUADRATIC, linear_observer, nonlinear_observer

import gsisio_jax as gx
from gsisio_jax import Interval
from gsisio_jax.interval.rounding import Rounding


@dataclass
class Runs:
    """Steps looked at, numbers compared with their bounds, misses of states, of inputs and of current inputs, steps
    with a conflict, and how near (in eps of its value) a state comes to a bound."""

    steps: int = 0
    checks: int = 0
    states: int = 0
    inputs: int = 0
    currents: int = 0
    alarms: int = 0
    closest: float = np.inf

    def add(self, other: Runs) -> None:
        for name in ("steps", "checks", "states", "inputs", "currents", "alarms"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.closest = min(self.closest, other.closest)

    @property
    def misses(self) -> int:
        return self.states + self.inputs + self.currents


def observer_of(name: str, dtype: Any) -> gx.Observer:
    return nonlinear_observer(name) if name in NONLINEAR else linear_observer(name, dtype)


@lru_cache
def estimator(name: str, dtype: Any, rounding: Rounding) -> Any:
    """Compiled, over a batch of records with a noise box for every step."""
    observer = observer_of(name, dtype)

    def one(initial: Interval, y: Any, u: Any, w: Interval, v: Interval) -> Any:
        known = u if u.shape[-1] else None
        est = gx.estimate(observer, initial, y, known, noise=gx.Noise(w, v), rounding=rounding)
        return est.state, est.input, est.current_input, est.status

    return jax.jit(jax.vmap(one, in_axes=(0, 0, None, 0, 0)))


def run(
    name: str, seed: int, batch: int, steps: int, dtype: Any, d_sizes: Any = (1.0,), rounding: Rounding = "outward"
) -> Runs:
    """A batch of records of one plant; unknown inputs of all sizes in turn, half of the records with no noise but what
    rounding leaves, two of three from one known point."""
    rng = np.random.default_rng([seed, sum(map(ord, name))])
    noise = np.where(np.arange(batch) % 2, 10.0 ** rng.uniform(-9, -3, batch), 0)
    plant: Any = NONLINEAR.get(name) or (QUADRATIC if name == "quadratic" else LINEAR[name])
    if name in NONLINEAR:
        record, u = enclosed_records(rng, plant, batch, steps, noise, dtype)
    else:
        sizes = np.resize(np.asarray(d_sizes, float), batch)
        record, u = tight_records(rng, plant, batch, steps, sizes, noise, dtype), np.zeros((steps, 0), dtype)
    start = np.where(np.arange(batch) % 3 == 2, 10.0 ** rng.uniform(-6, 0, batch), 0).astype(dtype)[:, None]
    first = record.x[:, 0]
    # The ends around the point: the sum is rounded, so one number further out.
    wide = (np.nextafter(first - start, dtype(-np.inf)), np.nextafter(first + start, dtype(np.inf)))
    box = [np.where(start > 0, side, first) for side in wide]
    boxes = [Interval.unchecked(*pair) for pair in (box, record.w, record.v)]
    state, given, current, status = jax.device_get(estimator(name, dtype, rounding)(boxes[0], record.y, u, *boxes[1:]))
    assert state.lower.dtype == dtype
    d = record.d[:, :-1]
    size = np.abs(record.x.astype(np.float64)) * np.finfo(dtype).eps + np.finfo(dtype).tiny
    x = record.x.astype(np.float64)
    room = (np.minimum(x - state.lower, state.upper - x) / size)[:, 1:]
    now = current_truth(observer_of(name, dtype), plant, record.d)
    return Runs(
        batch * steps,
        record.x.size + d.size + now.lo.size,
        int((~((state.lower <= record.x) & (record.x <= state.upper))).sum()),
        int((~((given.lower <= d) & (d <= given.upper))).sum()),
        int(((now.hi < current.lower) | (now.lo > current.upper)).sum()),
        int((status & int(gx.Status.CONFLICT) != 0).sum()),
        float(room.min()),
    )


def current_truth(observer: gx.Observer, plant: Any, d: np.ndarray) -> Any:
    """``current @ H d`` for the matrix that the observer has, in the type of d: what `current_input` is the box of."""
    K = np.asarray(observer.current).astype(d.dtype).astype(np.float64)
    inputs = [I(d[..., i].astype(np.float64)) for i in range(d.shape[-1])]
    through = [image(row, inputs) / float(plant.H_over) for row in plant.H_whole]
    found = [image(row, through) for row in K]
    shape = (*d.shape[:2], len(K))
    if not found:
        return I(np.zeros(shape))
    return I(
        np.stack([np.broadcast_to(v.lo, shape[:2]) for v in found], -1),
        np.stack([np.broadcast_to(v.hi, shape[:2]) for v in found], -1),
    )
