"""Bounds on boxes whose numbers are known: in NumPy, without a single compilation, and those of a compiled function."""

from contextlib import contextmanager

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gsisio_jax as gx
from gsisio_jax import Interval, inclusion
from gsisio_jax.inclusion.known_boxes import case_is_open, in_numpy
from gsisio_jax.interval.cast import as_array
from gsisio_jax.scalar.numpy_program import numpy_function as program

COMPILED = True  # about what is compiled, and what is not
BOX = Interval(np.array([-0.3, 0.2, 1.0]), np.array([0.7, 1.1, 2.5]))
WAYS = ("natural", "affine", "jacobian", "mean_value", "decomposition", "remainder", "tight", "bound")


def plain(x):
    """Exact and correctly rounded operations only: NumPy has them all."""
    return jnp.stack([x[0] * x[1] - 0.3 * x[2], x[2] / (1.0 + x[0] ** 2), jnp.where(x[1] > 0.5, x[0], x[2])])


@pytest.fixture(scope="module", params=[np.float64, np.float32])
def of_all_ways(request):
    """Bounds, and what was compiled for them; before anything else is, so that nothing is there already."""
    jax.clear_caches()
    box, found = BOX.astype(request.param), {}
    for way in WAYS:
        bounds = getattr(inclusion, way)(plain)
        with compilations() as compiled:
            found[way] = bounds, bounds(box), compiled
    return box, found


@contextmanager
def compilations():
    compiled = []

    def listen(event, seconds, **_):
        if "backend_compile" in event:
            compiled.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield compiled
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


@pytest.mark.parametrize("way", WAYS)
def test_nothing_is_compiled_and_the_bounds_are_those_of_a_compiled_function(way, of_all_ways):
    box, (bounds, found, compiled) = of_all_ways[0], of_all_ways[1][way]
    dtype = box.dtype
    assert compiled == []
    with compilations() as counted:
        expected = jax.jit(bounds)(box)
    assert counted  # the counter does count
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for ours, theirs in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert isinstance(ours, jax.Array)
        assert ours.dtype == dtype
        np.testing.assert_allclose(ours, theirs, rtol=50 * np.finfo(dtype).eps, atol=50 * np.finfo(dtype).eps)


@pytest.mark.parametrize("way", WAYS)
def test_a_function_that_holds_a_traced_number(way):
    """In a trace, which a program of NumPy comes of, for each number; what XLA makes of one is compared above."""

    def lower(p):
        found = getattr(inclusion, way)(lambda x: jnp.stack([p * x[0] + x[1], x[1] * x[2]]))(BOX)
        return getattr(found, "range", found).lower.ravel()[0]

    p = np.array([2.0, 3.0, 2.0 + 1e-6, 2.0 - 1e-6])
    expected = [float(lower(number)) for number in p]
    traced = program(lower, 2.0)
    np.testing.assert_allclose([traced(number) for number in p], expected, rtol=1e-12)
    np.testing.assert_allclose(program(jax.vmap(lower), p)(p), expected, rtol=1e-12)
    slope = float(program(jax.grad(lower), 2.0)(2.0))
    assert slope == pytest.approx((expected[2] - expected[3]) / 2e-6, abs=1e-6)


@pytest.mark.parametrize("way", ["natural", "mean_value"])
def test_a_function_that_holds_a_number_that_is_traced_alone(way):
    """Under `jax.vmap` and `jax.grad` outside of any trace, and under `jax.jit`: through both doors to NumPy, that of a
    function (natural) and that of its bounds (mean_value)."""

    def lower(p):
        return getattr(inclusion, way)(lambda x: p * x)(BOX).lower[0]

    expected = [float(lower(p)) for p in (2.0, 3.0)]
    np.testing.assert_allclose([jax.jit(lower)(p) for p in (2.0, 3.0)], expected, rtol=1e-12)
    np.testing.assert_allclose(jax.vmap(lower)(np.array([2.0, 3.0])), expected, rtol=1e-12)
    assert float(jax.grad(lower)(2.0)) == pytest.approx(BOX.lower[0], abs=1e-6)


def test_a_point_stays_a_point():
    side = jnp.array([0.3, 0.4, 0.5])
    seen = []

    def bounds(box):
        seen.append(box.lower is box.upper)
        return box.lower + box.upper

    in_numpy(bounds, Interval.unchecked(side, side))
    in_numpy(bounds, BOX.astype(np.float64))
    assert seen == [True, False]


def test_where_a_case_is_chosen_by_the_numbers_they_are_looked_at():
    def bounds(box):
        if isinstance(box.lower, jax.core.Tracer):
            case_is_open()
        return 2 * box.lower if float(box.lower[0]) < 0 else box.lower

    np.testing.assert_array_equal(in_numpy(bounds, BOX), 2 * BOX.lower)
    # Beside a known box nobody is to look at, a case that is open is none of an error.
    case_is_open()


def test_a_box_that_jax_would_round_is_rounded_outward():
    with jax.enable_x64(False):
        for way in ("natural", "mean_value", "tight", "bound"):
            wide = Interval.unchecked(np.full(1, 0.1), np.full(1, 0.3))  # neither is a float32
            found = getattr(inclusion, way)(lambda x: -x)(wide)
            found = getattr(found, "range", found)
            assert found.lower.dtype == np.float32
            assert float(found.lower[0]) <= -0.3
            assert float(found.upper[0]) >= -0.1


def test_what_is_on_the_device_is_a_copy():
    for size in range(1, 40):  # some arrays begin where JAX would take the memory as it is
        given = np.zeros(size)
        there = as_array(given)
        given[:] = 1
        assert not np.asarray(there).any()
    assert as_array(np.arange(3.0), np.float32).dtype == np.float32
    kept = jnp.arange(3.0)
    assert as_array(kept) is kept


def test_subnormal_numbers_of_arrays_on_the_device_are_moved_outward():
    given = jax.device_put(np.array([5e-324, -5e-324, 0.0, 1.0]))
    found = gx.Interval.unchecked(given, given).astype(np.float32).astype(np.float64)
    tiny = float(np.finfo(np.float64).tiny)
    box = gx.Interval.unchecked(given, given + 0.0).astype(np.float64)
    assert (np.asarray(box.lower) <= np.array([0.0, -tiny, 0.0, 1.0])).all()
    assert (np.asarray(found.upper) >= 0.0)[[0, 2, 3]].all()
    ordinary = jax.device_put(np.array([0.0, 1.0, -2.0]))
    assert gx.Interval.unchecked(ordinary, ordinary).astype(np.float64).lower is ordinary
