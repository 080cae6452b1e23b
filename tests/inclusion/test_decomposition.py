"""Decomposition functions: four cases, remainder form, tight bounds. Truth from NumPy, one (i, j) at a time."""

from __future__ import annotations

import functools
import itertools

import decomposition_numpy as oracle
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from inclusion.test_compositions import JUMPING, KINKED, SMOOTH, boxes, build, programs, to_box
from inclusion_points import points
from oracles.uncompiled import in_numpy

from gsisio_jax import Interval, inclusion

FORMS = {
    "decomposition": inclusion.decomposition,
    "remainder": inclusion.remainder,
    "tight": inclusion.tight,
}
SIZES = (1, 2, 3, 4)
# Compiling is what these tests spend their time on.


def function(n):
    """All named functions of n variables as the rows of one, so that one compilation serves them all."""
    return lambda x: oracle.rows(n, x, jnp)


def some_boxes(n, count=60, seed=0):
    """Corners (count, n): widths from 0 to 2, and in the last six infinite sides."""
    rng = np.random.default_rng([seed, n])
    lower = rng.uniform(-1.1, 1.1, (count, n))
    upper = lower + rng.choice([0.0, 1e-6, 0.1, 0.7, 2.0], (count, n))
    upper[0] = lower[0]
    lower[-6:-3, 0], upper[-3:, -1], lower[-1, 0] = -np.inf, np.inf, -np.inf
    return lower, upper


@functools.cache
def bounds(n):
    """All forms and the Jacobian enclosure on `some_boxes`, as NumPy."""

    @in_numpy
    @jax.vmap
    def run(lower, upper):
        # The derivative is computed once for all forms; `test_default_derivative` is about the forms' own.
        box = Interval.unchecked(lower, upper)
        jac = inclusion.jacobian(function(n))(box)
        return {name: form(function(n), jac)(box) for name, form in FORMS.items()} | {"jacobian": jac}

    return jax.tree.map(np.asarray, run(*some_boxes(n)))


def finite(n):
    lower, upper = some_boxes(n)
    return np.flatnonzero(np.isfinite(upper - lower).all(1))


def widest(n):
    lower, upper = some_boxes(n)
    return max(finite(n), key=lambda k: (upper[k] - lower[k]).sum())


def room(*arrays):
    """For rounding."""
    return 1e-12 * (1 + sum(np.where(np.isfinite(v), np.abs(v), 0) for v in arrays))


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("n", SIZES)
def test_no_point_of_a_box_leaves_its_bounds(n, form):
    """35 named functions; interior, faces, corners; infinite boxes too. Never NaN, never crossed."""
    result = bounds(n)[form]
    assert (result.lower <= result.upper).all()
    assert (result.lower < np.inf).all()
    assert (result.upper > -np.inf).all()
    for k, (lower, upper) in enumerate(zip(*some_boxes(n), strict=True)):
        x = points(lower, upper, count=1500, seed=k)
        with np.errstate(all="ignore"):
            value = oracle.rows(n, x.T)
        low, high = result.lower[k, :, None], result.upper[k, :, None]
        missed = (value < low - room(value)) | (value > high + room(value))
        assert not missed.any(), [list(oracle.FUNCTIONS[n])[i] for i in np.flatnonzero(missed.any(1))]


