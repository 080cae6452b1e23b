"""Studies: many runs of an observer over named axes, reduced as they go along.

`sweep` runs records at hand.
"""

from gsisio_jax.study.axes import Axis, Layout, Truth, grid
from gsisio_jax.study.reduce import Context, Kept, Reduction, Variable
from gsisio_jax.study.reductions import REDUCTIONS, quantiles, settle
from gsisio_jax.study.sweep import sweep

__all__ = [
    "REDUCTIONS",
    "Axis",
    "Context",
    "Kept",
    "Layout",
    "Reduction",
    "Truth",
    "Variable",
    "grid",
    "quantiles",
    "settle",
    "sweep",
]
