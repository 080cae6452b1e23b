"""Jacobian enclosures of the plant on a region, as NumPy centres and radii."""

from gsisio_jax.guard import Slopes, slopes_on

__all__ = ["Slopes", "slopes_on"]
