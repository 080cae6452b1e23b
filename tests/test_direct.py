"""Arithmetic that is handed to `jax.lax` is that of `jax.numpy`: values, types and derivatives."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsisio_jax.interval import direct

X = np.array([[1.5, -np.inf, np.nan], [0.0, -2.0, np.inf]])
OPERANDS = {
    "float64": jnp.asarray(X), "float32": jnp.asarray(X, np.float32), "row": jnp.asarray(X[0]), "NumPy": X + 1,
    "NumPy float32": np.float32([1, 2, 3]), "whole": jnp.asarray([[1, 2, 3], [4, 5, 6]]), "truth": jnp.asarray(X > 0),
    "number": jnp.float64(3.5), "NumPy number": np.float64(-0.0), "Python number": 0, "Python float": 0.5,
    "infinity": jnp.inf,
}  # fmt: skip
PLAIN = {"Python number", "Python float", "infinity"}
FEW = {name: OPERANDS[name] for name in ("float64", "NumPy", "Python number", "infinity")}
MASKS = {
    "array": jnp.asarray(X > 0),
    "NumPy": X < 0,
    "column": jnp.asarray([[True], [False]]),
    "one": jnp.asarray(True),
}


PAIRS = [(a, b) for a, b in itertools.product(OPERANDS, repeat=2) if not {a, b} <= PLAIN]
SUMS = [(direct.plus, jnp.add), (direct.minus, jnp.subtract)]


def agree(found, expected):
    assert jnp.result_type(found) == jnp.result_type(expected)
    np.testing.assert_array_equal(np.asarray(found), np.asarray(expected))


def chosen(operands, masks):
    return [
        (direct.where(mask, operands[a], operands[b]), jnp.where(mask, operands[a], operands[b]))
        for mask in masks.values()
        for a, b in PAIRS
        if a in operands and b in operands
    ]


def added(operands):
    return [
        (ours(operands[a], operands[b]), usual(operands[a], operands[b]))
        for ours, usual in SUMS
        for a, b in PAIRS
        if "truth" not in (a, b) and any(isinstance(operands[name], jax.Array) for name in (a, b))
    ]


def traced(function, *trees):
    """In one program whose arguments are all arrays of JAX."""
    leaves, structure = jax.tree.flatten(trees)
    given = [leaf for leaf in leaves if isinstance(leaf, jax.Array)]

    def of_arrays(arrays):
        left = iter(arrays)
        return function(*jax.tree.unflatten(structure, [next(left) if isinstance(v, jax.Array) else v for v in leaves]))

    return jax.jit(of_arrays)(given)


def test_where():
    for found, expected in (*traced(chosen, OPERANDS, MASKS), *chosen(FEW, MASKS)):
        agree(found, expected)


def test_sums():
    for found, expected in traced(added, OPERANDS):
        agree(found, expected)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_magnitudes_and_multiples(dtype):
    x, factor, least = jnp.asarray(X, dtype), dtype(3), dtype(1e-3)
    for value in (x, np.asarray(x)):
        agree(direct.absolute(value), jnp.abs(x))
        agree(direct.multiple_and_more(value, factor, least), x * factor + least)
    agree(direct.multiple_and_more(x, x, least), x * x + least)


def test_operands_are_brought_to_one_shape_and_type():
    for values in itertools.product(OPERANDS.values(), repeat=2):
        shape, dtype = direct.common(values)
        assert (shape, dtype) == (jnp.broadcast_shapes(*map(jnp.shape, values)), jnp.result_type(*values))
        for value in values:
            agree(direct.alike(value, shape, dtype), jnp.broadcast_to(jnp.asarray(value, dtype), shape))
    wide = direct.alike(1.0, (5000,), np.dtype(np.float32))
    agree(wide, jnp.ones(5000, jnp.float32))


def test_derivatives():
    x, mask = jnp.array([1.0, -2.0, 3.0]), jnp.array([True, False, True])

    def ours(x):
        return direct.where(mask, x * x, direct.minus(direct.plus(x, x), direct.absolute(x))).sum()

    found = jax.grad(ours)(x)
    np.testing.assert_array_equal(found, jax.grad(lambda x: jnp.where(mask, x * x, x + x - abs(x)).sum())(x))
    np.testing.assert_array_equal(found, [2.0, 3.0, 6.0])
