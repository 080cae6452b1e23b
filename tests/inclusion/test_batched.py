"""`inclusion.batched`: the bounds of `jax.vmap`, whatever the number of boxes is to the size of a chunk."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles.uncompiled import in_numpy

from gsisio_jax import Interval, inclusion
from gsisio_jax.interval import rounding

CENTRES = np.random.default_rng(0).uniform(-1, 1, (7, 2))
BOXES = Interval(CENTRES - 0.1, CENTRES + 0.2)
U = np.linspace(-1, 1, 7)[:, None]


def f(x, u):
    return jnp.stack([x[0] * x[1] + u[0], jnp.sin(x[1])])


@pytest.mark.parametrize("chunk", [3, 7, 256], ids=["overlapping", "one", "larger"])
def test_bounds_are_those_of_vmap(chunk):
    found = inclusion.batched(inclusion.affine(f), shared=False, chunk=chunk)(BOXES, U)
    wanted = in_numpy(jax.vmap(inclusion.affine(f)))(BOXES, U)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-14, atol=1e-15), found, wanted)
    values = in_numpy(jax.vmap(f))(CENTRES, U)
    assert np.asarray(found.range.contains(values)).all()


def test_arguments_for_all_boxes_gradients_and_rounding():
    ranges = inclusion.batched(inclusion.natural(f), chunk=3)
    plain = jax.vmap(inclusion.natural(f), (0, None))

    def widened(bounds):
        return lambda by: bounds(Interval.unchecked(BOXES.lower - by, BOXES.upper + by), U[0]).width.sum()

    found, wanted = (jax.value_and_grad(widened(bounds))(0.1) for bounds in (ranges, plain))
    np.testing.assert_allclose(found, wanted, rtol=1e-12)
    nearest = ranges(BOXES, U[0])
    with rounding.using("outward"):  # compiled anew, by the same function
        outward = ranges(BOXES, U[0])
    assert (np.asarray(outward.lower) < nearest.lower)[:, 0].all()  # a product and a sum, rounded down
    assert ranges(Interval(np.zeros((0, 2)), np.zeros((0, 2))), U[0]).shape == (0, 2)


@pytest.mark.parametrize(
    ("use", "message"),
    [
        (lambda b: b(BOXES[0], U[0]), r"shape \(N, n\), got a box of shape \(2,\); for one box"),
        (lambda b: b(CENTRES, U[0]), r"shape \(N, n\), got ndarray"),
        (lambda b: b(BOXES, U[:3]), r"has 7 rows, one a box; got one of shape \(3, 1\); .*shared=True"),
        (lambda b: inclusion.batched(b, chunk=0), "`chunk` must be a whole number of boxes of at least 1, got 0"),
        (lambda b: inclusion.batched(b, chunk=2.5), "`chunk` must be a whole number of boxes of at least 1, got 2.5"),
    ],
)
def test_wrong_uses(use, message):
    with pytest.raises(ValueError, match=r"^inclusion\.batched: .*" + message):
        use(inclusion.batched(inclusion.natural(f), shared=False))
