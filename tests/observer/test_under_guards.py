"""Calls under JAX's own guards (transfers, types, NaN), and exported with sizes that are symbols."""

import importlib.util

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

import gsisio_jax as gx
from gsisio_jax import Interval
from gsisio_jax.interval import cast
from gsisio_jax.observer import checks

COMPILED = True

BOX = Interval([-1.0], [1.0])
NOISE = gx.Noise(Interval.symmetric([0.01]), Interval.symmetric([0.1]))
Y = np.array([[0.2], [0.15], [np.nan], [0.1]])


@pytest.fixture(scope="module")
def observer():
    system = gx.System(lambda x: 0.5 * x, lambda x: x, G=np.zeros((1, 0)), H=np.zeros((1, 0)))
    return gx.design_observer(system, NOISE, Interval.entire(1))


def equal(found, expected):
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(np.asarray(a), np.asarray(b)), found, expected)


def test_arrays_on_the_device_are_all_that_a_call_needs(observer):
    expected = gx.estimate(observer, BOX, Y), gx.estimate(observer, BOX, Y, length=3)
    box, y, rows, three = jax.device_put((BOX, Y, list(Y), 3))
    with jax.transfer_guard("disallow"):
        carry, first = gx.start(observer, box, rows[0])
        outs = [first]
        for row in rows[1:]:
            carry, out = gx.step(observer, carry, row)
            outs.append(out)
        found = gx.estimation.collect(observer, outs)
        whole = gx.estimate(observer, box, y)
        cut = [gx.estimate(observer, box, y, length=length) for length in (3, three)]
    equal([found, whole, *cut], [expected[0], *expected, expected[1]])


def test_what_is_remembered_on_the_device_outlives_its_donation(observer):
    """A program may return the very array that it was given, and a user donate what came back."""
    expected = gx.step(observer, gx.start(observer, BOX, Y[0])[0], Y[1])
    kept = checks.prepare("start", observer, BOX, Y[0], None, None, False)
    jax.tree.map(lambda leaf: leaf.delete(), kept[2:4])  # u and noise
    equal(gx.step(observer, gx.start(observer, BOX, Y[0])[0], Y[1]), expected)


def test_two_types_where_promotion_is_strict(observer):
    expected = gx.estimate(observer, BOX, Y.astype(np.float32))
    with jax.numpy_dtype_promotion("strict"):
        equal(gx.estimate(observer, BOX, Y.astype(np.float32)), expected)
        equal(gx.estimate(observer, BOX, jnp.asarray(Y, np.float32)), expected)
        assert Interval(np.float32([0]), np.float64([1])).dtype == np.float64
        assert cast.floating_type(np.dtype(int), np.dtype(np.int32)) == np.float64
        assert cast.floating_type(np.float32, jnp.bfloat16) == np.float32


def test_shapes_where_promotion_of_ranks_is_refused(observer):
    def width(y):
        return gx.estimate(observer, BOX, y).state.width[-1, 0]

    y = jnp.asarray(np.nan_to_num(Y))
    found = jax.jit(jax.vmap(jax.value_and_grad(width)))
    expected = found(y[None])
    with jax.numpy_rank_promotion("raise"):
        equal(found(y[None]), expected)
        gx.design_observer(observer.system, NOISE, Interval.symmetric([1.0]))
        assert jax.device_put(BOX).contains(y).all()


def test_gradients_outside_of_jit_where_nan_is_an_error(observer):
    def width(w):
        return gx.estimate(observer, BOX, Y, noise=gx.Noise(Interval.symmetric(w), NOISE.v)).state.width[-1, 0]

    w = NOISE.w.upper
    expected = jax.grad(width)(w)
    with jax.debug_nans(True):
        np.testing.assert_allclose(jax.grad(width)(w), expected, rtol=1e-12)


def test_exported_with_any_number_of_records_and_steps(observer):
    def run(y):
        return jax.tree.leaves(jax.vmap(lambda y: gx.estimate(observer, BOX, y))(y))

    made = export.export(jax.jit(run))(jax.ShapeDtypeStruct((*export.symbolic_shape("b, T"), 1), np.float64))
    if importlib.util.find_spec("flatbuffers"):  # JAX needs it for nothing else
        made = export.deserialize(made.serialize())
    for y in (Y[None], np.stack([Y[:3], Y[1:]])):
        equal(made.call(y), jax.jit(run)(y))
