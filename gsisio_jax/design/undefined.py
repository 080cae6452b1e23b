"""Points of the region where f or g gives no number: no width is promised on such a region."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from gsisio_jax.interval.box import Interval
from gsisio_jax.plant.system import System
from gsisio_jax.scalar.numpy_program import numpy_function

_POINTS = 64
_FAR = 1e3  # an unbounded side is looked at as far as this


def undefined_in(system: System, region: Interval, u_region: Interval) -> str | None:
    """Why no width can be promised: a point of the region, within the state bounds, at which f or g is NaN or infinite.

    Corners and random points are tried, so None is no proof.
    """
    bounds, rng = system.state_bounds, np.random.default_rng(0)
    low, high = np.maximum(region.lower, bounds.lower), np.minimum(region.upper, bounds.upper)
    low, high = np.clip(low, -_FAR, _FAR), np.clip(high, -_FAR, _FAR)
    share = rng.uniform(size=(_POINTS, system.n))
    share[: _POINTS // 2] = rng.integers(2, size=(_POINTS // 2, system.n))
    u = np.clip(np.asarray(u_region.center, np.float64), -_FAR, _FAR)

    def both(x: Any, u: Any) -> tuple[Any, Any]:
        return system.dynamics(x, u), system.measurement(x, u)

    with jax.enable_x64(True):
        program = numpy_function(both, low, u)
        for x in low + share * (high - low):
            for name, value in zip("fg", program(x, u), strict=True):
                if not np.isfinite(value).all():
                    place = ", ".join(f"{entry:.4g}" for entry in x)
                    return (
                        f"no width is promised: {name} gives no number at x = ({place}), which lies in the region; "
                        "give a region, or `state_bounds`, without such states"
                    )
    return None
