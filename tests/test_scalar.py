"""Derivatives of scans over single numbers are those of the same scan over arrays, whatever is mapped."""

import importlib
import os
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles.uncompiled import in_numpy

from gsisio_jax import scalar
from gsisio_jax.interval.minmax import cut, larger, smaller
from gsisio_jax.interval.primitives import scale, times
from gsisio_jax.scalar import options

RANDOM = np.random.default_rng(0)
A, B, X = RANDOM.normal(size=3), RANDOM.normal(size=(3, 2)), RANDOM.normal(size=(3, 4))


def body(carry, x):
    a, b = carry
    sorted_ = jnp.cumsum(jnp.tanh(b) * a)  # no counterpart on numbers: it stays an operation on arrays
    near = smaller(jnp.sin(a) * b.sum(), larger(x, 0.3 * a)) + abs(a) / (2 + b[0] ** 2)
    bounded = cut(near, scale(jnp.where(x > 5, jnp.nan, b[1]), x)) + 0.1 * times(a, x)
    return (bounded, jnp.where(x > 0, sorted_, b * x + a)), (near * b[1], b)


def total(scan, a, b, xs):
    (a, b), ys = scan(body, (a, b), xs)
    return a + 0.3 * b.sum() + ys[0].sum() + ys[1].sum()


@pytest.mark.parametrize("axes", [(0, 0, 0), (None, 0, 0), (0, None, 0), (0, 0, None)])
@pytest.mark.parametrize("by", [0, 1, 2])
def test_derivatives_are_those_over_arrays(axes, by):
    args = [v if axis == 0 else v[0] for v, axis in zip((A, B, X), axes, strict=True)]

    def results(scan, *args):
        def mapped(*args):
            return jax.vmap(lambda *one: total(scan, *one), axes)(*args)

        def summed(*args):
            return mapped(*args).sum()

        return (
            mapped(*args),
            jax.vmap(jax.grad(lambda *one: total(scan, *one), by), axes)(*args),
            jax.grad(summed, by)(*args),
            jax.jacfwd(mapped, by)(*args),
            jax.jvp(jax.grad(summed, by), tuple(args), tuple(jnp.ones_like(v) for v in args))[1],
        )

    run = jax.jit if axes == (None, 0, 0) and by == 0 else in_numpy
    found, expected = (run(partial(results, scan))(*args) for scan in (scalar.scan, jax.lax.scan))
    for ours, plain in zip(found, expected, strict=True):
        np.testing.assert_allclose(ours, plain, rtol=1e-9, atol=1e-9)


def test_reverse_mode_keeps_only_arguments():
    closed = jax.make_jaxpr(jax.grad(lambda a: total(scalar.scan, a, B[0], X[0])))(A[0])
    kept = [eqn.outvars for eqn in closed.jaxpr.eqns if eqn.primitive.name == "scan"]
    assert sum(v.aval.shape == (4,) for v in kept[0]) <= 3 + 4  # results, and what comes into a step: a, b, x


def test_no_two_kept_numbers_are_written_by_one_operation():
    """XLA, with the flags of the command line, would copy both arrays whole at every turn."""

    def body(carry, row):
        low, high = jnp.sin(carry[0] + row), jnp.cos(carry[1] - row)
        return (low, high), (low * high, low + high, low - high, jnp.stack([low, high]))

    xs = jnp.arange(50.0)
    compiled = jax.jit(lambda a, b: scalar.scan(body, (a, b), xs)).lower(1.0, 2.0).compile()
    fusions = [
        line for line in compiled.as_text().splitlines() if " fusion(" in line and "dynamic-update-slice" in line
    ]
    assert fusions
    assert not [line for line in fusions if " = (" in line], "several results"
    found, expected = compiled(1.0, 2.0), jax.lax.scan(body, (1.0, 2.0), xs)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12)


def test_a_step_over_arrays_never_becomes_one_function(monkeypatch):
    """XLA would write what it sums once for every use: more than 20 GB for the flight's step, with 28 gains."""
    monkeypatch.setenv("XLA_FLAGS", options.extended(os.environ.get("XLA_FLAGS", "")))
    monkeypatch.setattr(importlib.import_module("gsisio_jax.scalar.scan"), "MOST_NUMBERS", 0)

    def body(carry, row):
        return jnp.sin(carry) * carry.sum() + row, carry.sum()

    compiled = jax.jit(lambda x, rows: scalar.scan(body, x, rows)).lower(A, X.T).compile()
    assert " sort(" in compiled.as_text()  # which a function cannot hold
    assert "small_call" not in compiled.as_text()
    found, expected = compiled(A, X.T), jax.lax.scan(body, A, X.T)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12)
