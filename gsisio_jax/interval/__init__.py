"""Boxes and their arithmetic, rounded outward.

`box` has the type, `rounding` the error model behind it, `minmax` a minimum and maximum whose subgradients survive
rounding, and `xla` keeps XLA from computing a bound more than once.
"""

from gsisio_jax.interval.box import Interval, hull, intersect, linear_image

__all__ = ["Interval", "hull", "intersect", "linear_image"]
