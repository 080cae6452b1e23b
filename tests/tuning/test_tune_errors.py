"""What `tune_noise` refuses, and what it says before it fits anything."""

import numpy as np
import pytest
import systems

import gsisio_jax as gx
from gsisio_jax.tuning import Records, tune_noise
from gsisio_jax.tuning.identify import identify
from gsisio_jax.tuning.shape import read_shape


@pytest.mark.parametrize("name", ["s1", "s7"])
def test_as_many_outputs_as_inputs_is_refused(name):
    """The paper's example and the quadruple tank: some input explains every record."""
    case = getattr(systems, name)()
    with pytest.raises(ValueError, match=r"not identifiable.*2 outputs for 2 unknown inputs.*true state"):
        identify("tune_noise", case.system, truth=False)
    assert "logged truth alone" in identify("tune_noise", case.system, truth=True).text


@pytest.mark.parametrize(("case", "spare"), [(systems.s4(True), 2), (systems.s5(), 1), (systems.s5(False), 3)])
def test_spare_outputs_identify(case, spare):
    found = identify("tune_noise", case.system, truth=False)
    assert f": {spare} combination" in found.text
    assert not found.weak


def test_refused_before_anything_runs():
    system = gx.System(lambda x: 0.5 * x, lambda x: x, G=[[1.0]], H=[[0.0]])
    noise = gx.Noise(gx.Interval.symmetric([0.1]), gx.Interval.symmetric([0.2]))
    observer = gx.design_observer(system, noise, gx.Interval.entire(1), missing=False)
    with pytest.raises(ValueError, match="tune_noise: noise bounds are not identifiable"):
        tune_noise(observer, Records(gx.Interval([0.0], [1.0]), np.zeros((2, 3, 1))))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"parameters": "all"}, '"scale", "each", "sides"'),
        ({"parameters": {"w": ["a"]}}, "2 of them"),
        ({"parameters": {"w": None, "v": None}}, "nothing is left to fit"),
        ({"objective": "cost"}, '"bounds" or "widths"'),
        ({"method": "adam"}, '"auto", "lp" or "optax"'),
        ({"weights": {"w": [1.0]}}, r'"w" of shape \(2,\)'),
        ({"held_out": 1.5}, "share from 0 to below 1"),
        ({"tolerance": 0.0}, "between 0 and 0.5"),
    ],
)
def test_arguments_are_checked(axis, change, message):
    with pytest.raises(ValueError, match=message):
        tune_noise(axis.observer, axis.records, **change)


def test_records_that_no_noise_explains(axis):
    """The initial box excludes the first measurement of a bound that is not fitted."""
    far = np.array(axis.y)
    far[2, 0, 1] += 50
    with pytest.raises(ValueError, match=r"no noise bounds of this shape explain.*record 2 at row 0"):
        tune_noise(axis.observer, Records(axis.initial, far), parameters={"v": ["position", None]}, held_out=0.0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda box, y: Records(box, []), "no record"),
        (lambda box, y: Records(box[None], y), "1 boxes for 6 records"),
        (lambda box, y: Records(box, y, x=y[:5]), "`x` has 5 records"),
        (lambda box, y: Records(box, y, x=y[:, :-3]), "expected 40 or 41"),
        (lambda box, y: Records(box, np.where(y > 1, np.inf, y)), "infinite"),
        (lambda box, y: Records(box, [y[0], y[1][:, :1]]), "record 1 of `y`"),
    ],
)
def test_records_are_checked(axis, make, message):
    with pytest.raises(ValueError, match=message):
        make(axis.initial, axis.y)


def test_records_must_fit_the_system(axis):
    with pytest.raises(ValueError, match="3 columns, the system needs 2"):
        tune_noise(axis.observer, Records(axis.initial, np.zeros((2, 4, 3))))


def test_shapes_stretch_away_from_zero():
    noise = gx.Noise(gx.Interval([-1.0, 0.0], [3.0, 0.0]), gx.Interval([2.0], [4.0]))
    shape = read_shape("test", noise, "sides")
    assert shape.names == ("w1-", "w1+", "v1+")
    stretched = shape.noise(np.array([2.0, 0.5, 3.0]))
    assert stretched.w.lower.tolist() == [-2.0, 0.0]
    assert stretched.w.upper.tolist() == [1.5, 0.0]
    assert (stretched.v.lower.tolist(), stretched.v.upper.tolist()) == ([2.0], [8.0])
    assert shape.factors(stretched).tolist() == [2.0, 0.5, 3.0]
    cost, fixed = shape.cost(np.array([1.0, 1.0, 10.0]))
    assert (cost.tolist(), fixed) == ([1.0, 3.0, 20.0], 0.0)
    shared = read_shape("test", noise, {"w": ["a", None], "v": "a"})
    assert shared.names == ("a",)
    assert shared.cost(np.array([1.0, 1.0, 10.0])) == (np.array([24.0]), 0.0)
