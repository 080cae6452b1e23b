"""Bounds of a function on a box, inside jit: ranges, affine forms, Jacobian enclosures.

    natural(f)(box, *args)      Interval      every operation replaced by its range
    affine(f)(box, *args)       AffineForm    slope, offset and range, met at every node
    jacobian(f)(box, *args)     Interval      enclosure of df/dx
    mean_value(f)(box, *args)   Interval      f(c) + J (box - c)

Source: design 5.
"""

from gsisio_jax.inclusion.api import AffineForm, affine, jacobian, mean_value, natural
from gsisio_jax.inclusion.interpreter import register_bounds
from gsisio_jax.inclusion.table import UnknownPrimitiveError

__all__ = [
    "AffineForm",
    "UnknownPrimitiveError",
    "affine",
    "jacobian",
    "mean_value",
    "natural",
    "register_bounds",
]
