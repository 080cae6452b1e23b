"""A certificate says where it holds, and a region where nothing can be promised is refused or named."""

import jax.numpy as jnp
import numpy as np
import pytest

import gsisio_jax as gx
from gsisio_jax import Interval

NOISE = gx.Noise(Interval.symmetric([0.01]), Interval.symmetric([0.1]))


def scalar(f, **options):
    return gx.System(f, lambda x: x, G=[[1.0]], H=[[0.0]], **options)


def test_a_power_of_a_vector_runs_and_its_undefined_states_are_named():
    """x ** 2.5 is one equation for all entries; of negative states it says nothing."""
    observer = gx.design_observer(scalar(lambda x: 0.1 * x**2.5), NOISE, Interval([-2.0], [2.0]))
    (note,) = observer.certificate.notes
    assert note.startswith("no width is promised: f gives no number at x = (-")
    assert note in str(observer.certificate)
    assert str(observer.certificate).startswith("Certificate: NONE.")
    assert not observer.certificate.certified
    assert np.isinf(observer.certificate.widths(NOISE)).all()
    est = gx.estimate(observer, Interval([0.5], [1.0]), [[0.7], [0.1]])
    assert np.isfinite(est.state.width).all()
    defined = gx.design_observer(scalar(lambda x: 0.1 * x**2.5), NOISE, Interval([0.1], [2.0]), missing=False)
    assert defined.certificate.notes == ()


def test_a_region_beyond_the_state_bounds_is_refused():
    system = scalar(lambda x: 0.5 * np.sin(1) * x, state_bounds=Interval([0.0], [1.0]))
    with pytest.raises(
        ValueError, match=r"`region` must have states in common .* state 1 it has \[3, 4\] and they have"
    ):
        gx.design_observer(system, NOISE, Interval([3.0], [4.0]))


def test_a_region_that_reaches_beyond_the_state_bounds_has_the_room_that_is_within_them():
    """[0.95, 2] and bounds [0, 1]: boxes are .2 wide and do not fit, though .2 is less than 1.05."""
    system = scalar(lambda x: 0.5 * jnp.sin(x), state_bounds=Interval([0.0], [1.0]))
    for lower in (0.95, 1.0):
        promise = gx.design_observer(system, NOISE, Interval([lower], [2.0]), missing=False, window=1).certificate
        assert not promise.self_consistent
        np.testing.assert_allclose(promise.slack, 1.0 - lower - promise.steady_width)
        assert str(promise).startswith("Certificate: EMPTY.")
    promise = gx.design_observer(system, NOISE, Interval([-5.0], [2.0]), missing=False, window=1).certificate
    assert promise.self_consistent
    np.testing.assert_array_equal(promise.region.width, [1.0])
    # Where it would be undefined beyond the bounds it is certified.
    power = scalar(lambda x: 0.1 * x**2.5, state_bounds=Interval([0.0], [5.0]))
    assert gx.design_observer(power, NOISE, Interval([-2.0], [2.0]), missing=False, window=1).certificate.certified


def test_an_affine_plant_has_no_region_to_leave():
    observer = gx.design_observer(scalar(lambda x: 0.5 * x), NOISE, Interval([-1.0], [1.0]), missing=False)
    line = next(line for line in str(observer.certificate).splitlines() if line.startswith("  state 1"))
    assert line.split()[-2:] == ["-", "-"]
