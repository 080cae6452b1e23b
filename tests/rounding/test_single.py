"""float32 end to end: sound, never promoted, and infinite where it overflows. The design is one of float64."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import single_run

import gsisio_jax as gx
from gsisio_jax import Interval

COMPILED = True


@pytest.fixture(scope="module")
def observer():
    return single_run.design()


def test_the_tightest_records_are_contained_and_nothing_is_promoted(observer):
    single_run.check_tight_records(observer, np.float32)


def test_the_same_where_64_bit_types_are_off():
    paths = os.pathsep.join([str(Path(gx.__file__).parents[1]), str(Path(__file__).parents[1])])
    done = subprocess.run(
        [sys.executable, "-W", "error", single_run.__file__],
        capture_output=True, text=True, env={**os.environ, "PYTHONPATH": paths},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


def test_what_overflows_is_unbounded_and_not_wrong(observer):
    """Measurements near the largest number of float32: the sums of the recursion go beyond it."""
    y = np.float32([[100.0, 0.0], [3e38, -3e38], [0.0, 3e38], [100.0, 0.0]])
    est = gx.estimate(observer, Interval.symmetric(np.float32([1.0, 1.0])), y)
    lower, upper = np.asarray(est.state.lower), np.asarray(est.state.upper)
    assert not np.isnan([lower, upper]).any()
    assert (lower < np.inf).all()
    assert (upper > -np.inf).all()
    assert (lower <= upper).all()
