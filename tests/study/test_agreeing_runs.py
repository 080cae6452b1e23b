"""Runs of a nonlinear plant that agree with a record are found where programs along them lead back and forth."""

import jax.numpy as jnp
import numpy as np
import pytest
import systems

from gsisio_jax.study.agreeing_runs import AgreeingRuns
from gsisio_jax.study.stretch import Sides, Stretch

ROWS = 20
BACK_AND_FORTH = (1, 7)  # records of the paper's example in which whole steps swing between two runs


@pytest.fixture(scope="module")
def example():
    case = systems.s1()
    return case, AgreeingRuns(case.system, ROWS)


@pytest.mark.parametrize("seed", BACK_AND_FORTH)
def test_a_run_is_found_where_programs_lead_back_and_forth(example, seed):
    case, runs = example
    system = case.system
    G, H, rng = np.asarray(system.G), np.asarray(system.H), np.random.default_rng(seed)
    low, high = (np.asarray(side) for side in (case.initial.lower, case.initial.upper))
    x, states, seen = rng.uniform(low, high), [], []
    for _ in range(ROWS):
        d = rng.normal(size=2)
        states.append(x)
        seen.append(np.asarray(system.measurement(jnp.asarray(x), None)) + H @ d + rng.uniform(-0.2, 0.2, 2))
        x = np.asarray(system.dynamics(jnp.asarray(x), None)) + G @ d + rng.uniform(-0.2, 0.2, 2)
    x, free = np.array(states), np.full((ROWS, 2), np.inf)
    noise = Sides(-0.2 * np.ones((ROWS, 2)), 0.2 * np.ones((ROWS, 2)))
    begin = Sides(np.vstack([low, -free[1:]]), np.vstack([high, free[1:]]))
    record = Stretch(G, H, np.array(seen), 0 * x, np.zeros((ROWS, 0)), noise, noise, begin, Sides(-free[0], free[0]))
    room = np.array([0.8, 1.2])
    near = Sides(np.maximum(x - room, begin.lower), np.minimum(x + room, begin.upper))
    found = runs.hull(record, near, ROWS - 1)
    assert (found.lower < found.upper).all()  # NaN, where no run is found
    # Every such hull of the paper's example is about as wide as the exact one.
    np.testing.assert_allclose(found.upper - found.lower, [1.19, 1.88], rtol=0.05)
