"""A hundred million primitives and ten million observer steps, in each precision (`pytest -m soak`, about an hour)."""

from __future__ import annotations

import numpy as np
import pytest
from plants import LINEAR, linear_observer
from soak import forms, observers, primitives, sums

COMPILED = True

pytestmark = pytest.mark.soak
DTYPES = pytest.mark.parametrize("dtype", [np.float64, np.float32], ids=["float64", "float32"])


@DTYPES
def test_a_hundred_million_primitives(dtype):
    found = primitives(dtype, 1e8, 100)
    print("\n", found)
    assert found["misses"] == 0, found["examples"]


@DTYPES
def test_forms_made_of_others(dtype):
    found = forms(dtype, 1e6, 100)
    assert found["misses"] == 0, found["examples"]


@DTYPES
def test_ten_million_observer_steps(dtype):
    found = observers(dtype, 1e7, 100)
    print("\n", found)
    assert (found["misses"], found["conflicts"]) == (0, 0), found["plants"]


@DTYPES
def test_a_million_steps_with_windows(dtype):
    """The same plants; that their rows look back over several steps is what is added."""
    windows = [linear_observer(name, dtype).window for name in LINEAR if name != "no unknown input"]
    assert all(window.length == 3 for window in windows)
    found = observers(dtype, 1e6, 300)
    assert (found["misses"], found["conflicts"]) == (0, 0), found["plants"]


@DTYPES
def test_deep_sums(dtype):
    assert sums(dtype, 2e5, 100)["misses"] == 0


@DTYPES
def test_rounded_to_nearest_all_of_them_fail(dtype):
    assert primitives(dtype, 1e6, 100, "nearest")["misses"] > 1e5
    assert observers(dtype, 1e5, 100, "nearest")["misses"] > 1e4
    assert sums(dtype, 1e4, 100, "nearest")["misses"] > 1e3
