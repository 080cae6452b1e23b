"""Axes of a study: what varies, what is paired, which rows belong to which case, and what is refused."""

import itertools

import numpy as np
import pytest

import gsisio_jax as gx
from gsisio_jax.study import Layout, Truth
from gsisio_jax.study.arguments import prepare

T = 5


def boxes(count, scale=1.0):
    """Box i is [-i, i] in both states, so that a row tells its number."""
    return gx.Interval.symmetric(scale * np.arange(count)[:, None] * np.ones(2))


def records(count):
    return np.arange(count)[:, None, None] * np.ones((T, 2))


def levels(count):
    return gx.Noise(boxes(count), boxes(count, 10.0))


SHARED = gx.Noise(gx.Interval.symmetric([1.0, 1.0]), gx.Interval.symmetric([1.0, 1.0]))


def built(**arguments):
    return Layout.build("sweep", arguments)


def test_different_names_make_the_product_and_the_order_is_that_of_c():
    arguments = {
        "initial": gx.grid("box", boxes(2)),
        "y": gx.grid("record", records(3)),
        "noise": gx.grid("level", levels(4), coordinate=[0.1, 0.2, 0.4, 0.8], unit="m"),
    }
    layout = built(**arguments)
    assert (layout.names, layout.sizes, layout.cases) == (("box", "record", "level"), (2, 3, 4), 24)
    taken = layout.take(arguments, np.arange(24))
    expected = np.array(list(itertools.product(range(2), range(3), range(4))))
    got = np.stack([taken["initial"].upper[:, 0], taken["y"][:, 0, 0], taken["noise"].w.upper[:, 1]], axis=1)
    np.testing.assert_array_equal(got, expected)
    np.testing.assert_array_equal(taken["noise"].v.upper[:, 0], 10 * expected[:, 2])
    assert layout.coordinates["level"].unit == "m"
    np.testing.assert_array_equal(layout.coordinates["box"].values, [0, 1])


def test_equal_names_are_paired_and_unnamed_batches_run_along_run():
    arguments = {
        "initial": boxes(3),
        "y": records(3),
        "noise": gx.grid("level", levels(2)),
        "length": gx.grid("level", np.array([4, 5])),
    }
    layout = built(**arguments)
    assert (layout.names, layout.sizes) == (("run", "level"), (3, 2))
    taken = layout.take(arguments, np.array([5, 0, 3]))
    np.testing.assert_array_equal(taken["case"], [5, 0, 3])
    np.testing.assert_array_equal(taken["initial"].upper[:, 0], [2, 0, 1])
    np.testing.assert_array_equal(taken["y"][:, 0, 0], [2, 0, 1])
    np.testing.assert_array_equal(taken["noise"].w.upper[:, 0], [1, 0, 1])
    np.testing.assert_array_equal(taken["length"], [5, 4, 5])


def test_what_all_cases_share_is_not_copied():
    arguments = {"initial": boxes(3), "y": records(3)[0], "noise": gx.Noise(boxes(3), SHARED.v), "u": None}
    layout = built(**arguments)
    taken, shared = layout.take(arguments, np.array([2])), layout.shared(arguments)
    assert taken["y"] is None
    assert shared["y"] is arguments["y"]
    assert taken["noise"].v.lower is None
    assert shared["noise"].v is not None
    assert shared["noise"].w.lower is None
    assert shared["initial"].upper is None
    assert taken["u"] is None
    assert shared["u"] is None


def test_noise_over_time_is_told_from_a_batch_by_its_first_axis():
    over_time = gx.Interval.symmetric(np.ones((1, T, 2)))
    layout = built(initial=boxes(3), noise=gx.Noise(over_time, SHARED.v))
    assert layout.sizes == (3,)
    arguments = {"initial": boxes(3), "noise": gx.Noise(over_time, SHARED.v)}
    assert layout.shared(arguments)["noise"].w.lower.shape == (T, 2)
    many = gx.Interval.symmetric(np.ones((3, T, 2)))
    arguments = {"initial": boxes(3), "noise": gx.Noise(many, over_time)}
    layout = built(**arguments)
    assert layout.take(arguments, np.array([1]))["noise"].w.lower.shape == (1, T, 2)
    assert layout.shared(arguments)["noise"].v.lower.shape == (T, 2)
    assert built(noise=gx.grid("level", gx.Noise(over_time, over_time))).sizes == (1,)


def test_one_case_needs_no_axis():
    arguments = {"initial": boxes(1)[0], "y": records(1)[0]}
    layout = built(**arguments)
    assert (layout.names, layout.cases) == ((), 1)
    assert layout.take(arguments, np.zeros(4, int))["initial"].lower is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"initial": boxes(3), "y": records(2)}, r"axis 'run' has 3 elements in `initial` and 2 in `y`.*gx\.grid"),
        ({"initial": boxes(3), "noise": levels(2)}, r"take shape \(1, T, n\)"),
        ({"initial": gx.grid("a", boxes(3)), "y": gx.grid("a", records(4))}, "paired"),
        ({"initial": gx.grid("a", boxes(3)[0])}, "no leading batch axis"),
        ({"initial": gx.grid("a", boxes(3), coordinate=[1, 2])}, "2 entries, the axis has 3"),
        ({"initial": gx.grid("a", boxes(2), [1, 2]), "y": gx.grid("a", records(2), [1, 3])}, "different coordinates"),
        ({"initial": gx.grid("a", boxes(2), [1, 2]), "y": gx.grid("a", records(2), [1, 2], "m")}, "different"),
        ({"initial": boxes(0)}, "is empty"),
        ({"y": records(2)[None]}, "one more in front"),
        ({"noise": gx.Noise(boxes(2), boxes(3))}, "parts of `noise`"),
    ],
)
def test_what_does_not_fit_is_refused(arguments, message):
    with pytest.raises(ValueError, match=f"^sweep: .*{message}"):
        built(**arguments)


