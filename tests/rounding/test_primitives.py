"""Every function on boxes of every kind, in both precisions: no value and no derivative outside of its bounds.

The slice for every day; `test_soak` and ``python -m benchmarks.soak`` are the same checks by the hundred million."""

from __future__ import annotations

import ival
import jax
import numpy as np
import pytest
from checks import Tally, bounds_of, check, check_forms, compare
from flint import arb, ctx
from oracles.real_all import FUNCTIONS
from sampling import boxes, points

NAMES = list(FUNCTIONS)
DTYPES = [np.float64, np.float32]
# Every twelfth function in one precision, another twelfth in the other; the whole table in both is `test_soak`.
SLICES = [(np.float64, NAMES[0::12]), (np.float32, NAMES[6::12])]


@pytest.mark.plain_xla
@pytest.mark.parametrize(("dtype", "names"), SLICES, ids=["float64", "float32"])
def test_no_value_lies_outside_of_its_bounds(dtype, names):
    tally = Tally()
    for name in names:
        tally.add(check(name, 0, 512, 24, dtype))
    assert tally.misses == 0, tally.examples[:5]
    assert tally.points > 80_000
    assert tally.skipped < tally.checks // 25  # sums of exponentials, mostly: too wide in double precision


@pytest.mark.parametrize("dtype", DTYPES, ids=["float64", "float32"])
def test_rounded_to_nearest_the_same_checks_fail(dtype):
    for name in ("cube", "over 49"):
        tally = check(name, 0, 512, 24, dtype, "nearest")
        assert tally.misses > tally.checks // 100, name


def test_the_same_bounds_hold_eager_and_for_one_box():
    """Compiled, operation by operation, and without a batch: XLA rearranges each of them in its own way."""
    assert check("over 103", 1, 64, 24, np.float32, jit=False).misses == 0
    name = "x y - x"
    real, rng = FUNCTIONS[name], np.random.default_rng(3)
    lower, upper = boxes(rng, 3, np.float32, real)
    t = points(rng, lower, upper, 24, real)
    for i in range(3):
        for jit in (True, False):
            found = bounds_of(name, "outward", jit, batched=False)(lower[i], upper[i])
            batch = jax.tree.map(lambda v: np.asarray(v)[None], found)
            assert compare(name, lower[i : i + 1], upper[i : i + 1], batch, t[i : i + 1]).misses == 0


def test_forms_made_of_others_hold_too():
    """Mean-value form, decompositions: a function at single points, some of which are flushed to zero."""
    assert check_forms("reciprocal", 0, 512, 24, np.float32).misses == 0


@pytest.mark.plain_xla
def test_the_two_oracles_agree():
    """crival's intervals contain the balls' numbers, and where the function is one of crival's own nothing else."""
    rng = np.random.default_rng(6)
    ctx.prec = 256
    for name, real in FUNCTIONS.items():
        lower, upper = boxes(rng, 24, np.float64, real)
        t = points(rng, lower, upper, 8, real).reshape(-1, real.size)
        t = t[(t[:, 0] > real.domain[0]) & (t[:, 0] < real.domain[1])]
        args = [ival.Interval(side) for side in t.T]
        pairs = [(real.value(*args), real.ball), *((p(*args), b) for p, b in _partials(real))]
        for i, (found, ball) in ((i, pair) for i in range(len(t)) for pair in pairs):
            if np.isnan(found.lo[i]) or name in ("floor", "ceil", "round", "sign", "clip"):
                continue
            truth = ball(*(arb(float(v)) for v in t[i]))
            if not truth.is_finite():
                continue
            assert not truth < arb(float(found.lo[i])), (name, t[i])
            assert not truth > arb(float(found.hi[i])), (name, t[i])


def _partials(real):
    return zip(real.partials, real.ball_partials, strict=True)
