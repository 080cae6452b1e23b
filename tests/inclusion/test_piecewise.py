"""Choices and products with switches: exact ranges, and the hull of both slopes where the cases meet.

The oracle samples values, values minus the form, and difference quotients, on faces, at the cuts and around them.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles.uncompiled_bounds import at_points

from gsisio_jax import inclusion
from gsisio_jax.interval import Interval, rounding

INF = np.inf


def _dead_zone(x):
    return jnp.where(x > 1.0, x - 1.0, jnp.where(x < -1.0, x + 1.0, 0.0))


def _dead_zone_by_size(x):
    return jnp.where(jnp.abs(x) > 1.0, x - jnp.sign(x), 0.0)


def _saturation(x):
    return jnp.where(x > 1, 1.0, jnp.where(x < -1, -1.0, x))


def _band(x):
    return jnp.where((x > -1) & (x < 1), x, jnp.sign(x))


def _outside(x):
    return jnp.where((x <= -1) | (x >= 1), jnp.sign(x), x)


def _coulomb(x):
    return x - jnp.sign(x) * jnp.minimum(jnp.abs(x), 0.3)


def _smooth_coulomb(x):
    return -0.4 * jnp.sign(x) * jnp.minimum(jnp.abs(x) / 0.5, 1.0)


def _huber(x):
    return jnp.where(jnp.abs(x) <= 1, 0.5 * x**2, jnp.abs(x) - 0.5)


def _masked(x):
    return (x > 0) * x - 0.1 * (x <= 0) * x


def _shifted(x):
    return jnp.where(2.0 - x > 0.5, 0.0, x - 1.5)


def _scaled_gain(x):
    return jnp.where(x[0] > 0.25, 2.0 * x[0] - 0.25 + x[1:], x[0] + x[1:])


def _nearly(x):
    """Continuous up to 1.7e-13, like every such guard with a threshold of 1e-6."""
    return jnp.where(jnp.abs(x) < 1e-6, 1.0, 1 - x**2 / 6)


def _guarded_sinc(x):
    small = jnp.abs(x) < 1e-6
    return jnp.where(small, 1.0, jnp.sin(x) / jnp.where(small, 1.0, x))


# Function, range on [-2, 3] (None: not checked), difference quotients there.
CONTINUOUS = [
    (_dead_zone, (-1, 2), (0, 1)),
    (_dead_zone_by_size, (-1, 2), (0, 1)),
    (_saturation, (-1, 1), (0, 1)),
    (_band, (-1, 1), (0, 1)),
    (_outside, (-1, 1), (0, 1)),
    (_coulomb, None, (0, 1)),
    (_smooth_coulomb, (-0.4, 0.4), (-0.8, 0)),
    (_huber, (0, 2.5), (-1, 1)),
    (_masked, None, (-0.1, 1)),
    (_shifted, (0, 1.5), (0, 1)),
    (_guarded_sinc, (np.sin(3) / 3, 1), (-0.436182, 0.435398)),
    (jax.nn.elu, (np.expm1(-2), 3), (np.exp(-2), 1)),
    (jax.nn.selu, None, (1.0507 * 1.67326 * np.exp(-2), 1.7581)),
    (jax.nn.leaky_relu, (-0.02, 3), (0.01, 1)),
    (jax.nn.hard_tanh, (-1, 1), (0, 1)),
    (lambda x: jnp.where(x < 0, -x, x), (0, 3), (-1, 1)),
    (lambda x: jnp.sqrt(jnp.where(x > 0, x, 0.0)), (0, np.sqrt(3)), None),
    (lambda x: jnp.where(x >= 0, x, 0) * jnp.where(x >= 0, 2.0, 7.0), (0, 6), (0, 2)),
]
JUMPING = [
    lambda x: jnp.where(x > 0, 1.0, x),
    lambda x: jnp.where(x == 0.5, 7.0, x),
    lambda x: jnp.sign(x) * (x + 1),
    lambda x: jnp.where(jnp.abs(x) < 1, x, 0.0),
]
BOXES = [(-2.0, 3.0), (0.5, 1.5), (-1.0, 1.0), (0.0, 0.25), (1.0, 1.0), (-2.0, -1.0)]


def _points(low, high, count=41):
    special = np.array([-1, 0, 0.25, 0.3, 0.5, 1, 1.5, 1e-6, -1e-6])
    near = np.concatenate([special, special * (1 + 1e-9) + 1e-12, special * (1 - 1e-9) - 1e-12])
    points = np.concatenate([np.linspace(low, high, count), near, [low, high]])
    return np.unique(points[(low <= points) & (points <= high)])


@pytest.fixture(scope="module", params=["outward", "nearest"])
def rounded(request):
    return request.param


def _check(function, low, high, how, dtype=np.float64):
    """Values, forms and difference quotients of a function of one number lie in its bounds."""
    box = Interval(np.array([low], dtype), np.array([high], dtype))
    points = _points(low, high).astype(dtype)
    values = at_points(function, points[:, None]).astype(np.float64).ravel()
    slip = (1e-12 if dtype == np.float64 else 1e-5) if how == "nearest" else 4 * np.finfo(dtype).eps
    with rounding.using(how):
        natural, form, jac = (q(function)(box) for q in (inclusion.natural, inclusion.affine, inclusion.jacobian))
    x = points.astype(np.float64)

    def inside(bounds, what, slip=slip):
        assert float(bounds.lower.ravel()[0]) <= what.min() + slip * abs(what).max()
        assert float(bounds.upper.ravel()[0]) >= what.max() - slip * abs(what).max()

    inside(natural, values)
    inside(form.range, values)
    inside(form.offset, values - float(form.slope.ravel()[0]) * x)
    if len(x) > 1:
        i, j = np.triu_indices(len(x), 1)
        far = abs(x[i] - x[j]) > 1e-4
        quotients = (values[i] - values[j])[far] / (x[i] - x[j])[far]
        if len(quotients):
            inside(jac, quotients, 1e-7 if dtype == np.float64 else 1e-2)  # differences of rounded numbers
    return natural, form, jac


@pytest.mark.parametrize("function", [f for f, _, _ in CONTINUOUS] + JUMPING + [_nearly])
def test_everything_is_contained(function, rounded):
    for low, high in BOXES:
        _check(function, low, high, rounded)


@pytest.mark.parametrize("function", [_dead_zone, _band, _coulomb, jax.nn.elu, JUMPING[0], _nearly])
def test_everything_is_contained_in_single_precision(function):
    for low, high in BOXES[:3]:
        _check(function, low, high, "outward", np.float32)


@pytest.mark.parametrize(("function", "values", "slopes"), CONTINUOUS)
def test_ranges_and_slopes_are_those_of_the_pieces(function, values, slopes):
    natural, _, jac = _check(function, -2.0, 3.0, "outward")
    if values is not None:
        np.testing.assert_allclose([natural.lower[0], natural.upper[0]], values, atol=1e-12)
    if slopes is not None:
        np.testing.assert_allclose([jac.lower[0, 0], jac.upper[0, 0]], slopes, atol=1e-4)


@pytest.mark.parametrize("function", JUMPING)
def test_jumps_have_no_bounded_slope(function):
    jac = inclusion.jacobian(function)(Interval([-2.0], [3.0]))
    assert (float(jac.lower[0, 0]), float(jac.upper[0, 0])) == (-INF, INF)


@pytest.mark.parametrize("side", [(-2.0, 0.0), (0.0, 3.0), (1.0, 2.0)])
def test_a_jump_counts_only_where_the_box_holds_both_sides(side):
    """where(x > 0, 1, x): 0 itself belongs to the lower piece."""
    jac = inclusion.jacobian(JUMPING[0])(Interval([side[0]], [side[1]]))
    bounded = side[0] > 0 or side[1] <= 0
    assert bool(np.isfinite(jac.upper[0, 0])) == bounded


@pytest.mark.parametrize("function", [_dead_zone, _dead_zone_by_size, _saturation, _coulomb, jax.nn.elu])
def test_on_the_whole_line_the_form_is_as_good_as_it_can_be(function):
    """Dead zone and friction are x up to a constant there, and saturation is bounded."""
    form = inclusion.affine(function)(Interval([-INF], [INF]))
    width = float(form.offset.upper[0] - form.offset.lower[0])
    assert width <= {_saturation: 2.0, _coulomb: 0.6}.get(function, 2.0) + 1e-9 or function is jax.nn.elu


def test_straight_pieces_get_their_chord():
    """|x| on [-1, 3]: the chord has slope 1/2, and 3/2 lies between it and the kink."""
    form = inclusion.affine(lambda x: jnp.where(x < 0, -x, x))(Interval([-1.0], [3.0]))
    assert float(form.slope[0, 0]) == pytest.approx(0.5)
    np.testing.assert_allclose([form.offset.lower[0], form.offset.upper[0]], [0, 1.5], atol=1e-12)


def test_entries_that_mix_are_not_taken_apart():
    """Entry i is switched by x_i and holds x_j as well: x_j is not on the segment of x_i."""

    def mixed(x):
        return jnp.where(x > 0, x * jnp.roll(x, 1), 0.0)

    box = Interval([-2.0, 0.2], [3.0, 0.9])
    points = np.stack(np.meshgrid(np.linspace(-2, 3, 41), np.linspace(0.2, 0.9, 8)), -1).reshape(-1, 2)
    values = at_points(mixed, points)
    natural, form = inclusion.natural(mixed)(box), inclusion.affine(mixed)(box)
    left = values - points @ np.asarray(form.slope).T
    for bounds, what in ((natural, values), (form.range, values), (form.offset, left)):
        assert (np.asarray(bounds.lower) <= what.min(0) + 1e-12).all()
        assert (np.asarray(bounds.upper) >= what.max(0) - 1e-12).all()


def test_one_number_switches_a_vector():
    box = Interval([-1.0, -1.0, 0.0], [1.0, 1.0, 2.0])
    grid = [np.linspace(a, b, 9) for a, b in zip(box.lower, box.upper, strict=True)]
    points = np.stack(np.meshgrid(*grid), -1).reshape(-1, 3)
    values = at_points(_scaled_gain, points)
    form, jac = inclusion.affine(_scaled_gain)(box), inclusion.jacobian(_scaled_gain)(box)
    left = values - points @ np.asarray(form.slope).T
    assert (np.asarray(form.offset.lower) <= left.min(0) + 1e-12).all()
    assert (np.asarray(form.offset.upper) >= left.max(0) - 1e-12).all()
    np.testing.assert_allclose(jac.lower, [[1, 1, 0], [1, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(jac.upper, [[2, 1, 0], [2, 0, 1]], atol=1e-12)


def test_a_known_threshold_that_moves():
    """The threshold is a known input: the jump is computed on the spot."""
    box, u = Interval([-2.0], [3.0]), jnp.array([0.5])

    def function(x, u):
        return jnp.where(x > u, x - u, 0.0)

    values = np.maximum(np.linspace(-2, 3, 101) - 0.5, 0)
    natural = inclusion.natural(function)(box, u)
    assert float(natural.lower[0]) <= values.min()
    assert float(natural.upper[0]) >= values.max()


def test_a_jump_of_a_value_without_bounds_is_no_rounding():
    """At the cut the value is known to have no bound, and neither has the jump: no share of that is small."""

    def f(x):
        return x * jnp.heaviside(jax.nn.softplus(x) - 4.0, -2.375)

    for upper in (50.0, INF):
        found = inclusion.jacobian(f)(Interval([0.625], [upper]))
        assert np.isinf(found.lower).all()
        assert np.isinf(found.upper).all()


def _bent_sum(x):
    return jnp.clip(x, -1.0, 1.0) + jnp.clip(x, 0.5, 2.0) + jnp.clip(x, -3.0, 0.0)


@pytest.mark.parametrize("turned", [lambda v: -v, lambda v: -jnp.abs(v), lambda v: v - 2.4, lambda v: 0.5 - v - 0.5])
def test_a_cut_of_a_sum_that_bends_is_none_of_its_variable(turned):
    """The sum is bounded as a function of x, but ``-sum > -1.2`` changes where the sum is 1.2, not x."""

    def f(x):
        y = turned(_bent_sum(x))
        return jnp.where(y > -1.2, y, 100.0)

    box, x = Interval([0.5], [1.1]), np.linspace(0.5, 1.1, 601)[:, None]
    value = at_points(f, x)
    assert {100.0} < set(value.ravel())  # both cases are taken
    for bounds in (inclusion.natural(f)(box), inclusion.affine(f)(box).range):
        assert bounds.contains(value, -1e-12).all()


def test_a_switch_beside_an_expression_known_as_a_whole():
    """The difference that ends a log_softmax has one operand, the exponents."""

    def f(x):
        y = jax.nn.log_softmax(x)
        return jnp.where(y > -1.0, y, 2.0 * y)

    box = Interval([-0.5, 0.0, 0.2], [0.5, 0.3, 1.0])
    x = np.random.default_rng(0).uniform(box.lower, box.upper, (500, 3))
    assert inclusion.natural(f)(box).contains(at_points(f, x)).all()


def test_a_choice_by_a_count_keeps_the_type_of_the_box():
    def f(x):
        return jnp.concatenate([jnp.piecewise(x, [x < -0.5, x > 0.7], [lambda v: v, lambda v: v * v, 1.0]), x])

    box = Interval(np.array([-1.0, 0.0], np.float32), np.array([1.0, 0.5], np.float32))
    form = inclusion.affine(f)(box)
    assert np.asarray(form.slope).dtype == np.float32
    x = np.random.default_rng(0).uniform(box.lower, box.upper, (500, 2))
    assert form.range.contains(at_points(f, x), -1e-6).all()
