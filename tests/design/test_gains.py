"""The gain program: its optimum against references, against perturbation, and against an independent solver."""

import dataclasses

import numpy as np
import pytest
import systems
from scipy import optimize

import gsisio_jax as gx
from gsisio_jax import Interval
from gsisio_jax.design.assemble import Plan
from gsisio_jax.design.feedthrough import factorise
from gsisio_jax.design.gains import improve, optimal_gain, profile_gain
from gsisio_jax.design.problem import GainProblem
from gsisio_jax.observer.enclosures import slopes_of


def problem_of(case: systems.Case) -> GainProblem:
    feedthrough = factorise(case.system.H)
    u_region = case.u_region if case.u_region is not None else Interval(np.zeros(0), np.zeros(0))
    return Plan(case.system, case.noise, feedthrough, u_region).problem(
        slopes_of(case.system, feedthrough.T2, u_region)(case.region)
    )


CASES = {"s1": systems.s1(), "s4b": systems.s4(True), "s5": systems.s5(), "s7": systems.s7()}


@pytest.fixture(scope="module", params=CASES)
def solved(request):
    problem = problem_of(CASES[request.param])
    width = np.asarray(CASES[request.param].region.width)
    scale = np.where(np.isfinite(width), width, 1.0)
    return problem, optimal_gain(problem, np.ones(problem.n), scale), scale


def test_reference_widths_of_the_papers_example():
    """Theory 6: W = (1.65, 2.49) on [-1,1] x [-1.5,1.5], which fits; (1.51, 2.31) on [-1,1]^2, which does not."""
    for region, expected in (((1.0, 1.5), (1.65, 2.49)), ((1.0, 1.0), (1.51, 2.31))):
        problem = problem_of(systems.s1(region=region))
        steady = problem.steady_width(optimal_gain(problem, np.ones(2), np.ones(2)))
        assert (steady <= 1.01 * np.array(expected)).all()
        np.testing.assert_allclose(steady, expected, rtol=0.01)


def test_the_weight_does_not_matter(solved):
    problem, gain, scale = solved
    steady = problem.steady_width(gain)
    rng = np.random.default_rng(0)
    for weight in (np.linspace(1, 10, problem.n), 10.0 ** rng.uniform(-1, 1, problem.n), np.full(problem.n, 0.3)):
        other = problem.steady_width(optimal_gain(problem, weight, scale))
        np.testing.assert_allclose(other, steady, rtol=1e-4)


def test_the_equality_holds_and_the_inverse_is_nonnegative(solved):
    problem, gain, _ = solved
    assert np.abs(problem.residual(gain)[:, problem.free]).max(initial=0.0) < 1e-12
    matrix = np.eye(problem.n) - problem.implicit(gain) - problem.growth(gain)
    assert np.linalg.inv(matrix).min() > -1e-9
    np.testing.assert_allclose(matrix @ problem.steady_width(gain), problem.noise_width(gain), rtol=1e-9, atol=1e-12)


def test_a_perturbed_gain_is_never_better(solved):
    problem, gain, _ = solved
    best = problem.steady_width(improve(problem, gain))
    seen = problem.seen[:, problem.free]
    # Directions along which the equality stays true: rows of the left null space of [H; C G].
    _, singular, right = np.linalg.svd(seen.T)
    free = right[(singular > 1e-10).sum() :]
    rng = np.random.default_rng(1)
    for size in 10.0 ** rng.uniform(-6, 1, 300):
        moved = gain + size * rng.normal(size=(problem.n, len(free))) * (rng.random((problem.n, 1)) < 0.7) @ free
        assert (problem.steady_width(moved) >= best * (1 - 1e-6)).all()


def test_rows_against_an_independent_linear_program(solved):
    """profile_gain row by row against scipy's HiGHS on the same cost, posed from scratch."""
    problem, gain, scale = solved
    width = problem.steady_width(gain)
    everything = np.full(problem.columns, True)
    ours = problem.row_cost(profile_gain(problem, width, everything, scale), width)
    np.testing.assert_allclose(ours, [_row_by_highs(problem, i, width) for i in range(problem.n)], rtol=1e-6)


