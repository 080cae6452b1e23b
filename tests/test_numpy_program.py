"""Programs of NumPy operations say what JAX says, whether they are run one by one or as Python's code."""

import math
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsisio_jax.interval.minmax import cut, raised, smaller
from gsisio_jax.interval.primitives import scale, times
from gsisio_jax.scalar import call, numpy_program, scalar_program, scan
from gsisio_jax.scalar.numpy_program import numpy_function, numpy_functions
from gsisio_jax.scalar.program import ScalarProgram
from gsisio_jax.scalar.unroll import ArrayOperation


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
    "truth": lambda a, b: (~(a < b), ~jnp.isfinite(a), (a > b).astype(a.dtype) - b, a.astype(bool), (a < b) == (b < 1)),
    "roots": lambda a, b: (jnp.sqrt(a), jnp.sqrt(a) / b, jnp.float32(a) * 2, jnp.float64(a) + 1, jnp.sign(a), a % b),
    "slopes": lambda a, b: jax.vjp(lambda x: (x * b, x - b), a)[1]((b, a)),
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
        _same(found, wanted, signs=name != "extremes")


ARRAYS = {
    "elements": lambda a: (a + a[::-1], jnp.maximum(a, a.T), jnp.minimum(a, 1), ~(a < 1), jnp.isfinite(a), jnp.sqrt(a)),
    "choice": lambda a: (jnp.where(a[0, 0] < 1, a, -a), jnp.where(a < a.T, a, a.T), jnp.square(a), a**2, a**3, a**-3),
    "numbers": lambda a: (
        a * a[0, 0] + a[1, 1] / a, a[:, :1] - a, a[0, 0] - a[0] < a[1, 2] * a, jnp.maximum(a, a[2, 2]) * a[:1],
        times(a, a[0, 0]), times(a[1, 1], a), times(a[:, :1], a[:1]), (a > 0) & (a[0, 0] > 0), raised(a, a[0, 1]),
        scale(jnp.where(a[0, 0] > 0, 2.0, 0.0).astype(a.dtype), a), scale(jnp.where(a > 0, 2.0, 0.0), a[0, 0]),
    ),
    "products": lambda a: (times(a, a.T), scale(jnp.where(jnp.isfinite(a), a, 3), a.T), raised(a, a.T), cut(a, a.T)),
    "order": lambda a: (jnp.sort(a, 0), jnp.sort(a, 1)),
    "largest": lambda a: jnp.argmax(a, 0),
    "least": lambda a: jnp.argmin(a, 1),
    "keys": lambda a: jax.lax.sort((a, a.T, a > 0), dimension=1, num_keys=1),
    "reduced": lambda a: (
        a.max((0, 1)), (a > 0).any(0), (a > 0).all(), (a > 0).sum(1), a[:, :1].min(0),
        a.max(0), a.min(), (a > 0).all(1), (a > 0).any(), jnp.prod(a > 0, 0), (a > 0).sum(dtype=int),
    ),
    "moved": lambda a: (a[1], a[:, ::2], a[0, 1], a[::-1, 1:], a.T, a.reshape(-1), a[None], jnp.split(a, 3, 1), [*a.T]),
    "joined": lambda a: (
        jnp.stack([a, a.T]), jnp.stack([a, a.T], 2), jnp.stack([a[0, 0], a[1, 2]]), jnp.concatenate([a, a], 1),
    ),
    "spread": lambda a: (jnp.broadcast_to(a[0], (2, 3)), jnp.full((2, 2), a[1, 1]), a[:, None] - a),
    "padded": lambda a: (
        jax.lax.pad(a, a[0, 0], [(1, 2, 0), (0, 1, 2)]), jax.lax.pad(a, a[1, 1], [(-1, 2, 1), (1, -2, 0)]),
    ),
    "updated": lambda a: [
        f(a, i) for i in (-7, -1, 0, 1, 9) for f in (
            lambda a, i: jax.lax.dynamic_update_slice(a, a[:2, :1], (i, 1 - i)),
            lambda a, i: jax.lax.dynamic_slice(a, (i, i), (2, 1)),
        )
    ],
    "types": lambda a: (a.astype(np.float32), a.astype(np.float64), a.astype(bool), (a > 0).astype(np.int32), a > a.T),
    "empty": lambda a: (a[:0] + 1, a[:, :0].max(0), jnp.sort(a[:0], 0), jnp.stack([a[:0], a[:0]]), a[:0].T),
}  # fmt: skip


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("name", ARRAYS)
def test_arrays_are_those_of_jax(name, dtype, monkeypatch):
    """As code from the first run on, and never: bit by bit, with NaN, infinities and signed zeros."""
    function, points = ARRAYS[name], np.random.default_rng(0).choice(POINTS, (20, 3, 3)).astype(dtype)
    compiled = jax.jit(function)
    for few in (1, 10**9):
        monkeypatch.setattr(numpy_program, "_FEW_RUNS", few)
        program = numpy_function(function, points[0])
        for a in points:
            _same(program(a), compiled(a), signs=name not in ("elements", "numbers", "reduced", "order", "keys"))


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_functions_of_every_entry_are_those_of_jax_whatever_the_length(dtype):
    """They are compiled for few lengths only; of the last bit XLA says this for one length, that for another."""
    x = np.random.default_rng(0).uniform(0.05, 0.95, 20).astype(dtype)

    def functions(x):
        of_one = [f(x) for f in (jax.lax.sin, jax.lax.exp, jax.lax.log, jax.lax.tanh, jax.lax.rsqrt)]
        return [*of_one, jax.lax.acosh(1 + x), jax.lax.atan2(x, 1 - x), jax.lax.pow(x, 1 - x)]

    def found(x):
        return numpy_function(functions, x)(x)

    for own, of_jax in zip(found(x[:15].reshape(3, 5)), functions(jnp.asarray(x[:15])), strict=True):
        assert own.dtype == dtype
        np.testing.assert_array_max_ulp(own.reshape(-1), np.asarray(of_jax), 2)
    whole = found(x)
    for shape in ((0,), (1, 1), (16,), (17,), (2, 5, 2)):
        given = x[: math.prod(shape)].reshape(shape)
        for own, entries in zip(found(given), whole, strict=True):
            assert own.shape == shape
            np.testing.assert_array_max_ulp(own.reshape(-1), entries[: own.size], 2)


