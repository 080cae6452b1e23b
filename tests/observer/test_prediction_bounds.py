"""f(box) + B u + w bounds every state that no unknown input reaches, whatever the gains are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles.uncompiled import in_numpy

import gsisio_jax as gx
from gsisio_jax import Interval, inclusion


def _ball(radii):
    return Interval(-np.asarray(radii), np.asarray(radii))


def _attitude(q):
    """The first two columns of the rotation matrix of a unit quaternion."""
    a, b, c, d = q
    return jnp.stack([
        1 - 2 * (c * c + d * d), 2 * (b * c + a * d), 2 * (b * d - a * c),
        2 * (b * c - a * d), 1 - 2 * (b * b + d * d), 2 * (c * d + a * b),
    ])  # fmt: skip


def _record(g, x, steps, dw, dv):
    rng, g = np.random.default_rng(1), in_numpy(g)
    states, y = [], []
    for _ in range(steps):
        states.append(x)
        value = np.asarray(g(x))
        y.append(value + rng.uniform(-dv, dv, value.shape))
        x = x + rng.uniform(-dw, dw, x.shape)
    return np.array(states), np.array(y)


@pytest.mark.parametrize("region", ["bounds", 0.1, 0.4])
def test_attitude_from_six_outputs(region):
    """Identity dynamics: widths never exceed those of the box before by more than the noise."""
    bounds = _ball([1.0] * 4)
    system = gx.System(lambda q: q, _attitude, G=np.zeros((4, 0)), H=np.zeros((6, 0)), state_bounds=bounds)
    noise = gx.Noise(_ball([1e-3] * 4), _ball([0.02] * 6))
    q = np.array([0.8, 0.2, -0.3, 0.48])
    q /= np.linalg.norm(q)
    design = bounds if region == "bounds" else Interval(q - region, q + region)
    observer = gx.design_observer(system, noise, region=design, missing=False, sweeps=1, window=1)
    states, y = _record(_attitude, q, 30, 1e-3, 0.02)
    est = gx.estimate(observer, Interval(q - 0.06, q + 0.06), y)
    lower, upper = np.asarray(est.state.lower), np.asarray(est.state.upper)
    assert ((lower <= states) & (states <= upper)).all()
    width = upper - lower
    np.testing.assert_array_less(width[1:], width[:-1] + 2e-3 + 1e-12)
    assert width.max() <= 0.12 + 29 * 2e-3 + 1e-9


def _coupled(x, u):
    return jnp.stack([0.9 * x[0] + 0.1 * x[1] * x[2], jnp.tanh(x[1]) + u[0], 0.5 * x[2] + 0.1 * jnp.sin(x[0])])


@pytest.mark.parametrize("outputs", ["quadratic", "none at all", "missing"])
@pytest.mark.parametrize("reached", [(), (2,)])
def test_states_that_no_input_reaches(outputs, reached):
    """Every step lies in the plain image of the box before, in the rows of G that are zero."""
    G = np.zeros((3, 1))
    G[list(reached)] = 1.0
    H = np.array([[0.0], [1.0]])
    if not reached:
        G, H = G[:, :0], H[:, :0]
    wide = Interval([-3.0] * 3, [3.0] * 3)
    system = gx.System(
        _coupled,
        lambda x: jnp.stack([x[0] ** 2 + x[2], 0.0 * x[1]]) * (outputs != "none at all"),
        G=G, H=H, m=1, state_bounds=wide if reached else None,
    )  # fmt: skip
    dw = np.array([0.01, 0.02, 0.0])
    noise = gx.Noise(_ball(dw), _ball([0.1, 0.1]))
    observer = gx.design_observer(
        system, noise, region=_ball([1.0] * 3), u_region=_ball([1.0]), missing=False, certify=False, sweeps=1, window=1
    )
    rng = np.random.default_rng(2)
    u = rng.uniform(-1, 1, (12, 1))
    x, y, measurement, coupled = np.array([0.2, -0.1, 0.3]), [], in_numpy(system.measurement), in_numpy(_coupled)
    for k in range(12):
        y.append(measurement(x, u[k]))
        x = coupled(x, u[k])
    y = np.full((12, 2), np.nan) if outputs == "missing" else np.array(y)
    est = gx.estimate(observer, Interval([0.0, -0.3, 0.1], [0.4, 0.1, 0.5]), y, u=u)
    assert np.isfinite(est.state.width).all()
    images = in_numpy(jax.vmap(inclusion.natural(_coupled)))(est.state[:-1], u[:-1])
    others = np.array([i for i in range(3) if i not in reached])
    assert (est.state.lower[1:, others] >= (images.lower - dw - 1e-9)[:, others]).all()
    assert (est.state.upper[1:, others] <= (images.upper + dw + 1e-9)[:, others]).all()
