"""Boxes: checks of the constructor, conventions with infinity, and the exact linear image."""

import fractions

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from gsisio_jax import Interval, hull, intersect, linear_image
from gsisio_jax.interval import rounding
from gsisio_jax.interval.cast import cast_down, cast_up
from gsisio_jax.interval.primitives import scale

FINITE = st.floats(-1e6, 1e6, allow_nan=False, width=32)


def boxes(size: int):
    pair = st.tuples(hnp.arrays(np.float64, size, elements=FINITE), hnp.arrays(np.float64, size, elements=FINITE))
    return pair.map(lambda p: Interval(np.minimum(*p), np.maximum(*p)))


@pytest.mark.parametrize(
    ("lower", "upper", "words"),
    [
        ([0.0, 2.0], [1.0, 1.0], "cross at index [1]"),
        ([np.nan], [1.0], "NaN at index [0]"),
        ([np.inf], [np.inf], "cross"),
        ([-np.inf], [-np.inf], "cross"),
        (np.zeros(2), np.ones(3), "shape"),
        (["a"], [1.0], "real numbers"),
    ],
)
def test_bad_bounds_are_refused(lower, upper, words):
    with pytest.raises(ValueError, match="Interval") as error:
        Interval(lower, upper)
    assert words in str(error.value)


def test_properties_are_never_nan():
    box = Interval([-np.inf, -np.inf, 2.0, 1.0], [np.inf, 3.0, np.inf, 5.0])
    assert box.center.tolist() == [0.0, 3.0, 2.0, 3.0]
    assert box.radius.tolist() == [np.inf, np.inf, np.inf, 2.0]
    assert Interval.entire(3).width.tolist() == [np.inf] * 3
    huge = Interval([-1.7e308], [1.7e308])
    assert huge.center.tolist() == [0.0]


def test_is_a_pytree_and_passes_through_transformations():
    box = Interval(jnp.zeros((5, 2)), jnp.ones((5, 2)))
    doubled = jax.jit(jax.vmap(lambda b: Interval(2 * b.lower, 2 * b.upper)))(box)
    np.testing.assert_array_equal(doubled.upper, 2 * np.ones((5, 2)))


@settings(max_examples=60, deadline=None)
@given(hnp.arrays(np.float64, (3, 2), elements=FINITE), boxes(2))
def test_linear_image_is_the_exact_hull_of_the_corners(matrix, box):
    image = linear_image(matrix, box)
    exact = [fractions.Fraction(0)] * 3
    for i in range(3):
        corners = [
            sum(
                fractions.Fraction(float(m)) * fractions.Fraction(float(x))
                for m, x in zip(matrix[i], (a, b), strict=True)
            )
            for a in (box.lower[0], box.upper[0])
            for b in (box.lower[1], box.upper[1])
        ]
        exact = min(corners), max(corners)
        size = (
            float(max(abs(c) for c in corners)) + np.abs(matrix[i]) @ np.abs(box.lower) + 1e-290
        )  # the floor of the rounding
        assert abs(float(image.lower[i]) - float(exact[0])) <= 1e-14 * size
        assert abs(float(image.upper[i]) - float(exact[1])) <= 1e-14 * size


def test_linear_image_of_infinite_boxes():
    with rounding.using("nearest"):
        image = linear_image(np.array([[0.0, 1.0], [1.0, 0.0], [-2.0, 0.0]]), Interval([-np.inf, 1.0], [3.0, 2.0]))
    assert image.lower.tolist() == [1.0, -np.inf, -6.0]
    assert image.upper.tolist() == [2.0, 3.0, np.inf]
    with pytest.raises(ValueError, match="linear_image"):
        linear_image(np.ones((2, 3)), Interval(np.zeros(2), np.ones(2)))


def test_scale_has_finite_gradients_at_infinity():
    def lowest(m, x):
        return scale(m, x).min() + jnp.where(jnp.isfinite(scale(m, x)), scale(m, x), 0).sum()

    for x in (jnp.array([-jnp.inf, 1.0]), jnp.array([jnp.inf, 0.0])):
        grads = jax.grad(lowest, argnums=(0, 1))(jnp.array([0.0, 2.0]), x)
        assert all(np.isfinite(g).all() for g in grads)


def test_intersection_reports_its_slack_and_never_crosses():
    a = Interval([0.0, 0.0, 0.0], [4.0, 1.0, 1.0])
    b = Interval([1.0, 0.5, 3.0], [2.0, 9.0, 4.0])
    met, slack = intersect(a, b)
    assert slack.tolist() == [2.0, 0.5, -2.0]
    assert met.lower.tolist() == [1.0, 0.5, 0.0]
    assert met.upper.tolist() == [2.0, 1.0, 1.0]
    assert hull(a, b).upper.tolist() == [4.0, 9.0, 4.0]


def test_intersection_passes_over_a_side_that_overflowed():
    nan = np.nan  # the third box misses a with the side that is left
    a = Interval([0.0, 0.0, 0.0], [4.0, 4.0, 4.0])
    b = Interval.unchecked(np.array([nan, 1.0, nan]), np.array([2.0, nan, -1.0]))
    met, _ = intersect(a, b)
    assert met.lower.tolist() == [0.0, 1.0, 0.0]
    assert met.upper.tolist() == [2.0, 4.0, 4.0]


_compiled_casts = jax.jit(lambda x: (cast_down(x, np.float32), cast_up(x, np.float32)))  # once for all examples
_derivative = jax.jit(jax.grad(lambda x: cast_down(x, np.float32).sum().astype(float)))


@settings(max_examples=100, deadline=None)
@given(hnp.arrays(np.float64, 4, elements=st.floats(allow_nan=False)))
def test_narrowing_casts_round_outward(values):
    down, up = np.asarray(cast_down(values, np.float32)), np.asarray(cast_up(values, np.float32))
    assert down.dtype == up.dtype == np.float32
    assert (down.astype(float) <= values).all()
    assert (up.astype(float) >= values).all()
    traced = [np.asarray(side) for side in _compiled_casts(values)]
    normal = (np.abs(values) > 1e-30) | (values == 0)  # compiled code flushes subnormal numbers
    np.testing.assert_array_equal(traced[0][normal], down[normal])
    np.testing.assert_array_equal(traced[1][normal], up[normal])
    assert _derivative(np.array([0.1])) == 1.0


def test_a_box_is_no_array():
    with pytest.raises(TypeError, match=r"use np.asarray\(box.lower\) and np.asarray\(box.upper\)"):
        np.asarray(Interval([0.0], [1.0]))
