"""Minimum and maximum whose derivatives are weights: their sum, whom they favour, where they are finite."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsisio_jax.interval.minmax import larger, largest, smaller, smallest

EPS = float(np.finfo(np.float64).eps)
SPECIAL = np.array([-np.inf, np.inf, 0.0, -0.0, 1.0, 1.0 + EPS, 1.0 - EPS, -1.0, 1e-17, 1e300, -1e300, 1e-300])
A, B = (x.ravel() for x in np.meshgrid(SPECIAL, SPECIAL))
PAIRS = [(smaller, jnp.minimum, np.less), (larger, jnp.maximum, np.greater)]


@pytest.mark.parametrize(("ours", "plain", "better"), PAIRS)
def test_of_two(ours, plain, better):
    value = np.asarray(ours(A, B))
    np.testing.assert_array_equal(value, np.asarray(plain(A, B)))
    by_a, by_b = (np.asarray(g) for g in jax.jit(jax.vmap(jax.grad(ours, (0, 1))))(A, B))
    np.testing.assert_allclose(by_a + by_b, 1, rtol=4 * EPS)
    assert (by_a >= 0).all()
    assert (by_b >= 0).all()
    with np.errstate(invalid="ignore"):
        apart = ~(np.abs(A - B) <= 1e-8 * (np.abs(A) + np.abs(B)))
    apart &= A != B
    np.testing.assert_array_equal(by_a[apart], better(A, B)[apart])
    ulp = (A == 1) & (np.abs(B - 1) <= EPS)
    assert ulp.sum() == 3
    np.testing.assert_allclose(by_a[ulp], 0.5, atol=1e-6)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(("ours", "plain"), [(smallest, np.min), (largest, np.max)])
@pytest.mark.parametrize("axis", [0, 1])
def test_of_many(ours, plain, axis, dtype):
    values = np.random.default_rng(0).standard_normal((7, 5)).astype(dtype)
    values[2], values[4, 1], values[0, 0], values[6, 4] = values[3], np.inf, -np.inf, -np.inf
    np.testing.assert_array_equal(np.asarray(ours(values, axis)), plain(values, axis))
    weights = np.asarray(jax.jit(jax.grad(lambda v: ours(v, axis).sum()))(values))
    assert weights.dtype == dtype
    np.testing.assert_allclose(weights.sum(axis), 1, rtol=1e-6)
    best = np.expand_dims(plain(values, axis), axis)
    np.testing.assert_array_equal(weights > 0, values == best)


@pytest.mark.parametrize("zero", [0, 0.0, np.float32(0), np.zeros(1, int)])
def test_constants_of_any_kind(zero):
    assert float(jax.grad(lambda t: larger(t, zero).sum())(2.0)) == 1
    assert float(jax.grad(lambda t: smaller(zero, t).sum())(2.0)) == 0
    assert larger(jnp.float32(2), 0).dtype == jnp.float32


def test_forward_and_second_order():
    def of(t):
        return larger(smaller(t**2, 2 * t), jnp.stack([t, 3 * t]).sum() - 3.0)

    first, second = jax.jit(lambda t: jax.jvp(jax.grad(of), (t,), (1.0,)))(1.2)
    assert (float(first), float(second)) == (pytest.approx(4.0), 0.0)
    assert float(jax.jit(lambda t: jax.jvp(of, (t,), (1.0,))[1])(0.5)) == pytest.approx(1.0)
