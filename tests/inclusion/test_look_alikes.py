"""Expressions that are nearly those of which more is known than their operations say: bounded as what they are."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from gsisio_jax import Interval, inclusion
from gsisio_jax.inclusion import UnknownPrimitiveError

ROOT = math.sqrt(2 / math.pi)
GATES = {
    "silu": (lambda x: x * jax.nn.sigmoid(x), jax.nn.silu),
    "silu by exp": (lambda x: x * (1.0 / (1.0 + jnp.exp(-x))), jax.nn.silu),
    "silu by tanh": (lambda x: 0.5 * x * (1.0 + jnp.tanh(x / 2.0)), jax.nn.silu),
    "gelu": (lambda x: x * 0.5 * (1.0 + lax.erf(x / math.sqrt(2.0))), lambda x: jax.nn.gelu(x, approximate=False)),
    "gelu by tanh": (lambda x: 0.5 * x * (1.0 + jnp.tanh(ROOT * x * (1.0 + 0.044715 * x * x))), jax.nn.gelu),
    "mish": (lambda x: x * jnp.tanh(jnp.logaddexp(x, 0.0)), jax.nn.mish),
    "mish by log": (lambda x: jnp.tanh(jnp.log1p(jnp.exp(x))) * x, jax.nn.mish),
}


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", GATES)
def test_gates_are_known_however_they_are_written(name, dtype):
    written, known = GATES[name]
    box = Interval(np.array([-3.0, -0.5], dtype), np.array([1.0, 0.25], dtype))
    found, exact = (inclusion.natural(fn)(box) for fn in (written, known))
    np.testing.assert_allclose(found.lower, exact.lower, rtol=1e-6)
    np.testing.assert_allclose(found.upper, exact.upper, rtol=1e-6)


def spread(fn):
    """Within a call, where operations are seen only by who looks into it."""
    return jax.jit(lambda v: jax.nn.sigmoid(fn(v)))


def rows(x):
    return jnp.exp(jnp.outer(x, x + jnp.array([0.0, 3.0])))


def logs(m):
    return m - jnp.log(jnp.sum(jnp.exp(m), 1)).reshape(1, 2)


TWO = ([1.0, -3.0], [2.0, -2.0])
NEARLY = {
    "gate of the other entry": (lambda x: x * spread(lambda v: v[::-1])(x), TWO),
    "gate of a neighbour": (lambda x: x * jax.nn.sigmoid(jnp.roll(x, 1)), TWO),
    "gate of the mean": (lambda x: x * spread(lambda v: jnp.broadcast_to(v.mean(), v.shape))(x), TWO),
    "gate of a clip": (lambda x: x * spread(lambda v: jnp.clip(v, -4, 4))(x), ([-9.0, -9.0], [-7.0, -7.0])),
    "gate of a condition": (lambda x: x * spread(lambda v: jnp.where(v > -3.3, v, 5.0))(x), ([-9.0], [-7.0])),
    "a scale for each entry": (lambda x: x * spread(lambda v: v * np.array([1.0, 2.0]))(x), ([1.0, 1.0], [2.0, 2.0])),
    "far away another": (lambda x: x * jax.nn.sigmoid(x + 1e-30 * x**36), ([-9.0], [-7.0])),
    "nearly silu": (lambda x: x * (jax.nn.sigmoid(x) * (1 + 1e-11)), ([1.3], [1.3])),
    "constant of ten digits": (
        lambda x: 0.5 * x * (1 + jnp.tanh(0.7978845608 * (x + 0.044715 * x**3))), ([1.3], [1.3]),
    ),
    "root of ten digits": (lambda x: 0.5 * x * (1 + lax.erf(x / 1.4142135623)), ([1.3], [1.3])),
    "softmax by columns": (lambda x: rows(x) / rows(x).sum(1).reshape(1, 2), ([1.0, 1.0], [1.1, 1.1])),
    "softmax, one matrix": (lambda x: (lambda m: m / m.sum(1).reshape(1, 2))(rows(x)), ([1.0, 1.0], [1.1, 1.1])),
    "log_softmax by columns": (lambda x: logs(jnp.log(rows(x))), ([1.0, 1.0], [1.1, 1.1])),
    "sorted by two keys": (
        lambda x: lax.sort((jnp.zeros(2), jnp.array([1.0, 0.0]), x), num_keys=2)[2], ([0.0, 5.0], [1.0, 6.0]),
    ),
    "rows sorted by two keys": (
        lambda x: lax.sort((jnp.zeros((2, 2)), jnp.array([[1.0, 0.0], [0.0, 1.0]]), jnp.outer(x, x)), num_keys=2)[2],
        ([1.0, 5.0], [2.0, 6.0]),
    ),
    "truth beyond a table": (
        lambda x: jnp.take(jnp.array([False, False]), jnp.floor(2 * x).astype(int)) + 0.0, ([0.0], [1.2]),
    ),
    "searched through a sorter": (
        lambda x: jnp.searchsorted(jnp.array([2.0, 0.0, 1.0]), x, sorter=jnp.array([1, 2, 0])) + 0.0, ([0.5], [1.5]),
    ),
    "nearly the Euclidean norm": (lambda x: jnp.linalg.norm(x, ord=2 + 1e-10).reshape(1), ([1.0, -1.0], [1.0, -1.0])),
}  # fmt: skip


@pytest.mark.parametrize("name", NEARLY)
def test_what_is_nearly_known_is_bounded_as_it_is(name):
    fn, (lower, upper) = NEARLY[name]
    lower, upper = np.array(lower), np.array(upper)
    share = np.random.default_rng(0).uniform(size=(400, len(lower)))
    share[:200] = np.round(share[:200])  # corners
    x = lower + share * (upper - lower)
    value = np.asarray(jax.vmap(lambda v: jnp.asarray(fn(v), float))(x))
    slip = 1e-14 * (1 + abs(value))
    box = Interval(lower, upper)
    for bounds in (inclusion.natural(fn, "outward")(box), inclusion.affine(fn, "outward")(box).range):
        assert (np.asarray(bounds.lower, float) <= value + slip).all()
        assert (value - slip <= np.asarray(bounds.upper, float)).all()


def test_a_constant_of_five_digits_in_float32():
    few = np.float32(0.79788)

    def fn(x):
        return 0.5 * x * (1 + jnp.tanh(few * (x + np.float32(0.044715) * x**3)))

    box = Interval(np.full(1, 1.3, np.float32), np.full(1, 1.3, np.float32))
    found = inclusion.natural(fn, "outward")(box)
    t = float(np.float32(1.3))
    exact = 0.5 * t * (1 + math.tanh(float(few) * (t + float(np.float32(0.044715)) * t**3)))
    assert found.lower <= exact <= found.upper


def test_names_of_other_packages_are_no_names_of_jax():
    """A package whose folder begins with that of JAX has a function of its own by a name that JAX has too."""
    source = "import jax\n\n@jax.jit\ndef fmax(x, y):\n    return x + y\n"
    names: dict = {}
    exec(compile(source, f"{jax.__file__.rpartition('/')[0]}_ext/ops.py", "exec"), names)
    found = inclusion.natural(lambda x: names["fmax"](x, x))(Interval([1.0], [2.0]))
    assert found.contains(np.array([4.0])).all()


def test_a_function_applied_in_place_is_refused():
    with pytest.raises(UnknownPrimitiveError, match=r"scatter.*x\.at\[i\]\.set\(h\(x\[i\]\)\).*test_look_alikes"):
        inclusion.natural(lambda x: x.at[1].apply(jnp.sin))(Interval([0.0, 0.0], [1.0, 2.0]))
    found = inclusion.natural(lambda x: x.at[1].set(jnp.sin(x[1])))(Interval([0.0, 1.0], [1.0, 2.0]))
    assert found.contains(np.sin([[0.0, 1.0], [0.0, 2.0]]) * [0, 1] + [[0.5, 0.0], [1.0, 0.0]]).all()


SEVERAL = {
    "lu": lambda x: jnp.linalg.inv(x[:, None, None] * jnp.eye(2)),
    "cholesky": lambda x: jnp.linalg.cholesky(x[:, None, None] * jnp.eye(2)),
    "triangular_solve": lambda x: jax.scipy.linalg.solve_triangular(x[:, None, None] * jnp.eye(2), jnp.ones((2, 2, 1))),
}


@pytest.mark.parametrize("name", SEVERAL)
def test_several_matrices_at_once_are_refused(name):
    with pytest.raises(UnknownPrimitiveError, match=f"`{name}` of several matrices at once; take them one by one"):
        inclusion.natural(SEVERAL[name])(Interval([1.0, 2.0], [2.0, 3.0]))


def test_truth_values_within_what_is_differentiated_again():
    """The derivative of an inverse asks for those of the entries, of which some hang on stacked truth values."""

    def fn(x):
        bent = jnp.piecewise(x, [x < 0.7, x > 1.2], [lambda v: v, lambda v: v * v, 1.0])
        return jnp.linalg.inv(8 * jnp.eye(2, dtype=x.dtype) + jnp.sin(jnp.outer(bent, x)))[0]

    box = Interval(np.array([1.3, 1.4], np.float32), np.array([1.5, 1.6], np.float32))
    found = inclusion.jacobian(fn)(box)
    exact = jax.jacfwd(fn)(jnp.array([1.4, 1.5], jnp.float32))
    assert found.contains(np.asarray(exact)).all()
    assert found.width.max() < 0.2
