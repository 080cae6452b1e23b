"""A function as a linear map of the state and of a few atoms: ``f(x) = L x + A a(x) + c``.

An atom is the result of an operation that is not linear (a sine, a product), or an entry of the known input. Sums and
multiples between them are collected while tracing, in fractions, so a linear combination of outputs, ``R f(x)``, has
the constant weights ``R L`` and ``R A``: what cancels cancels exactly, and costs nothing at run time.

On a box every atom has a slope and an offset, ``a - s . x in offset``, and a range. Bounds of a combination are the
linear part plus those of the atoms, slopes combined before the box is applied (`joint`), or ranges alone (`natural`).

Rounding: see `atoms`, and `atom_bounds` for atoms of atoms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.atom_bounds import BoxOfAtoms
from gsisio_jax.inclusion.atom_forms import BoundedAtom, joined
from gsisio_jax.inclusion.atom_values import atom_value, stacked_values, thin_box
from gsisio_jax.inclusion.atoms import AtomBounds, Rows, States
from gsisio_jax.inclusion.linear_parts import Atom, Linear
from gsisio_jax.interval.box import Interval, is_concrete
from gsisio_jax.interval.primitives import matmul


@dataclass
class Expansion:
    """``function(x, u) = L x + A a(x, u) + c``, found while tracing.

    Attributes:
        n: number of states.
        atoms: in an order in which each depends on earlier ones only.
        outputs: one `Linear` for every component of the function.
    """

    n: int
    atoms: list[Atom]
    outputs: list[Linear]

    @property
    def terms(self) -> int:
        """Number of terms that a row can have."""
        return self.n + len(self.atoms) + 1

    def rows(self, weights: Any, dtype: Any, minus: Any = None) -> Rows:
        """``weights @ function - minus @ x``, weights (r, outputs); in fractions until the end if they are known."""
        if not (is_concrete(weights) and is_concrete(minus)):
            return self._traced_rows(jnp.asarray(weights, dtype), dtype, minus)
        weights = np.asarray(weights, np.float64)
        minus = np.zeros((len(weights), self.n)) if minus is None else np.asarray(minus, np.float64)
        states = np.zeros((len(weights), self.n), dtype)
        atoms = np.zeros((len(weights), len(self.atoms)), dtype)
        constant = np.zeros(len(weights), dtype)
        for r, row in enumerate(weights):
            total = Linear({i: -Fraction(float(v)) for i, v in enumerate(minus[r]) if v})
            for weight, output in zip(row, self.outputs, strict=True):
                if weight:
                    total = total.plus(output.times(Fraction(float(weight))))
            for k, value in total.coefficients.items():
                (states if k < self.n else atoms)[r, k - (0 if k < self.n else self.n)] = float(value)
            constant[r] = float(total.constant)
        return Rows(states, atoms, constant)

    def _traced_rows(self, weights: Any, dtype: Any, minus: Any) -> Rows:
        each = self.rows(np.eye(len(self.outputs)), dtype)
        states, size = matmul(weights, each.states), matmul(abs(weights), abs(each.states))
        if minus is not None:
            states, size = states - minus, size + abs(minus)
        lost = size, matmul(abs(weights), abs(each.atoms))
        # A constant is rounded at the size of its parts: it becomes part of an error that is there anyway.
        constant = matmul(weights, each.constant)
        return Rows(states, matmul(weights, each.atoms), constant, lost)

    def bounds(
        self, states: States, u: Any, wanted: Sequence[bool] | None = None, with_values: bool = False
    ) -> AtomBounds:
        """Bounds of the atoms on a box, and on request their values at its center; those that are not `wanted`, by
        themselves or by others, may be anything."""
        box, at, thin = BoxOfAtoms(states, u, self.terms), [], thin_box(states.center, self.terms)
        for atom, used in zip(self.atoms, self._needed(wanted), strict=True):
            box.add(atom, used)
            if with_values:
                known = box.found[-1].value
                at.append(atom_value(atom, states.center, thin, u, at, self.terms) if known is None else known)
        return _stacked(box.found, at if with_values else None, states)

    def values(self, x: Any, u: Any, wanted: Sequence[bool] | None = None) -> tuple[Any, Any]:
        """The atoms at a point x, and what rounding leaves of them, (J,) each."""
        found: list[Any] = []
        thin, zero = thin_box(x, self.terms), jnp.zeros_like(x[0])
        for atom, used in zip(self.atoms, self._needed(wanted), strict=True):
            value = atom_value(atom, x, thin, u, found, self.terms) if used else Interval.unchecked(zero, zero)
            found.append(value)
        return stacked_values(found, x.dtype)

    def used_by(self, *rows: Rows) -> list[bool]:
        """Which atoms have a weight in some row."""
        return [
            any(not is_concrete(row.atoms) or bool(np.any(row.atoms[:, j])) for row in rows)
            for j in range(len(self.atoms))
        ]

    def _needed(self, wanted: Sequence[bool] | None) -> list[bool]:
        needed = [True] * len(self.atoms) if wanted is None else list(wanted)
        for j in range(len(self.atoms))[::-1]:
            if needed[j]:
                for argument in self.atoms[j].arguments:
                    for k in argument.coefficients:
                        if k >= self.n:
                            needed[k - self.n] = True
        return needed


def _stacked(found: list[BoundedAtom], at: list[Any] | None, states: States) -> AtomBounds:
    n, dtype = len(states.center), states.center.dtype
    value, error = (None, None) if at is None else stacked_values(at, dtype)
    if not found:
        none = jnp.zeros(0, dtype)
        return AtomBounds(jnp.zeros((0, n), dtype), none, none, Interval.unchecked(none, none), value, error)

    def stack(parts: list[Any]) -> Any:
        return joined(parts, dtype)

    natural = Interval.unchecked(stack([b.range.lower for b in found]), stack([b.range.upper for b in found]))
    slope, center, radius = ([getattr(b, name) for b in found] for name in ("slope", "center", "radius"))
    return AtomBounds(stack([stack(part) for part in slope]), stack(center), stack(radius), natural, value, error)
