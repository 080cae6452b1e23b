"""Gradients through `estimate`: finite everywhere, and equal to central differences where the result is smooth."""

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import systems

import gsisio_jax as gx

STEPS, POINTS = 6, 100
STEP = 1e-6
NAN, INF = np.nan, np.inf


def score(observer: gx.Observer, u: Any, point: Any) -> Any:
    """Sum of the finite widths at the last step and of the finite margins."""
    initial, y, noise = point
    est = gx.estimate(observer, initial, y, u, noise)
    widths = jnp.concatenate([est.state.width[-1], est.input.width[-1], est.current_input.width[-1]])
    total = jnp.where(jnp.isfinite(widths), widths, 0).sum()
    return total + jnp.where(jnp.isfinite(est.margin), est.margin, 0).sum()


class Case:
    """A test system with a compiled batch of gradients and one of values, both over `POINTS` points."""

    def __init__(self, case: systems.Case):
        self.case = case = replace(case, steps=STEPS)
        observer, u = case.design(missing=False), jnp.asarray(case.u(STEPS))
        self.gradients = jax.jit(jax.vmap(jax.grad(partial(score, observer, u))))
        self.values = jax.jit(jax.vmap(jax.vmap(partial(score, observer, u))))
        self.estimates = jax.jit(jax.vmap(lambda point: gx.estimate(observer, point[0], point[1], u, point[2])))

    def points(self) -> Any:
        """Random initial boxes, records and noise bounds around those of the test system, as NumPy arrays."""

        @jax.vmap
        def draw(key: Any) -> Any:
            keys = jax.random.split(key, 7)

            def moved(key: Any, bound: Any) -> Any:
                return bound * jax.random.uniform(key, bound.shape, minval=0.6, maxval=1.4)

            record, _ = self.case.simulate(keys[0])
            initial, noise = self.case.initial, self.case.noise
            spread = moved(keys[1], initial.radius), moved(keys[2], initial.radius)
            box = gx.Interval(initial.center - spread[0], initial.center + spread[1])
            bounds = [
                gx.Interval(moved(a, box.lower), moved(b, box.upper))
                for a, b, box in ((keys[3], keys[4], noise.w), (keys[5], keys[6], noise.v))
            ]
            return box, record.y, gx.Noise(*bounds)

        return jax.tree.map(np.array, draw(jax.random.split(jax.random.key(5), POINTS)))


@pytest.fixture(scope="module")
def paper():
    return Case(systems.s1())


@pytest.fixture(scope="module")
def tanks():
    return Case(systems.s5())


def test_equal_to_central_differences(paper):
    """In one random direction per point and kind of argument; the rest must be kinks, where the sides differ."""
    point = paper.points()
    slopes = paper.gradients(point)
    random = np.random.default_rng(3)
    directions = [
        tuple(
            jax.tree.map(lambda x, on=(i == kind): on * random.standard_normal(x.shape), part)
            for i, part in enumerate(point)
        )
        for kind in range(3)  # initial box, record, noise
    ]
    along = jax.tree.map(lambda *d: np.stack(d, axis=1), *directions)  # (points, kinds, ...)

    def moved(by: float) -> Any:
        return jax.tree.map(lambda x, d: x[:, None] + by * d, point, along)

    behind, here, ahead = (np.asarray(paper.values(moved(by))) for by in (-STEP, 0.0, STEP))
    central, left, right = (ahead - behind) / (2 * STEP), (here - behind) / STEP, (ahead - here) / STEP
    products = jax.tree.map(lambda g, d: (np.asarray(g)[:, None] * d).reshape(POINTS, 3, -1).sum(-1), slopes, along)
    predicted = sum(jax.tree.leaves(products))
    assert np.isfinite(predicted).all()
    wrong = np.abs(predicted - central) > 1e-5 * np.maximum(np.abs(central), 1e-2)
    assert wrong.any(axis=1).sum() <= 2
    kinks = np.abs(left - right) > 1e-4 * np.abs(central)
    assert kinks[wrong].all()
    # The comparison says something: every kind of argument moves the result at most points.
    assert ((np.abs(central) > 1e-3).mean(axis=0) > 0.5).all()


def hard_points(case: Case) -> tuple[list[str], Any]:
    """Points at which a careless derivative is NaN; the rest of the batch stays random."""
    initial, y, noise = case.points()
    names: list[str] = []

    def at(name: str) -> int:
        names.append(name)
        return len(names) - 1

    y[at("one row missing"), 2] = NAN
    y[at("one entry missing"), 3, 0] = NAN
    y[at("first row missing"), 0] = NAN
    y[at("last row missing"), -1] = NAN
    y[at("all rows missing")] = NAN
    i = at("initial box infinite")
    initial.lower[i], initial.upper[i] = -INF, INF
    initial.upper[at("one side infinite"), 0] = INF
    i = at("initial box infinite, first row missing")
    initial.lower[i], initial.upper[i], y[i, 0] = -INF, INF, NAN
    i = at("initial box infinite, all rows missing")
    initial.lower[i], initial.upper[i], y[i] = -INF, INF, NAN
    i = at("initial box of zero width")
    initial.lower[i] = initial.upper[i] = case.case.initial.center
    i = at("initial box of zero width at 0")
    initial.lower[i] = initial.upper[i] = 0
    i = at("no noise")
    for bound in jax.tree.leaves(noise):
        bound[i] = 0
    i = at("no noise, initial box of zero width, all zero")
    for bound in jax.tree.leaves((initial, y, noise)):
        bound[i] = 0
    i = at("lower side at 0")
    initial.lower[i] = 0
    y[at("conflict in row 0"), 0] += 1e3
    y[at("conflict in row 3"), 3] -= 1e3
    i = at("conflict, then a missing row")
    y[i, 3], y[i, 4] = y[i, 3] + 1e3, NAN
    i = at("conflict with an infinite initial box")
    initial.lower[i], initial.upper[i], y[i, 2] = -INF, INF, 1e6
    i = at("huge initial box")
    initial.lower[i], initial.upper[i] = -1e150, 1e150
    i = at("tiny noise")
    for bound in jax.tree.leaves(noise):
        bound[i] *= 1e-12
    return names, (initial, y, noise)


@pytest.mark.parametrize("name", ["paper", "tanks"])
def test_finite_everywhere(name, request):
    case = request.getfixturevalue(name)
    names, point = hard_points(case)
    finite = np.ones(POINTS, dtype=bool)
    for leaf in jax.tree.leaves(case.gradients(point)):
        finite &= np.isfinite(np.asarray(leaf)).reshape(POINTS, -1).all(axis=1)
    assert [label for i, label in enumerate(names) if not finite[i]] == []
    assert finite.all()


@pytest.mark.parametrize("name", ["paper", "tanks"])
def test_the_hard_points_are_hard(name, request):
    """They reach conflicts, missing rows and unbounded boxes, and their boxes hold no NaN."""
    case = request.getfixturevalue(name)
    _, point = hard_points(case)
    est = case.estimates(point)
    status = np.asarray(est.status)
    for kind in (gx.Status.CONFLICT, gx.Status.MISSING, gx.Status.UNBOUNDED):
        assert (status & kind).any()
    assert not any(np.isnan(leaf).any() for leaf in jax.tree.leaves(est))
    assert (est.state.lower <= est.state.upper).all()
