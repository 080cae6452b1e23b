"""The model itself: widened results of single operations and of sums, in both precisions, against fractions."""

from __future__ import annotations

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsisio_jax import Interval, inclusion, linear_image
from gsisio_jax.interval import rounding
from gsisio_jax.observer.residuals import exact, upper_inverse

DTYPES = [np.float64, np.float32]


def numbers(rng, shape, dtype):
    """Floating numbers of all magnitudes, some of them subnormal or the largest ones."""
    info = np.finfo(dtype)
    size = np.exp2(rng.uniform(np.log2(float(info.tiny)) / 2, np.log2(float(info.max)) / 2, shape))
    kind = rng.integers(8, size=shape)
    size = np.where(kind < 4, np.exp2(rng.uniform(-3, 3, shape)), size)
    return (size * rng.choice([-1, 1], shape)).astype(dtype)


def below(lower, values):
    return all(Fraction(float(a)) <= b for a, b in zip(np.ravel(lower), values, strict=True) if np.isfinite(a))


@pytest.mark.parametrize("dtype", DTYPES, ids=["float64", "float32"])
def test_one_operation_of_two(dtype):
    rng = np.random.default_rng(1)
    x, y = numbers(rng, (2, 400), dtype)
    a, b = ([Fraction(float(v)) for v in side] for side in (x, y))
    cases = {
        "add": (jnp.add, [p + q for p, q in zip(a, b, strict=True)]),
        "multiply": (jnp.multiply, [p * q for p, q in zip(a, b, strict=True)]),
        "divide": (jnp.divide, [p / q for p, q in zip(a, b, strict=True)]),
        "by a constant": (lambda p, q: p / dtype(49.0), [p / 49 for p in a]),
        "by another": (lambda p, q: p / dtype(103.0), [p / 103 for p in a]),
    }
    for name, (operation, truth) in cases.items():
        found = jax.jit(lambda p, q, f=operation: (rounding.down(f(p, q)), rounding.up(f(p, q))))(x, y)
        assert below(found[0], truth), name
        assert below(-found[1], [-t for t in truth]), name


@pytest.mark.parametrize("dtype", DTYPES, ids=["float64", "float32"])
def test_sums_that_cancel(dtype):
    """Long dot products whose exact value is a tiny remainder of what goes in."""
    rng = np.random.default_rng(2)
    matrix, x = rng.standard_normal((60, 300)).astype(dtype), rng.standard_normal((60, 300)).astype(dtype)
    with np.errstate(over="ignore"):
        matrix[:, ::2], x[:, ::2] = matrix[:, 1::2], -x[:, 1::2] * dtype(1 + 3 * np.finfo(dtype).eps)
    truth = [
        sum(Fraction(float(p)) * Fraction(float(q)) for p, q in zip(*rows, strict=True))
        for rows in zip(matrix, x, strict=True)
    ]
    found = jax.jit(jax.vmap(lambda m, v: linear_image(m[None], Interval.unchecked(v, v))))(matrix, x)
    assert below(found.lower[:, 0], truth)
    assert below(-found.upper[:, 0], [-t for t in truth])
    deep = jax.jit(
        jax.vmap(lambda m, v: inclusion.affine(lambda t: jnp.sum(m * t), "outward")(Interval.unchecked(v, v)).range)
    )(matrix, x)
    assert below(deep.lower, truth)
    assert below(-deep.upper, [-t for t in truth])
    near = jax.jit(
        jax.vmap(lambda m, v: inclusion.natural(lambda t: jnp.sum(m * t), "nearest")(Interval.unchecked(v, v)))
    )(matrix, x)
    assert not below(near.lower, truth) or not below(-near.upper, [-t for t in truth])


def test_overflow_is_infinite_and_not_wrong():
    big = Interval([1e308, 0.0], [1.5e308, 1.0])
    total = inclusion.natural(lambda x: jnp.stack([x[0] + x[0] - x[0], x[0] * x[0], 1 / (x[0] * x[0]), jnp.exp(x[0])]))(
        big
    )
    assert np.asarray(total.lower[:2]).tolist() == [-np.inf, -np.inf]
    assert np.asarray(total.upper[:2]).tolist() == [np.inf, np.inf]
    assert total.lower[2] <= 1e-320
    assert total.upper[3] == np.inf
    assert not np.isnan(np.asarray(total.lower)).any()


