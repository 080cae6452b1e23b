"""Corollary 1: any subset of the bounding methods, intersected, in functions and in observers."""

from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import systems
from oracles.uncompiled import in_numpy

import gsisio_jax as gx
from gsisio_jax import Interval
from gsisio_jax.design.abstraction import affine_abstraction
from gsisio_jax.inclusion.intersection import METHODS, bound

REGION = Interval([-1.5, -2.0], [1.0, 2.5])


def curved(x, u):
    return jnp.stack([jnp.sin(x[0]) * x[1] + u[0], jnp.exp(0.5 * x[1]) - x[0] ** 2, x[0] - 2 * x[1]])


@pytest.fixture(scope="module")
def planes():
    both = Interval(np.append(REGION.lower, -1.0), np.append(REGION.upper, 1.0))
    return affine_abstraction(lambda z: curved(z[:2], z[2:]), both)


@pytest.fixture(scope="module")
def forms(planes):
    """The bounds of 40 boxes by every subset that is looked at below."""
    random = np.random.default_rng(0)
    corners = np.sort(random.uniform(REGION.lower, REGION.upper, (40, 2, 2)), axis=1)
    corners[0] = REGION.lower, REGION.upper
    corners[1:4, 1] = corners[1:4, 0]  # points
    boxes, u = Interval(corners[:, 0], corners[:, 1]), random.uniform(-1, 1, (40, 1))
    subsets = [(name,) for name in METHODS] + [("affine", "natural"), ("natural", "mean_value"), METHODS]
    return boxes, u, {s: one_by_one(bound(curved, s, planes), boxes, u) for s in subsets}


def one_by_one(bounds, boxes, u):
    """`jax.vmap` of bounds, whose trace takes twice as long as that of one box."""
    program = in_numpy(bounds)
    found = [program(boxes[i], u[i]) for i in range(len(u))]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *found)


def samples(boxes, u):
    """Grid points of every box, faces and corners included, and f there."""
    share = np.linspace(0, 1, 9)
    grid = np.stack(np.meshgrid(share, share), -1).reshape(-1, 2)
    points = boxes.lower[:, None] + grid * (boxes.upper - boxes.lower)[:, None]
    points = np.where(grid == 1, boxes.upper[:, None], points)
    return points, in_numpy(jax.vmap(lambda xs, v: jax.vmap(lambda x: curved(x, v))(xs)))(points, u)


def test_every_subset_contains_the_function(forms):
    boxes, u, found = forms
    points, values = samples(boxes, u)
    for form in found.values():
        slack = 1e-12 * (1 + np.abs(values))
        assert (form.range.lower[:, None] - slack <= values).all()
        assert (values <= form.range.upper[:, None] + slack).all()
        rest = values - np.einsum("bij,bkj->bki", form.slope, points)
        assert (form.offset.lower[:, None] - slack <= rest).all()
        assert (rest <= form.offset.upper[:, None] + slack).all()


def test_the_intersection_is_no_wider_than_its_parts(forms):
    _, _, found = forms
    for whole, part in combinations(found, 2):
        larger, smaller = (whole, part) if len(whole) > len(part) else (part, whole)
        if set(smaller) < set(larger):
            assert (found[larger].range.width <= found[smaller].range.width + 1e-12).all()


def test_outside_its_region_an_abstraction_says_nothing(planes):
    wide = Interval(REGION.lower - 0.1, REGION.upper)
    assert np.isinf(in_numpy(bound(curved, ["abstraction"], planes))(wide, np.zeros(1)).range.width).all()
    assert np.isfinite(in_numpy(bound(curved, ["abstraction", "natural"], planes))(wide, np.zeros(1)).range.width).all()


def test_bad_choices():
    with pytest.raises(ValueError, match=r"`bounds` must name some of affine.*'tangent'"):
        bound(curved, ["natural", "tangent"])
    with pytest.raises(ValueError, match='"abstraction" needs an `Abstraction`'):
        bound(curved, ["abstraction"])


def test_observers_with_other_bounds_still_contain_the_truth():
    """Each on its own: without the default ones the boxes are wider, never wrong."""
    case = systems.s1()
    small = Interval([-0.1, -0.1], [0.1, 0.1])
    sims = jax.vmap(lambda key: gx.simulate(case.system, key, jnp.zeros(2), jnp.zeros((20, 2)), case.noise))(
        jax.random.split(jax.random.key(1), 50)
    )
    d, width = np.zeros((50, 20, 2)), {}
    for methods in (("affine", "natural"), ("natural", "abstraction"), ("decomposition", "mean_value")):
        observer = case.design(bounds=methods, missing=False, certify=False).with_rounding("nearest")
        estimates = jax.vmap(lambda y: gx.estimate(observer, small, y))(sims.y)  # noqa: B023
        assert estimates.state.contains(sims.x[:, :-1], -1e-12).all()
        assert estimates.input.contains(d[:, :-1], -1e-12).all()
        assert not (np.asarray(estimates.status) & gx.Status.CONFLICT).any()
        width[methods] = np.asarray(estimates.state.width[:, -1]).mean()
    assert all(value >= 0.999 * width["affine", "natural"] for value in width.values())
