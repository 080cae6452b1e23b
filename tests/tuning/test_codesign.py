"""Derivatives through the gain's linear program, and what they are for: noise, region, sensors, cheapest bounds."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import systems
from jax.flatten_util import ravel_pytree
from scipy.optimize import linprog

import gsisio_jax as gx
from gsisio_jax.tuning import Allocation, optimal_widths

S1 = systems.s1()


def plant(theta):
    """The paper's example with a number in f, two in g (where the sensors look), its noise and its region free."""

    def f(x):
        return jnp.stack([theta["a"] * x[0] - 0.12 * x[1] + 1.1 * jnp.sin(0.3 * x[1] - 0.2 * x[0]),
                          -0.2 * x[0] - 0.14 * x[1]])  # fmt: skip

    def g(x):
        first = 0.2 * x[0] + theta["g"][0] * x[1] + 0.8 * jnp.sin(0.3 * x[0] + 0.2 * x[1])
        return jnp.stack([first, jnp.sin(theta["g"][1] * x[0])])

    noise = gx.Noise(gx.Interval(-theta["w"], theta["w"]), gx.Interval(-theta["v"], 0.5 * theta["v"]))
    return gx.System(f, g, G=S1.system.G, H=S1.system.H), noise, gx.Interval(-theta["region"], theta["region"])


def start():
    values = {"a": 0.6, "g": [0.65, 1.0], "w": [0.2, 0.2], "v": [0.2, 0.2], "region": [1.0, 1.5]}
    return {name: jnp.asarray(value) for name, value in values.items()}


def test_derivatives_equal_differences_of_designs_solved_anew():
    theta = start()
    flat, rebuild = ravel_pytree(theta)
    both = jax.jit(jax.jacrev(lambda q: (optimal_widths(plant, rebuild(q)),) * 2, has_aux=True))
    slopes = np.asarray(both(flat)[0])

    def widths(q):
        return both(q)[1]

    step = 1e-6
    differences = np.stack(
        [np.asarray(widths(flat + e) - widths(flat - e)) / (2 * step) for e in step * np.eye(len(flat))], axis=1
    )
    np.testing.assert_allclose(slopes, differences, rtol=1e-6, atol=1e-6)
    assert (np.abs(differences) > 0.05).all()  # every parameter matters
    system, noise, region = plant(theta)
    certificate = gx.design_observer(system, noise, region, missing=False).certificate
    solved = replace(certificate, rounds=0, excess=0.0)  # what the promise counts besides is no part of the program
    np.testing.assert_allclose(widths(flat), solved.widths(noise), rtol=1e-9)


def test_matrices_must_not_move():
    def moving(q):
        return gx.System(lambda x: 0.5 * x, lambda x: x, G=jnp.stack([q, q]), H=np.zeros((2, 1))), None, None

    with pytest.raises(ValueError, match="only f, g, the noise and the region may"):
        jax.grad(lambda q: optimal_widths(moving, q).sum())(jnp.ones(1))


# Cheapest sensors
A, C = np.array([[1.1, 0.2], [0.0, 1.05]]), np.array([[1.0, 1.0], [0.0, 1.0]])
W = 0.01
REQUIRED = np.array([0.5, 0.4])
PRICE = np.array([1.0, 0.05])


