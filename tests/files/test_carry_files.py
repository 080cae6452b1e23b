"""A carry goes on from its file in the same bits, and with no other observer."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from files import plants

import gsisio_jax as gx
from gsisio_jax import Interval
from gsisio_jax.observer.fixed import Fixed
from gsisio_jax.observer.scan import blank


@pytest.fixture(scope="module")
def observer():
    return plants.design("nearest")


@pytest.fixture(scope="module")
def carry(observer):
    found, _ = gx.start(observer, plants.start(), plants.measurements()[0])
    for y in plants.measurements()[1:5]:
        found, _ = gx.step(observer, found, y)
    return found


def test_a_run_goes_on(observer, carry, tmp_path):
    gx.save_carry(tmp_path / "carry", carry, observer, step=5)
    found, step = gx.load_carry(tmp_path / "carry", observer)
    assert (step, Fixed(found)) == (5, Fixed(carry))
    whole = gx.estimate(observer, plants.start(), plants.measurements())
    for k in range(step, 12):
        found, out = gx.step(observer, found, plants.measurements()[k])
        np.testing.assert_array_equal(out.state.lower, whole.state.lower[k])
        np.testing.assert_array_equal(out.input.upper, whole.input.upper[k - 1])


def test_many_runs_at_once(observer, tmp_path):
    boxes = Interval(np.full((3, 2), -2.0), np.full((3, 2), 2.0))
    many, _ = jax.vmap(lambda box: gx.start(observer, box, plants.measurements()[0]))(boxes)
    gx.save_carry(tmp_path / "carry", many, observer)
    assert Fixed(gx.load_carry(tmp_path / "carry", observer)[0]) == Fixed(many)


def test_windows_delays_and_the_prediction_form_keep_what_they_need(tmp_path):
    for kind, size in (("window", 2), ("prediction", 1), ("delayed", 2)):
        observer = plants.design(kind)
        first = jax.tree.map(jnp.asarray, blank(observer, Interval.symmetric(np.ones(size))))
        gx.save_carry(tmp_path / "carry", first, observer, 1)
        assert Fixed(gx.load_carry(tmp_path / "carry", observer)[0]) == Fixed(first)


def test_another_observer_is_refused(observer, carry, tmp_path):
    gx.save_carry(tmp_path / "carry", carry, observer)
    wider = replace(observer, noise=gx.Noise(plants.NOISE.w, plants.ball(0.05, 0.2)))
    with pytest.raises(ValueError, match=r"it differs: noise.v.lower, noise.v.upper; load that observer"):
        gx.load_carry(tmp_path / "carry", wider)
    with pytest.raises(ValueError, match="it differs: structure"):
        gx.load_carry(tmp_path / "carry", observer.with_rounding("outward"))
    other = gx.System(lambda x: 0.4 * x, observer.system.g, observer.system.G, observer.system.H)
    with pytest.raises(ValueError, match="it differs: f gives"):
        gx.load_carry(tmp_path / "carry", replace(observer, system=other))


def test_a_carry_of_another_form_is_not_saved(observer, carry, tmp_path):
    with pytest.raises(ValueError, match="save_carry: `carry` must be one that this observer has made, with 2 states"):
        gx.save_carry(tmp_path / "carry", carry, plants.design("window"))
    with pytest.raises(
        ValueError, match=r"`carry` must be a gsisio_jax.Carry, got Observer .arguments in the wrong order"
    ):
        gx.save_carry(tmp_path / "carry", observer, carry)
    with pytest.raises(ValueError, match="`step` must be a number of measurements, at least 0, got -1"):
        gx.save_carry(tmp_path / "carry", carry, observer, step=-1)
    assert not list(tmp_path.iterdir())


def test_an_observer_is_no_carry(observer, tmp_path):
    observer.save(tmp_path / "observer")
    with pytest.raises(ValueError, match=r"load_carry: .* must be the file of one carry, it is that of one observer"):
        gx.load_carry(tmp_path / "observer", observer)
