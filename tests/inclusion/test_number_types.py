"""Integers, which wrap around and saturate, against JAX itself; and the types of numbers that are refused."""

from __future__ import annotations

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from seen import checked, estimated, sides

from gsisio_jax import inclusion
from gsisio_jax.inclusion import UnknownPrimitiveError
from gsisio_jax.interval import Interval

PRECISIONS = pytest.mark.parametrize("dtype", [np.float64, np.float32], ids=["float64", "float32"])
UINT8, INT8, INT32 = [0, 255], [-128, 127], [-(2**31), 2**31 - 1]


def as_int8(x):
    return x.astype(jnp.int8)


# Name: (function, box, whole range of the type).
WRAPPING = {
    "cast, too large": (lambda x: x[0].astype(jnp.uint8), (0, 400), UINT8),
    "cast, negative": (lambda x: x[0].astype(jnp.uint8), (-5, 4), UINT8),
    "cast of a constant box": (lambda x: x[0].astype(jnp.uint8), (300, 300), UINT8),
    "cast, far out": (lambda x: x[0].astype(jnp.int32), (0, 1e10), INT32),
    "cast to the first number beyond": (lambda x: x[0].astype(jnp.int32), (0, 2.0**31), INT32),
    "cast of integers": (lambda x: x[0].astype(jnp.int32).astype(jnp.uint8), (0, 1000), UINT8),
    "subtraction": (lambda x: x[0].astype(jnp.uint8) - jnp.uint8(3), (0, 4), UINT8),
    "of truth values": (lambda x: (x[0] > 0).astype(jnp.uint8) - (x[0] < 0).astype(jnp.uint8), (-1, 2), UINT8),
    "negation": (lambda x: -(x[0] > 0.5).astype(jnp.uint8), (0, 1), UINT8),
    "product": (lambda x: as_int8(x[0]) * jnp.int8(40), (0, 10), INT8),
    "product of two": (lambda x: as_int8(x[0]) * as_int8(x[0] + 1), (0, 20), INT8),
    "product with a large constant": (lambda x: x[0].astype(jnp.int32) * 100000, (0, 1e5), INT32),
    "magnitude": (lambda x: jnp.abs(as_int8(x[0])), (-128, 4), INT8),
    "power": (lambda x: as_int8(x[0]) ** 3, (-8, 4), INT8),
    "dot": (lambda x: as_int8(x) @ jnp.array([100], jnp.int8), (1, 3), INT8),
    "sum": (lambda x: jnp.sum(as_int8(x) * jnp.ones(2, jnp.int8), dtype=jnp.int8), (100, 102), INT8),
    "running sum": (lambda x: jnp.cumsum(as_int8(x) * jnp.ones(2, jnp.int8), dtype=jnp.int8)[1], (100, 102), INT8),
    "sum of updates": (
        lambda x: jnp.full(1, 100, jnp.int8).at[np.array([0, 0])].add(as_int8(x) * jnp.ones(2, jnp.int8))[0],
        (10, 20), INT8,
    ),
    "quotient": (lambda x: lax.div(as_int8(x[0]), jnp.int8(-1)), (-128, -127), INT8),
    "floored quotient": (lambda x: as_int8(x[0]) // jnp.int8(-1), (-128, -127), INT8),
    "quotient by 0": (lambda x: lax.div(jnp.int8(7), as_int8(x[0])), (-1.5, 4), INT8),
    "floored quotient by 0": (lambda x: jnp.int8(7) // as_int8(x[0]), (-1.5, 4), INT8),
    "remainder by 0": (lambda x: lax.rem(jnp.int8(7), as_int8(x[0])), (-0.5, 0.4), INT8),
    "floored remainder by 0": (lambda x: jnp.int8(7) % as_int8(x[0]), (-0.5, 0.4), INT8),
    "floored remainder by the constant 0": (lambda x: as_int8(x[0]) % jnp.int8(0), (-0.5, 4), INT8),
}  # fmt: skip


@PRECISIONS
@pytest.mark.parametrize("name", WRAPPING)
def test_what_may_wrap_around_is_all_of_its_type(name, dtype):
    f, (lower, upper), whole = WRAPPING[name]
    natural, jac = checked(f, lower, upper, dtype)
    assert sides(natural) == [float(dtype(v)) for v in whole]
    if not name.endswith("constant box"):
        assert sides(jac) == [-np.inf, np.inf]


# Name: (function, box, its range there).
FITTING = {
    "index": (lambda x: jnp.clip(jnp.floor(x[0]).astype(int), 0, 2), (-7.5, 9), [0, 2]),
    "cast": (lambda x: x[0].astype(jnp.uint8), (-0.9, 255.9), [0, 255]),
    "sum": (lambda x: as_int8(x[0]) + jnp.int8(27), (-100, 100.5), [-73, 127]),
    "smaller of two": (lambda x: jnp.minimum(x[0].astype(jnp.uint8), jnp.uint8(3)), (0, 9), [0, 3]),
    "fmin": (lambda x: jnp.fmin(x[0].astype(jnp.uint8), jnp.uint8(3)), (0, 9), [0, 3]),
    "clip": (lambda x: jnp.clip(x[0].astype(jnp.uint8), 1, 3), (0, 9), [1, 3]),
    "where": (lambda x: jnp.where(x[0] > 0, 1, 200), (-1, 1), [1, 200]),
    "cond": (lambda x: lax.cond(x[0] > 0, lambda: 300, lambda: 2), (-1, 1), [2, 300]),
    "count": (lambda x: jnp.sum(x[0] > jnp.arange(3)), (-1, 1.5), [0, 2]),
    "same twice": (lambda x: (n := as_int8(x[0])) - n, (-100, 100), [0, 0]),
}


@PRECISIONS
@pytest.mark.parametrize("name", FITTING)
def test_what_fits_is_bounded_as_a_real_number(name, dtype):
    f, (lower, upper), truth = FITTING[name]
    natural, _ = checked(f, lower, upper, dtype)
    np.testing.assert_allclose(sides(natural), truth, atol=1e-4)


def test_integers_keep_their_forms():
    form = inclusion.affine(lambda x: 3 * jnp.floor(x).astype(int) - 3 * x)(Interval([-100.0], [500.0]))
    assert form.range.lower >= -6.001
    assert form.range.upper <= 3.001


def test_what_does_not_move_does_not_jump_by_wrapping_around():
    natural, jac = checked(lambda x: as_int8(x[0]) * jnp.int8(2), 100.2, 100.7)
    assert sides(natural) == INT8
    assert sides(jac) == [0, 0]


def test_cases_are_not_taken_apart_where_a_sum_may_wrap_around():
    f = lambda x: jnp.where(x[0].astype(jnp.uint8) - jnp.uint8(3) > 10, x[0], -x[0])  # noqa: E731
    checked(f, 0, 4, extra=[2.5])


def test_large_constants_are_not_rounded_inward():
    f = lambda x: x[0].astype(jnp.int64) + (2**53 + 1)  # noqa: E731
    natural = inclusion.natural(f, rounding="outward")(Interval([0.0], [0.0]))
    assert int(natural.lower) <= 2**53 + 1 <= int(natural.upper)


def complex_size(x):
    return jnp.abs(x[0] + 1j * x[1])


REFUSED = {
    "complex": (complex_size, "convert_element_type", "of complex numbers"),
    "complex norm": (lambda x: jnp.linalg.norm(x + 1j), "convert_element_type", "of complex numbers"),
    "complex matrix": (lambda x: jnp.abs(np.array([[1j, 2.0]]) @ x), "dot_general", "of complex numbers"),
    "complex table": (lambda x: jnp.abs(jnp.interp(x, jnp.arange(3.0), 1j * jnp.arange(3))), "", "of complex numbers"),
    "complex cases": (lambda x: jnp.abs(jnp.where(x > 0, 1j, 2.0)), "select_n", "of complex numbers"),
    "complex branches": (
        lambda x: jnp.abs(lax.cond(x[0] > 0, lambda: 1j * jnp.ones(2), lambda: 2j * jnp.ones(2))), "cond",
        "of complex numbers",
    ),
    "half": (lambda x: x.astype(jnp.float16) * 2, "convert_element_type", "of float16 numbers"),
    "bfloat": (lambda x: x.astype(jnp.bfloat16) * 2, "convert_element_type", "of bfloat16 numbers"),
    "half in a sum of clips": (
        lambda x: sum(jnp.clip(x.astype(jnp.float16).astype(float), k, k + 1) for k in range(3)),
        "convert_element_type", "of float16 numbers",
    ),
    "precision": (lambda x: lax.reduce_precision(x, 5, 2), "reduce_precision", "to fewer bits"),
    "and": (lambda x: x.astype(int) & 2, "and", "of integers"),
    "or": (lambda x: x.astype(int) | 2, "or", "of integers"),
    "xor": (lambda x: x.astype(int) ^ 2, "xor", "of integers"),
    "not": (lambda x: ~x.astype(int), "not", "of integers"),
    "reduce_or": (lambda x: lax.reduce_or(x.astype(int), (0,)), "reduce_or", "of integers"),
    "reduce_and": (lambda x: lax.reduce_and(x.astype(int), (0,)), "reduce_and", "of integers"),
    "reduce_xor": (lambda x: lax.reduce_xor(x.astype(int), (0,)), "reduce_xor", "of integers"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
@pytest.mark.parametrize("bounds", [inclusion.natural, inclusion.affine, inclusion.jacobian])
def test_refusals_name_the_operation_and_the_line(name, bounds):
    f, operation, detail = REFUSED[name]
    with pytest.raises(UnknownPrimitiveError) as refused:
        bounds(f)(Interval([0.0, -1.0], [0.5, 2.0]))
    assert refused.value.operation == operation or not operation
    assert refused.value.detail == detail
    first = inspect.getsourcelines(f)[1]
    file, _, line = (refused.value.place or "").rpartition(":")
    assert file.endswith("test_number_types.py")
    assert first <= int(line) <= first + 3


@PRECISIONS
def test_what_does_not_depend_on_the_box_may_be_of_any_type(dtype):
    def f(x):
        scale = jnp.abs(jnp.exp(1j * jnp.ones(2)) + 1) + (jnp.int32(6) & 3) + jnp.float16(0.1).astype(x.dtype)
        return scale.astype(x.dtype) * x

    checked(f, [0, -1], [1, 2], dtype)


def test_real_numbers_have_parts():
    f = lambda x: jnp.stack([jnp.real(x), jnp.conj(x), jnp.angle(x), jnp.imag(x)])  # noqa: E731
    checked(f, [0.5, -1], [1, -0.5])


@PRECISIONS
@pytest.mark.parametrize("t", [0.5, -0.5, 1.5, 2.5, 0.3, -7.7, np.inf, "below", "odd"])
def test_round_away_from_zero(t, dtype):
    odd = 2.0 ** np.finfo(dtype).nmant + 1
    t = {"below": np.nextafter(dtype(0.5), dtype(0)), "odd": odd}.get(t, t)
    truth = float(lax.round(jnp.asarray(t, dtype)))
    at = np.array([t], dtype)
    for rounding in ("outward", "nearest"):
        if np.isfinite(t):
            bounds = inclusion.natural(lambda x: lax.round(x[0]), rounding=rounding)(Interval(at, at))
            assert sides(bounds) == [truth, truth]
    wide = inclusion.natural(lambda x: lax.round(x[0]))(Interval(at - 1 if np.isfinite(t) else np.zeros(1, dtype), at))
    assert wide.upper == truth


def test_estimates_hold_integers_that_wrap_around():
    def f(x):
        turned = (x[0] > 0).astype(jnp.uint8) - (x[0] < 0).astype(jnp.uint8)
        return jnp.stack([0.5 * x[0], 0.5 * x[1] + 0.01 * turned])

    states = estimated(f, v=1e-6, least=-9.0)
    assert states[:, 1].max() > 2.2  # it did wrap around


def test_jax_is_what_is_compared_with():
    assert int(jax.jit(lambda a, b: a - b)(jnp.uint8(1), jnp.uint8(2))) == 255
