"""region="auto": a region that fits the steady width designed for it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gsisio_jax.errors import NoDesignFound
from gsisio_jax.interval.box import Interval
from gsisio_jax.plant.system import System

_MARGIN = 1.05  # regions are this much wider than the steady width they were made from
_ROUNDS = 40


def find_region(system: System, steady_width: Callable[[Interval], np.ndarray]) -> Interval:
    """Grow a region from a point until it holds its own steady width, then enlarge it as long as it does.

    The centre is that of the state bounds (0 where there are none): a region around another operating point must be
    given by hand.

    Raises:
        NoDesignFound: no such region was met.

    Source: theory 6.
    """
    center = np.asarray(system.state_bounds.center, dtype=np.float64)
    width = np.zeros(system.n)
    for _ in range(_ROUNDS):
        steady = steady_width(_around(system, center, width))
        if not np.isfinite(steady).all():
            break
        if (steady <= width).all():
            return _enlarge(system, center, width, steady_width)
        width = np.maximum(width, _MARGIN * steady)
    raise NoDesignFound(
        f"design_observer: region='auto' met no region around {center.tolist()} that holds its own steady width (last "
        f"width tried: {width.tolist()}). Give a region by hand, around the operating point; smaller noise bounds or "
        "more outputs may help too. Boxes are certain even where the certificate is empty."
    )


def _enlarge(system: System, center: np.ndarray, width: np.ndarray, steady_width: Callable) -> Interval:
    """The largest multiple of the region, within a factor of 16, that still holds its own steady width."""
    low, high = 1.0, 16.0
    for _ in range(8):
        middle = np.sqrt(low * high)
        steady = steady_width(_around(system, center, middle * width))
        low, high = (middle, high) if (steady <= middle * width).all() else (low, middle)
    return _around(system, center, low * width)


def _around(system: System, center: np.ndarray, width: np.ndarray) -> Interval:
    bounds = system.state_bounds
    lower, upper = np.maximum(center - width / 2, bounds.lower), np.minimum(center + width / 2, bounds.upper)
    return Interval(lower, upper)
