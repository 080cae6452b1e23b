"""Whatever a part of an observer can be comes back from JSON and arrays as it was, to the last bit."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays_of

from gsisio_jax import Interval
from gsisio_jax.files.tree import Unknown, decode, encode

ARRAYS = arrays_of.arrays(
    st.sampled_from([np.float64, np.float32, np.int64, np.int32, np.bool_]),
    arrays_of.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=3),
)
LEAVES = st.none() | st.booleans() | st.integers(-(2**60), 2**60) | st.floats() | st.text(max_size=5) | ARRAYS
TREES = st.recursive(
    LEAVES,
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.lists(inner, max_size=3).map(tuple)
        | st.builds(Interval.unchecked, inner, inner)
    ),
    max_leaves=8,
)


def same(a, b):
    if isinstance(a, Interval):
        return type(b) is Interval and same((a.lower, a.upper), (b.lower, b.upper))
    if isinstance(a, tuple | list):
        return type(a) is type(b) and len(a) == len(b) and all(map(same, a, b))
    if hasattr(a, "dtype"):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    return type(a) is type(b) and (a == b or (a != a and b != b)) and str(a) == str(b)


@settings(max_examples=150, deadline=None)
@given(TREES)
def test_there_and_back(tree):
    arrays = {}
    node = json.loads(json.dumps(encode(tree, "tree", arrays), allow_nan=False))
    assert same(tree, decode(node, arrays, None))
    assert arrays == {}


@settings(max_examples=100, deadline=None)
@given(st.recursive(LEAVES, lambda inner: st.dictionaries(st.sampled_from(["kind", "fields", "array", "x"]), inner)))
def test_other_entries_are_refused(node):
    if isinstance(node, dict):
        with pytest.raises(Unknown):
            decode(node, {}, None)


def test_what_has_no_form_is_an_error():
    with pytest.raises(TypeError, match=r"tree\.1 is of the class set, which has no form in a file"):
        encode((1, {2}), "tree", {})
