"""The default against exact hulls: a plant of `benchmarks.random_plants`, and the programs that say what is exact."""

import jax
import numpy as np
from oracles.record_hull import exact_hull

import gsisio_jax as gx
from benchmarks.error_hulls import error_hulls
from benchmarks.random_plants import random_plant
from benchmarks.tightness import rotation_input
from benchmarks.tightness_default import drawn_noise, run_of
from gsisio_jax import Interval

STEP = 12


def _runs(plant, vertices=False, count=3):
    noise = [drawn_noise(plant, seed, vertices) for seed in range(count)]
    x, y = (np.stack(part) for part in zip(*(run_of(plant, *one, False) for one in noise), strict=True))
    return noise, x, y


def test_hulls_in_errors_are_those_of_the_record():
    plant = rotation_input()
    noise, _, y = _runs(plant)
    found = error_hulls(plant, noise, STEP)
    for sides, record in zip(found, y, strict=True):
        exact = exact_hull(plant.A, plant.C, plant.w, plant.v, plant.start, record[: STEP + 1], plant.G, plant.H)
        np.testing.assert_allclose(sides[1] - sides[0], exact, rtol=1e-7)
        assert (sides[0] <= 1e-9).all()
        assert (sides[1] >= -1e-9).all()


def test_a_random_plant_is_tight_by_default():
    """One step with one gain is 11 to 15 % wider than the hull here."""
    plant = random_plant(0)
    system = gx.System(lambda x: plant.A @ x, lambda x: plant.C @ x, G=plant.G, H=plant.H)
    noise = gx.Noise(Interval.symmetric(plant.w), Interval.symmetric(plant.v))
    observer = gx.design_observer(system, noise, Interval.entire(len(plant.A)), missing=False)
    drawn, x, y = _runs(plant, count=6)
    start = Interval.symmetric(plant.start)
    state = jax.jit(jax.vmap(lambda y: gx.estimate(observer, start, y).state))(y)
    assert state.contains(x).all()
    hull = np.diff(error_hulls(plant, drawn, STEP), axis=1)[:, 0]
    ratio = np.asarray(state.width)[:, STEP] / hull
    assert (ratio > 1 - 1e-9).all()
    assert (ratio.mean(0) < 1.04).all()
