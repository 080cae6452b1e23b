"""Reverse mode through `jax.vmap` where results of a step differ in their axes, against the same over arrays.

What all cases share is handed on from step to step without their axis, beside numbers that have it.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles.uncompiled import in_numpy

from gsisio_jax import scalar
from gsisio_jax.interval.minmax import larger
from gsisio_jax.scalar import primitive

SIZES = (3, 2)  # of two nested batches, the outer first
RANDOM = np.random.default_rng(3)


def body(carry, row):
    """Each number has the axes of what it is made of: `p` and `q` stay as they are, `c` of `p` and `b` of `q` alone."""
    a, b, c, p, q = carry
    mixed = jnp.sin(a) * b + larger(c, 0.1 * row) * p + q
    return (mixed + 0.2 * a, 0.5 * b * q + q, jnp.cos(c) * p, p, q), (p * p, mixed * c, b * p, q + row)


def by_scan(scan, a, p, q, rows):
    last, kept = scan(body, (a, q * 0.5, p + 0.1, p, q), rows)
    return jax.tree.leaves((last, kept))


def by_steps(scan, a, p, q, rows):
    """A chain of calls: what one hands out without an axis goes into the next."""
    carry, kept = (a, q * 0.5, p + 0.1, p, q), []
    for row in rows:
        carry, out = scalar.call(body, carry, row) if scan is scalar.scan else body(carry, row)
        kept.append(out)
    return jax.tree.leaves((carry, kept))


def drawn(marks):
    """An argument with the axes that are marked."""
    return RANDOM.uniform(0.3, 1.2, [size for size, mark in zip(SIZES, marks, strict=True) if mark])


NONE, OUTER, INNER, BOTH = (False, False), (True, False), (False, True), (True, True)
CASES = [
    # of a, p, q and the rows
    (OUTER, NONE, NONE, NONE),  # many boxes, one noise and one record
    (NONE, NONE, NONE, OUTER),  # many records, one noise
    (NONE, OUTER, NONE, NONE),
    (NONE, NONE, INNER, NONE),
    (BOTH, OUTER, INNER, NONE),
    (INNER, NONE, OUTER, NONE),
    (NONE, OUTER, INNER, NONE),
    (OUTER, NONE, INNER, OUTER),
    (BOTH, BOTH, NONE, OUTER),
    (BOTH, BOTH, BOTH, BOTH),
]


def nested(function, axes):
    for level in (1, 0):
        along = tuple(0 if marks[level] else None for marks in axes)
        if any(axis == 0 for axis in along):
            function = jax.vmap(function, along)
    return function


@pytest.mark.parametrize("run", [by_scan, by_steps])
@pytest.mark.parametrize("axes", CASES)
def test_cotangents_are_those_over_arrays(axes, run):
    args = [drawn(marks) for marks in axes[:3]]
    rows = np.stack([drawn(axes[3]) for _ in range(3)], -1)

    def results(scan, args, weights):
        def mapped(*args):
            return nested(lambda *one: run(scan, *one), axes)(*args)

        found, back = jax.vjp(mapped, *args)
        # Only some results matter, too: the others' cotangents are then no numbers but absent.
        first = jax.grad(lambda *args: (weights[0] * mapped(*args)[0]).sum(), (0, 1, 2, 3))(*args)
        twice = jax.jvp(lambda *args: jax.vjp(mapped, *args)[1](weights), args, tuple(0.5 * x for x in args))[1]
        return found, back(weights), first, twice, jax.jacfwd(mapped, 1)(*args)

    args = (*args, rows)
    shapes = jax.eval_shape(nested(lambda *one: run(jax.lax.scan, *one), axes), *args)
    weights = [RANDOM.normal(size=shape.shape) for shape in shapes]
    ours = in_numpy(lambda *given: results(scalar.scan, *given))(args, weights)
    plain = in_numpy(lambda *given: results(jax.lax.scan, *given))(args, weights)
    for one, other in zip(jax.tree.leaves(ours), jax.tree.leaves(plain), strict=True):
        assert one.shape == other.shape
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)


def test_tangents_of_a_batch_alone():
    """Tangents with an axis at a point without one (`jax.jacfwd`), transposed: some results lack that axis."""

    def function(p, q):
        return scalar.call(lambda p, q: (jnp.sin(p) * q, q * q, p), p, q)

    p, q, basis = 0.7, 1.3, np.array([1.0, 2.0, 3.0])

    def pushed(tangents, scale):
        return jax.vmap(lambda t: jax.jvp(function, (p, q), (t, scale))[1])(tangents)

    weights = [np.array([1.0, -1.0, 2.0]), np.array([0.5, 0.25, 3.0]), np.array([2.0, 0.0, 1.0])]
    back = jax.linear_transpose(pushed, basis, 1.0)(tuple(weights))
    np.testing.assert_allclose(back[0], np.cos(p) * q * weights[0] + weights[2])
    np.testing.assert_allclose(back[1], np.sin(p) * weights[0].sum() + 2 * q * weights[1].sum())


def test_a_tangent_has_the_axes_of_its_result():
    """That of ``a + r`` by r alone does not depend on a, which has an axis: what follows is handed one that has it."""
    a = np.array([1.0, 2.0, 3.0])

    def mapped(r):
        return jax.vmap(lambda a: scalar.call(lambda a, r: (a + r, r), a, r))(a)

    found, pushed = jax.jvp(mapped, (2.0,), (0.5,))
    np.testing.assert_array_equal(pushed[0], [0.5, 0.5, 0.5])
    assert [x.shape for x in pushed] == [x.shape for x in found]
    closed = jax.make_jaxpr(lambda r: jax.jvp(mapped, (r,), (r,)))(2.0)
    assert [x.shape for x in closed.out_avals] == 4 * [(3,)]
    [back] = jax.vjp(mapped, 2.0)[1]((np.array([1.0, 2.0, 4.0]), np.array([8.0, 16.0, 32.0])))
    assert back == 63


def test_an_axis_without_meaning_is_not_summed_over():
    """What simplifying left of a primal in the program of cotangents, but not in that of tangents."""
    value = jnp.asarray(np.broadcast_to([1.0, 2.0], (3, 2)))
    has, axes, wants = BOTH[::-1], (True, False), (False, False)  # the innermost level first
    assert primitive._fitted(value, has, axes, wants) == 3
    np.testing.assert_array_equal(primitive._fitted(value, has, axes, axes), [1, 2])


def test_one_group_is_one_program():
    """Where all results have the same axes nothing is added: one program of cotangents, no sums."""

    def back(axes):
        function = nested(lambda a, p: scalar.call(lambda a, p: (jnp.sin(a) * p, a * p), a, p), axes)
        args = tuple(jnp.asarray(drawn(marks)) for marks in axes)
        found, pulled = jax.vjp(function, *args)
        return [eqn.primitive.name for eqn in jax.make_jaxpr(pulled)(found).eqns]

    def inner(names):
        return [name for name in names if name not in ("jit", "pjit")]

    assert inner(back((NONE, NONE))) == inner(back((OUTER, OUTER))) == ["scalar_program"]
    assert inner(back((OUTER, NONE))) == ["scalar_program", "reduce_sum"]
