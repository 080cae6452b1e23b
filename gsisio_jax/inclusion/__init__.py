"""Bounds of a function on a box, inside jit: ranges, affine forms, Jacobian enclosures, decompositions.

    natural(f)(box, *args)         Interval      every operation replaced by its range
    affine(f)(box, *args)          AffineForm    slope, offset and range, met at every node
    jacobian(f)(box, *args)        Interval      enclosure of df/dx
    mean_value(f)(box, *args)      Interval      f(c) + J (box - c)
    decomposition(f)(box, *args)   Interval      [f_d(lo, hi), f_d(hi, lo)], the four cases of the paper
    remainder(f)(box, *args)       Interval      the best of 2^n such forms for every row
    tight(f)(box, *args)           Interval      exact where signs of df/dx are known, else the best of all
    bound(f, methods)(box, *args)  AffineForm    any choice of these, intersected (paper, Corollary 1)
    batched(natural(f))(boxes, *args)            any of these on many boxes, compiled for that

Source: theory 9.
"""

from gsisio_jax.inclusion.batches import batched
from gsisio_jax.inclusion.by_hand import register_bounds
from gsisio_jax.inclusion.intersection import METHODS, bound
from gsisio_jax.inclusion.mixed_monotone import (
    decomposition,
    decomposition_function,
    decomposition_gain,
    remainder,
    tight,
    width_gain,
)
from gsisio_jax.inclusion.planes import Abstraction
from gsisio_jax.inclusion.rules.registry import UnknownPrimitiveError
from gsisio_jax.inclusion.transforms import AffineForm, affine, jacobian, mean_value, natural

__all__ = [
    "METHODS",
    "Abstraction",
    "AffineForm",
    "UnknownPrimitiveError",
    "affine",
    "batched",
    "bound",
    "decomposition",
    "decomposition_function",
    "decomposition_gain",
    "jacobian",
    "mean_value",
    "natural",
    "register_bounds",
    "remainder",
    "tight",
    "width_gain",
]
