"""Arrays that are none: complex, masked, text, dates, columns by name; and what counts as missing."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
import scipy.sparse
from uses import (
    BOX,
    DATES,
    KEY,
    MASKED,
    NOISE,
    D,
    G,
    H,
    Own,
    Y,
    carlo,
    check_refused,
    estimate,
    f,
    g,
    plant,
    simulate,
    sweep,
    table,
)

import gsisio_jax as gx
from gsisio_jax import Interval, System
from gsisio_jax.interval.reading import read_array
from gsisio_jax.tuning import Records

READ = {
    "complex G": (plant(G=np.array([[1j], [0]]), H=[[0.0]]), "System: `G`", "complex numbers", "give .real"),
    "complex H": (plant(G=[[1.0], [0.0]], H=[[0j]]), "System: `H`", "complex numbers", "give .real"),
    "masked G": (plant(G=np.ma.array([[1.0], [2.0]], mask=[[0], [1]]), H=[[0.0]]), "`G`", "masked at index [1, 0]"),
    "sparse G": (plant(G=scipy.sparse.eye(2, 0), H=H), "System: `G`", "sparse matrix", ".toarray()"),
    "maps for matrices": (lambda o: System(G, H, f, g), "System: `G`", "got an object of type function"),
    "text in a box": (lambda o: Interval(["0"], ["1"]), "Interval: `lower`", "got text", "to_numeric"),
    "masked bound": (
        lambda o: Interval(np.ma.array([0.0], mask=True), [1.0]),
        "Interval: `lower`",
        "masked at index [0]",
    ),
    "NA bound": (lambda o: Interval(pd.Series([None], dtype="Float64"), [1.0]), "`lower`", "missing (NA)", "inf for"),
    "None bound": (lambda o: Interval([None], [1.0]), "Interval: `lower`", "missing at index [0]"),
    "no bound": (lambda o: Interval(None, 1.0), "Interval: `lower`", "nothing (None)"),
    "box of boxes": (lambda o: Interval(BOX, BOX), "Interval: `lower`", "type Interval", "the right order?"),
    "masked radius": (
        lambda o: Interval.symmetric(np.ma.array([0.1], mask=True)),
        "Interval.symmetric: `radius`",
        "mask",
    ),
    "complex bound": (lambda o: Interval([0j], [1.0]), "Interval: `lower`", "complex"),
    "large integer": (lambda o: Interval([2**53 + 1], [2**54]), "`lower`", "9007199254740993", "cannot hold", "offset"),
    "huge integer": (lambda o: Interval([0], [2**70 + 1]), "`upper`", "cannot hold"),
    "long double": (lambda o: Interval(np.longdouble([1]) / 3, [1.0]), "`lower`", "cannot hold", "astype(float)"),
    "y of dates": (estimate(BOX, pd.DataFrame({"t": DATES})), "estimate: `y`", "column 't'", "seconds"),
    "y of durations": (estimate(BOX, np.zeros((3, 1), "m8[s]")), "estimate: `y`", "dates or times", "seconds"),
    "y by name": (
        estimate(BOX, {"a": [1.0], "b": [2.0]}),
        "estimate: `y`",
        "columns by name (a, b)",
        "np.column_stack",
    ),
    "y complex": (estimate(BOX, np.zeros((3, 1), complex)), "estimate: `y`", "complex numbers", "give .real"),
    "y text": (estimate(BOX, [["1,5"]]), "estimate: `y`", "got text", "to_numeric"),
    "y text column": (
        estimate(BOX, pd.DataFrame({"a": ["x"]})),
        "estimate: `y`",
        "column 'a'",
        "type str at index [0]",
    ),
    "y ragged": (estimate(BOX, [[1.0], [1.0, 2.0]]), "estimate: `y`", "different lengths", "the same length"),
    "y ragged arrays": (estimate(BOX, [jnp.ones(1), jnp.ones(2)]), "estimate: `y`", "different shapes ((1,), (2,))"),
    "y nothing": (estimate(BOX, None), "estimate: `y`", "nothing (None)"),
    "y generator": (estimate(BOX, (k for k in range(3))), "estimate: `y`", "type generator"),
    "y of objects": (estimate(BOX, [[object()]]), "estimate: `y`", "type object at index [0, 0]"),
    "y structured": (
        estimate(BOX, np.zeros(3, [("a", float)])),
        "estimate: `y`",
        "structured",
        "structured_to_unstruct",
    ),
    "y a key": (estimate(BOX, KEY), "estimate: `y`", "a random key", "the right order?"),
    "u masked": (estimate(BOX, Y, np.ma.array(Y, mask=True)), "estimate: `u`", "masked at index [0, 0]"),
    "u is noise": (estimate(BOX, Y, NOISE), "estimate: `u`", "type Noise", "right order?"),
    "x0 masked": (simulate(0, np.ma.array([0.0, 1.0], mask=[0, 1]), D, NOISE), "simulate: `x0`", "masked at index [1]"),
    "x0 complex": (simulate(0, [0j, 0], D, NOISE), "simulate: `x0`", "complex"),
    "x0 a box": (simulate(0, BOX, D, NOISE), "simulate: `x0`", "type Interval", "right order?"),
    "x0 NaN": (simulate(0, [np.nan, 0], D, NOISE), "simulate: `x0`", "finite"),
    "d masked": (carlo(d=np.ma.array(np.zeros((3, 1)), mask=True)), "monte_carlo: `d`", "masked at index [0, 0]"),
    "runs x0 masked": (carlo(np.ma.array([0.0, 0.0], mask=[1, 0]), initial=BOX), "monte_carlo: `x0`", "masked"),
    "truth masked": (sweep(BOX, Y, truth=(np.ma.array(np.zeros((3, 2)), mask=True), None)), "sweep: `truth`", "masked"),
    "sweep y by name": (sweep(BOX, {"a": Y}), "sweep: `y`", "columns by name (a)"),
    "sweep y dates": (sweep(BOX, DATES), "sweep: `y`", "dates or times"),
    "y with a date": (estimate(BOX, [[1.0], [DATES[0]], [2.0]]), "estimate: `y`", "dates or times"),
    "time of a list of dates": (sweep(BOX, Y, time=list(DATES)), "sweep: `time`", "dates or times", "seconds"),
    "masked labels": (lambda o: gx.grid("a", Y, np.ma.array([1, 2], mask=[0, 1])), "grid: `coordinate`", "masked"),
    "records by name": (lambda o: Records(BOX, {"y": Y}), "Records: `y`", "columns by name (y)"),
    "records u masked": (
        lambda o: Records(BOX, Y, u=np.ma.array(Y, mask=True)),
        "Records: `u`",
        "masked at index [0, 0]",
    ),
    "matrix NA": (lambda o: gx.linear_image([[None, 1.0]], BOX), "linear_image: `matrix`", "missing at index [0, 0]"),
    "contains text": (lambda o: BOX.contains(["a", "b"]), "Interval.contains: `value`", "text"),
}


@table(READ)
def test_what_is_no_array_of_numbers(objects, use, words):
    check_refused(use, objects, words)


NAN = np.array([[1.0], [np.nan], [2.0]])


@pytest.mark.parametrize(
    "y",
    [
        MASKED,
        np.ma.array(MASKED.astype(int)),
        [MASKED[0], MASKED[1], MASKED[2]],
        [[1.0], [np.ma.masked], [2]],
        [[1.0], [None], [2.0]],
        [[1.0], [pd.NA], [2.0]],
        pd.DataFrame({"a": pd.array([1, None, 2], dtype="Int64")}),
        pd.DataFrame({"a": pd.array([1.0, None, 2.0], dtype="Float64")}),
        pd.DataFrame({"a": [1.0, None, 2.0]}),
        pd.DataFrame({"a": pd.Series([1, None, 2.0], dtype=object)}),
        [pd.Series([1.0], dtype="Float64"), pd.Series([None], dtype="Float64"), pd.Series([2.0])],
    ],
    ids=[
        "masked",
        "integers",
        "masked rows",
        "masked number",
        "None",
        "NA",
        "Int64",
        "Float64",
        "NaN",
        "object",
        "rows",
    ],
)
def test_whatever_is_marked_as_missing_is_missing(y):
    np.testing.assert_array_equal(read_array("estimate", "y", y, missing=True), NAN)


def test_a_masked_measurement_changes_no_box(observer):
    """The fill value -9999 lies outside of every box: as a measurement it would be a conflict."""
    boxes, masked = (gx.estimate(observer, BOX, y) for y in (NAN * 0.1, MASKED * 0.1))
    np.testing.assert_array_equal(masked.state.lower, boxes.state.lower)
    np.testing.assert_array_equal(masked.state.upper, boxes.state.upper)
    assert masked.status.tolist() == boxes.status.tolist()
    assert not masked.alarms()
    assert gx.estimate(observer, BOX, MASKED.data * 0.1).alarms()


def test_floating_arrays_are_not_copied():
    for array in (np.ones((3, 1)), np.ones((3, 1), np.float32), jnp.ones(2)):
        assert read_array("estimate", "y", array) is array
    traced = jax.make_jaxpr(lambda x: Interval([x[0], 0.0], [x[1], 1.0]).lower)(jnp.ones(2))
    assert traced.out_avals[0].shape == (2,)


def test_what_float64_holds_is_taken():
    assert read_array("a", "b", [2**53, -(2**60)]).tolist() == [2.0**53, -(2.0**60)]
    assert read_array("a", "b", np.longdouble([0.5, np.nan]))[0] == 0.5
    assert type(read_array("a", "b", np.ones((1, 1)).view(Own))) is np.ndarray
    assert read_array("a", "b", pd.Series([True, False])).tolist() == [1.0, 0.0]
