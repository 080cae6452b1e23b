"""Atoms and their arguments on a box, as forms and ranges, each valid by itself.

Rounding: see `atoms`, and `atom_bounds` for atoms of atoms.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.atoms import States, widened_atoms
from gsisio_jax.inclusion.node import Form, InputBox, Node
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, choose, nan_to_unbounded
from gsisio_jax.interval.direct import where
from gsisio_jax.interval.minmax import cut, raised
from gsisio_jax.interval.primitives import scale


@dataclass
class BoundedAtom:
    """An atom a on a box: ``|a - slope x - center| <= radius`` and its range; see `AtomBounds`.

    Attributes:
        value: at the center of the box with its rounding error, where that is known already.
        size: its q, see `magnitude`; None until it is asked for.
    """

    slope: Any
    center: Any
    radius: Any
    range: Interval
    value: Any = None
    size: Any = None

    def magnitude(self, states: States) -> Any:
        """The q of an atom, at least its range: ``sum |slope_i| m_i + |center| + radius``."""
        if self.size is None:
            size = jnp.maximum(abs(self.range.lower), abs(self.range.upper))
            form = abs(self.center) + self.radius
            for k, part in enumerate(self.slope):
                form = form if is_zero(part) else form + scale(abs(part), states.magnitude[k])
            self.size = jnp.maximum(size, form)
        return jax.lax.stop_gradient(self.size)


@dataclass
class Argument:
    """A linear argument t: its range, ``|t - slope x - center| <= radius``, and ``sum |slope_i| m_i + |center| +
    radius <= size``.

    Range and form are valid each by itself. Of the states alone (`plain`), the weights are known, and what the radius
    stands for is rounding that a share of the size takes in.
    """

    range: Interval
    slope: list[Any]
    center: Any
    radius: Any
    size: Any
    plain: bool

    def node(self, domain: InputBox) -> Node:
        """For the rules of the engine over arrays."""
        center, radius = self.center, self.radius
        offset = Interval.unchecked(jnp.asarray(center - radius), jnp.asarray(center + radius))
        slope: Any = np.asarray(self.slope) if self.plain else joined(self.slope, domain.lower.dtype)
        return Node(self.range, Form(slope, offset if self.plain else nan_to_unbounded(offset), domain))


def from_node(node: Node, states: States, terms: int) -> BoundedAtom:
    """What a rule of the engine over arrays made, as an atom."""
    natural = nan_to_unbounded(node.range)
    n, dtype = len(states.center), states.center.dtype
    if node.form is None:
        slope: Any = np.zeros(n, dtype)
        offset = natural
    else:
        slope, offset = node.form.slope, nan_to_unbounded(node.form.folded())
    found = widened_atoms(slope, offset, natural, states, terms)
    parts = [np.asarray(slope[k]) if isinstance(slope, np.ndarray) else slope[k] for k in range(n)]
    return BoundedAtom(parts, found.center, found.radius, found.range)


def joined(parts: list[Any], dtype: Any) -> Any:
    """Numbers or arrays, some of them known while tracing, as one array."""
    return jnp.stack([jnp.asarray(part, dtype) for part in parts])


def is_zero(value: Any) -> bool:
    """Known to be 0 while tracing."""
    return isinstance(value, np.ndarray | np.generic) and not value.any()


def flushed(size: Any) -> Any:
    """What makes T larger for what is flushed to zero in an argument, see `atom_bounds`."""
    info = jnp.finfo(size.dtype)
    return np.dtype(size.dtype).type(float(info.tiny) / float(info.eps))


def padding(size: Any, ulps: Any, floor: float) -> Any:
    if not rounding.outward():
        return np.zeros((), size.dtype)
    return rounding.error(size, ulps, floor)


def chosen(
    usable: Any, center: Any, radius: Any, pad: Any, size: Any, natural: Interval, kappa: float, flat: bool, best: bool
) -> tuple[Any, Any, Any, Any]:
    """Is a form used, its center and radius and 4 times its `size`; else those of the range, as a form of slope 0.

    Args:
        flat: the range may be finite where no form is usable.
        best: it may be narrower than the form; where it is not by more than rounding, the slope is kept.
    """
    usable = usable & (size < float(jnp.finfo(size.dtype).max) / 64)
    lower, upper = natural.lower, natural.upper
    far = jnp.maximum(abs(lower), abs(upper))
    middle, half = np.zeros((), size.dtype), np.asarray(np.inf, size.dtype)
    if flat:
        half = 0.5 * upper - 0.5 * lower
        middle = where(half < jnp.inf, 0.5 * lower + 0.5 * upper, 0)
        # Its own rounding, and rows of it.
        half = half + padding(far, 2 * kappa + 8, rounding.FLUSHED)
        if best:
            usable = usable & (radius <= half + pad)
    center, radius = where(usable, center, middle), where(usable, radius + pad, half)
    return usable, center, radius, where(usable, 4 * size, 2 * far)


def met_with_form(natural: Interval, slope: list[Any], center: Any, radius: Any, states: States) -> Interval:
    """A range met with the image of a form; the range itself where rounding makes the two miss each other."""
    middle, spread = center, radius
    for k, part in enumerate(slope):
        if not is_zero(part):
            middle, spread = middle + part * states.center[k], spread + scale(abs(part), states.radius[k])
    met = Interval.unchecked(raised(natural.lower, middle - spread), cut(natural.upper, middle + spread))
    return nan_to_unbounded(choose(met.lower <= met.upper, met, natural))
