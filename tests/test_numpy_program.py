"""Programs of NumPy operations say what JAX says, whether they are run one by one or as Python's code."""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsisio_jax.interval.primitives import scale, times
from gsisio_jax.scalar import numpy_program
from gsisio_jax.scalar.numpy_program import numpy_function


def test_a_numpy_program_gives_what_jax_gives():
    def function(x, i):
        rows = jnp.stack([jnp.sin(x), jnp.where(x > 0, x, jnp.inf), jnp.round(x), x**3, jnp.cumsum(x)])
        table = jnp.einsum("ij,kj->ik", rows[2:], rows[2:]) + jnp.arange(3.0)
        best = jnp.max(rows, axis=0), jnp.argmin(rows, axis=1), jnp.sort(x)[::-1], rows.sum(), rows.T[i]
        return table, best, jax.lax.fori_loop(0, 3, lambda k, a: a * x[k], 1.0), jax.nn.softplus(x), i // 2, -7 // i

    x, i = jnp.array([0.5, -1.5, 2.5, 3.0]), jnp.asarray(3)
    program, compiled = numpy_function(function, x, i), jax.jit(function)
    for values in (x, -2 * x, x.at[1].set(jnp.nan)):
        mine, wanted = program(values, i), compiled(values, i)
        assert jax.tree.structure(mine) == jax.tree.structure(wanted)
        for a, b in zip(jax.tree.leaves(mine), jax.tree.leaves(wanted), strict=True):
            assert isinstance(a, np.ndarray)
            assert a.dtype == b.dtype
            np.testing.assert_allclose(a, b, rtol=1e-13)


def test_random_numbers_are_those_of_jax():
    """Keys are no arrays of NumPy: they go from JAX to JAX, also around a loop."""

    def function(key, x):
        first, *rest = jax.random.split(key, 3)
        turn = lambda k, both: (jax.random.fold_in(both[0], k), both[1] + jax.random.normal(both[0]))  # noqa: E731
        chosen = jnp.stack(rest)[jax.lax.fori_loop(0, 3, turn, (first, 0.0))[1].astype(int) % 2]
        return jax.random.uniform(chosen, (2,)) + x, jax.random.bernoulli(jnp.where(x > 0, first, key))

    program, compiled = numpy_function(function, jax.random.key(0), 1.0), jax.jit(function)
    for seed in range(8):  # as code in the end
        arguments = jax.random.key(seed), seed - 3.0
        for a, b in zip(program(*arguments), compiled(*arguments), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-13)


OPERATIONS = {
    "sums": lambda a, b: (a + b, a - b, -a, a * b, jnp.square(a), a / b, jnp.abs(a)),
    "powers": lambda a, b: (a**3, a**4, a**7, a**-1, b**-2, b**-5),
    "order": lambda a, b: (a < b, a <= b, a > b, a >= b, a == b, a != b),
    "extremes": lambda a, b: (jnp.maximum(a, b), jnp.minimum(a, b), jnp.clip(a, -1, b)),
    "choice": lambda a, b: (jnp.where(a < b, a, b), jnp.where((a < b) & ~(b == 0) | (a > 1) ^ (b > 1), b, 2.0)),
    "products": lambda a, b: (times(a, b), scale(jnp.where(jnp.isfinite(a), a, 3), b)),
    "loop": lambda a, b: jax.lax.fori_loop(0, 20, lambda i, x: jnp.where(x < i, x + a, x * b), a),
    "whole": lambda a, b: (a.astype(jnp.int32) * 3 - 1, (b > a).astype(int) // 2, a > b),
}  # fmt: skip
POINTS = (0.0, -0.0, 1.5, -2.0, 1e25, -1e-25, np.inf, -np.inf, np.nan)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("name", OPERATIONS)
def test_single_numbers_are_those_of_jax(name, dtype, monkeypatch):
    """As code from the first run on, and never: bit by bit, with NaN, infinities and signed zeros."""
    function, points = OPERATIONS[name], POINTS
    if name == "whole":  # what becomes of NaN as a whole number is anyone's
        points = tuple(p for p in POINTS if abs(p) < 10)
    a, b = np.array(list(product(points, points)), dtype).T
    wanted = jax.jit(jax.vmap(function))(a, b)
    for few in (1, 10**9):
        monkeypatch.setattr(numpy_program, "_FEW_RUNS", few)
        program = numpy_function(function, a[0], b[0])
        found = jax.tree.map(lambda *x: np.array(x), *(program(*pair) for pair in zip(a, b, strict=True)))
        for own, other in zip(jax.tree.leaves(found), map(np.asarray, jax.tree.leaves(wanted)), strict=True):
            assert own.dtype == other.dtype
            np.testing.assert_array_equal(own, other)
            if own.dtype.kind == "f" and name != "extremes":  # the sign of max(0, -0) is anyone's
                zero = own == 0
                np.testing.assert_array_equal(np.signbit(own[zero]), np.signbit(other[zero]))