def _row_by_highs(problem: GainProblem, i: int, width: np.ndarray) -> float:
    """min over rows y with y [H; C G] = G_i of the row cost: every absolute value |a + M'y| becomes a variable t."""
    l, q, n = problem.l, problem.q, problem.n
    e = np.eye(n)[i]
    select_y, select_z = np.eye(problem.columns)[:l], np.eye(problem.columns)[l:]
    P = -(select_z.T @ problem.C)  # P_i = e + y P
    terms: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = [  # constant, matrix (columns, k), weights (k,)
        (e @ problem.F, P @ problem.F - select_y.T @ problem.E, width),
        (e, P, problem.F_radius @ width + problem.dw),
        (np.zeros(l), select_y.T, problem.E_radius @ width + problem.dv),
        (np.zeros(q), select_z.T[:, :q], problem.R @ width),
        (np.zeros(l), select_z.T[:, :q] @ problem.T2, problem.dv),
        (np.zeros(len(problem.ds)), select_z.T[:, q:], problem.ds),
    ]
    size = [len(weights) for _, _, weights in terms]
    total = problem.columns + sum(size)
    cost, rows, right, start = np.zeros(total), [], [], problem.columns
    for (constant, matrix, weights), k in zip(terms, size, strict=True):
        cost[start : start + k] = weights
        for sign in (1, -1):
            block = np.zeros((k, total))
            block[:, : problem.columns] = sign * matrix.T
            block[:, start : start + k] = -np.eye(k)
            rows.append(block)
            right.append(-sign * constant)
        start += k
    equality = np.zeros((problem.G.shape[1], total))
    equality[:, : problem.columns] = problem.seen.T
    bounds = [(None, None)] * problem.columns + [(0, None)] * sum(size)
    found = optimize.linprog(cost, np.vstack(rows), np.concatenate(right), equality, problem.G[i], bounds)
    assert found.status == 0
    return found.fun


def test_units_do_not_matter():
    """The same plant in other units of states and outputs has the same gain in those units."""
    problem = problem_of(systems.s1())
    x, y = np.array([1e5, 1e-3]), np.array([1e-4, 1e3])
    z = np.array([7.0])
    scaled = dataclasses.replace(
        problem,
        F=problem.F * x[:, None] / x,
        F_radius=problem.F_radius * x[:, None] / x,
        E=problem.E * y[:, None] / x,
        E_radius=problem.E_radius * y[:, None] / x,
        T2=problem.T2 * z[:, None] / y,
        C=problem.C * z[:, None] / x,
        R=problem.R * z[:, None] / x,
        G=problem.G * x[:, None],
        H=problem.H * y[:, None],
        dw=problem.dw * x,
        dv=problem.dv * y,
    )
    plain = problem.steady_width(optimal_gain(problem, np.ones(2), np.ones(2)))
    other = scaled.steady_width(optimal_gain(scaled, np.ones(2), x))
    np.testing.assert_allclose(other / x, plain, rtol=1e-6)


def test_a_bank_holds_the_certified_gain_first_and_more_behind():
    case = systems.s4(True)
    one, many = (case.design(gains=k, missing=False) for k in (1, 6))
    kept = one.gains.residual.shape[0]  # the certified one, and what designs without an output would have
    assert kept <= 2
    assert 1 < many.gains.residual.shape[0] <= 5 + kept  # equal gains are kept once
    np.testing.assert_allclose(one.gains.residual[0], many.gains.residual[0], atol=1e-12)
    with pytest.raises(ValueError, match="gains"):
        case.design(gains=0)


def test_an_input_that_is_known_precisely_is_cancelled():
    """Its sensor's noise is 10^-13 of the width of the state. A gain that left the input passed for one that cancels it
    to rounding, in units of such boxes: of the input nothing would then be known, and the design was refused."""
    system = gx.System(lambda x: 0.9 * x, lambda x: 0 * x, G=[[1.0]], H=[[1.0]])
    noise = gx.Noise(gx.Interval.symmetric([1e4]), gx.Interval.symmetric([1e-9]))
    observer = gx.design_observer(system, noise, gx.Interval.entire(1), missing=False, sweeps=1, window=1)
    np.testing.assert_array_equal(observer.gains.residual[0], [[1, -1]])
    np.testing.assert_allclose(observer.certificate.steady_width, 2e5)
    d = np.array([1e9, -1e9, 3e8, 0.0])
    x = np.concatenate([[0.0], [sum(0.9 ** (k - j) * d[j] for j in range(k + 1)) for k in range(3)]])[:, None]
    state = gx.estimate(observer, gx.Interval([-1.0], [1.0]), d[:, None]).state
    assert state.contains(x).all()
    assert (state.width <= 2e5).all()


def test_promised_widths_of_inputs_are_the_same_in_all_units():
    """A solver takes what is small for nothing: 27 and 1.8 were promised in the place of .78, or the design refused."""
    rng, promised = np.random.default_rng(0), []
    A, G, C = (np.round(rng.normal(size=shape), 3) for shape in ((3, 3), (3, 1), (3, 3)))
    for S, d in ((np.ones(3), 1.0), (np.array([1e5, 1, 1e-3]), 1.0), (np.ones(3), 1e5), (np.full(3, 1e5), 1e-3)):
        system = gx.System(
            lambda x, F=0.4 * A * S / S[:, None]: F @ x,
            lambda x, E=C * S: E @ x,
            G=G * d / S[:, None],
            H=np.zeros((3, 1)),
        )
        noise = gx.Noise(Interval.symmetric([0.5, 0.05, 0.02] / S), Interval.symmetric([0.1, 0.3, 0.05]))
        found = gx.design_observer(system, noise, Interval.entire(3), missing=False, sweeps=1, window=1).certificate
        promised.append(d * found.input_width[0])
    np.testing.assert_allclose(promised, promised[0], rtol=1e-6)
