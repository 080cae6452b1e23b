"""What ordinary model code is made of: small linear systems, loops, branches, sorting, moving indices, scatters."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from jax import lax
from sampled import SETTINGS, bounds, check

from gsisio_jax import Interval, inclusion

USUAL, WIDE, THREE = ([0.1, 0.1], [0.9, 0.9]), ([-1.0, -1.0], [1.0, 1.0]), ([0.1, -0.5, 0.3], [0.9, 0.4, 0.8])
SMALL = ([0.4, 0.6], [0.5, 0.7])
EVERY = pytest.mark.parametrize(("rounding", "dtype"), SETTINGS, ids=["float64", "float32", "nearest"])
RIGHT = np.array([1.0, 2.0])
VALUES = np.array([0.0, 1.0, 0.5, 2.0])


def _matrix(x, xp):
    return xp.array([[2.0 + x[0], x[1]], [x[0] * x[1], 3.0]])


def _matrix3(x, xp):
    return xp.array([[3.0 + x[0], x[1], 0.5], [x[0] * x[1], 4.0, x[1]], [0.2, x[0], 5.0]])


def _matrix4(x, xp):
    rows = [[4.0 + x[0], x[1], 0.5, 0.0], [x[0] * x[1], 4.0, x[1], 1.0], [0.2, x[0], 5.0, x[1]], [0.0, 1.0, x[0], 3.0]]
    return xp.array(rows)


def _symmetric(x, xp):
    return xp.array([[2.0 + x[0], 0.5 * x[1]], [0.5 * x[1], 3.0]])


def _euler(x, xp, turns):
    for _ in range(turns):
        x = x + 0.1 * xp.stack([x[1], -xp.sin(x[0])])
    return x


def _while(x):
    def turn(state):
        t, x = state
        return t + 0.1, x + 0.1 * jnp.stack([x[1], -jnp.sin(x[0])])

    return lax.while_loop(lambda state: state[0] < 0.35, turn, (0.0, x))[1]


def _long(x):
    return lax.while_loop(lambda s: s[0] < 60, lambda s: (s[0] + 1, s[1] + 0.01 * s[1][::-1]), (0, x))[1]


def _switch(x, xp):
    branches = [xp.sin, lambda v: v + 1, lambda v: 2 * v]
    if xp is np:
        return branches[int(3 * x[0])](x)
    return lax.switch((3 * x[0]).astype(int), branches, x)


def _convolution(x):
    kernel = jnp.array([[[0.5, 0.2]], [[2.0, -1.0]]], x.dtype)
    return lax.conv_general_dilated(x.reshape(1, 1, -1), kernel, (1,), "VALID")[0]


def _convolved(x):
    return np.array([np.convolve(x, [0.2, 0.5], "valid"), np.convolve(x, [-1.0, 2.0], "valid")])


LINEAR = {
    # name: function, oracle, how wide range and Jacobian may be on a small box
    "solve": (lambda x: jnp.linalg.solve(_matrix(x, jnp), RIGHT),
              lambda x: np.linalg.solve(_matrix(x, np), RIGHT), 1.3),
    "solve, both sides": (lambda x: jnp.linalg.solve(_matrix3(x, jnp), jnp.sin(jnp.array([x[0], x[1], 1.0]))),
                          lambda x: np.linalg.solve(_matrix3(x, np), np.sin([x[0], x[1], 1.0])), 1.3),
    "solve, four rows": (lambda x: jnp.linalg.solve(_matrix4(x, jnp), jnp.arange(4.0)),
                         lambda x: np.linalg.solve(_matrix4(x, np), np.arange(4.0)), 1.3),
    "solve, constant": (lambda x: jnp.linalg.solve(jnp.array([[2.0, 1.0], [1.0, 3.0]]), x),
                        lambda x: np.linalg.solve([[2.0, 1.0], [1.0, 3.0]], x), 1.01),
    "inv": (lambda x: jnp.linalg.inv(_matrix3(x, jnp)), lambda x: np.linalg.inv(_matrix3(x, np)), 1.4),
    "det": (lambda x: jnp.linalg.det(_matrix4(x, jnp)), lambda x: np.linalg.det(_matrix4(x, np)), 1.3),
    "slogdet": (lambda x: jnp.linalg.slogdet(_matrix4(x, jnp))[1],
                lambda x: np.linalg.slogdet(_matrix4(x, np))[1], 1.3),
    "cholesky": (lambda x: jnp.linalg.cholesky(_symmetric(x, jnp)),
                 lambda x: np.linalg.cholesky(_symmetric(x, np)), 1.1),
    "cho_solve": (lambda x: jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(_symmetric(x, jnp)), RIGHT),
                  lambda x: np.linalg.solve(_symmetric(x, np), RIGHT), 1.5),
    "lu_solve": (lambda x: jax.scipy.linalg.lu_solve(jax.scipy.linalg.lu_factor(_matrix(x, jnp)), RIGHT),
                 lambda x: np.linalg.solve(_matrix(x, np), RIGHT), 1.9),
    "solve_triangular": (lambda x: jax.scipy.linalg.solve_triangular(_matrix3(x, jnp), jnp.arange(3.0), lower=True),
                         lambda x: scipy.linalg.solve_triangular(_matrix3(x, np), np.arange(3.0), lower=True), 1.3),
    "solve_triangular, unit, transposed": (
        lambda x: jax.scipy.linalg.solve_triangular(_matrix3(x, jnp), jnp.arange(3.0), trans=1, unit_diagonal=True),
        lambda x: scipy.linalg.solve_triangular(_matrix3(x, np), np.arange(3.0), trans=1, unit_diagonal=True), 1.3),
}  # fmt: skip


@EVERY
@pytest.mark.parametrize("name", LINEAR)
def test_small_linear_systems(name, rounding, dtype):
    fn, oracle, loose = LINEAR[name]
    check(fn, oracle, *SMALL, rounding, dtype, loose, 20.0)
    if rounding == "outward" and dtype == np.float64:
        check(fn, oracle, *USUAL, rounding, dtype, 10.0, 60.0)  # wide: inside, and finite


def test_a_system_that_may_be_singular_has_no_bound_and_is_no_error():
    def f(x):
        return jnp.linalg.solve(jnp.array([[x[0], 1.0], [1.0, 1.0]]), jnp.array([1.0, 2.0]))

    found = bounds(f, [0.5], [1.5], "outward", np.float64)
    assert np.isinf([found["natural"].lower, found["natural"].upper]).all()
    assert np.isinf(found["jacobian"].upper).all()
    assert np.isfinite(found["slope"]).all()
    at = bounds(f, [1.0], [1.0], "outward", np.float64)
    assert np.isinf(at["natural"].upper).all()


def test_a_known_matrix_is_inverted_exactly():
    """On an infinite box, the form of a linear function keeps its offset of width 0."""
    form = inclusion.affine(lambda x: jnp.linalg.solve(jnp.array([[2.0, 0.0], [1.0, 4.0]]), x))(Interval.entire(2))
    np.testing.assert_array_equal(form.slope, [[0.5, 0.0], [-0.125, 0.25]])
    np.testing.assert_array_equal(form.offset.upper, [0, 0])


CODE = {
    # name: function, oracle, box, how wide the range may be, and the Jacobian
    "counted loop": (lambda x: lax.fori_loop(0, 4, lambda i, v: _euler(v, jnp, 1), x), lambda x: _euler(x, np, 4),
                     USUAL, 1.1, 1.5),
    "loop until a time": (_while, lambda x: _euler(x, np, 4), USUAL, 1.1, 1.5),
    "long loop": (_long, lambda x: np.linalg.matrix_power([[1, 0.01], [0.01, 1]], 60) @ x, USUAL, 1.01, 1.01),
    "switch": (lambda x: _switch(x, jnp), lambda x: _switch(x, np), USUAL, 1.5, None),
    "select": (lambda x: jnp.select([x[0] > 0.7, x[0] > 0.3], [x[1], x[1] ** 2], -1.0),
               lambda x: np.select([x[0] > 0.7, x[0] > 0.3], [x[1], x[1] ** 2], -1.0), USUAL, 1.1, None),
    "piecewise": (lambda x: jnp.piecewise(x, [x < 0.3, x > 0.7], [lambda t: t + 1, lambda t: t * t, 0.5]),
                  lambda x: np.piecewise(x, [x < 0.3, x > 0.7], [lambda t: t + 1, lambda t: t * t, 0.5]),
                  USUAL, 3.0, None),
    "sort": (jnp.sort, np.sort, THREE, 1.01, 1.01),
    "sort, decided": (jnp.sort, np.sort, ([0.5, 0.0, 1.5], [1.0, 0.4, 2.0]), 1.01, 1.01),
    "median": (jnp.median, np.median, THREE, 1.01, 1.01),
    "top_k": (lambda x: lax.top_k(x, 2)[0], lambda x: np.sort(x)[::-1][:2], THREE, 1.01, 1.01),
    "argmax": (lambda x: jnp.argmax(x) * 1.0, lambda x: np.argmax(x) * 1.0, THREE, 1.01, None),
    "argmin": (lambda x: jnp.argmin(x) * 1.0, lambda x: np.argmin(x) * 1.0, THREE, 1.01, None),
    "argsort": (lambda x: jnp.argsort(x) * 1.0, lambda x: np.argsort(x) * 1.0, USUAL, 1.01, None),
    "entry of a table": (lambda x: jnp.asarray(VALUES)[(3 * x[0]).astype(int)] * x[1],
                         lambda x: VALUES[int(3 * x[0])] * x[1], USUAL, 1.01, None),
    "entry of x": (lambda x: x[(2 * x[0]).astype(int)], lambda x: x[int(2 * x[0])], USUAL, 1.01, None),
    "slice of a table": (lambda x: lax.dynamic_slice(jnp.asarray(VALUES), ((3 * x[0]).astype(int),), (2,)),
                         lambda x: VALUES[min(int(3 * x[0]), 2):][:2], USUAL, 1.01, None),
    "update at a place": (lambda x: lax.dynamic_update_slice(jnp.zeros(3, x.dtype), x[1:], ((3 * x[0]).astype(int),)),
                          lambda x: np.where(np.arange(3) == int(3 * x[0]), x[1], 0.0), USUAL, 1.01, None),
    "place in a table": (lambda x: jnp.searchsorted(jnp.array([0.0, 0.3, 0.6, 1.0]), x) * 1.0,
                         lambda x: np.searchsorted([0.0, 0.3, 0.6, 1.0], x) * 1.0, USUAL, 1.01, None),
    "segment_sum": (lambda x: jax.ops.segment_sum(jnp.concatenate([x, x**2]), jnp.array([0, 1, 1, 2]), 3),
                    lambda x: np.array([x[0], x[1] + x[0] ** 2, x[1] ** 2]), WIDE, 1.01, 1.01),
    "segment_max": (lambda x: jax.ops.segment_max(jnp.concatenate([x, x**2]), jnp.array([0, 1, 1, 2]), 3),
                    lambda x: np.array([x[0], max(x[1], x[0] ** 2), x[1] ** 2]), WIDE, 1.01, 1.01),
    "scatters": (lambda x: x.at[0].multiply(x[1]).at[1].set(3.0 * x[0]).at[1].subtract(1.0),
                 lambda x: np.array([x[0] * x[1], 3 * x[0] - 1]), USUAL, 1.01, 1.01),
    "convolution": (_convolution, _convolved, THREE, 1.01, 1.01),
    "convolution of two": (lambda x: jnp.convolve(x, x + 1), lambda x: np.convolve(x, x + 1), USUAL, 1.01, 1.01),
    "cross and einsum": (lambda x: jnp.einsum("i,ij->j", jnp.cross(x, jnp.array([1.0, 2.0, 3.0])), jnp.eye(3) * 2),
                         lambda x: 2 * np.cross(x, [1.0, 2.0, 3.0]), THREE, 1.01, 1.01),
    "calls": (lambda x: jax.named_call(jax.checkpoint(jnp.sin), name="call")(jax.device_put(x)),
              np.sin, WIDE, 1.01, 1.01),
}  # fmt: skip


@EVERY
@pytest.mark.parametrize("name", CODE)
def test_loops_branches_and_indices(name, rounding, dtype):
    fn, oracle, (lower, upper), loose, slopes = CODE[name]
    check(fn, oracle, lower, upper, rounding, dtype, loose, slopes)


def test_debugging_is_passed_over():
    def f(x):
        jax.debug.print("{}", x)
        jax.debug.callback(lambda v: None, x)
        return x + 1

    assert inclusion.natural(f)(Interval([0.0], [1.0])).upper == 2


def test_loops_whose_number_of_turns_is_not_known_are_refused():
    def f(x):
        return lax.while_loop(lambda v: v[0] < 1, lambda v: v + 0.1, x)

    with pytest.raises(inclusion.UnknownPrimitiveError, match=r"while.*number of turns depends on the box"):
        inclusion.natural(f)(Interval([0.0], [0.5]))

    def g(x, n):
        return lax.fori_loop(0, n, lambda i, v: v + 0.1, x)

    with pytest.raises(inclusion.UnknownPrimitiveError, match="number of turns is not known while tracing"):
        jax.jit(inclusion.natural(g))(Interval([0.0], [0.5]), 3)
    assert inclusion.natural(lambda x: g(x, 3))(Interval([0.0], [0.5])).upper > 0.7


def test_an_index_that_may_lie_outside():
    """Clamped where JAX clamps, unknown where JAX fills with NaN."""
    table = jnp.array([1.0, 2.0])
    clamped = inclusion.natural(lambda x: lax.dynamic_index_in_dim(table, (9 * x[0]).astype(int), keepdims=False))
    assert clamped(Interval([0.5], [1.0])).lower == 2
    filled = inclusion.natural(lambda x: jnp.take(table, (9 * x).astype(int)))
    assert np.isinf(filled(Interval([0.5], [1.0])).upper).all()
