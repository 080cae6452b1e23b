"""Every function of one variable on boxes of every kind, in both precisions, against more digits."""

from __future__ import annotations

import numpy as np
import pytest
from flint import arb
from oracles.real_functions import BALLS, FUNCTIONS, LONG, ROOM
from primitives import boxes, compiled, count_misses, points

SLICE = {np.float64: (64, 24), np.float32: (64, 24)}
DTYPES = [np.float64, np.float32]


@pytest.mark.parametrize("dtype", DTYPES, ids=["float64", "float32"])
def test_no_value_lies_outside_of_its_bounds(dtype):
    checks, misses, examples = 0, 0, []
    for name in FUNCTIONS:
        found = count_misses(name, 0, *SLICE[dtype], dtype)
        checks, misses, examples = checks + found[0], misses + found[1], examples + found[2]
    assert misses == 0, examples[:5]
    assert checks > 50_000


@pytest.mark.parametrize("dtype", DTYPES, ids=["float64", "float32"])
def test_rounded_to_nearest_the_same_checks_fail(dtype):
    for name in ("cube", "over 49", "sin"):
        checks, misses, _ = count_misses(name, 0, *SLICE[dtype], dtype, "nearest")
        assert misses > checks // 100, name


def test_compiled_and_eager_bounds_both_hold():
    for name in ("over 103", "sin"):
        assert count_misses(name, 1, 256, 64, np.float32, jit=True)[1] == 0


@pytest.mark.parametrize("name", BALLS)
def test_functions_known_in_balls_only(name):
    rng, real = np.random.default_rng(5), BALLS[name]
    lower, upper = boxes(rng, 64, np.float64, real)
    natural, _, _, _, jac = compiled(name, "outward", False)(lower, upper)
    t = points(rng, lower, upper, 6, real)
    for i, j in np.ndindex(t.shape):
        for bounds, ball in ((natural, real.ball), (jac, real.ball_slope)):
            truth = ball(arb(float(t[i, j])))
            assert not truth < arb(float(bounds.lower[i])), (name, lower[i], upper[i], t[i, j])
            assert not truth > arb(float(bounds.upper[i])), (name, lower[i], upper[i], t[i, j])


def test_the_long_double_oracle_agrees_with_balls():
    rng = np.random.default_rng(6)
    if np.finfo(LONG).eps > 1e-18:
        pytest.skip("no long double of more than 53 bits on this platform")
    for name, real in FUNCTIONS.items():
        lower, upper = boxes(rng, 40, np.float64, real)
        t = points(rng, lower, upper, 4, real).ravel()
        low, high = real.domain
        t = t[(t > low) & (t < high) & (np.abs(t) < min(real.largest, 1e4)) & (np.abs(t) > 1e-300)]
        with np.errstate(all="ignore"):
            values, slopes = real.value(t.astype(LONG)), real.slope(t.astype(LONG))
        for x, value, slope in zip(t, values, slopes, strict=True):
            for found, ball in ((value, real.ball), (slope, real.ball_slope)):
                truth = ball(arb(float(x)))
                if not np.isfinite(found) or not truth.is_finite() or abs(truth) < 1e-290 or abs(truth) > 1e290:
                    continue
                high_part = float(found)
                error = abs(arb(high_part) + arb(float(found - LONG(high_part))) - truth)
                assert error < ROOM * abs(truth), (name, x)


@pytest.mark.soak
@pytest.mark.parametrize("dtype", DTYPES, ids=["float64", "float32"])
def test_a_hundred_million_checks(dtype):
    """The nightly size: compiled, every function, until 1e8 values were looked at."""
    checks, seed = 0, 100
    while checks < 1e8:
        for name in FUNCTIONS:
            found = count_misses(name, seed, 4000, 100, dtype, jit=True)
            assert found[1] == 0, found[2][:5]
            checks += found[0]
        seed += 1
    print(f"\n{np.dtype(dtype).name}: {checks} checks of {len(FUNCTIONS)} functions, no miss")