@pytest.mark.parametrize("n", SIZES)
def test_four_cases_and_remainder_equal_the_oracle(n):
    lower, upper = some_boxes(n)
    result = bounds(n)
    for k in finite(n):
        a, b = result["jacobian"].lower[k], result["jacobian"].upper[k]
        keep = np.isfinite(a).all(1) & np.isfinite(b).all(1)
        assert keep.sum() >= len(keep) - 2

        def f(x, keep=keep):
            return oracle.rows(n, x)[keep]

        low = oracle.f_d(f, a[keep], b[keep], lower[k], upper[k])
        high = oracle.f_d(f, a[keep], b[keep], upper[k], lower[k])
        np.testing.assert_allclose(result["decomposition"].lower[k][keep], low, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(result["decomposition"].upper[k][keep], high, rtol=1e-12, atol=1e-12)
        low, high = oracle.remainder(f, a[keep], b[keep], lower[k], upper[k])
        np.testing.assert_allclose(result["remainder"].lower[k][keep], low, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(result["remainder"].upper[k][keep], high, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("n", SIZES)
def test_tight_in_remainder_in_decomposition(n):
    """Never looser, and on many boxes tighter."""
    result = bounds(n)
    for inner, outer in (("tight", "remainder"), ("remainder", "decomposition")):
        small, large = result[inner], result[outer]
        assert (small.lower >= large.lower - room(large.lower)).all()
        assert (small.upper <= large.upper + room(large.upper)).all()
        k = finite(n)
        gained = (small.upper - small.lower)[k] < 0.9 * (large.upper - large.lower)[k]
        assert gained.sum() > 10


@pytest.mark.parametrize("n", SIZES)
def test_tight_is_exact_where_signs_are_known(n):
    """Then the range is that of the corners."""
    lower, upper = some_boxes(n)
    result, seen = bounds(n), 0
    for k in finite(n):
        a, b = result["jacobian"].lower[k], result["jacobian"].upper[k]
        known = ((a >= 0) | (b <= 0)).all(1)
        corners = np.array(list(itertools.product(*zip(lower[k], upper[k], strict=True))))
        with np.errstate(invalid="ignore"):
            value = oracle.rows(n, corners.T)[known]
        known[known] = np.isfinite(value).all(1)
        value = value[np.isfinite(value).all(1)]
        np.testing.assert_allclose(result["tight"].lower[k][known], value.min(1), rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(result["tight"].upper[k][known], value.max(1), rtol=1e-12, atol=1e-12)
        seen += (known & (upper[k] > lower[k]).any()).sum()
    assert seen > 20


@pytest.mark.parametrize("n", [1, 2])
def test_no_center_gives_better_bounds_than_that_of_tight(n):
    """Against mean-value forms around 41^n centers of the box, from the same derivative bounds."""
    lower, upper = some_boxes(n)
    result, gained = bounds(n), 0
    for k in finite(n):
        share = np.array(list(itertools.product(np.linspace(0, 1, 41), repeat=n)))
        center = lower[k] + share * (upper[k] - lower[k])
        with np.errstate(invalid="ignore"):
            value = oracle.rows(n, center.T)
        for i in range(len(value)):
            a, b = result["jacobian"].lower[k, i], result["jacobian"].upper[k, i]
            if np.isfinite(a).all() and np.isfinite(b).all():
                low, high = oracle.mean_value(value[i], a, b, center, lower[k], upper[k])
                assert result["tight"].lower[k, i] >= low.max() - room(low.max())
                assert result["tight"].upper[k, i] <= high.min() + room(high.min())
                gained += result["tight"].lower[k, i] > result["remainder"].lower[k, i] + 1e-3
    assert gained > 5


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("n", SIZES)
def test_box_of_zero_width(n, form):
    """The bounds are f(x)."""
    lower, upper = some_boxes(n)
    assert (lower[0] == upper[0]).all()
    with np.errstate(invalid="ignore"):
        value = oracle.rows(n, lower[0])
    for side in (bounds(n)[form].lower[0], bounds(n)[form].upper[0]):
        np.testing.assert_allclose(side[np.isfinite(value)], value[np.isfinite(value)], rtol=1e-14, atol=1e-15)


@pytest.mark.parametrize("form", ["cases", "optimal"])
@pytest.mark.parametrize("n", SIZES)
def test_decomposition_function_is_monotone(n, form):
    """Increasing in x, decreasing in y, f on the diagonal; so [f_d(lo, hi), f_d(hi, lo)] bounds f (paper, Prop. 2)."""
    lower, upper = some_boxes(n)
    k = widest(n)
    a, b = bounds(n)["jacobian"].lower[k], bounds(n)["jacobian"].upper[k]
    f_d = in_numpy(jax.vmap(inclusion.decomposition_function(function(n), Interval(a, b), form)))
    rng = np.random.default_rng(n)
    x, y, more = lower[k] + (upper[k] - lower[k]) * rng.choice([0, 1, 0.5, *rng.uniform(0, 1, 9)], (3, 2000, n))
    more = np.maximum(x, more)
    known = np.isfinite(a).all(1) & np.isfinite(b).all(1)
    at, up, down, diagonal = (np.asarray(f_d(*p))[:, known] for p in ((x, y), (more, y), (y, x), (y, y)))
    fewer = np.asarray(f_d(y, more))[:, known]
    assert (up >= at - room(at)).all()
    assert (fewer <= down + room(down)).all()
    np.testing.assert_allclose(diagonal, oracle.rows(n, y.T)[known].T, rtol=1e-13, atol=1e-14)
    assert (up > at + 1e-3).any()
    assert (fewer < down - 1e-3).any()
    if form == "cases":
        expected = [oracle.f_d(lambda z: oracle.rows(n, z)[known], a[known], b[known], x[i], y[i]) for i in range(20)]
        np.testing.assert_allclose(at[:20], expected, rtol=1e-12, atol=1e-12)


def test_bounds_from_fixed_derivatives_shrink_with_the_box():
    """With derivative bounds of a larger box the bounds of nested boxes are nested, in all three forms' f_d."""
    n, rng = 2, np.random.default_rng(3)
    lower, upper = some_boxes(n)
    k = widest(n)
    jac = Interval(bounds(n)["jacobian"].lower[k], bounds(n)["jacobian"].upper[k])

    @in_numpy
    @functools.partial(jax.vmap, in_axes=(0, None))
    def run(box, derivative):
        f_d = inclusion.decomposition_function(function(n), derivative, "optimal")
        return [form(function(n), derivative)(box) for name, form in FORMS.items() if name != "tight"] + [
            Interval.unchecked(f_d(box.lower, box.upper), f_d(box.upper, box.lower))
        ]

    ends = np.sort(rng.uniform(0, 1, (4, 200, n)), axis=0)
    ends[0, :100], ends[3, 50:150] = 0, 1
    low, inner_low, inner_high, high = lower[k] + ends * (upper[k] - lower[k])
    for wide, narrow in zip(run(Interval(low, high), jac), run(Interval(inner_low, inner_high), jac), strict=True):
        assert (narrow.lower >= wide.lower - room(wide.lower)).all()
        assert (narrow.upper <= wide.upper + room(wide.upper)).all()


def test_bounds_from_own_derivatives_need_not_shrink_with_the_box():
    """The case, and with it the corner, changes from 2 to 3 where the upper bound of the derivative drops below 1."""

    def f(x):
        return -x[0] + 2.1 / 11 * x[0] ** 11

    ends = np.array([[1.0], [0.99]])
    whole, part = in_numpy(jax.vmap(inclusion.decomposition(f)))(Interval(0 * ends, ends)).lower
    assert whole == pytest.approx(-1)
    assert part < -1.7


@settings(max_examples=6, deadline=None)
@given(programs(SMOOTH | KINKED | JUMPING), boxes)
def test_compositions(program, sides):
    """Random chains of the engine's operations: no point outside. (The other half of `tight`, the affine range, has
    its own such test.)"""
    f, box = build(*zip(*program, strict=True)), to_box(sides)
    x = points(box.lower, box.upper)
    evaluate = in_numpy(jax.vmap(f))
    value = np.asarray(evaluate(x))
    # At a jump rounding alone may take the other side: look where f does not move with x.
    near = [np.asarray(evaluate(x * (1 + sign * 1e-12) + sign * 1e-13)) for sign in (1, -1)]
    steady = np.all([np.abs(v - value).max(1) < 1e-6 for v in near], axis=0)

    @in_numpy
    def run(box):
        jac = inclusion.jacobian(f)(box)
        f_d = inclusion.decomposition_function(f, jac, "optimal")
        centered = Interval.unchecked(f_d(box.lower, box.upper), f_d(box.upper, box.lower))
        return inclusion.decomposition(f, jac)(box), inclusion.remainder(f, jac)(box), centered

    for result in run(box):
        assert (result.lower <= result.upper).all()
        allowed = 1e-11 * (1 + np.abs(value[steady]))
        assert (value[steady] >= np.asarray(result.lower) - allowed).all()
        assert (value[steady] <= np.asarray(result.upper) + allowed).all()


def test_default_derivative():
    """Left out, it is the Jacobian enclosure on the box at hand, further arguments included."""

    def f(x, u):
        return jnp.stack([u * jnp.sin(x[0]) + x[1], x[0] * x[1]])

    @in_numpy
    def run(box, u):
        jac = inclusion.jacobian(f)(box, u)
        return [(form(f)(box, u), form(f, jac)(box, u)) for form in FORMS.values()]

    for u in (0.7, Interval(0.2, 0.9)):
        for default, given_one in run(Interval([-1.0, -0.5], [2.0, 0.1]), u):
            np.testing.assert_array_equal(default.lower, given_one.lower)
            np.testing.assert_array_equal(default.upper, given_one.upper)


# P11: what the paper's Lemma 2 says, and what holds.


def test_one_z_for_all_rows_is_wrong():
    """f = (x, -x): row 1 needs z = x, row 2 needs z = y, so any single z breaks a bound; a z for every row is right."""

    def f(x):
        return np.array([x[0], -x[0]])

    a = b = [[1.0], [-1.0]]
    lower, upper = np.array([0.0]), np.array([1.0])
    truth = f(lower), f(upper)
    for z in ("x", "y"):
        low, high = (oracle.f_d_one_z(f, a, b, *pair, z) for pair in ((lower, upper), (upper, lower)))
        assert (low > np.minimum(*truth)).any()
        assert (high < np.maximum(*truth)).any()
    box = inclusion.decomposition(lambda x: jnp.concatenate([x, -x]))(Interval(lower, upper))
    np.testing.assert_array_equal(box.lower, [0, -1])
    np.testing.assert_array_equal(box.upper, [1, 0])


def test_the_constant_of_lemma_2_is_too_small():
    """``||width|| <= (L_q + 2 ||C_q||) ||x - y||`` fails: f = (x1 + x2, x1 - x2), C = 0, L = sqrt 2, width (2, 2)."""
    matrix = np.array([[1.0, 1.0], [1.0, -1.0]])
    derivative = Interval(matrix, matrix)
    box = Interval(np.zeros(2), np.ones(2))
    bounds = inclusion.decomposition(lambda x: matrix @ x, derivative)(box)
    gain = np.asarray(inclusion.decomposition_gain(derivative))
    printed = np.linalg.norm(matrix, 2) + 2 * np.linalg.norm(gain, 2)
    assert np.linalg.norm(bounds.width) == pytest.approx(2 * np.sqrt(2))
    assert printed * np.linalg.norm(box.width) == pytest.approx(2)
    np.testing.assert_allclose(bounds.width, np.asarray(inclusion.width_gain(derivative)) @ box.width)


@pytest.mark.parametrize("n", SIZES)
def test_width_gain_bounds_the_width(n):
    """Entry by entry, on every finite box; the larger constants of cases 2 and 3 are needed."""
    lower, upper = some_boxes(n)
    result = bounds(n)["decomposition"]
    for k in finite(n):
        jac = Interval(bounds(n)["jacobian"].lower[k], bounds(n)["jacobian"].upper[k])
        gain = np.asarray(inclusion.width_gain(jac))
        limit = np.where(upper[k] > lower[k], gain, 0) * np.where(np.isfinite(gain), upper[k] - lower[k], 1)
        width = result.upper[k] - result.lower[k]
        assert (width <= limit.sum(1) + room(width)).all()


@pytest.mark.parametrize(
    ("a", "b", "slope", "gain", "width_gain"),
    [
        (0.5, 2.0, 2.0, 0.0, 2.0),
        (-1.0, 2.0, 2.0, 1.0, 4.0),
        (-2.0, 1.0, -2.0, 1.0, 4.0),
        (-2.0, -0.5, -2.0, 0.0, 2.0),
        (-1.0, 1.0, 1.0, 1.0, 3.0),
        (-np.inf, 1.0, -3.0, 1.0, np.inf),
        (0.0, 0.0, 0.0, 0.0, 0.0),
    ],
    ids=["case 1", "case 2", "case 3", "case 4", "tie", "half-infinite", "zero"],
)
def test_gains_of_the_four_cases(a, b, slope, gain, width_gain):
    """``max(|a|, |b|) + 2 C``; attained in every case by the steepest function that the bounds allow."""
    derivative = Interval([[a]], [[b]])
    assert inclusion.decomposition_gain(derivative).item() == gain == oracle.case(a, b)[1]
    assert inclusion.width_gain(derivative).item() == width_gain
    width = inclusion.decomposition(lambda x: slope * x, derivative)(Interval([0.3], [1.3])).width.item()
    assert width == pytest.approx(width_gain if np.isfinite(width_gain) else abs(slope) + 2 * gain)
