"""Studies: many runs of an observer over named axes, reduced as they go along.

`sweep` runs records at hand, `monte_carlo` simulates its own; `tightness` says how near to the exact hull boxes are.
"""

from gsisio_jax.study.axes import Axis, Layout, Truth, grid
from gsisio_jax.study.containment import BROKEN
from gsisio_jax.study.hulls import tightness
from gsisio_jax.study.monte_carlo import monte_carlo
from gsisio_jax.study.reduction_base import Context, Kept, Reduction, Variable
from gsisio_jax.study.reductions import REDUCTIONS, quantiles, settle
from gsisio_jax.study.summary import STATISTICS, summary
from gsisio_jax.study.sweep import sweep
from gsisio_jax.study.tightness_result import Tightness

__all__ = [
    "BROKEN",
    "REDUCTIONS",
    "STATISTICS",
    "Axis",
    "Context",
    "Kept",
    "Layout",
    "Reduction",
    "Tightness",
    "Truth",
    "Variable",
    "grid",
    "monte_carlo",
    "quantiles",
    "settle",
    "summary",
    "sweep",
    "tightness",
]
