"""region="auto" around a state, a box or a trajectory: it holds all of it, with room for the steady boxes."""

import jax.numpy as jnp
import numpy as np
import pytest

import gsisio_jax as gx
from gsisio_jax import Interval
from gsisio_jax.cli.config import RegionPart

NOISE = gx.Noise(Interval.symmetric([0.01]), Interval.symmetric([0.1]))
PLANT = gx.System(
    lambda x: 0.9 * x + 0.05 * jnp.sin(3 * x), lambda x: x + 0.2 * jnp.sin(x), G=[[1.0]], H=[[0.0]],
    state_bounds=Interval([-20.0], [8.0]),
)  # fmt: skip
RUN = np.linspace(0.0, 7.0, 20)[:, None]


@pytest.mark.parametrize(
    ("around", "lower", "upper"),
    [
        ([5.0], 5.0, 5.0),
        (Interval([2.0], [3.0]), 2.0, 3.0),
        (RUN, 0.0, 7.0),
        (Interval(np.append(RUN - 0.2, [[-np.inf]], 0), np.append(RUN + 0.2, [[np.inf]], 0)), -0.2, 8.0),
    ],
    ids=["state", "box", "trajectory", "boxes over time"],
)
def test_the_region_has_room_around_what_was_given(around, lower, upper):
    promise = gx.design_observer(PLANT, NOISE, "auto", missing=False, around=around).certificate
    assert promise.self_consistent
    (steady,) = promise.steady_width
    room = steady / 2 if lower == upper else steady
    assert promise.region.lower[0] <= lower - room
    assert promise.region.upper[0] >= min(upper + room, 8.0)
    assert promise.region.upper[0] <= 8.0
    (said,) = promise.notes or ("",)
    boxes = isinstance(around, Interval)
    if np.ndim(around.lower if boxes else around) == 1:
        assert "around one state or box" in said
    else:
        assert said == "" if boxes else "along the states that were given" in said


def test_boxes_of_the_run_stay_in_the_region_that_was_grown_around_it():
    """Without `around` the region lies about the centre of the state bounds, and the run leaves it; that is said."""
    x = RUN[:, 0]
    y = (x + 0.2 * np.sin(x))[:, None]
    initial = Interval([-0.1], [0.1])
    found = gx.design_observer(PLANT, NOISE, "auto", missing=False, around=x[:, None])
    est = gx.estimate(found, initial, y)
    assert (np.asarray(est.status) == 0).all()
    assert "0 of 20 steps" in est.summary(found)
    blind = gx.design_observer(PLANT, NOISE, "auto", missing=False)
    assert "(-6)" in blind.certificate.notes[0]
    assert "around" in blind.certificate.notes[0]
    est = gx.estimate(blind, initial, y)
    share = np.mean(np.asarray(est.status) & int(gx.Status.OUTSIDE_REGION) != 0)
    assert share > 0.8
    assert f"{round(20 * share)} of 20 steps (the box leaves the region at" in est.summary(blind)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"around": [1.0, 2.0]}, r"`around` must be a state \(1,\)"),
        ({"around": np.full((3, 1), np.nan)}, "finite values of every state within the state bounds"),
        ({"around": [9.0]}, "within the state bounds"),
        ({"around": "initial"}, "`around` must be an array of real numbers"),
        ({"around": [1.0], "region": Interval([0.0], [1.0])}, "leave it out where `region` is a box"),
    ],
)
def test_mistakes(options, message):
    with pytest.raises(ValueError, match=message):
        gx.design_observer(**{"system": PLANT, "noise": NOISE, "region": "auto", **options})


def test_where_there_is_no_such_region_the_place_is_named():
    loud = gx.Noise(Interval.symmetric([3.0]), Interval.symmetric([3.0]))
    steep = gx.System(lambda x: x, lambda x: x + 1.1 * jnp.sin(x), G=[[1.0]], H=[[0.0]])
    message = r"around \[2.0\] to \[3.0\] that holds its own steady width.*smaller or another box"
    with pytest.raises(gx.NoDesignFound, match=message):
        gx.design_observer(steep, loud, "auto", missing=False, around=Interval([2.0], [3.0]))


def test_the_key_of_the_command_line():
    assert RegionPart(auto=True, around=[1.0]).around == [1.0]
    assert RegionPart(auto=True, around="initial").around == "initial"
    assert RegionPart(auto=True, around={"lower": [0.0], "upper": [1.0]}).around.upper == [1.0]
    with pytest.raises(ValueError, match="around says where auto = true looks"):
        RegionPart(lower=[0.0], upper=[1.0], around=[0.5])
