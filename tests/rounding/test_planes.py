"""Affine planes that were found in float64 still enclose f in float32."""

import jax.numpy as jnp
import numpy as np
import pytest

from gsisio_jax import Interval
from gsisio_jax.design.abstraction import affine_abstraction


def f(x):
    return jnp.stack([jnp.sin(3 * x[0]) + 0.1 * x[1], 1e3 * x[0] * x[1]])


@pytest.mark.plain_xla
def test_planes_of_32_bits_enclose_what_those_of_64_bits_do():
    region = Interval([0.1, -0.7], [1.3, 0.9])
    planes = affine_abstraction(f, region, mesh=3)
    narrow = planes.astype(np.float32)
    low, high = (np.float64(side) for side in (narrow.region.lower, narrow.region.upper))
    assert (low.min(0) >= region.lower).all()
    assert (high.max(0) <= region.upper).all()
    rng = np.random.default_rng(0)
    for box_low, box_high in zip(low, high, strict=True):
        points = np.float32(box_low + rng.random((200, 2)) * (box_high - box_low))
        for point in points[((points >= box_low) & (points <= box_high)).all(1)]:
            inside = ((np.asarray(planes.region.lower) <= point) & (point <= np.asarray(planes.region.upper))).all(1)
            # All cells that hold the point bound f there; so must the narrow planes, evaluated without rounding.
            for k in np.flatnonzero(inside):
                for name, sign in (("lower", -1), ("upper", 1)):
                    new, old = (
                        np.float64(getattr(p, f"{name}_slope")[k]) @ np.float64(point)
                        + np.float64(getattr(p, f"{name}_offset")[k])
                        for p in (narrow, planes)
                    )
                    assert (sign * (new - old) >= 0).all()
