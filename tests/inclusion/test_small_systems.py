"""Derivatives of small linear systems, inverses and determinants: how much wider than what they take on faces, corners
and inside of a box. The oracle are JAX's own derivatives at these points."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from models.machines import arm
from oracles.uncompiled import in_numpy
from sampled import points

from gsisio_jax import Interval, inclusion
from gsisio_jax.scalar.numpy_program import numpy_function

RIGHT = jnp.array([1.0, 2.0])


def _two(x):
    return jnp.array([[2.0 + x[0], x[1]], [x[0] * x[1], 3.0]])


def _three(x):
    return jnp.array([[3.0 + x[0], x[1], 0.5], [x[0] * x[1], 4.0, x[1]], [0.2, x[0], 5.0]])


def _four(x):
    return 4 * jnp.eye(4) + x[0] * jnp.ones((4, 4)) + x[1] ** 2 * jnp.eye(4)[::-1]


def _arm(x):
    return arm().system.f(x, jnp.array([7.0, 1.0]))


SQUARE = ([0.5, 0.5], [0.4, 0.4])
# Function, middle and half-widths of the box; ratio of the widths (the worst entry) on all, 0.3 and 0.05 of it. Without
# what the terms of a derivative have in common these were 4.9 3.2 2.9, 6.3 4.5 4.0, 10 9.1 8.8 and 72 22 21.
CASES = {
    "solve": (lambda x: jnp.linalg.solve(_two(x), RIGHT), *SQUARE, (3.6, 1.6, 1.1)),
    "inv": (lambda x: jnp.linalg.inv(_three(x)), *SQUARE, (4.5, 1.8, 1.15)),
    "det": (lambda x: jnp.linalg.det(_four(x)), *SQUARE, (5.0, 2.2, 1.25)),
    "two-link arm": (_arm, [-1.2, 0.6, 0.0, 0.0], [0.75, 0.8, 1.0, 1.0], (70.0, 12.5, 3.1)),
}


@pytest.mark.parametrize("name", CASES)
def test_derivatives_are_not_much_wider_than_what_they_take(name):
    fn, middle, half, most = CASES[name]
    middle, half = np.array(middle), np.array(half)
    bounds = numpy_function(inclusion.jacobian(fn), Interval(middle, middle))
    slopes = in_numpy(jax.vmap(jax.jacfwd(fn)))
    for share, largest in zip((1.0, 0.3, 0.05), most, strict=True):
        lower, upper = middle - share * half, middle + share * half
        seen = np.asarray(slopes(points(lower, upper)))
        found = bounds(Interval(lower, upper))
        least, highest = seen.min(0), seen.max(0)
        size = 1e-12 * (1 + abs(seen).max())  # rounding of the samples
        assert (np.asarray(found.lower) <= least + size).all()
        assert (highest - size <= np.asarray(found.upper)).all()
        moves = highest - least > 1e-6 * abs(seen).max()
        ratio = np.asarray(found.width)[moves] / (highest - least)[moves]
        assert moves.any()
        assert ratio.max() < largest, ratio