def best_width(v, state):
    """The least steady width of one state over all gains: an independent linear program.

    With p = 0 every N is allowed: x = (I - N_z C)(A x + w) + N_y (y - C x - v) + N_z (z - v). With a weight lambda per
    state and Y = diag(lambda) N, minimise 1'b subject to lambda' - 1'(growth) >= e_i': the optimum is W_i.
    """
    n = 2
    # Unknowns: lambda (n,), then Y (n, 2 n) by rows, then the absolute values of 4 n terms per row.
    terms = 4 * n
    count = n + 2 * n * n
    rows, cost = [], np.zeros(count + n * terms)
    budget = np.zeros((n, len(cost)))
    for i in range(n):
        matrix = np.zeros((terms, len(cost)))
        Y = slice(n + 2 * n * i, n + 2 * n * (i + 1))
        matrix[:, i] = np.concatenate([A[i], np.eye(n)[i], np.zeros(2 * n)])
        matrix[:, Y] = np.vstack([np.hstack([-C.T, -(C @ A).T]), np.hstack([np.zeros((n, n)), -C.T]), np.eye(2 * n)])
        size = np.zeros_like(matrix)
        first = count + terms * i
        size[:, first : first + terms] = np.eye(terms)
        rows += [matrix - size, -matrix - size]
        cost[first + n : first + terms] = np.concatenate([np.full(n, 2 * W), 2 * v, 2 * v])
        budget[:, first : first + n] += np.eye(n)
        budget[i, i] -= 1
    bounds = [(0, None)] * n + [(None, None)] * (2 * n * n) + [(0, None)] * (n * terms)
    limit = np.concatenate([np.zeros(2 * n * terms), -np.eye(n)[state]])
    found = linprog(cost, np.vstack([*rows, budget]), limit, bounds=bounds)
    return found.fun if found.status == 0 else np.inf


def brute_force():
    """The cheapest point of a grid of sensor pairs, refined once around the best: cost within the grid's step of it."""
    best, at = np.inf, np.log([0.1, 0.1])
    for reach, count in ((np.log(30.0), 13), (0.6, 9), (0.15, 9), (0.04, 5)):
        axis = np.linspace(-reach, reach, count)
        center = at
        for a in center[0] + axis:
            for b in center[1] + axis:
                v = np.exp([a, b])
                cost = (PRICE / v).sum()
                if cost < best and all(best_width(v, i) <= REQUIRED[i] for i in range(2)):
                    best, at = cost, np.array([a, b])
    return best


@pytest.fixture(scope="module")
def bought() -> Allocation:
    system = gx.System(
        lambda x: jnp.asarray(A) @ x, lambda x: jnp.asarray(C) @ x, G=np.zeros((2, 0)), H=np.zeros((2, 0))
    )
    noise = gx.Noise(gx.Interval.symmetric([W, W]), gx.Interval.symmetric([0.1, 0.1]))
    return gx.allocate(system, noise, gx.Interval.entire(2), REQUIRED, {"v": PRICE}, missing=False, window=1)


def test_allocate_meets_the_requirement_when_designed_afresh(bought):
    assert (bought.width <= REQUIRED).all()
    np.testing.assert_array_equal(bought.width, bought.observer.certificate.steady_width)
    widths = [best_width(bought.noise.v.upper, i) for i in range(2)]
    np.testing.assert_allclose(widths, bought.width, rtol=1e-6)
    assert bought.cost == pytest.approx((PRICE / bought.noise.v.upper).sum())
    assert "steady width" in str(bought)


def test_allocate_is_as_cheap_as_brute_force(bought):
    assert bought.cost == pytest.approx(brute_force(), rel=0.02)
    # Both sensors matter: with either one worth nothing the requirement fails.
    for v in ([bought.noise.v.upper[0], 10.0], [10.0, bought.noise.v.upper[1]]):
        assert any(best_width(np.array(v), i) > REQUIRED[i] for i in range(2))


def test_allocate_with_a_price_of_ones_own(bought):
    found = gx.allocate(
        bought.observer.system, bought.noise, gx.Interval.entire(2), REQUIRED,
        lambda noise: (2 * jnp.asarray(PRICE) / noise.v.width).sum(), missing=False,
    )  # fmt: skip
    assert found.cost == pytest.approx(bought.cost, rel=1e-3)


def test_allocate_says_what_cannot_be_had(bought):
    system, noise, everywhere = bought.observer.system, bought.noise, gx.Interval.entire(2)
    with pytest.raises(ValueError, match=r"cannot be certified: even 0.001 times"):
        gx.allocate(system, noise, everywhere, [1e-4, 1.0], {"v": PRICE})
    with pytest.raises(ValueError, match="nothing is for sale"):
        gx.allocate(system, noise, everywhere, REQUIRED, {"v": [0.0, 0.0]})
    with pytest.raises(ValueError, match="2 positive widths"):
        gx.allocate(system, noise, everywhere, [1.0], {"v": PRICE})
