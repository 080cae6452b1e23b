"""Boxes and their arithmetic, rounded outward.

`box` has the type, `image` its linear images, `cast` casts that round outward, `rounding` the error model behind them,
`minmax` a minimum and maximum whose subgradients survive rounding, and `primitives` the elementwise operations that JAX
sees as one equation each.
"""

from gsisio_jax.interval.box import Interval, hull, intersect
from gsisio_jax.interval.image import linear_image

__all__ = ["Interval", "hull", "intersect", "linear_image"]
