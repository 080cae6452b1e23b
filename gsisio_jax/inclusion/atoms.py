"""Boxes of states and atoms, and linear combinations of them, widened once for all rows.

**Rounding.** Let a row have N terms in all (states, atoms, a constant) and T = sum |L_i| m_i + sum |A_j| q_j, where
``m_i >= |x_i|`` and ``q_j = sum_i |s_ji| m_i + |offset_j|``. Slopes combined, weights rounded once from fractions,
products and sums are each off by eps of a term of T, N + 4 times at most for each of two levels: in all less than
``(2 N + 12) eps T``, plus what is flushed to zero. So every offset is made wider by ``kappa q_j`` and every state by
``kappa m_i``, with ``kappa = (2 N + 16) eps``, ONCE for a box: a row of weights w then takes in
``sum |w_i| kappa m_i + sum |w_j| kappa q_j = kappa T`` by itself, whatever its weights are, and needs no error term of
its own. For ranges the same with ``|range_j|`` in the place of q_j. Flushed numbers lose less than ``2^60 tiny``, see
`rounding.generous`; that is added to every offset and state.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, center_and_radius
from gsisio_jax.interval.direct import multiple_and_more, where
from gsisio_jax.interval.image import faint, plain_sums
from gsisio_jax.interval.minmax import cut, raised
from gsisio_jax.interval.primitives import matmul, scale


class States(eqx.Module):
    """The box of x as atoms and rows use it: center, radius, `error` = kappa m, and both sides widened by it.

    Every field has shape (n,); a radius may be infinite, a center never is.
    """

    center: Any
    radius: Any
    magnitude: Any
    error: Any
    wide: Interval

    @classmethod
    def of(cls, box: Interval, terms: int) -> States:
        box = Interval.unchecked(jnp.asarray(box.lower), jnp.asarray(box.upper))
        center, radius = center_and_radius(box)
        magnitude = abs(center) + radius
        error = wider(magnitude, terms)
        return cls(center, radius + error, magnitude, error, Interval.unchecked(box.lower - error, box.upper + error))


class AtomBounds(eqx.Module):
    """Bounds of J atoms on a box, widened so that linear images need no more rounding (module docstring).

    Attributes:
        slope: (J, n).
        center, radius: (J,) of the offset: ``|a - slope x - center| <= radius``.
        range: box (J,).
        value, value_error: (J,) the atoms at the center of the box, and their rounding error; None if not asked for.
    """

    slope: Any
    center: Any
    radius: Any
    range: Interval
    value: Any = None
    value_error: Any = None


def wider(size: Any, terms: int) -> Any:
    """kappa times `size`, for rows of up to so many terms; a constant for gradients. 0 to nearest."""
    if not rounding.outward():
        return jnp.zeros_like(size)
    info = jnp.finfo(size.dtype)
    kind = np.dtype(size.dtype).type
    kappa, floor = kind((2 * terms + 16) * float(info.eps)), kind(rounding.FLUSHED * float(info.tiny))
    return multiple_and_more(jax.lax.stop_gradient(size), kappa, floor)


def of_constant(constant: Any) -> Any:
    """What a constant of a row is off by; nothing where it is 0."""
    size = jnp.asarray(abs(constant))
    return where(size == 0, 0, wider(size, 0))


class Rows(eqx.Module):
    """Linear combinations ``states x + atoms a(x) + constant``: weights (r, n), (r, J) and (r,).

    `lost` holds the sums of magnitudes that the weights were made of, (r, n) and (r, J), where they are not known while
    tracing: what cancels in them is then rounded at the size of its parts. None where they were rounded once.
    """

    states: Any
    atoms: Any
    constant: Any
    lost: Any = None

    def joint(self, states: States, atoms: AtomBounds) -> tuple[Any, Any]:
        """Center and radius (r,), slopes combined before the box is applied."""
        slope = self.slope(atoms)
        center = matmul(slope, states.center) + matmul(self.atoms, atoms.center) + self.constant
        radius = scale(abs(slope), states.radius).sum(-1) + scale(abs(self.atoms), atoms.radius).sum(-1)
        return center, radius + self.rounding_error(states, atoms)

    def rounding_error(self, states: States, atoms: AtomBounds) -> Any:
        """What the slopes of the states, the constant, and weights that were rounded are off by, (r,)."""
        error = scale(abs(self.states), states.error).sum(-1) + of_constant(self.constant) + self._faint()
        if self.lost is None or not rounding.outward():
            return error
        far = jnp.maximum(abs(atoms.range.lower), abs(atoms.range.upper))
        size = scale(abs(atoms.slope), states.magnitude).sum(-1) + abs(atoms.center) + atoms.radius
        size = jnp.maximum(size, where(jnp.isfinite(far), far, 0))
        of_states, of_atoms = self.lost
        return error + wider(
            scale(of_states, states.magnitude).sum(-1) + scale(of_atoms, size).sum(-1), self.atoms.shape[-1]
        )

    def _faint(self) -> Any:
        return faint(self.states) + faint(self.atoms)

    def joint_box(self, states: States, atoms: AtomBounds) -> Interval:
        """The same as a box (r,)."""
        center, radius = self.joint(states, atoms)
        return Interval.unchecked(center - radius, center + radius)

    def slope(self, atoms: AtomBounds) -> Any:
        """(r, n), up to rounding that `AtomBounds` has taken in."""
        return self.states + matmul(self.atoms, atoms.slope)

    def natural(self, states: States, atoms: AtomBounds) -> Interval:
        """Box (r,) from ranges alone."""
        weights = jnp.concatenate([jnp.asarray(self.states), jnp.asarray(self.atoms)], -1)
        lower = jnp.concatenate([states.wide.lower, atoms.range.lower])
        upper = jnp.concatenate([states.wide.upper, atoms.range.upper])
        low, high = plain_sums(weights, Interval.unchecked(lower, upper))
        error = of_constant(self.constant) + self._faint() if self.lost is None else self.rounding_error(states, atoms)
        return Interval.unchecked(low + (self.constant - error), high + (self.constant + error))

    def bounds(self, states: States, atoms: AtomBounds) -> Interval:
        """The intersection of both, box (r,)."""
        joint, natural = self.joint_box(states, atoms), self.natural(states, atoms)
        return Interval.unchecked(raised(natural.lower, joint.lower), cut(natural.upper, joint.upper))


def widened_atoms(slope: Any, offset: Interval, natural: Interval, states: States, terms: int) -> AtomBounds:
    """Bounds of any functions as atoms: affine forms (J, n), (J,) and ranges, each valid by itself."""
    center, radius = offset.center, offset.radius
    size = scale(abs(slope), states.magnitude).sum(-1) + abs(center) + radius
    far = jnp.maximum(abs(natural.lower), abs(natural.upper))
    error = wider(where(jnp.isfinite(far), far, 0), terms)
    # The radius of an interval is itself rounded.
    radius = radius + wider(where(jnp.isfinite(size), size, 0), terms)
    radius = where(jnp.isfinite(size), radius, jnp.inf)
    return AtomBounds(slope, center, radius, Interval.unchecked(natural.lower - error, natural.upper + error))
