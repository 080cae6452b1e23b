"""Jacobian enclosures of the plant on a region, as NumPy centres and radii."""

from gsisio_jax.guard import Slopes, slopes_of

__all__ = ["Slopes", "slopes_of"]
