"""Images of boxes under matrices, and upper bounds of products with magnitudes."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, is_concrete, nan_to_unbounded
from gsisio_jax.interval.direct import absolute, minus, multiple_and_more, plus, where
from gsisio_jax.interval.primitives import add_up, scale
from gsisio_jax.interval.reading import read_array


def linear_image(matrix: Float[Array, "m n"], x: Interval) -> Interval:
    """Bound the image of a box under a constant matrix (exact in real arithmetic).

    Args:
        matrix: shape (m, n), finite, units [y]/[x].
        x: box of shape (n,), units [x]; infinite sides allowed (``0 * inf = 0``).

    Returns:
        Box of shape (m,), units [y].

    Raises:
        ValueError: shapes do not agree; the matrix is not finite.

    >>> linear_image(np.array([[1.0, -2.0]]), Interval([0.0, 0.0], [1.0, 1.0]))
    Interval([-2.], [1.])

    Source: paper, Prop. 2 and Lemma 1.
    """
    if not isinstance(x, Interval):
        raise ValueError(f"linear_image: `x` must be a gsisio_jax.Interval of shape (n,), got {type(x).__name__}")
    matrix = read_array("linear_image", "matrix", matrix)
    if is_concrete(matrix) and not np.isfinite(np.asarray(matrix)).all():
        raise ValueError("linear_image: `matrix` must be finite; only the box may have infinite sides")
    if np.ndim(matrix) != 2 or len(x.shape) != 1 or matrix.shape[1] != x.shape[0]:
        raise ValueError(
            f"linear_image: a matrix (m, n) and a box (n,) are needed, got {np.shape(matrix)} and {x.shape}"
        )
    x = x.astype(jnp.result_type(matrix, x.dtype))
    known = all(map(is_concrete, (matrix, x.lower, x.upper)))
    return _compiled_image(rounding.outward(), matrix, x) if known else nan_to_unbounded(image(matrix, x))


@partial(jax.jit, static_argnums=0, inline=True)
def _compiled_image(outward: bool, matrix: Any, x: Interval) -> Interval:
    """One program instead of one for each operation."""
    with rounding.using("outward" if outward else "nearest"):
        return nan_to_unbounded(image(matrix, x))


def image(matrix: Any, x: Interval) -> Interval:
    """`linear_image` without its checks, for a stack of matrices (..., m, n) and boxes (n,) or (..., n).

    Rounded outward, also for the exact product with a matrix that was rounded to `matrix` entry by entry. NaN where it
    overflows, see `nan_to_unbounded`.
    """
    low, high = products(matrix, x)
    # A sum of products, not a dot: the batched dot of a tiny matrix is slow, and 0 * inf must not reach it.
    return Interval.unchecked(rounding.sum_down(low), rounding.sum_up(high))


def widened_for_sums(box: Interval, terms: int) -> Interval:
    """The box, wider by what `plain_image` loses in a sum of so many terms, whatever the weights are.

    A sum of n products of weights that were rounded once is off by ``(n + 4) eps sum |w_i| |x_i|`` at most, and every
    side is moved by ``kappa |x_i|`` with ``kappa = (n + 8) eps``; what is flushed to zero is in ``2^60 tiny``
    (`rounding.generous`).
    """
    if not rounding.outward():
        return box
    info = jnp.finfo(box.dtype)
    kind = np.dtype(box.dtype).type
    kappa, floor = kind((terms + 8) * float(info.eps)), kind(rounding.FLUSHED * float(info.tiny))
    sides = (jax.lax.stop_gradient(absolute(side)) for side in (box.lower, box.upper))
    lower, upper = (multiple_and_more(side, kappa, floor) for side in sides)
    return Interval.unchecked(minus(box.lower, lower), plus(box.upper, upper))


def plain_image(matrix: Any, x: Interval) -> Interval:
    """`image` of a box that has been through `widened_for_sums`: sums as they come. NaN where it overflows."""
    low, high = plain_sums(matrix, x)
    floor = faint(matrix)
    return Interval.unchecked(low - floor, high + floor)


def plain_sums(matrix: Any, x: Interval) -> tuple[Any, Any]:
    """Both sides of ``matrix @ x``, sums as they come; without the `faint`."""
    low, high = products(matrix, x)
    return low.sum(-1), high.sum(-1)


def faint(weights: Any) -> Any:
    """What rows (..., n) with weights below ``2^-40`` may lose where products are flushed to zero, beyond what was
    widened before them: that was multiplied by the weight, too. 0 for all other rows."""
    if not rounding.outward():
        return 0.0
    small = ((weights != 0) & (absolute(weights) < 2.0**-40)).any(-1)
    dtype = jnp.result_type(weights)
    lost = jnp.finfo(dtype).dtype.type(2.0**10 * float(jnp.finfo(dtype).tiny))
    return np.where(small, lost, dtype.type(0)) if isinstance(weights, np.ndarray) else where(small, lost, 0)


def products(matrix: Any, x: Interval) -> tuple[Any, Any]:
    """Smallest and largest of every product in ``matrix @ x``, (..., m, n), to nearest; for `rounding.sum_down`."""
    at_lower, at_upper = scale(matrix, x.lower[..., None, :]), scale(matrix, x.upper[..., None, :])
    # Sides are chosen by sign, not by min and max: those tie on boxes of width 0 and would halve the derivative of the
    # width.
    up = matrix >= 0
    return where(up, at_lower, at_upper), where(up, at_upper, at_lower)


def matvec_upper(matrix: Any, magnitude: Any) -> Any:
    """Upper bound of ``matrix @ magnitude`` for a nonnegative matrix (..., m, n) and magnitude (n,) or (..., n)."""
    return rounding.sum_up(scale(matrix, magnitude[..., None, :]))


def loose_matvec_upper(matrix: Any, magnitude: Any) -> Any:
    """`matvec_upper` for matrices of the size of rounding, with less work and a thousandth more (`rounding.generous`);
    exactly 0 for rows of zeros."""
    found = rounding.generous(add_up(scale(matrix, magnitude[..., None, :])))
    return where((matrix != 0).any(-1), found, 0)
