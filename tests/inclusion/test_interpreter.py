"""The engine inside jit, vmap, grad and scan; types; errors and bounds supplied by hand."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from oracles.uncompiled import in_numpy
from oracles.uncompiled_bounds import at_points

from gsisio_jax import inclusion
from gsisio_jax.inclusion.transforms import affine_and_jacobian, affine_with_slack
from gsisio_jax.interval import Interval, rounding

BOUNDS = ("natural", "affine", "jacobian", "mean_value")


def tanks(x):
    """Six tanks in a row: outflow by the root of the level."""
    s, h, k = 19.62**0.5, 0.5, 0.015
    r = jnp.sqrt(x)
    flow = jnp.concatenate([jnp.array([0.1]), h * k * s * r[:-1]])
    return x + flow - h * k * s * r


# Kinks, ties, poles, flat ends, ends of domains; all act on entries or on pairs of them, so they share compiled code.
DELICATE = {
    "roots": lambda x: jnp.sqrt(x) + x**0.3 - jnp.cbrt(x),
    "growth": lambda x: jnp.exp(x) + x**3 + x * jnp.log(x),
    "quotients": lambda x: x / jnp.abs(x[::-1]) + jnp.tan(x),
    "kinks": lambda x: jnp.max(x) + jnp.where(x > 0, x, x[::-1]) + jnp.mod(x, 2.0),
    "plane": lambda x: jnp.arctan2(x, x[::-1]) + jnp.linalg.norm(x) - jnp.arcsin(x),
}


@pytest.mark.parametrize("name", BOUNDS)
def test_jit_and_vmap_equal_a_loop(name):
    """What XLA makes of it against the same in NumPy."""
    bound = getattr(inclusion, name)
    f = lambda x: jnp.stack([x[0] * jnp.cos(x[2]), jnp.sqrt((5 - x[0]) ** 2 + x[1] ** 2), x[2] - x[1]])  # noqa: E731
    rng = np.random.default_rng(1)
    lower = np.array([2.0, 12.0, 0.1]) + rng.uniform(-1, 1, (3, 3))
    boxes = Interval(lower, lower + rng.uniform(0, 0.5, (3, 3)))
    batch = jax.jit(jax.vmap(bound(f)))(boxes)
    for i in range(3):
        for a, b in zip(jax.tree.leaves(batch), jax.tree.leaves(bound(f)(boxes[i])), strict=True):
            np.testing.assert_allclose(a[i], b, rtol=1e-12, atol=1e-12)


def test_vmap_over_an_argument():
    f = lambda x, a: jnp.sin(a * x)  # noqa: E731
    box, a = Interval([-1.0, 0.0], [1.0, 2.0]), np.array([0.5, 1.0, 3.0])
    batch = in_numpy(jax.vmap(inclusion.affine(f), in_axes=(None, 0)))(box, a)
    alone = in_numpy(inclusion.affine(f))
    for i in range(3):
        one = alone(box, a[i])
        for p, q in zip(jax.tree.leaves(batch), jax.tree.leaves(one), strict=True):
            np.testing.assert_allclose(p[i], q, rtol=1e-14, atol=1e-15)


def test_inside_a_scan():
    def step(box, _):
        box = inclusion.natural(lambda x: 0.5 * jnp.sin(x) + 0.1)(box)
        return box, box

    last, track = lax.scan(step, Interval(jnp.array([-1.0]), jnp.array([1.0])), None, length=20)
    assert track.shape == (20, 1)
    assert last.width < 1e-4


def test_one_trace_for_all_numbers():
    count = 0

    def f(x):
        nonlocal count
        count += 1
        return jnp.sin(x)

    call = jax.jit(inclusion.affine(f))
    for i in range(3):
        call(Interval(np.array([float(i)]), np.array([i + 1.0])))
    assert count == 2  # once more to see that it is the same function


SIDES = {
    "finite": ([-1.0, 0.5], [0.4, 1.5]),
    "touching 0": ([0.0, 0.0], [0.7, 2.0]),
    "zero width": ([0.3, 0.6], [0.3, 0.6]),
    "zero width at 0": ([0.0, 0.0], [0.0, 0.0]),
    "entire": ([-np.inf, -np.inf], [np.inf, np.inf]),
    "half": ([-1.0, -np.inf], [np.inf, 0.0]),
    "tiny": ([1e-12, -1e-12], [2e-12, 1e-12]),
    "huge": ([-1e200, -1e300], [1e200, 1e300]),
    "outside": ([-3.0, -2.0], [-2.5, -1.0]),
}


def flat_bounds(f, lower, upper, *args):
    """Every number that comes out for f, in one row."""
    box = Interval.unchecked(lower, upper)
    leaves = jax.tree.leaves((inclusion.affine(f)(box, *args), inclusion.jacobian(f)(box, *args)))
    return jnp.concatenate([leaf.ravel() for leaf in leaves])


@pytest.mark.parametrize("name", DELICATE)
def test_gradients_are_finite(name):
    lower, upper = (np.array([side[i] for side in SIDES.values()]) for i in (0, 1))

    def pull(lower, upper):
        out, back = jax.vjp(lambda a, b: flat_bounds(DELICATE[name], a, b), lower, upper)
        # Into every output at once, whatever its value, with weights that let nothing cancel.
        return back(1.0 + jnp.arange(out.size) % 7)

    # Compiled code takes subnormal numbers for zero, NumPy does not.
    run = jax.jit if name == "quotients" else in_numpy
    for gradient in run(jax.vmap(pull))(lower, upper):
        bad = [kind for kind, row in zip(SIDES, gradient, strict=True) if not np.isfinite(row).all()]
        assert not bad


@pytest.mark.parametrize("f", [
    lambda x, a: jnp.sin(a * x) * x[::-1] + jnp.tanh(x) - a * x**3,
    lambda x, a: jnp.sqrt(x + 1) + jnp.maximum(x, 0.1 * x[::-1]) + jnp.exp(a * x) / (x + 2),
])  # fmt: skip
def test_gradients_match_finite_differences(f):
    def flat(p):
        return flat_bounds(f, p[:2], p[2:4], p[4])

    p, step = np.array([-0.43, -0.19, 0.29, 1.37, 0.83]), 1e-6 * np.eye(5)
    gradient = np.asarray(in_numpy(jax.jacrev(flat))(p))
    values = at_points(flat, np.concatenate([p + step, p - step]))
    np.testing.assert_allclose(gradient, (values[:5] - values[5:]).T / 2e-6, atol=1e-7, rtol=1e-6)


@pytest.mark.parametrize("name", DELICATE)
def test_one_walk_for_affine_bounds_and_derivatives_finds_what_two_do(name):
    """Also where no end of the box is known, and rounded outward."""
    for side, mode in ((0.5, "outward"), (np.inf, "outward"), (0.5, "nearest")):
        box = Interval([-side, 0.25], [0.75, side])
        with rounding.using(mode):
            jacobian = inclusion.jacobian(DELICATE[name])(box)
            for slack, affine in ((False, inclusion.affine), (True, affine_with_slack)):
                together, apart = affine_and_jacobian(DELICATE[name], slack)(box), affine(DELICATE[name])(box)
                jax.tree.map(np.testing.assert_array_equal, together, (apart, jacobian))


def test_float32_in_float32_out():
    box = Interval(np.array([-1, 0.5], np.float32), np.array([1, 2], np.float32))
    for name in ("roots",):
        for leaf in jax.tree.leaves([getattr(inclusion, bound)(DELICATE[name])(box) for bound in BOUNDS]):
            assert leaf.dtype == jnp.float32
            assert not np.isnan(leaf).any()
    x = np.random.default_rng(0).uniform(box.lower, box.upper, (200, 2))
    value = at_points(robot_like, x)
    form = inclusion.affine(robot_like)(box)
    assert (form.range.lower - 1e-5 <= value).all()
    assert (value <= form.range.upper + 1e-5).all()


def robot_like(x):
    return jnp.stack([jnp.sin(x[0]) * x[1], jnp.sqrt(x[1]) / 3])


def test_type_is_that_of_box_and_arguments():
    box32 = Interval(np.zeros(1, np.float32), np.ones(1, np.float32))
    f = lambda x, a: a * x  # noqa: E731
    assert inclusion.natural(f)(box32, jnp.float64(2)).dtype == jnp.float64
    assert inclusion.natural(f)(box32, 2.0).dtype == jnp.float32
    assert inclusion.natural(f)(box32, 2).dtype == jnp.float32
    assert inclusion.natural(f)(box32, Interval(np.zeros(1), np.ones(1))).dtype == jnp.float64
    third = Interval([1 / 3], [1 / 3]).astype(jnp.float32)
    assert inclusion.natural(lambda x: x)(Interval([1 / 3], [1 / 3])).lower.dtype == jnp.float64
    assert third.width > 0


def test_unknown_operation_is_named_with_its_place():
    def f(x):
        return jax.scipy.special.gammaln(x) + 1  # the line to be named

    line = f.__code__.co_firstlineno + 1
    message = rf"`lgamma`.*test_interpreter\.py:{line}.*register_bounds"
    with pytest.raises(inclusion.UnknownPrimitiveError, match=message):
        inclusion.natural(f)(Interval([0.0, 1.0], [1.0, 2.0]))
    table = jnp.zeros(10_000)
    with pytest.raises(inclusion.UnknownPrimitiveError, match=r"dynamic_slice.*indices that depend on the box"):
        inclusion.natural(lambda x: lax.dynamic_slice(table, (x[0].astype(int),), (1,)))(Interval([0.0], [1.0]))
    # What does not depend on the box needs no bounds.
    assert inclusion.natural(lambda x, a: x + jnp.sort(a)[0])(Interval([0.0], [1.0]), jnp.array([3.0, 2.0])).lower == 2


def test_bounds_by_hand_for_a_primitive_and_for_a_function():
    box = Interval([2.0], [3.0])
    with pytest.raises(inclusion.UnknownPrimitiveError, match="lgamma"):
        inclusion.natural(lax.lgamma)(box)
    inclusion.register_bounds(
        "lgamma",
        lambda x: Interval.unchecked(lax.lgamma(x.lower), lax.lgamma(x.upper)),
        lambda x: Interval.unchecked(lax.digamma(x.lower), lax.digamma(x.upper)),
    )
    bounds = inclusion.natural(lambda x: 2 * lax.lgamma(x))(box)
    np.testing.assert_allclose([bounds.lower[0], bounds.upper[0]], [0, 2 * np.log(2)], atol=1e-12)
    jac = inclusion.jacobian(lambda x: lax.lgamma(2 * x))(Interval([1.0], [1.5]))
    np.testing.assert_allclose([jac.lower[0, 0], jac.upper[0, 0]], 2 * np.array([0.42278433, 0.92278433]), rtol=1e-7)

    @jax.jit
    def sorted_entries(x):
        return jnp.sort(x)

    inclusion.register_bounds("sorted_entries", lambda x: Interval.unchecked(jnp.sort(x.lower), jnp.sort(x.upper)))
    pair = Interval([0.0, 1.0], [5.0, 2.0])
    form = inclusion.affine(lambda x: sorted_entries(x) + x)(pair)
    np.testing.assert_array_equal(form.slope, np.eye(2))
    np.testing.assert_array_equal(form.offset.upper, [2, 5])
    assert np.isinf(inclusion.jacobian(sorted_entries)(pair).upper).all()
    with pytest.raises(ValueError, match="must be functions"):
        inclusion.register_bounds("lgamma", None)


@pytest.mark.parametrize("box", [np.zeros(2), Interval(0.0, 1.0), Interval(np.zeros((2, 2)), np.ones((2, 2)))])
def test_a_box_of_another_shape_is_refused(box):
    for bound in BOUNDS:
        with pytest.raises(ValueError, match=rf"{bound}: .*Interval of shape \(n,\)"):
            getattr(inclusion, bound)(lambda x: x)(box)


def test_long_scan_equals_the_unrolled_one():
    def turn(c, a):
        level, count = c
        level = 0.9 * level + 0.1 * jnp.tanh(level) * a
        return (level, count + 1), level[0] + count

    def f(x):
        return lax.scan(turn, (x, 0.0), x[0] * jnp.arange(18.0) / 18)

    def by_hand(x):
        c, out = (x, 0.0), []
        for a in x[0] * jnp.arange(18.0) / 18:
            c, y = turn(c, a)
            out.append(y)
        return c, jnp.stack(out)

    box = Interval([0.2, -0.4], [0.5, 0.1])
    for bound in (inclusion.affine, inclusion.jacobian):
        for a, b in zip(jax.tree.leaves(bound(f)(box)), jax.tree.leaves(bound(by_hand)(box)), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-13)


def test_gradient_rules_of_a_function_are_ignored():
    @jax.custom_jvp
    def twice(x):
        return 2 * x

    twice.defjvp(lambda primals, tangents: (twice(*primals), 77 * tangents[0]))
    assert inclusion.jacobian(twice)(Interval([0.0], [1.0])).upper == 2


def test_six_tanks_are_bounded_tightly():
    box = Interval(np.full(6, 16.0), np.full(6, 24.0))
    bounds = jax.jit(inclusion.affine(tanks))
    form = bounds(box)
    assert form.offset.width.max() < 5e-3
    jac = inclusion.jacobian(tanks)(box)
    assert (np.diag(jac.lower) > 0.99).all()
    assert np.isfinite(bounds(Interval(np.zeros(6), np.full(6, 24.0))).offset.width).all()
