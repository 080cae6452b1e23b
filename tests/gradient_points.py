"""Gradients of a run against central differences, at random points of a test system and in random directions; and
points at which a careless derivative is NaN.

The gradient may go through `tuning.fold`: the differences go through `estimate`, so each checks the other.
"""

from __future__ import annotations

from collections.abc import Callable
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
NAN, INF = np.nan, np.inf
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
    """A test system, with its gradient and its values compiled for `points` points.

    `through` is what the gradient goes through, `score` or `folded`; `jit` compiles, or stands in for it; `options` are
    those of the design.
    """

    def __init__(
        self, case: systems.Case, points: int, through: Callable[..., Any], jit: Any = jax.jit, **options: Any
    ):
        self.case, self.points = replace(case, steps=STEPS), points
        observer, u = case.design(missing=False, **options), jnp.asarray(case.u(STEPS))
        self.gradients = jit(jax.vmap(jax.grad(lambda at: through(observer, u, at))))
        self.values = jit(jax.vmap(lambda at: score(observer, u, at)))
        self.estimates = jit(jax.vmap(lambda at: gx.estimate(observer, at[0], at[1], u, at[2])))

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

    def hard(self) -> tuple[list[str], Any]:
        """Points at which a careless derivative is NaN, with their names; the rest of the batch stays random."""
        initial, y, noise = self.draw()
        names: list[str] = []

        def at(name: str) -> int:
            names.append(name)
            return len(names) - 1

        y[at("one row missing"), 2] = NAN
        y[at("one entry missing"), 3, 0] = NAN
        y[at("first row missing"), 0] = NAN
        y[at("last row missing"), -1] = NAN
        y[at("all rows missing")] = NAN
        i = at("initial box infinite")
        initial.lower[i], initial.upper[i] = -INF, INF
        initial.upper[at("one side infinite"), 0] = INF
        i = at("initial box infinite, first row missing")
        initial.lower[i], initial.upper[i], y[i, 0] = -INF, INF, NAN
        i = at("initial box infinite, all rows missing")
        initial.lower[i], initial.upper[i], y[i] = -INF, INF, NAN
        i = at("initial box of zero width")
        initial.lower[i] = initial.upper[i] = self.case.initial.center
        i = at("initial box of zero width at 0")
        initial.lower[i] = initial.upper[i] = 0
        i = at("no noise")
        for bound in jax.tree.leaves(noise):
            bound[i] = 0
        i = at("no noise, initial box of zero width, all zero")
        for bound in jax.tree.leaves((initial, y, noise)):
            bound[i] = 0
        i = at("noise without bounds")
        noise.v.lower[i], noise.v.upper[i] = -INF, INF
        i = at("lower side at 0")
        initial.lower[i] = 0
        y[at("conflict in row 0"), 0] += 1e3
        y[at("conflict in row 3"), 3] -= 1e3
        i = at("conflict, then a missing row")
        y[i, 3], y[i, 4] = y[i, 3] + 1e3, NAN
        i = at("conflict with an infinite initial box")
        initial.lower[i], initial.upper[i], y[i, 2] = -INF, INF, 1e6
        i = at("huge initial box")
        initial.lower[i], initial.upper[i] = -1e150, 1e150
        i = at("tiny noise")
        for bound in jax.tree.leaves(noise):
            bound[i] *= 1e-12
        return names, (initial, y, noise)

    def not_finite(self) -> list[str]:
        """Names of the hard points whose gradient has a NaN or an infinite entry."""
        names, point = self.hard()
        finite = np.ones(self.points, dtype=bool)
        for leaf in jax.tree.leaves(self.gradients(point)):
            finite &= np.isfinite(np.asarray(leaf)).reshape(self.points, -1).all(axis=1)
        names += ["a random point"] * (self.points - len(names))
        return [name for name, good in zip(names, finite, strict=True) if not good]

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
