"""Affine abstraction (paper, Prop. 1): two planes that enclose f on a region, or two per cell of a mesh of it.

Only the data type and its evaluation live here; the planes are made offline by `gsisio_jax.design.abstraction`.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, entire_like, is_concrete
from gsisio_jax.interval.cast import cast_down, cast_up
from gsisio_jax.interval.image import products


class Abstraction(eqx.Module):
    """Planes ``lower_slope x + lower_offset <= f(x) <= upper_slope x + upper_offset`` for x in `region`; a pytree.

    For a mesh every array has one axis more, over the cells, in front; each cell has its own planes.

    Attributes:
        region: box (n,), or for a mesh the cells (cells, n), which tile a box; units [x].
        lower_slope, upper_slope: shape (cells?, m, n), units [f]/[x].
        lower_offset, upper_offset: shape (cells?, m), units [f].
        theta: (cells?, m), optimum of the linear program, component by component: the planes' largest distance
            before f was enclosed between the vertices. The paper's one number is `printed_theta`.
        sigma: (cells?, m), what the smoothness class asks to add to either plane.
        gap: (cells?, m), largest distance of the planes: at most ``theta + 2 sigma``, less where a tighter
            enclosure was proved.
        verified: "engine": the planes were proved by bounding f on sub-boxes; "sigma": by the smoothness class.

    Source: paper, Prop. 1 and Cor. 1; theory 9.
    """

    region: Interval
    lower_slope: Float[Array | np.ndarray, "*cells m n"]
    upper_slope: Float[Array | np.ndarray, "*cells m n"]
    lower_offset: Float[Array | np.ndarray, "*cells m"]
    upper_offset: Float[Array | np.ndarray, "*cells m"]
    theta: Float[Array | np.ndarray, "*cells m"]
    sigma: Float[Array | np.ndarray, "*cells m"]
    gap: Float[Array | np.ndarray, "*cells m"]
    verified: str = eqx.field(static=True)

    @property
    def printed_theta(self) -> Any:
        """The optimum of (eq:abstraction) as printed, one number for all components: the largest; shape (cells?)."""
        return self.theta.max(-1)

    def over(self, box: Interval) -> Interval:
        """Bounds of f on a box inside the region, from the planes alone.

        Args:
            box: shape (n,), units [x].

        Returns:
            Interval: (m,), units [f]. Over each cell that the box touches, the planes' range on the common part;
            of these the hull. ``(-inf, inf)`` if any part of the box lies outside the region.

        Raises:
            ValueError: the box has another shape.

        Source: paper, Cor. 1 (the two bounds with a hat).
        """
        n = self.upper_slope.shape[-1]
        if not isinstance(box, Interval) or box.shape != (n,):
            got = f"a box of shape {box.shape}" if isinstance(box, Interval) else repr(box)
            raise ValueError(f"Abstraction.over: an Interval of shape ({n},) is needed, got {got}")
        low, high = jnp.reshape(self.region.lower, (-1, n)), jnp.reshape(self.region.upper, (-1, n))
        # Written so that NaN ends up outside, and a box equal to the region keeps its whole gradient.
        inside = ((box.lower >= low.min(0)) & (box.upper <= high.max(0))).all()
        x_lower = jnp.where(box.lower >= low, box.lower, low)
        x_upper = jnp.where(box.upper <= high, box.upper, high)
        touched = (x_lower <= x_upper).all(-1)
        lower = _minimum(self.lower_slope, x_lower, x_upper, self.lower_offset)
        upper = -_minimum(-self.upper_slope, x_lower, x_upper, -self.upper_offset)
        # Every cell is looked at: a gather would need shapes that depend on the box.
        lower = jnp.where(touched[:, None], jnp.reshape(lower, (-1, lower.shape[-1])), jnp.inf).min(0)
        upper = jnp.where(touched[:, None], jnp.reshape(upper, (-1, upper.shape[-1])), -jnp.inf).max(0)
        known = inside & touched.any()
        nothing = entire_like(lower)
        bounds = Interval.unchecked(jnp.where(known, lower, nothing.lower), jnp.where(known, upper, nothing.upper))
        return bounds.astype(box.dtype)

    def astype(self, dtype: Any) -> Abstraction:
        """The same planes in another floating type. A narrower one keeps them valid: the outer faces of the region move
        inward, and offsets leave room for the rounding of the slopes and of the faces between cells.
        Traced planes are rounded to nearest.
        """
        dtype = jax.dtypes.canonicalize_dtype(dtype)
        leaves = jax.tree.leaves(self)
        fits = all(jnp.finfo(leaf.dtype).bits <= jnp.finfo(dtype).bits for leaf in leaves)
        if fits or not all(map(is_concrete, leaves)):
            return jax.tree.map(lambda value: jnp.asarray(value, dtype), self)
        eps = float(jnp.finfo(dtype).eps)
        wide: Any = jax.tree.map(lambda value: np.asarray(value, np.float64), self)
        low, high = wide.region.lower, wide.region.upper
        cells = tuple(range(low.ndim - 1))
        first, last = low.min(cells, keepdims=True), high.max(cells, keepdims=True)
        lower = np.where(low == first, cast_up(low, dtype), low.astype(dtype))
        upper = np.where(high == last, cast_down(high, dtype), high.astype(dtype))
        far = np.maximum(np.abs(low), np.abs(high))[..., None, :]

        def room(slope: Any) -> Any:
            """Of slopes and faces that are each off by half an ulp, with as much again."""
            return (4 * eps * np.abs(slope) * far).sum(-1) + float(jnp.finfo(dtype).tiny)

        def narrow(value: Any) -> Any:
            return jnp.asarray(value.astype(dtype))

        return Abstraction(
            region=Interval.unchecked(narrow(lower), narrow(upper)),
            lower_slope=narrow(wide.lower_slope),
            upper_slope=narrow(wide.upper_slope),
            lower_offset=cast_down(wide.lower_offset - room(wide.lower_slope), dtype),
            upper_offset=cast_up(wide.upper_offset + room(wide.upper_slope), dtype),
            theta=narrow(wide.theta),
            sigma=narrow(wide.sigma),
            gap=narrow(wide.gap),
            verified=self.verified,
        )


def _minimum(slope: Any, lower: Any, upper: Any, offset: Any) -> Any:
    """Lower bound of A x + b on boxes (cells, n), A of shape (cells?, m, n)."""
    low, _ = products(slope, Interval.unchecked(lower, upper))
    terms = jnp.concatenate([low, jnp.broadcast_to(offset[..., None], (*low.shape[:-1], 1))], -1)
    return rounding.unbounded(rounding.sum_down(terms), -jnp.inf) if rounding.outward() else terms.sum(-1)
