"""Products that overflow inside of one operation: what follows them there must not take them for numbers."""

from __future__ import annotations

import itertools
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsisio_jax import Interval, inclusion
from gsisio_jax.scalar.numpy_program import numpy_function


def _product(x):
    return x[0] * x[1] * x[2]


def _last_running(x):
    return x[0] * x[1] * x[2] * x[3]


# Functions of four numbers, and what they are in exact arithmetic. The product of the first two overflows on the whole
# box, and is then multiplied by what may be zero, or as small as that is large.
CHAINS = {
    "cumprod": (lambda x: jnp.cumprod(x)[3], _last_running),
    "cumprod, reverse": (lambda x: jax.lax.cumprod(x[::-1], reverse=True)[0], _last_running),
    "prod": (jnp.prod, _last_running),
    "scatter": (lambda x: jnp.ones(1, x.dtype).at[jnp.zeros(4, int)].multiply(x)[0], _last_running),
    "determinant": (
        lambda x: jnp.linalg.det(jnp.diag(x[:3])),
        _product,
    ),
    "one by one": (lambda x: x[0] * x[1] * x[2] * x[3], _last_running),
}
SMALL = {np.float64: 1e-308, np.float32: 1e-38}
LARGE = {np.float64: 1e200, np.float32: 1e25}


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("name", CHAINS)
def test_corners_are_inside(name, dtype, sign):
    function, exact = CHAINS[name]
    large, small = LARGE[dtype], SMALL[dtype]
    for last in ((-small, small), (0.5 * small, small), (1.0, 2.0), (0.0, 0.0)):
        sides = np.array([(large, 2 * large), (large, large), last, (1.0, 1.0)], dtype)
        sides[0] *= sign
        lower, upper = sides.min(1), sides.max(1)
        for bound in (inclusion.natural, inclusion.affine):
            call = bound(function, "outward")
            found = numpy_function(lambda a, b, call=call: call(Interval.unchecked(a, b)), lower, upper)(lower, upper)
            box = getattr(found, "range", found)
            least, most = float(np.asarray(box.lower).item()), float(np.asarray(box.upper).item())
            assert not np.isnan([least, most]).any()
            for corner in itertools.product(*zip(lower, upper, strict=True)):
                value = exact([Fraction(float(entry)) for entry in corner])
                assert least == -np.inf or Fraction(least) <= value, (bound, last, corner)
                assert most == np.inf or value <= Fraction(most), (bound, last, corner)
