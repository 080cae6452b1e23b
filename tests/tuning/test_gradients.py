"""Gradients of folded runs: against differences, at ties, in second order, and in the memory they take."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import systems
from gradient_points import KINDS, Checker

import gsisio_jax as gx
from gsisio_jax.tuning import fold

POINTS = 50  # a slice of the 1,000 of `python -m benchmarks.gradients`


@pytest.fixture(scope="module")
def tank() -> Checker:
    return Checker(systems.s7(), POINTS)


def test_quadruple_tank_against_central_differences(tank):
    report = tank.check(tank.draw())
    assert (report.error < 1e-4).all(), dict(zip(KINDS, report.error.max(axis=0), strict=True))
    assert report.between[report.kink].all()
    assert (~report.kink).mean() > 0.9
    # The comparison says something: every kind of argument moves the result.
    assert ((np.abs(report.central) > 1e-3).mean(axis=0) > 0.5).all()


def test_a_subgradient_at_ties(tank):
    """The initial box ends exactly where the first measurement does: the result has a kink there, and the derivative
    lies between those to both sides."""
    point = tank.draw(seed=6)
    initial, y, noise = point
    # y1 = h1 / 2 + v1: the strip of the first state.
    initial.lower[:, 0], initial.upper[:, 0] = (
        2 * (y[:, 0, 0] - noise.v.upper[:, 0]),
        2 * (y[:, 0, 0] - noise.v.lower[:, 0]),
    )
    report = tank.check(point, seed=4)
    assert report.kink[:, 0].mean() > 0.5
    assert report.between.all()


def mean_width(observer, initial, y, noise):
    return fold(observer, initial, y, lambda s, out, k: s + out.state.width.sum(), jnp.zeros(()), noise=noise) / len(y)


def test_forward_over_reverse(axis):
    """The width is piecewise linear in the bounds of a linear plant, so second derivatives are 0 but for scaling."""
    noise, y = axis.observer.noise, jnp.asarray(axis.y[0, :4])

    def of(scale):
        bounds = jax.tree.map(lambda b: scale**3 * jnp.asarray(b), noise)
        return mean_width(axis.observer, axis.initial, y, bounds)

    first, second = jax.jit(lambda s: jax.jvp(jax.grad(of), (s,), (jnp.ones(()),)))(jnp.asarray(1.1))
    assert np.isfinite([first, second]).all()
    # d/ds W(s^3) = 3 s^2 W' and, W' being constant in between, the second derivative 6 s W'.
    assert float(second) == pytest.approx(2 * float(first) / 1.1, rel=1e-9)
    assert float(first) > 0


def test_memory_grows_with_the_root_of_the_length(axis):
    """Compiled, not run: 10,000 steps of a batch of 50. Kept step by step, the boxes alone would take more."""
    steps, batch = 10_000, 50
    shape = jax.ShapeDtypeStruct((batch, steps, 2), jnp.float64)

    def loss(noise, y):
        return jax.vmap(lambda record: mean_width(axis.observer, axis.initial, record, noise))(y).mean()

    sizes = jax.jit(jax.grad(loss)).lower(axis.observer.noise, shape).compile().memory_analysis()
    record = batch * steps * 2 * 8
    assert sizes.temp_size_in_bytes < 4 * record  # copies of the record itself, and little besides


def test_fold_sees_what_estimate_returns(axis):
    y = axis.y[0, :9]
    est = gx.estimate(axis.observer, axis.initial, y, length=7)

    def update(state, out, k, row):
        return state[0] + out.state.width, jnp.minimum(state[1], out.margin), state[2] + row * (k + 1)

    start = jnp.zeros(2), jnp.asarray(jnp.inf), jnp.zeros(())
    run = jax.jit(lambda y: fold(axis.observer, axis.initial, y, update, start, length=7, rows=jnp.arange(9.0)))
    width, margin, rows = run(y)
    np.testing.assert_allclose(width, est.state.width[:7].sum(axis=0), rtol=1e-12)
    assert float(margin) == pytest.approx(float(est.margin[:7].min()))
    assert float(rows) == sum(k * (k + 1) for k in range(7))
