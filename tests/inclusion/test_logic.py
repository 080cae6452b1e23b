"""Selection, comparisons, steps, kinks, remainders, the angle: where the derivative of AD would be unsound."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from inclusion_points import points
from jax import lax
from oracles.uncompiled_bounds import at_points

from gsisio_jax import inclusion
from gsisio_jax.interval import Interval

COMPILED = True  # where the numbers of a box are known while its bounds are made, more is decided
INF = np.inf


def box(*sides):
    return Interval(np.array([a for a, _ in sides]), np.array([b for _, b in sides]))


def pair(bounds):
    return np.asarray(bounds.lower).ravel().tolist() + np.asarray(bounds.upper).ravel().tolist()


def test_where_undecided():
    f = lambda x: jnp.where(x < 0, x + 2, -x - 1)  # noqa: E731
    bounds, form = inclusion.natural(f)(box((-1, 2))), inclusion.affine(f)(box((-1, 2)))
    # The hull of both branches over the whole box; the function itself covers [-3, 2].
    assert bounds.lower == -3
    assert 2 <= bounds.upper <= 4
    assert form.range.lower == -3
    assert 2 <= form.range.upper <= 4
    assert pair(inclusion.jacobian(f)(box((-1, 2)))) == [-INF, INF]


def test_where_decided():
    f = lambda x: jnp.where(x < 0, x + 2, -x - 1)  # noqa: E731
    for b, slope, value in (((-1, -0.5), 1, [1, 1.5]), ((0, 2), -1, [-3, -1])):
        assert pair(inclusion.natural(f)(box(b))) == value
        assert pair(inclusion.jacobian(f)(box(b))) == [slope, slope]
        assert inclusion.affine(f)(box(b)).offset.width == 0


def test_selection_keeps_what_the_cases_share():
    form = inclusion.affine(lambda x: jnp.where(x > 0, x + 1, x - 1))(Interval.entire(1))
    assert form.slope == 1
    assert pair(form.offset) == [-1, 1]


def test_uncertain_argument_selects_without_a_jump_in_x():
    f = lambda x, u: jnp.where(u > 0, 2 * x, 3 * x)  # noqa: E731
    assert pair(inclusion.jacobian(f)(box((-1, 2)), box((-1, 1)))) == [2, 3]


@pytest.mark.parametrize(("fn", "decided", "value"), [
    (jnp.floor, (0.2, 0.8), 0.0),
    (jnp.ceil, (0.2, 0.8), 1.0),
    (jnp.round, (0.6, 1.4), 1.0),
    (jnp.sign, (0.2, 5.0), 1.0),
    (jnp.trunc, (-0.9, 0.9), 0.0),
    (lambda x: (x > 0).astype(float), (0.1, 1.0), 1.0),
    (lambda x: x.astype(int).astype(float), (1.2, 1.9), 1.0),
    (lambda x: jnp.isfinite(x) * 1.0, (1.2, 1.9), 1.0),
    (lambda x: jnp.floor_divide(x, 2.0), (2.2, 3.9), 1.0),
])  # fmt: skip
def test_steps(fn, decided, value):
    assert pair(inclusion.natural(fn)(box(decided))) == [value, value]
    assert pair(inclusion.jacobian(fn)(box(decided))) == [0, 0]


@pytest.mark.parametrize(("fn", "value"), [
    (jnp.floor, [-2, 1]), (jnp.ceil, [-1, 2]), (jnp.round, [-2, 2]), (jnp.sign, [-1, 1]),
    (lambda x: (x > 0) * 1.0, [0, 1]), (lambda x: x.astype(int) * 1.0, [-1, 1]),
])  # fmt: skip
def test_steps_that_jump(fn, value):
    assert pair(inclusion.natural(fn)(box((-1.6, 1.6)))) == value
    # AD says 0; the difference quotient across the jump says otherwise.
    assert pair(inclusion.jacobian(fn)(box((-1.6, 1.6)))) == [-INF, INF]


def test_rounding_follows_its_argument_on_all_of_r():
    form = inclusion.affine(jnp.floor)(Interval.entire(1))
    assert form.slope == 1
    assert pair(form.offset) == [-1, 0]


@pytest.mark.parametrize(("fn", "left"), [(jnp.abs, -1), (jax.nn.relu, 0), (lambda x: jnp.maximum(x, -0.0), 0)])
def test_kinks_have_the_hull_of_both_sides(fn, left):
    assert pair(inclusion.jacobian(fn)(box((-1, 2)))) == [left, 1]
    assert pair(inclusion.jacobian(fn)(box((0, 0)))) == [left, 1]
    assert pair(inclusion.jacobian(fn)(box((1, 2)))) == [1, 1]
    assert pair(inclusion.jacobian(fn)(box((-2, -1)))) == [left, left]
    # The chord above, the parallel through the kink below.
    form = inclusion.affine(fn)(box((-1, 2)))
    assert form.offset.lower == 0
    np.testing.assert_allclose(form.offset.upper, 2 / 3 if left == 0 else 4 / 3)
    # One infinite side still leaves a bounded rest.
    assert np.isfinite(inclusion.affine(fn)(box((-1, INF))).offset.width)


def test_extremes_of_entries():
    b = box((-1, 2), (1, 3), (-4, 0.5))
    f = lambda x: jnp.array([jnp.max(x), jnp.min(x), jnp.max(x[:2])])  # noqa: E731
    bounds, jac = inclusion.natural(f)(b), inclusion.jacobian(f)(b)
    assert bounds.lower.tolist() == [1, -4, 1]
    assert bounds.upper.tolist() == [3, 0.5, 3]
    # The last entry can never be the largest, so the maximum does not depend on it.
    assert jac.lower.tolist() == [[0, 0, 0], [0, 0, 0], [0, 0, 0]]
    assert jac.upper[np.array([0, 2])].tolist() == [[1, 1, 0], [1, 1, 0]]
    assert (jac.upper[1] <= 1).all()


def test_clip():
    f = lambda x: jnp.clip(x, -1.0, 1.0)  # noqa: E731
    b = box((-3, -2), (-3, 0), (-0.5, 0.5), (0, 3), (-9, 9))
    jac = inclusion.jacobian(f)(b)
    assert np.diag(jac.lower).tolist() == [0, 0, 1, 0, 0]
    assert np.diag(jac.upper).tolist() == [0, 1, 1, 1, 1]
    assert pair(inclusion.natural(f)(b)) == [-1, -1, -0.5, 0, -1, -1, 0, 0.5, 1, 1]
    assert pair(inclusion.natural(lambda x: lax.clamp(-1.0, x, 1.0))(b)) == pair(inclusion.natural(f)(b))


def test_products_and_running_results():
    b = box((-1, 2), (1, 3), (-4, 0.5))
    f = lambda x: jnp.stack([lax.cumprod(x), lax.cummax(x), lax.cummin(x, reverse=True)])  # noqa: E731
    bounds = inclusion.natural(f)(b)
    assert bounds.lower.tolist() == [[-1, -3, -24], [-1, 1, 1], [-4, -4, -4]]
    assert bounds.upper.tolist() == [[2, 6, 12], [2, 3, 3], [0.5, 0.5, 0.5]]
    x = points(b.lower, b.upper)
    form = inclusion.affine(f)(b)
    rest = at_points(f, x) - np.einsum("ijk,pk->pij", form.slope, x)
    assert (form.offset.lower - 1e-12 <= rest).all()
    assert (rest <= form.offset.upper + 1e-12).all()
    assert pair(inclusion.natural(jnp.prod)(b)) == [-24, 12]


def test_logic_in_three_values():
    def f(x):
        a, b = x[0], x[1]
        return jnp.stack([
            (a > 0) & (b > 0), (a > 0) | (b > 0), ~(b > 0), (a > 0) ^ (b > 0), jnp.all(x > -9), jnp.any(x > 1),
            a == a, a != a, a < b, a <= b, b == 1.5,
        ])  # fmt: skip

    bounds = inclusion.natural(lambda x: f(x) * 1.0)(box((-1, 0.5), (1, 2)))
    assert bounds.lower.tolist() == [0, 1, 0, 0, 1, 0, 1, 0, 1, 1, 0]
    assert bounds.upper.tolist() == [1, 1, 0, 1, 1, 1, 1, 0, 1, 1, 1]
    # Affine forms know that x and x + 1 move together.
    assert inclusion.affine(lambda x: (x[0] < x[0] + 1) * 1.0)(box((-5, 5))).range.lower == 1


@pytest.mark.parametrize("a", [-7.3, -1.0, -0.2, 0.0, 0.4, 1.9, 2.0, 5.1])
@pytest.mark.parametrize("width", [0.0, 0.3, 1.5, 9.0])
def test_remainders(a, width):
    x = np.linspace(a, a + width, 401)
    for fn, truth in ((lambda t: jnp.mod(t, 2.0), np.mod(x, 2.0)), (lambda t: jnp.fmod(t, 2.0), np.fmod(x, 2.0)),
                      (lambda t: jnp.mod(t, -2.0), np.mod(x, -2.0))):  # fmt: skip
        bounds, form = inclusion.natural(fn)(box((a, a + width))), inclusion.affine(fn)(box((a, a + width)))
        assert (bounds.lower <= truth + 1e-12).all()
        assert (truth <= bounds.upper + 1e-12).all()
        assert bounds.width <= 4
        rest = truth - float(form.slope[0, 0]) * x
        assert (form.offset.lower <= rest + 1e-12).all()
        assert (rest <= form.offset.upper + 1e-12).all()
        jumps = np.abs(np.diff(truth)).max() > 1
        jac = inclusion.jacobian(fn)(box((a, a + width)))
        assert pair(jac) in ([1, 1], [-INF, INF])
        assert not jumps or pair(jac) == [-INF, INF]
    assert pair(inclusion.natural(lambda t: jnp.mod(t, 2.0))(box((-9, 9)))) == [0, 2]
    assert pair(inclusion.jacobian(lambda t: jnp.mod(t, 2.0))(box((0.1, 1.9)))) == [1, 1]


ANGLES = {
    "first": ((1, 2), (1, 3)), "second": ((1, 2), (-3, -1)), "third": ((-2, -1), (-3, -1)),
    "fourth": ((-2, -1), (1, 3)),
    "right": ((-2, 1), (0.5, 3)), "up": ((0.5, 1), (-2, 3)), "down": ((-1, -0.5), (-2, 3)),
    "point": ((0.3, 0.3), (-1, -1)),
    "corner at the origin": ((0, 1), (0, 1)), "edge through the origin": ((-1, 1), (0, 2)),
    "upper half": ((0, 2), (-1, 1)),
}  # fmt: skip


@pytest.mark.parametrize("name", ANGLES)
def test_angle_is_exact_away_from_the_cut(name):
    f = lambda x: jnp.arctan2(x[0], x[1])  # noqa: E731
    b = box(*ANGLES[name])
    y, x = np.meshgrid(np.linspace(b.lower[0], b.upper[0], 201), np.linspace(b.lower[1], b.upper[1], 201))
    truth, bounds = np.arctan2(y, x), inclusion.natural(f)(b)
    np.testing.assert_allclose([bounds.lower, bounds.upper], [truth.min(), truth.max()], atol=1e-15)
    form, jac = inclusion.affine(f)(b), inclusion.jacobian(f)(b)
    rest = truth - float(form.slope[0]) * y - float(form.slope[1]) * x
    np.testing.assert_allclose([form.offset.lower, form.offset.upper], [rest.min(), rest.max()], atol=2e-4)
    assert form.offset.lower <= rest.min() + 1e-12
    assert rest.max() <= form.offset.upper + 1e-12
    if "origin" in name or name == "upper half":
        assert pair(jac) == [-INF, -INF, INF, INF]
    else:
        square = x**2 + y**2
        for i, partial in enumerate((x / square, -y / square)):
            np.testing.assert_allclose([jac.lower[i], jac.upper[i]], [partial.min(), partial.max()], rtol=1e-3)
            assert jac.lower[i] <= partial.min() + 1e-12
            assert partial.max() <= jac.upper[i] + 1e-12


@pytest.mark.parametrize(
    "sides", [((-1, 1), (-2, -1)), ((-1, 1), (-2, 3)), ((-1, 0), (-2, -1)), ((-INF, INF), (-INF, INF))]
)
def test_angle_across_the_cut(sides):
    f = lambda x: jnp.arctan2(x[0], x[1])  # noqa: E731
    assert pair(inclusion.natural(f)(box(*sides))) == [-np.pi, np.pi]
    assert pair(inclusion.jacobian(f)(box(*sides))) == [-INF, -INF, INF, INF]
    assert pair(inclusion.affine(f)(box(*sides)).offset) == [-np.pi, np.pi]


def test_angle_on_half_planes():
    f = lambda x: jnp.arctan2(x[0], x[1])  # noqa: E731
    np.testing.assert_allclose(pair(inclusion.natural(f)(box((1, INF), (-INF, INF)))), [0, np.pi])
    np.testing.assert_allclose(pair(inclusion.natural(f)(box((-INF, INF), (1, INF)))), [-np.pi / 2, np.pi / 2])


def test_norm_over_the_origin():
    b = box((-1, 2), (-1, 2))
    bounds = inclusion.natural(jnp.linalg.norm)(b)
    np.testing.assert_allclose([bounds.lower, bounds.upper], [0, np.sqrt(8)])
    form = inclusion.affine(jnp.linalg.norm)(b)
    x = points(b.lower, b.upper, 400)
    rest = np.linalg.norm(x, axis=1) - x @ np.asarray(form.slope)
    assert (form.offset.lower <= rest + 1e-12).all()
    assert (rest <= form.offset.upper + 1e-12).all()
    away = inclusion.jacobian(jnp.linalg.norm)(box((1, 2), (1, 2)))
    assert (away.lower > 0).all()
    assert (away.upper < 1.5).all()


def test_branches():
    f = lambda x: lax.cond(x[0] > 0, lambda y: 2 * y, lambda y: -y, x)  # noqa: E731
    assert pair(inclusion.natural(f)(box((1, 2)))) == [2, 4]
    assert pair(inclusion.natural(f)(box((-1, 2)))) == [-2, 4]
    assert pair(inclusion.jacobian(f)(box((1, 2)))) == [2, 2]
    assert pair(inclusion.jacobian(f)(box((-1, 2)))) == [-INF, INF]
    switch = lambda x, i: lax.switch(i, [lambda y: y, lambda y: 2 * y, lambda y: 3 * y], x)  # noqa: E731
    assert pair(jax.jit(inclusion.natural(switch))(box((1, 2)), 2)) == [3, 6]


def test_power_with_an_exponent_that_is_not_known_in_advance():
    f = lambda x, p: x**p  # noqa: E731
    natural = jax.jit(inclusion.natural(f))
    np.testing.assert_allclose(pair(natural(box((1, 4)), jnp.array([0.5]))), [1, 2], rtol=1e-14)
    # (-2)^2 = 4 although no logarithm exists.
    assert pair(natural(box((-2, 1)), jnp.array([2.0]))) == [-INF, INF]
    np.testing.assert_allclose(pair(inclusion.natural(f)(box((1, 4)), box((-1, 2)))), [0.25, 16])
    np.testing.assert_allclose(pair(inclusion.natural(lambda x: 2.0**x)(box((-1, 3)))), [0.5, 8])


def test_division():
    f = lambda x: x[0] / x[1]  # noqa: E731
    np.testing.assert_allclose(pair(inclusion.natural(f)(box((1, 2), (-4, -1)))), [-2, -0.25])
    assert pair(inclusion.natural(f)(box((1, 2), (-1, 1)))) == [-INF, INF]
    assert pair(inclusion.natural(f)(box((1, 2), (0, 1)))) == [1, INF]
    assert pair(inclusion.natural(lambda x, c: x / c)(box((1, 2)), 0.0)) == [-INF, INF]
    assert pair(inclusion.natural(lambda x, c: x / c)(box((1, INF)), 2.0)) == [0.5, INF]