def _same(found, wanted, signs=True):
    assert jax.tree.structure(found) == jax.tree.structure(wanted)
    for own, other in zip(jax.tree.leaves(found), map(np.asarray, jax.tree.leaves(wanted)), strict=True):
        assert own.dtype == other.dtype
        assert own.shape == other.shape
        np.testing.assert_array_equal(own, other)
        if own.dtype.kind == "f" and signs:  # the sign of max(0, -0) is anyone's, and which of these comes first
            zero = own == 0
            np.testing.assert_array_equal(np.signbit(own[zero]), np.signbit(other[zero]))


def test_parts_of_a_result_are_programs_of_their_own_that_compute_what_they_need(monkeypatch):
    traced, done = [], []

    def several(a, b):
        traced.append(1)
        shared, heavy = jnp.sin(a) + 1, b @ b
        return {"x": shared, "y": (a, 2.0)}, heavy.sum(), (), jax.lax.scan(lambda c, row: (c + row, c), shared, b)

    given = np.linspace(0, 1, 3), np.linspace(-1, 1, 9).reshape(3, 3)
    operation = numpy_program._operation
    monkeypatch.setattr(numpy_program, "_operation", lambda eqn: done.append(eqn.primitive.name) or operation(eqn))
    parts = numpy_functions(several, *given)
    assert not done  # they are made when they are called
    _same(parts[0](*given), several(*given)[0])
    assert "sin" in done
    assert not {"dot_general", "scan"} & set(done)
    for part, wanted in zip(parts, several(*given), strict=True):
        _same(part(*given), wanted)
    assert len(traced) == 3  # once for all programs, and twice here


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_programs_of_numbers_are_not_traced_again(dtype, monkeypatch):
    """Values, derivatives and operations on arrays within, with what they close over."""

    def function(a, b):
        def body(x):
            low = jnp.sort(x)[::-1] + b
            turned = jax.lax.fori_loop(0, jnp.where(x[0] > 1, 2, 3), lambda i, y: y * x[i] - low, x)
            return {
                "a": times(low, x),
                "b": (turned > x[0], jnp.where(x < 1, x, low)),
                "c": jnp.float32(low[0]),
                "d": 2.0,
            }

        found, slopes = call(body, a), jax.jvp(lambda x: call(lambda x: smaller(x * b, x[::-1]), x), (a,), (b,))
        return found, slopes, scan(lambda c, x: (c * x + b, c[0] > x), a, jnp.arange(8, dtype=dtype))

    points = np.random.default_rng(1).choice([0.5, -1.5, 2.0, np.inf, np.nan, 0.0], (12, 2, 3)).astype(dtype)
    compiled = jax.jit(function)
    for few in (1, 10**9):
        monkeypatch.setattr(numpy_program, "_FEW_RUNS", few)
        with monkeypatch.context() as patch:
            program_call = lambda *_: pytest.fail("traced again")  # noqa: E731
            closed = jax.make_jaxpr(function)(*points[0])
            patch.setattr(ScalarProgram, "__call__", program_call)
            program = numpy_program.numpy_program(closed)
        for a, b in points:
            for own, other in zip(program(a, b), jax.tree.leaves(compiled(a, b)), strict=True):
                assert own.dtype == other.dtype
                np.testing.assert_allclose(own, other, rtol=4 * np.finfo(own.dtype).eps if own.dtype.kind == "f" else 0)


@pytest.mark.parametrize("derivative", [jax.grad, lambda of: lambda x: jax.jvp(of, (x,), (2 * x,))[1]])
def test_derivatives_of_operations_on_arrays(derivative):
    """In a program of numbers, where JAX alone knows them."""

    def of(x):
        return call(lambda x: jnp.sort(jnp.sin(x)) @ jnp.arange(1.0, 4.0) + jnp.cumsum(x**2)[2], x)

    x = np.array([0.7, -1.2, 0.1])
    operations = scalar_program(jax.make_jaxpr(jnp.sort)(x)).operations
    assert any(isinstance(number.equation, ArrayOperation) for number in operations)
    np.testing.assert_allclose(numpy_function(derivative(of), x)(x), jax.jit(derivative(of))(x), rtol=1e-14)
