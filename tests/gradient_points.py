"""Gradients of a run against central differences, at random points of a test system and in random directions.

The gradient goes through `tuning.fold`, the differences through `estimate`, so each checks the other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import systems

import gsisio_jax as gx
from gsisio_jax.tuning import fold

STEPS = 6
STEP = 1e-6
KINDS = ("initial box", "record", "noise")


@dataclass(frozen=True)
class Report:
    """Derivatives along one direction per point and kind of argument, (points, kinds).

    `kink` marks where the differences to both sides differ by more than their own error.
    """

    gradient: np.ndarray
    central: np.ndarray
    left: np.ndarray
    right: np.ndarray

    @property
    def kink(self) -> np.ndarray:
        return np.abs(self.left - self.right) > 1e-4 * self.size

    @property
    def size(self) -> np.ndarray:
        return np.maximum(np.abs(self.central), 1e-2)

    @property
    def error(self) -> np.ndarray:
        """Relative error; 0 at kinks."""
        return np.where(self.kink, 0, np.abs(self.gradient - self.central) / self.size)

    @property
    def between(self) -> np.ndarray:
        """The derivative lies between those to both sides (to within the error of a difference)."""
        low, high = np.minimum(self.left, self.right), np.maximum(self.left, self.right)
        room = 1e-4 * self.size
        return (low - room <= self.gradient) & (self.gradient <= high + room)


class Checker:
    """A test system, with its gradient and its values compiled for `points` points."""

    def __init__(self, case: systems.Case, points: int):
        self.case, self.points = replace(case, steps=STEPS), points
        observer, u = case.design(missing=False), jnp.asarray(case.u(STEPS))
        self.gradients = jax.jit(jax.vmap(jax.grad(lambda at: folded(observer, u, at))))
        self.values = jax.jit(jax.vmap(lambda at: score(observer, u, at)))

    def draw(self, seed: int = 5) -> Any:
        """Random initial boxes, records and noise bounds around those of the system, as NumPy arrays."""
        initial, noise = self.case.initial, self.case.noise

        @jax.vmap
        def one(key: Any) -> Any:
            keys = jax.random.split(key, 7)

            def moved(key: Any, bound: Any) -> Any:
                return bound * jax.random.uniform(key, bound.shape, minval=0.6, maxval=1.4)

            record, _ = self.case.simulate(keys[0])
            low, high = moved(keys[1], initial.radius), moved(keys[2], initial.radius)
            bounds = [
                gx.Interval(moved(a, box.lower), moved(b, box.upper))
                for a, b, box in ((keys[3], keys[4], noise.w), (keys[5], keys[6], noise.v))
            ]
            return gx.Interval(initial.center - low, initial.center + high), record.y, gx.Noise(*bounds)

        return jax.tree.map(np.array, one(jax.random.split(jax.random.key(seed), self.points)))

    def check(self, point: Any, seed: int = 3) -> Report:
        random = np.random.default_rng(seed)
        slopes = self.gradients(point)
        columns = []
        for kind in range(len(KINDS)):
            along = tuple(
                jax.tree.map(lambda x, on=(i == kind): on * random.standard_normal(x.shape), part)
                for i, part in enumerate(point)
            )

            def at(by: float, along: Any = along) -> np.ndarray:
                return np.asarray(self.values(jax.tree.map(lambda x, d: x + by * d, point, along)))

            behind, here, ahead = at(-STEP), at(0.0), at(STEP)
            products = jax.tree.map(lambda g, d: (np.asarray(g) * d).reshape(self.points, -1).sum(-1), slopes, along)
            gradient = sum(jax.tree.leaves(products))
            columns.append((gradient, (ahead - behind) / (2 * STEP), (here - behind) / STEP, (ahead - here) / STEP))
        return Report(*(np.stack(parts, axis=1) for parts in zip(*columns, strict=True)))


def _finite(value: Any) -> Any:
    return jnp.where(jnp.isfinite(value), value, 0).sum()


def score(observer: gx.Observer, u: Any, at: Any) -> Any:
    """Sum of the finite widths at the last step and of the finite margins."""
    est = gx.estimate(observer, at[0], at[1], u, at[2])
    return sum(_finite(box.width[-1]) for box in (est.state, est.input, est.current_input)) + _finite(est.margin)


def folded(observer: gx.Observer, u: Any, at: Any) -> Any:
    """The same by `fold`."""

    def update(state: Any, out: Any, k: Any) -> Any:
        widths = sum(_finite(box.width) for box in (out.state, out.input, out.current_input))
        return widths, state[1] + _finite(out.margin)

    zero = jnp.zeros((), at[1].dtype)
    return sum(fold(observer, at[0], at[1], update, (zero, zero), u, at[2]))
