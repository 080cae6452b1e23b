"""Outputs with a constant: the boxes are those of the plant without it, measured without it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import systems

import gsisio_jax as gx

STEPS = 12
NOISE = gx.Noise(systems.ball([0.1, 0.1]), systems.ball([0.1, 0.1]))


def f(x):
    return jnp.stack([0.5 * x[0] + 0.1 * x[1], 0.4 * x[1]])


def g(x):
    return jnp.stack([x[0], x[0] + x[1]])


def plant(output, **more):
    return gx.System(f, output, G=[[0.0], [1.0]], H=[[0.1], [0.0]], **more)


@pytest.mark.parametrize("region", [systems.ball([3.0, 3.0]), gx.Interval.entire(2)], ids=["region", "everywhere"])
def test_a_constant_in_an_affine_output_moves_no_box(region):
    constant = np.array([1.0, -7.5])
    plain, moved = plant(g), plant(lambda x: g(x) + constant)
    run = gx.simulate(plain, jax.random.key(0), np.zeros(2), np.ones((STEPS, 1)), NOISE)
    found = [
        gx.estimate(gx.design_observer(system, NOISE, region, missing=False, sweeps=1), systems.ball([1.0, 1.0]), y)
        for system, y in ((plain, run.y), (moved, run.y + constant))
    ]
    for est in found:
        assert (est.status == gx.Status.OK).all()
        assert est.state.contains(run.x[:-1], -1e-12).all()
    for one, other in zip(*(jax.tree.leaves((est.state, est.input)) for est in found), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9)


def test_a_known_input_in_an_affine_output_moves_no_box():
    u = np.sin(np.arange(STEPS))[:, None]
    plain, moved = plant(g), plant(lambda x, u: g(x) + 3 * u, m=1)
    run = gx.simulate(plain, jax.random.key(0), np.zeros(2), np.ones((STEPS, 1)), NOISE)
    region = systems.ball([3.0, 3.0])
    one = gx.estimate(
        gx.design_observer(plain, NOISE, region, missing=False, sweeps=1), systems.ball([1.0, 1.0]), run.y
    )
    observer = gx.design_observer(moved, NOISE, region, u_region=gx.Interval([-1.0], [1.0]), missing=False, sweeps=1)
    other = gx.estimate(observer, systems.ball([1.0, 1.0]), run.y + 3 * u, u)
    assert (other.status == gx.Status.OK).all()
    for a, b in zip(*(jax.tree.leaves((est.state, est.input)) for est in (one, other)), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9)
