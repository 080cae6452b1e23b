"""Gradients of folded runs: against differences, at ties, in second order, and in the memory they take."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import systems
from gradient_points import KINDS, Checker, folded
from oracles.uncompiled import in_numpy

import gsisio_jax as gx
from gsisio_jax.tuning import fold

POINTS = 50  # a slice of the 1,000 of `python -m benchmarks.gradients`


# A tank whose level is measured. The slope of the root is infinite at 0.
TANK = systems.Case(
    system=gx.System(
        lambda x: x - 0.1 * jnp.sqrt(x) + 0.2, lambda x: x, G=np.zeros((1, 0)), H=np.zeros((1, 0)),
        state_bounds=gx.Interval([0.0], [20.0]),
    ),
    noise=gx.Noise(gx.Interval.symmetric([0.05]), gx.Interval.symmetric([0.3])),
    initial=gx.Interval([3.0], [5.0]),
    region=gx.Interval([1.0], [8.0]),
    steps=6,
    d=lambda key, steps: jnp.zeros((steps, 0)),
)  # fmt: skip


@pytest.fixture(scope="module")
def tank() -> Checker:
    # The cheapest design: the default ones are in the table of `python -m benchmarks.gradients`.
    return Checker(TANK, POINTS, folded, in_numpy, sweeps=1, bounds=["affine"])


def test_against_central_differences(tank):
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
    initial.lower[:, 0] = y[:, 0, 0] - noise.v.upper[:, 0]
    initial.upper[:, 0] = y[:, 0, 0] - noise.v.lower[:, 0]
    report = tank.check(point, seed=4)
    assert report.kink[:, 0].mean() > 0.3
    assert report.between.all()


def test_finite_everywhere(tank):
    assert tank.not_finite() == []


def test_finite_everywhere_where_rows_are_solved_on_infinite_boxes():
    """The second sweep of the paper's example solves its outputs for states of which nothing is known."""
    assert Checker(systems.s1(), 24, folded, in_numpy, sweeps=2).not_finite() == []


BOX = gx.Interval([-1.0], [1.0])


def mean_width(observer, y, noise):
    return fold(observer, BOX, y, lambda s, out, k: s + out.state.width.sum(), jnp.zeros(()), noise=noise) / len(y)


def test_forward_over_reverse(small):
    """The width is piecewise linear in the bounds of a linear plant, and these grow with the cube of a scale s: so
    dW/ds = 3 s^2 W', and W' being constant in between, the second derivative is 6 s W'."""
    noise, y = small.noise, jnp.asarray(np.random.default_rng(0).uniform(-0.3, 0.3, (4, 1)))

    def of(scale):
        return mean_width(small, y, jax.tree.map(lambda b: scale**3 * jnp.asarray(b), noise))

    first, second = jax.jit(lambda s: jax.jvp(jax.grad(of), (s,), (jnp.ones(()),)))(jnp.asarray(1.1))
    assert float(first) > 0
    assert float(second) == pytest.approx(2 * float(first) / 1.1, rel=1e-9)


def kept(observer, steps):
    """Bytes that the forward run of a gradient keeps for the backward run, besides copies of the record."""
    y = jax.ShapeDtypeStruct((steps, 1), jnp.float64)
    pull = jax.eval_shape(lambda noise, y: jax.vjp(lambda n: mean_width(observer, y, n), noise)[1], observer.noise, y)
    sizes = [leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(pull)]
    assert max(sizes) <= 1.1 * 8 * steps
    return sum(size for size in sizes if size < 4 * steps)  # whatever is not one number per step


def test_memory_grows_with_the_root_of_the_length(small):
    assert kept(small, 10_000) < 2.5 * kept(small, 2_500)
    assert kept(small, 10_000) < 8 * 10_000


def test_fold_sees_what_estimate_returns(small):
    y = np.random.default_rng(1).uniform(-0.3, 0.3, (9, 1))
    est = gx.estimate(small, BOX, y, length=7)

    def update(state, out, k, row):
        return state[0] + out.state.width, jnp.minimum(state[1], out.margin), state[2] + row * (k + 1)

    start = jnp.zeros(1), jnp.asarray(jnp.inf), jnp.zeros(())
    run = jax.jit(lambda y: fold(small, BOX, y, update, start, length=7, rows=jnp.arange(9.0)))
    width, margin, rows = run(y)
    np.testing.assert_allclose(width, est.state.width[:7].sum(axis=0), rtol=1e-12)
    assert float(margin) == pytest.approx(float(est.margin[:7].min()))
    assert float(rows) == sum(k * (k + 1) for k in range(7))