def test_subnormal_ends_are_kept_inside():
    tiny = 1e-310
    square = jax.jit(inclusion.natural(lambda x: 1e300 * x))
    found = square(Interval([-tiny], [tiny]))
    assert found.lower[0] <= -1e-10
    assert found.upper[0] >= 1e-10


def test_known_numbers_round_only_where_they_must():
    low, high = rounding.known_sum(np.array([0.5, 0.1]), np.array([0.25, 0.2]))
    assert low[0] == high[0] == 0.75
    assert Fraction(low[1]) < Fraction(0.1) + Fraction(0.2) < Fraction(high[1])
    low, high = rounding.known_product(np.array([0.5, 0.1, 0.0]), np.array([3.0, 3.0, np.inf]))
    assert (low[0], high[0], low[2], high[2]) == (1.5, 1.5, 0.0, 0.0)
    assert Fraction(low[1]) < Fraction(0.1) * 3 < Fraction(high[1])


def test_boxes_of_64_bits_round_outward_where_jax_has_32():
    with jax.enable_x64(False):
        box = Interval([0.1, -0.1, 1e-50], [0.1, -0.1, 1e300])
        assert box.lower.dtype == np.float32
        assert (np.float64(box.lower) <= [0.1, -0.1, 1e-50]).all()
        assert (np.float64(box.upper) >= [0.1, -0.1, 1e300]).all()


def test_inverses_are_proved():
    rng = np.random.default_rng(3)
    for size in (1, 3, 6):
        M = np.abs(rng.standard_normal((size, size))) * (rng.random((size, size)) < 0.6)
        M *= 0.9 / max(np.abs(np.linalg.eigvals(M)).max(), 0.9)
        V = upper_inverse(M)
        assert V is not None
        assert (exact(V).dot(exact(np.eye(size)) - exact(M)) >= exact(np.eye(size))).all()
        np.testing.assert_allclose(V, np.linalg.inv(np.eye(size) - M), rtol=1e-9, atol=1e-12)
    assert upper_inverse(np.array([[1.0]])) is None
    # What does not see each other stays apart.
    assert upper_inverse(np.diag([0.5, 0.25]))[0, 1] == 0


def test_what_does_not_enter_has_no_derivative_at_all():
    """Widening leaves a zero of the Jacobian alone: times an unbounded variable it must stay 0."""
    box = Interval([-1.0, 0.5, -np.inf], [1.0, 2.0, np.inf])

    def f(x):
        return jnp.stack([jnp.sin(x[0]) * x[1] + 0.3 * jnp.exp(x[1]) / 49, jnp.sum(jnp.tanh(x[:2])), x[0] / x[1]])

    slopes = inclusion.jacobian(f)(box)
    assert not np.asarray(slopes.lower)[:, 2].any()
    assert not np.asarray(slopes.upper)[:, 2].any()
    assert np.isfinite(inclusion.mean_value(f)(box).width).all()


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_norms_of_numbers_of_very_different_size(dtype):
    """x / |(x, y)| with an x so far below y that one of them is lost wherever both are scaled alike."""
    slope = jax.jit(inclusion.jacobian(lambda v: jnp.sqrt(v[0] ** 2 + v[1] ** 2)))
    most = 20 if dtype == np.float32 else 240
    rng = np.random.default_rng(0)
    for x, y in 10.0 ** rng.uniform(-most, most, (200, 2)):
        x, y = dtype(x), dtype(y)
        found = slope(Interval(np.array([-x, y], dtype), np.array([x, y * dtype(4)], dtype)))
        far = Fraction(float(x)) ** 2 + Fraction(float(y)) ** 2
        upper, lower = (Fraction(float(side[0])) for side in (found.upper, found.lower))
        assert upper**2 * far >= Fraction(float(x)) ** 2
        assert lower < 0
        assert lower**2 * far >= Fraction(float(x)) ** 2
