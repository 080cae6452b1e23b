"""Whole runs with the tightest noise bounds that floating numbers leave possible; `test_soak` has all plants and the
nightly sizes."""

from __future__ import annotations

import numpy as np
import pytest
from oracles.exact_plant import is_tight, tight_records
from oracles.exact_sums import hull, product, sign
from plants import LINEAR, QUADRATIC
from runs import run

COMPILED = True

RUNS = [
    ("feedthrough of rank one", np.float64, (1.0, 1e6, 1e12)),
    ("constants", np.float32, (1.0, 1e3)),
]


@pytest.mark.parametrize(("name", "dtype", "sizes"), RUNS, ids=["float64", "float32"])
def test_no_bound_misses_the_truth(name, dtype, sizes):
    found = run(name, 0, 24, 60, dtype, sizes)
    # No alarm by rounding alone, either.
    assert (found.states, found.inputs, found.currents, found.alarms) == (0, 0, 0, 0)
    assert found.steps == 24 * 60


def test_rounded_to_nearest_the_same_run_fails():
    found = run("no unknown input", 0, 24, 60, np.float64, (1.0,), "nearest")
    assert found.states > 100


@pytest.mark.parametrize("dtype", [np.float64, np.float32], ids=["float64", "float32"])
def test_records_are_as_tight_as_fractions_say(dtype):
    rng = np.random.default_rng(0)
    for plant in (*LINEAR.values(), QUADRATIC):
        size = 0.5 if plant.squares else (1e12 if dtype == np.float64 else 1e3)
        record = tight_records(rng, plant, 4, 30, [size, 1.0 if size > 1 else 0.1] * 2, [0, 0, 1e-3, 1e-6], dtype)
        assert all(is_tight(plant, record, run, k) for run in range(4) for k in range(29))


def test_exact_sums_know_the_sign_of_what_is_left():
    rng = np.random.default_rng(1)
    a, b = (rng.standard_normal((2, 200)) * 2.0 ** rng.integers(-40, 40, (2, 200)) for _ in range(2))
    terms = [part for x, y in zip(a, b, strict=True) for part in product(x, y)]
    assert (sign([*terms, *(-part for part in terms)]) == 0).all()
    tiny = 2.0**-300
    assert (sign([*terms, np.full(200, -tiny), *(-part for part in terms)]) == -1).all()
    lower, upper = hull([*terms, np.full(200, tiny)], np.float64)
    assert (np.nextafter(lower, upper) == upper).all()
    assert (sign([*terms, -lower]) >= 0).all()
    assert (sign([*terms, -upper]) <= 0).all()
