"""One common scale of the bounds: recovered from below where a conflict can arise, with a logged truth elsewhere."""

from dataclasses import replace

import jax
import numpy as np
import pytest
import systems

import gsisio_jax as gx
from gsisio_jax.tuning import Records, tune_noise

# S5 at its full length of 200 steps, and S4b, are measured by `python -m benchmarks.tuning`.
SETTINGS = {"s5": (systems.s5, 30)}


def simulated(case: systems.Case, count: int, truth: bool = False) -> Records:
    run, _ = jax.jit(jax.vmap(case.simulate))(jax.random.split(jax.random.key(1), count))
    u = np.asarray(case.u(case.steps)) if case.system.m else None
    return Records(case.initial, np.asarray(run.y), u, x=np.asarray(run.x) if truth else None)


@pytest.mark.parametrize("name", SETTINGS)
def test_common_scale_from_twenty_records(name):
    """Within 10 % from below: the true bounds are never contradicted, and nine tenths of them are."""
    make, steps = SETTINGS[name]
    case = replace(make(), steps=steps)
    # The template is 1.3 times the truth, so the truth is not where the search starts.
    wide = gx.Noise(*(gx.Interval(1.3 * b.lower, 1.3 * b.upper) for b in (case.noise.w, case.noise.v)))
    records = simulated(case, 20)
    observer = case.design(missing=False, sweeps=1, window=1).with_rounding("nearest")
    found = tune_noise(observer, records, wide, "scale", held_out=0.0, tolerance=4e-3)
    assert 0.9 <= 1.3 * found.factors["scale"] <= 1.001
    assert found.cost <= found.start_cost


def test_with_a_logged_truth():
    """One output, one input: only containment can tell. What is held out is reported, not assumed."""
    case = systems.Case(
        gx.System(lambda x: 0.5 * x[:1], lambda x: x, G=[[1.0]], H=[[0.0]]),
        gx.Noise(gx.Interval.symmetric([0.1]), gx.Interval.symmetric([0.2])),
        gx.Interval([-1.0], [1.0]), gx.Interval([-9.0], [9.0]), 30,
        lambda key, steps: jax.random.normal(key, (steps, 1)),
    )  # fmt: skip
    observer = case.design(missing=False)
    simple = simulated(case, 10, truth=True)
    truth = np.array(simple.x)
    truth[7, 4] += 1  # of a record that is held out: farther from what was measured than the noise goes
    records = Records(gx.Interval([-2.0], [2.0]), simple.y, x=truth)  # no truth lies on an edge of the first box
    found = tune_noise(observer, records, None, {"v": "v"}, held_out=0.5)
    assert "logged truth alone" in found.explained
    # x = y - v exactly: the largest noise that the fitted records hold is the bound of v.
    largest = np.abs(records.y - records.x)[:5].max()
    assert found.noise.v.upper[0] == pytest.approx(largest, rel=1e-2)
    assert found.noise.v.upper[0] <= 0.2 * 1.001
    # Noise at its very bound leaves it by rounding.
    outside = np.abs(records.y - records.x)[5:] > found.noise.v.upper[0] * (1 + 1e-12)
    assert (found.held_out.logged, found.held_out.outside) == (5 * 30, outside.sum())
    assert found.held_out.contradicted == outside.any(axis=(1, 2)).sum() > 0
    room = tune_noise(observer, records, None, {"v": "v"}, held_out=0.5, containment_margin=0.05)
    assert room.noise.v.upper[0] == pytest.approx(largest + 0.05, rel=1e-2)
