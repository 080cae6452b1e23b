"""Does a function, as JAX evaluates it, stay within its bounds? Its values at points, and differences between them."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from inclusion_points import points

import gsisio_jax as gx
from gsisio_jax import inclusion
from gsisio_jax.interval import Interval


def checked(f, lower, upper, dtype=np.float64, extra=(), count=24, rounding="outward"):
    """Natural, affine and derivative bounds of f on a box, after every value that is a number was held against them.

    `extra` are points that random ones do not meet. Returns the natural bounds and those of the Jacobian.
    """
    lower, upper = (np.atleast_1d(np.asarray(side, dtype)) for side in (lower, upper))
    box = Interval(lower, upper)
    at = np.concatenate([points(lower, upper, count), np.asarray(extra, float).reshape(-1, lower.size)]).astype(dtype)
    at = np.clip(at, lower, upper)
    values = np.stack([np.asarray(f(jnp.asarray(x)), float) for x in at])
    natural = inclusion.natural(f, rounding=rounding)(box)
    form = inclusion.affine(f, rounding=rounding)(box)
    jac = inclusion.jacobian(f, rounding=rounding)(box)
    for bounds in (natural, form.range):
        inside = (np.asarray(bounds.lower) <= values) & (values <= np.asarray(bounds.upper))
        assert (inside | np.isnan(values)).all(), (at[~inside.reshape(len(at), -1).all(1)][0], bounds)
    slope = np.asarray(form.slope, float)
    for x, value in zip(at, values, strict=True):
        image = slope @ x.astype(float)
        slip = 1e-5 * (1 + np.abs(image)) if dtype == np.float32 else 1e-12 * (1 + np.abs(image))
        low, high = (image + np.asarray(side, float) for side in (form.offset.lower, form.offset.upper))
        assert (((low - slip <= value) & (value <= high + slip)) | np.isnan(value)).all(), (x, value, form)
    least, most = (np.asarray(side, float) for side in (jac.lower, jac.upper))
    for (x, a), (y, b) in zip(
        zip(at, values, strict=True), zip(np.roll(at, 1, 0), np.roll(values, 1, 0), strict=True), strict=True
    ):
        step = x.astype(float) - y
        with np.errstate(invalid="ignore"):
            first, last = (np.where(step == 0, 0, side * step) for side in (least, most))
        low, high = np.minimum(first, last).sum(-1), np.maximum(first, last).sum(-1)
        slip = (1e-4 if dtype == np.float32 else 1e-9) * (1 + np.abs(a) + np.abs(b))
        assert (((low - slip <= a - b) & (a - b <= high + slip)) | np.isnan(a - b)).all(), (x, y, a - b, jac)
    return natural, jac


def estimated(f, v, least):
    """States (9, 2) of a plant whose first state an unknown input moves, after its boxes were seen to hold them.

    `v` bounds the noise of the first state as measured, and `least` that state in the region of the design.
    """
    noise = gx.Noise(w=Interval.symmetric([1e-6, 1e-6]), v=Interval.symmetric([v]))
    system = gx.System(f, lambda x: x[:1], G=[[1.0], [0.0]], H=[[0.0]])
    observer = gx.design_observer(system, noise, region=Interval([least, -9.0], [9.0, 9.0]), allow_uncertified=True)
    x, states = np.array([1.0, 2.0]), []
    for k in range(9):
        states.append(x)
        x = np.array(f(jnp.asarray(x)))
        x[0] = 2.1 * np.cos(k) - 0.1
    estimate = gx.estimate(observer, Interval([0.9, 1.9], [1.1, 2.1]), np.array(states)[:, :1])
    assert np.asarray(estimate.state.contains(np.array(states))).all()
    return np.array(states)


def sides(box) -> list[float]:
    return [float(np.ravel(side)[0]) for side in (box.lower, box.upper)]