@pytest.mark.parametrize("name", ["", "state", "time", 3])
def test_names_of_the_result_are_refused(name):
    with pytest.raises(ValueError, match=r"^grid: `name`"):
        gx.grid(name, boxes(2))


def test_grids_of_grids_and_coordinates_of_two_dimensions_are_refused():
    with pytest.raises(ValueError, match="wrap it once"):
        gx.grid("b", gx.grid("a", boxes(2)))
    with pytest.raises(ValueError, match="one entry per element"):
        gx.grid("a", boxes(2), coordinate=[[1, 2]])


PLANT = gx.System(lambda x: x, lambda x: x, G=np.zeros((2, 0)), H=np.zeros((2, 0)))
PUMPED = gx.System(lambda x, u: x + u, lambda x: x, G=np.zeros((2, 0)), H=np.zeros((2, 0)), m=1)
FINE = {"initial": boxes(1)[0], "y": records(3), "noise": SHARED, "u": None, "length": None, "truth": None}
NAN, INF = np.full((T, 2), np.nan), np.full((T, 2), np.inf)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"initial": np.zeros(2)}, "`initial` must be a gsisio_jax.Interval"),
        ({"noise": 0.1}, "`noise` must be a gsisio_jax.Noise"),
        ({"initial": gx.Interval.symmetric([1.0] * 3)}, r"`initial` must have shape \(2,\), or \(S, 2\)"),
        ({"y": records(3)[..., :1]}, r"`y` must have shape \(T, 2\), or \(S, T, 2\) for a batch; got \(3, 5, 1\)"),
        ({"y": np.zeros((0, 2))}, "no rows"),
        ({"y": INF}, r"`y` is infinite; mark missing entries with NaN \(at index \[0, 0\]\)"),
        ({"noise": gx.Noise(boxes(3), gx.Interval.symmetric([1.0] * 3))}, r"`noise.v` must have shape \(2,\)"),
        ({"noise": gx.Noise(SHARED.w, gx.Interval.symmetric(np.ones((1, T - 1, 2))))}, r"`noise.v`.* \(5, 2\)"),
        ({"initial": gx.Interval.unchecked(NAN, NAN)}, "bound of `initial` or `noise` is not legal.*NaN"),
        ({"initial": gx.Interval.unchecked(np.ones(2), np.zeros(2))}, "cross at index"),
        ({"noise": gx.Noise.unchecked(gx.Interval.symmetric(INF), SHARED.v)}, "must be finite"),
        ({"u": np.zeros((T, 1))}, r"`u` must have shape \(5, 0\)"),
        ({"length": np.array([1.0, 2, 3])}, "`length` must hold integers"),
        ({"length": np.array([1, 0, 3])}, "between 1 and the 5 rows"),
        ({"length": 6}, "got 6"),
        ({"truth": records(3)}, r"must be a pair \(x, d\)"),
        ({"truth": (None, None)}, "must hold the true states"),
        ({"truth": (records(3)[:, :3], None)}, r"`truth` must have shape \(5, 2\) or \(6, 2\)"),
        ({"truth": (records(3), np.zeros((T, 1)))}, r"`truth` must have shape \(4, 0\) or \(5, 0\)"),
        ({"truth": Truth(NAN)}, "`truth` is not finite"),
    ],
)
def test_numbers_and_shapes_are_checked(change, message):
    with pytest.raises(ValueError, match=f"^sweep: .*{message}"):
        prepare("sweep", PLANT, FINE | change)


def test_known_inputs_are_needed_and_finite():
    with pytest.raises(ValueError, match=r"1 known inputs; give `u` of shape \(5, 1\)"):
        prepare("sweep", PUMPED, FINE)
    with pytest.raises(ValueError, match="`u` is not finite"):
        prepare("sweep", PUMPED, FINE | {"u": np.full((3, T, 1), np.nan)})


def test_a_narrower_type_rounds_bounds_outward():
    initial = gx.Interval([0.1, -0.7], [0.1, 0.7])
    cast, dtype = prepare("sweep", PLANT, FINE | {"initial": initial, "y": gx.grid("a", np.float32(records(2)))})
    assert dtype == np.float64  # that of the wider argument, as in `estimate`
    narrow = gx.Interval(np.float32([0.1, 0.2]), np.float32([0.1, 0.3]))
    third = gx.Interval.symmetric(np.full(2, 1 / 3))
    change = {"initial": narrow, "y": gx.grid("a", np.float32(records(2))), "noise": gx.Noise(third, third)}
    cast, dtype = prepare("sweep", PLANT, FINE | change)
    assert dtype == np.float32
    assert cast["y"].value.dtype == cast["noise"].w.lower.dtype == np.float32
    assert (cast["noise"].w.upper.astype(float) >= 1 / 3).all()
    assert (cast["noise"].w.lower.astype(float) <= -1 / 3).all()
