"""Functions affine in x come out exact: slope A, offset b of width 0, Jacobian A, also on all of R^n."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from gsisio_jax import inclusion
from gsisio_jax.interval import Interval

A = np.array([[1.0, 2.0, 0.0], [0.0, -3.0, 0.5]])
B = np.array([0.1, -0.2])

AFFINE = {
    "matrix": lambda x: A @ x + B,
    "matrix on the right": lambda x: x @ A.T,
    "matrix of x": lambda x: (jnp.outer(x, jnp.array([1.0, 2.0])) @ jnp.array([[1.0], [-1.0]])).ravel(),
    "einsum": lambda x: jnp.einsum("ij,kj->ki", jnp.stack([x, 2 * x]), A),
    "scalar": lambda x: 2 * x[0] - x[2] / 4 + 1,
    "slices": lambda x: jnp.concatenate([x[1:], x[:1], x[::-1], x[::2]]),
    "gather": lambda x: x[jnp.array([2, 0, 2])],
    "gather, negative index": lambda x: x[jnp.array([-1, 1])],
    "boolean mask": lambda x: x[np.array([True, False, True])],
    "stack": lambda x: jnp.stack([x, -x], axis=1).reshape(3, 2).T,
    "split": lambda x: sum(jnp.split(x, 3)),
    "pad": lambda x: jnp.pad(x, (1, 2), constant_values=3.0),
    "roll and flip": lambda x: jnp.roll(x, 1) + jnp.flip(x),
    "cumsum": lambda x: jnp.cumsum(x[::-1]),
    "sum and mean": lambda x: jnp.array([jnp.sum(x), jnp.mean(x)]),
    "set": lambda x: x.at[1].set(2 * x[0] + 1),
    "add at": lambda x: x.at[jnp.array([0, 2])].add(x[1]),
    "dynamic slice": lambda x: lax.dynamic_slice(x, (1,), (2,)),
    "dynamic update": lambda x: lax.dynamic_update_slice(x, -x[:1], (2,)),
    "take along": lambda x: jnp.take(jnp.tile(x, (2, 1)), 1, axis=0),
    "tile and transpose": lambda x: jnp.transpose(jnp.broadcast_to(x, (2, 3))),
    "select": lambda x: jnp.where(jnp.array([True, False, True]), x, -x),
    "select of a constant": lambda x: jnp.where(jnp.arange(3) < 1, x, 0.0),
    "stop gradient": lambda x: lax.stop_gradient(x) + x,
    "checkpoint": jax.checkpoint(lambda x: x * 3 - 1),
    "jit": jax.jit(lambda x: jnp.dot(A, x)),
    "scan": lambda x: lax.scan(lambda c, a: (c + 2 * a, c - a), x[0], x)[1],
    "long scan": lambda x: lax.scan(lambda c, a: (0.5 * c + a, c[0]), x, jnp.ones((40, 3)))[1][-3:],
    "loop": lambda x: lax.fori_loop(0, 4, lambda i, c: c.at[i % 3].add(i * x[0]), x),
    "cancels": lambda x: (x + 1) - x + x[0] * jnp.ones(3),
    "zero": lambda x: 0 * x,
    "constant": lambda x: jnp.array([1.0, 2.0]),
    "decided branch": lambda x: lax.cond(jnp.array(1.0) > 0, lambda y: y + 1, lambda y: jnp.sin(y), x),
    "decided relu": lambda x: jax.nn.relu(jnp.array([5.0, 5.0, -5.0]) + 0 * x) + x,
}
BOXES = {
    "finite": Interval([-1.0, 0.5, 2.0], [1.0, 0.75, 2.0]),
    "some sides infinite": Interval([-np.inf, 0.0, -np.inf], [1.0, np.inf, np.inf]),
}


@pytest.mark.parametrize("name", AFFINE)
def test_affine_functions_are_exact(name):
    f = AFFINE[name]
    origin = np.asarray(f(jnp.zeros(3)))
    matrix = np.stack([np.asarray(f(jnp.zeros(3).at[i].set(1.0))) - origin for i in range(3)], axis=-1)
    for kind, box in BOXES.items():
        form, jac = inclusion.affine(f)(box), inclusion.jacobian(f)(box)
        np.testing.assert_allclose(form.slope, matrix, rtol=1e-15, atol=1e-15, err_msg=kind)
        np.testing.assert_allclose(form.offset.lower, origin, rtol=1e-15, atol=1e-15, err_msg=kind)
        np.testing.assert_array_equal(form.offset.lower, form.offset.upper, err_msg=kind)
        np.testing.assert_array_equal(jac.lower, jac.upper, err_msg=kind)
        np.testing.assert_allclose(jac.lower, matrix, rtol=1e-15, atol=1e-15, err_msg=kind)
        # The range of an affine function is known in closed form.
        with np.errstate(invalid="ignore"):
            ends = [np.where(matrix == 0, 0, matrix * side) for side in (box.lower, box.upper)]
        low, high = origin + np.minimum(*ends).sum(-1), origin + np.maximum(*ends).sum(-1)
        for bounds in (form.range, form.over(box)):
            np.testing.assert_allclose(bounds.lower, low, atol=1e-14, err_msg=kind)
            np.testing.assert_allclose(bounds.upper, high, atol=1e-14, err_msg=kind)


def test_constants_from_arguments_stay_exact():
    f = lambda x, M, b, k: M @ x * k["gain"] + b  # noqa: E731
    form = inclusion.affine(f)(Interval.entire(3), A, jnp.asarray(B), {"gain": 2.0})
    np.testing.assert_array_equal(form.slope, 2 * A)
    np.testing.assert_array_equal(form.offset.lower, B)
    np.testing.assert_array_equal(form.offset.upper, B)


def test_an_interval_argument_goes_to_the_offset():
    f = lambda x, u: x + u * u - 2 * u  # noqa: E731
    u = Interval([0.0, 0.0, 1.0], [0.0, 2.0, 3.0])
    form = inclusion.affine(f)(Interval.entire(3), u)
    np.testing.assert_array_equal(form.slope, np.eye(3))
    np.testing.assert_array_equal(form.offset.lower, [0, -4, -5])
    np.testing.assert_array_equal(form.offset.upper, [0, 4, 7])
    jac = inclusion.jacobian(f)(Interval.entire(3), u)
    np.testing.assert_array_equal(jac.lower, np.eye(3))
    np.testing.assert_array_equal(jac.upper, np.eye(3))


def test_an_uncertain_factor():
    f = lambda x, u: u * x  # noqa: E731
    box, u = Interval([1.0, -1.0], [2.0, 1.0]), Interval([0.5, 0.5], [1.5, 1.5])
    jac = inclusion.jacobian(f)(box, u)
    np.testing.assert_array_equal(jac.lower, np.diag([0.5, 0.5]))
    np.testing.assert_array_equal(jac.upper, np.diag([1.5, 1.5]))
    form = inclusion.affine(f)(box, u)
    for factor in (0.5, 1.0, 1.5):
        for x in ([1.0, -1.0], [2.0, 1.0], [1.3, 0.2]):
            assert form.offset.contains(np.array(x) * factor - form.slope @ np.array(x), margin=-1e-12).all()


def test_products_use_the_tightest_planes():
    form = inclusion.affine(lambda x: x[0] * x[1])(Interval([1.0, 2.0], [3.0, 6.0]))
    np.testing.assert_allclose(form.slope, [4, 2])
    # x y - 4 x - 2 y + 8 = (x - 2)(y - 4), between -2 and 2.
    np.testing.assert_allclose([form.offset.lower, form.offset.upper], [-10, -6])
    moved = inclusion.affine(lambda x: (x[0] + 1) * (x[1] - 2))(Interval([0.0, 4.0], [2.0, 8.0]))
    np.testing.assert_allclose(moved.slope, [4, 2])
    np.testing.assert_allclose([moved.offset.lower, moved.offset.upper], [-10, -6])


def test_meeting_at_inner_nodes_tightens():
    f = lambda x: jnp.sqrt(x[0] * (1 - x[0]))  # noqa: E731
    box = Interval([0.2], [0.4])
    natural, form = inclusion.natural(f)(box), inclusion.affine(f)(box)
    assert form.range.upper < natural.upper - 0.05
    assert form.range.lower > natural.lower


def test_slope_over_a_smaller_box():
    form = inclusion.affine(lambda x: jnp.array([2 * x[0] - x[1], x[1] ** 2]))(Interval([-2.0, -2.0], [2.0, 2.0]))
    inner = form.over(Interval([0.0, 0.0], [1.0, 1.0]))
    np.testing.assert_allclose([inner.lower[0], inner.upper[0]], [-1, 2])
    assert inner.lower[1] <= 0
    assert inner.upper[1] >= 1


def test_one_scalar_meets_an_array():
    # The entries of x are as many as those of the value: an axis mixed up would go unseen in shapes.
    form = inclusion.affine(lambda x: x - jnp.sum(x))(Interval.entire(3))
    np.testing.assert_array_equal(form.slope, np.eye(3) - 1)
    jac = inclusion.jacobian(lambda x: x[1] * x)(Interval([1.0, 2.0, 3.0], [1.0, 2.0, 3.0]))
    np.testing.assert_array_equal(jac.lower, [[2, 1, 0], [0, 4, 0], [0, 3, 2]])


def test_any_shape_and_any_structure():
    out = inclusion.affine(lambda x: {"a": x[0] * jnp.ones((2, 2)), "b": x.sum()})(Interval([0.0, 1.0], [1.0, 2.0]))
    assert out["a"].slope.shape == (2, 2, 2)
    assert out["a"].offset.shape == (2, 2)
    assert out["b"].slope.shape == (2,)
    assert inclusion.jacobian(lambda x: jnp.outer(x, x))(Interval.entire(2)).shape == (2, 2, 2)
