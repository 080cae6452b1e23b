"""Widening for rounding is no part of a derivative: gradients are those of bounds that are rounded to nearest."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsisio_jax import Interval, inclusion
from gsisio_jax.interval import rounding
from gsisio_jax.scalar.numpy_program import numpy_function


@pytest.mark.parametrize("dtype", [np.float64, np.float32], ids=["float64", "float32"])
def test_they_do_not_see_the_widening(dtype):
    def f(x):
        return jnp.sin(x[0]) * x[1] - jnp.maximum(x[0], x[1]) / 49

    def slopes(mode):
        def width(pair):
            form = inclusion.affine(f, mode)(Interval.unchecked(pair[0], pair[1]))
            return sum(jnp.where(jnp.isfinite(v), v, 0) for v in (form.range.width, form.offset.lower))

        return numpy_function(jax.grad(width), np.zeros((2, 2), dtype))

    outward, nearest = slopes("outward"), slopes("nearest")
    for lower, upper in (([0.5, 1.0], [0.75, 2.0]), ([0.5, 0.5], [0.5, 0.5]), ([-np.inf, 1.0], [np.inf, 2.0])):
        box = np.array([lower, upper], dtype)
        found = np.asarray(outward(box)), np.asarray(nearest(box))
        assert np.isfinite(found[0]).all()
        if upper[1] > lower[1]:  # at a point another slope may be taken
            np.testing.assert_allclose(found[0], found[1], rtol=1e-4 if dtype == np.float32 else 1e-9, atol=1e-5)


@pytest.mark.parametrize("dtype", [np.float64, np.float32], ids=["float64", "float32"])
@pytest.mark.parametrize("widened", [rounding.down, rounding.up, rounding.sum_down, rounding.sum_up])
def test_what_is_added_to_a_number_is_a_constant(widened, dtype):
    x = np.array([0.3, -1.7, 1e-30], dtype)
    with rounding.using("outward"):
        slope = numpy_function(jax.grad(lambda x: widened(x).sum()), x)(x)
    assert slope.tolist() == [1.0, 1.0, 1.0], "not even by the last digit"
