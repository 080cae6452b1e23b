"""How a step bounds f and g: as rows over a few atoms where they are small, as affine forms over arrays elsewhere.

Both give `AtomBounds` of a box, and `Rows` for linear combinations of f and g over them; the step does not know which
of the two it has.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.atoms import AtomBounds, Rows, States, of_constant, widened_atoms, wider
from gsisio_jax.inclusion.expansion import Expansion
from gsisio_jax.inclusion.intersection import DEFAULT, bound
from gsisio_jax.inclusion.reader import expand
from gsisio_jax.interval.box import Interval, is_concrete, magnitude
from gsisio_jax.interval.primitives import matmul, scale
from gsisio_jax.observer.measurement import value_at
from gsisio_jax.observer.types import Observer


class Plain:
    """The maps of a system as a key: two systems with the same f, g and sizes have the same expansion."""

    def __init__(self, system: Any):
        self.maps, self.n, self.m = system.maps, system.n, system.m
        calls = system.f_takes_u, system.g_takes_u, system.captured
        self._key = system.f, system.g, *calls, system.n, system.l, system.m

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Plain) and self._key == other._key


@lru_cache(maxsize=16)  # it holds f and g, and what they hold
def _expansion(plain: Plain, dtype: Any) -> Expansion | None:
    return expand(plain.maps, plain.n, plain.m, dtype)


@dataclass(frozen=True)
class Maps:
    """Bounds of [f; g] and of the unknown-input-free outputs T2 g, for one observer while a step is traced.

    Attributes:
        observer: with concrete gains, or traced ones.
        dtype: of the data.
        expansion: None where f and g are bounded over arrays: other methods than the default, large maps, or operations
            that are no functions of single numbers.
    """

    observer: Observer
    dtype: Any
    expansion: Expansion | None

    @classmethod
    def of(cls, observer: Observer, dtype: Any) -> Maps:
        # What is concrete is a constant of the program, also where JAX holds it.
        observer = jax.tree.map(lambda leaf: np.asarray(leaf) if is_concrete(leaf) else leaf, observer)
        system = observer.system
        found = _expansion(Plain(system), np.dtype(dtype)) if observer.bounds == DEFAULT else None
        return cls(observer, dtype, found)

    @property
    def terms(self) -> int:
        """Number of terms that a row can have, for rounding."""
        system = self.observer.system
        atoms = system.n + system.l if self.expansion is None else len(self.expansion.atoms)
        steps = max(
            (rows.terms for rows in (self.observer.window, self.observer.input_rows) if rows is not None), default=0
        )
        return system.n + atoms + self.observer.T2.shape[0] + 4 + steps

    @property
    def written(self) -> int:
        """Rounds with a value of psi that are written out; more are a loop. Over arrays psi is most of a step."""
        return 1 if self.expansion is None else 3

    def states(self, box: Interval) -> States:
        return States.of(box, self.terms)

    def bounds(self, states: States, box: Interval, u: Any) -> AtomBounds:
        """Atoms of [f; g] on a box, with their values at its center where the certificate asks for them."""
        observer, promised = self.observer, self.observer.certificate.promised
        if self.expansion is not None:
            return self.expansion.bounds(states, u, with_values=promised)
        form = bound(observer.system.maps, observer.bounds, observer.abstraction)(box, u)
        found = widened_atoms(form.slope, form.offset, form.range, states, self.terms)
        value, error = self._at(observer.system.maps, states.center, u) if promised else (None, None)
        return replace(found, value=value, value_error=error)

    def free_bounds(self, states: States, box: Interval, u: Any) -> AtomBounds:
        """Atoms of T2 g on a box."""
        if self.expansion is not None:
            return self.expansion.bounds(states, u, self.expansion.used_by(self.free))
        observer = self.observer
        form = bound(self._free_map, observer.bounds, observer.output_abstraction)(box, u)
        return widened_atoms(form.slope, form.offset, form.range, states, self.terms)

    def output_bounds(self, states: States, box: Interval, u: Any) -> AtomBounds:
        """Atoms of [f; g] on a box, of which those that g does not need may be anything."""
        system = self.observer.system
        if self.expansion is not None:
            of_g = self.expansion.rows(self.on_outputs(np.eye(system.l)), self.dtype)
            return self.expansion.bounds(states, u, self.expansion.used_by(of_g))
        form = bound(system.measurement, self.observer.bounds, None)(box, u)
        zero = jnp.zeros(system.n, self.dtype)
        slope, ranges = (
            jnp.concatenate([jnp.zeros((system.n, system.n), self.dtype), form.slope]),
            (form.offset, form.range),
        )
        offset, natural = (
            Interval.unchecked(*(jnp.concatenate([zero, side]) for side in (b.lower, b.upper))) for b in ranges
        )
        return widened_atoms(slope, offset, natural, states, self.terms)

    def free_at(self, x: Any, u: Any) -> tuple[Any, Any]:
        """Atoms of T2 g at a point, and what rounding leaves of them."""
        if self.expansion is not None:
            return self.expansion.values(x, u, self.expansion.used_by(self.free))
        return self._at(self._free_map, x, u)

    def _at(self, function: Any, x: Any, u: Any) -> tuple[Any, Any]:
        value = value_at(function, x, u)
        extra = wider(magnitude(value), self.terms)
        return value.center, value.radius + extra

    def on_outputs(self, weights: Any) -> Any:
        """Weights (r, l) of g as weights (r, n + l) of [f; g]."""
        xp = np if is_concrete(weights) else jnp
        return xp.concatenate([xp.zeros((weights.shape[0], self.observer.system.n)), weights], axis=1)

    def rows(self, weights: Any, minus: Any = None) -> Rows:
        """``weights @ [f; g] - minus @ x`` for weights (r, n + l), over `bounds`."""
        if self.expansion is not None:
            return self.expansion.rows(weights, self.dtype, minus)
        return self._over_arrays(weights, minus)

    @cached_property
    def free(self) -> Rows:
        """T2 g, over `free_bounds`."""
        return self._free_rows(None)

    @cached_property
    def remainder(self) -> Rows:
        """psi = T2 g - C x, over `free_bounds`."""
        return self._free_rows(self.observer.C)

    def _free_rows(self, minus: Any) -> Rows:
        T2 = self.observer.T2
        if self.expansion is not None:
            return self.expansion.rows(self.on_outputs(T2), self.dtype, minus)
        return self._over_arrays(jnp.eye(T2.shape[0], dtype=self.dtype), minus)

    def _over_arrays(self, weights: Any, minus: Any) -> Rows:
        states = jnp.zeros((weights.shape[0], self.observer.system.n), self.dtype) if minus is None else -minus
        return Rows(
            jnp.asarray(states, self.dtype), jnp.asarray(weights, self.dtype), jnp.zeros(len(weights), self.dtype)
        )

    def _free_map(self, x: Any, u: Any) -> Any:
        return self.observer.T2 @ self.observer.system.measurement(x, u)


def at_point(rows: Rows, x: Any, x_error: Any, value: Any, value_error: Any) -> tuple[Any, Any]:
    """Center and radius (r,) of a linear combination at a point x, from values of the atoms there."""
    center = matmul(rows.states, x) + matmul(rows.atoms, value) + rows.constant
    radius = matmul(abs(rows.states), x_error) + scale(abs(rows.atoms), value_error).sum(-1)
    return center, radius + of_constant(rows.constant)
