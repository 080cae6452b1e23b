"""The bound of a discretisation against accurate integrations of random states, and what is refused."""

import pickle

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from continuous import plants
from continuous.plants import CASES, broken, check
from oracles.uncompiled import in_numpy

import gsisio_jax as gx
from gsisio_jax import Interval
from gsisio_jax.continuous.merging import merged

DAILY = [name for name in CASES if name not in plants.SLOW]
SWING = plants.SWING


@pytest.fixture(scope="module", params=DAILY)
def case_and_model(request):
    return CASES[request.param], CASES[request.param].model()


def test_the_bound_holds_for_random_states(case_and_model):
    check(*case_and_model, 400)


def test_a_bound_that_is_too_small_is_found_out():
    case = CASES["pendulum, Euler"]
    model = case.model()
    check(case, model, 400)
    with pytest.raises(AssertionError, match="outside of its bound"):
        check(case, broken(model, 0.8), 400)


@pytest.mark.soak
def test_the_bound_holds_for_a_hundred_thousand_states():
    count = -(-100_000 // len(CASES))
    for name, case in CASES.items():
        ratio = check(case, case.model(), count, seed=1)
        print(f"{name}: bound over largest error {np.round(ratio, 2).tolist()}")


def test_boxes_hold_the_continuous_plant():
    """A pushed and shaken pendulum between samples as it is, its angle measured; every box proved."""
    case = CASES["pendulum, shaken"]
    model = case.model()
    steps, v = 40, 0.01
    system = model.system(lambda x: x[:1])
    noise = model.noise(Interval.symmetric([v]), w=Interval.symmetric([1e-4, 1e-4]))
    observer = gx.design_observer(system, noise, region=SWING, missing=False, sweeps=1)
    rng = np.random.default_rng(2)
    x, truth, seen = np.array([0.3, -0.2]), [], []
    low, high = np.asarray(case.options["disturbance"].lower), np.asarray(case.options["disturbance"].upper)
    for _ in range(steps):
        truth.append(x)
        seen.append(x[:1] + rng.uniform(-v, v, 1))
        d = rng.uniform(-2, 3)
        for _ in range(4):
            w = np.where(rng.random(2) < 0.5, low, high)
            fine = plants.solve_ivp(
                lambda t, z, d=d, w=w: np.array([z[1], -9.81 * np.sin(z[0]) - 0.3 * z[1] + d]) + w,
                (0, case.dt / 4), x, rtol=1e-12, atol=1e-13,
            )  # fmt: skip
            x = fine.y[:, -1]
    boxes = gx.estimate(observer, Interval([0.0, -0.5], [0.6, 0.5]), np.array(seen))
    assert np.asarray(boxes.state.contains(np.array(truth))).all()
    assert model.holds(boxes.state).all()
    assert (np.asarray(boxes.state.width)[-1] < [0.05, 2.0]).all()


def test_proof_ends_with_the_first_box_outside_of_the_region():
    model = CASES["motor, hold"].model()
    low, high = np.zeros((4, 2)), np.ones((4, 2)) * 0.5
    high[2] = 9
    u = np.zeros((4, 1))
    assert model.holds(Interval(low, high), u).tolist() == [True, True, True, False]
    u[0] = 5
    assert model.holds(Interval(low, high), u).tolist() == [True, False, False, False]
    with pytest.raises(ValueError, match=r"give `u` of shape \(4, 1\), got none"):
        model.holds(Interval(low, high))


def test_coefficients_of_float32_are_part_of_the_bound():
    """x' = 1000 has no error but that of dt, which float32 knows to 1.5e-9."""
    field, region = lambda x: 1000 + 0 * x, Interval([0.0], [1.0])
    off = 1000 * abs(float(np.float32(0.1)) - 0.1)
    for method in ("euler", "taylor", "zoh"):
        fine, coarse = (gx.discretize(field, 0.1, method, region=region, dtype=t) for t in ("float64", "float32"))
        assert fine.error.upper[0] < off / 100, method
        assert off < coarse.error.upper[0] < 100 * off, method
    with jax.enable_x64(False):  # then float32 is the type of the run, and of the boxes
        plain = gx.discretize(field, 0.1, "euler", region=region)
    assert plain.error.upper.dtype == np.float32
    assert off < plain.error.upper[0] < 100 * off


def test_an_exact_step_needs_no_bound_of_the_input():
    model = gx.discretize(lambda x: jnp.stack([x[1], 0 * x[0]]), 0.5, "zoh", region=SWING, G=[[0.0], [1.0]])
    np.testing.assert_allclose(model.G, [[0.125], [0.5]], atol=1e-15)
    assert model.input_bounds is None
    assert np.asarray(model.error.width).max() < 1e-14
    assert model.system(lambda x: x[:1]).p == 1


@pytest.mark.parametrize(("method", "order"), [("euler", 1), ("taylor", 3), ("rk4", 4)])
def test_the_plant_moves_on_within_a_step(method, order):
    """``x' = x`` from 1: the remainder is that of the exponential, and larger than it would be at the start alone."""
    h = 0.5
    left_out = float(mpmath.exp(h) - sum(mpmath.mpf(h) ** k / mpmath.factorial(k) for k in range(order + 1)))
    at_start = h ** (order + 1) / mpmath.factorial(order + 1)
    model = gx.discretize(lambda x: x, h, method, region=Interval([1.0], [1.0]), order=order)
    assert at_start < left_out <= model.error.upper[0] < 2 * left_out


def test_a_pole_that_a_short_step_cannot_reach_is_no_obstacle():
    """``x' = -1/(2 + x)`` is solved exactly; a tenth of the region below 0 lies its pole."""
    h, wide = 0.02, Interval([0.0], [20.0])
    model = gx.discretize(lambda x: -1 / (2 + x), h, region=wide)
    x = np.linspace(0, 20, 401)[:, None]
    found = np.sqrt((2 + x) ** 2 - 2 * h) - 2 - in_numpy(jax.vmap(model.f))(x)
    assert np.asarray(model.error.contains(found)).all()
    assert model.error.width[0] < 1e-5
    with pytest.raises(ValueError, match=r"no finite bound; give .* a shorter dt"):
        gx.discretize(lambda x: -1 / (2 + x), 2.5, region=wide)


@pytest.mark.parametrize(
    ("f", "region", "exact"),
    [
        (lambda x: jnp.clip(3 * x, -1, 1) + 2, [1.0, 2.0], lambda x: x + 0.3),  # at 0 it is another one
        (lambda x: -jnp.abs(x), [1.0, 2.0], lambda x: x * np.exp(-0.1)),
        # A slope of -1, and of -1 + 4e-10 up to x = 1: more than rounding.
        (
            lambda x: -x + 4e-10 * jnp.clip(x, -1, 1),
            [0.0, 3.0],
            lambda x: x * np.exp(-0.1) + 4e-10 * np.where(x < 1, 0.1 * np.exp(-0.1) * x, 1 - np.exp(-0.1)),
        ),
    ],
)
def test_a_hold_of_what_is_affine_only_there(f, region, exact):
    model = gx.discretize(f, 0.1, "zoh", region=Interval(*np.array(region)[:, None]))
    x = np.linspace(*region, 11)[:, None]
    left = exact(x) - in_numpy(jax.vmap(model.f))(x)
    # The oracle rounds, too; what was missed were .1 and 1e-10.
    assert np.asarray(Interval(model.error.lower - 1e-15, model.error.upper + 1e-15).contains(left)).all()
    assert model.error.width[0] < 1e-9


def test_kinks_are_bounded_on_both_sides():
    """``-|x|`` grows at a rate of 1 on one side and falls on the other: of Euler's error both signs occur."""
    model = gx.discretize(lambda x: -jnp.abs(x), 0.1, "euler", region=Interval([-1.0], [1.0]))
    x = np.linspace(-1, 1, 201)[:, None]
    exact = np.where(x > 0, x * np.exp(-0.1), x * np.exp(0.1))
    found = exact - in_numpy(jax.vmap(model.f))(x)
    assert np.asarray(model.error.contains(found)).all()
    assert found.max() > 0.9 * model.error.upper[0] > 0
    assert found.min() < 0.9 * model.error.lower[0] < 0


def test_the_map_compares_pickles_and_watches_the_field():
    model = gx.discretize(plants.pendulum, 0.01, "rk4", region=SWING, bound=False)
    again = pickle.loads(pickle.dumps(model))
    np.testing.assert_array_equal(again.f(np.ones(2)), model.f(np.ones(2)))
    rates = np.array([-1.0])
    watched = gx.discretize(lambda x: rates * x, 0.01, "euler", region=Interval([0.0], [1.0])).system(lambda x: x)
    rates[0] = 2.0
    with pytest.raises(ValueError, match="has changed since the System was made"):
        watched.check_unchanged("estimate")


def decay(x):  # substrate that is used up, with a pole below 0
    return -8 * x / (0.5 + x + x**2 / 20)


def test_bounds_that_the_plant_never_leaves_keep_the_enclosure_off_a_pole():
    region, limits = Interval([0.05], [6.0]), Interval([0.0], [np.inf])
    with pytest.raises(ValueError, match=r"has no finite bound; .* `state_bounds` that the plant never leaves"):
        gx.discretize(decay, 0.1, "euler", region=region)
    model, euler = (gx.discretize(decay, 0.1, region=region, state_bounds=limits, order=order) for order in (2, 1))
    assert model.system(lambda x: x).state_bounds is limits
    lower, wide = model.notes
    assert lower.startswith("order=1 leaves out less than order=2 (at most 0.")
    assert "wider than a hundredth of the region in state 1: " in wide
    assert "cells=4" in wide
    assert (np.asarray(euler.error.width) < 0.8 * np.asarray(model.error.width)).all()


def test_states_that_f_does_not_use_or_in_sines_alone_need_no_finite_region():
    def car(x):  # position, heading, speed
        return jnp.stack([x[2] * jnp.cos(x[1]), 0.1 * x[2], -0.05 * x[2]])

    def model(method, far, round):
        return gx.discretize(
            car, 0.1, method, region=Interval([-far, -round, 0], [far, round, 30]), G=[[0], [0], [1]],
            input_bounds=Interval([-3.0], [2.0]), cells=2,
        )  # fmt: skip

    endless, wide = model("euler", np.inf, np.inf), model("euler", 1e3, 7.0)
    np.testing.assert_allclose(endless.error.width, wide.error.width, rtol=1e-9, atol=1e-14)
    np.testing.assert_allclose(endless.G, wide.G)
    assert endless.holds(Interval([[-1e9, 50.0, 1.0]] * 2, [[1e9, 60.0, 2.0]] * 2)).all()


def test_equal_operations_are_done_once():
    def function(x):
        return jnp.sin(x) * x + jax.jit(jnp.sin)(x) + x * jnp.sin(x)

    x = np.linspace(0, 1, 3)
    found = jax.make_jaxpr(merged(function, x))(x)
    assert [e.primitive.name for e in found.jaxpr.eqns] == ["sin", "mul", "add", "add"]
    np.testing.assert_allclose(merged(function, x)(x), function(x))


@jax.custom_jvp
def _half(x):
    return 0.5 * x


_half.defjvp(lambda primals, tangents: (_half(*primals), 7.0 * tangents[0]))
ONE = Interval([-1.0], [1.0])
WRONG = {
    "infinite region": (
        lambda: gx.discretize(plants.pendulum, 0.1, region=Interval.entire(2)),
        "`region` must be finite for a bound",
    ),
    "region beyond bounds": (
        lambda: gx.discretize(plants.pendulum, 0.1, region=SWING, state_bounds=Interval([3.0, 0.0], [4.0, 1.0])),
        "no state of `region` is in `state_bounds`",
    ),
    "cells of no end": (
        lambda: gx.discretize(lambda x: jnp.sin(x), 0.1, region=Interval.entire(1), cells=[2]),
        "`cells` cut states of which `region` is finite",
    ),
    "unbounded input": (
        lambda: gx.discretize(plants.pendulum, 0.1, region=SWING, G=[[0.0], [1.0]]),
        "give `input_bounds`, a box",
    ),
    "no inputs": (lambda: gx.discretize(plants.motor, 0.1, region=SWING), "f takes u; give `u_bounds`"),
    "not affine": (
        lambda: gx.discretize(plants.pendulum, 0.1, "zoh", region=SWING),
        r'df\[1\]/dx\[0\] lies between .* Use method="taylor"',
    ),
    "affine at the start of a step": (
        lambda: gx.discretize(lambda x: 1 + jnp.maximum(x - 1, 0), 0.1, "zoh", region=Interval([0.0], [0.95])),
        r"affine where the plant may be within a step; df\[0\]/dx\[0\] lies between .* or a shorter dt",
    ),
    "affine at a point": (
        lambda: gx.discretize(jnp.sin, 0.1, "zoh", region=Interval([1.0], [1.0])),
        "affine where the plant may be within a step",
    ),
    "affine in places, and pushed": (
        lambda: gx.discretize(lambda x: -jnp.abs(x), 0.1, "zoh", region=Interval([1.0], [2.0]), G=[[1.0]]),
        "affine everywhere where an unknown input has no bound.*Give `input_bounds`",
    ),
    "jump": (lambda: gx.discretize(jnp.sign, 0.1, "euler", region=ONE), "f is not Lipschitz on .* without the jump"),
    "kink": (
        lambda: gx.discretize(lambda x: 1 - jnp.abs(x), 0.1, region=ONE),
        'derivative 1 of f .* use method="euler"',
    ),
    "infinite slope": (
        lambda: gx.discretize(lambda x: -jnp.sqrt(x), 0.1, "euler", region=Interval([0.0], [1.0])),
        "not Lipschitz",
    ),
    "escape": (
        lambda: gx.discretize(lambda x: x**3, 9.0, "euler", region=ONE),
        "the plant may reach .* no finite bound",
    ),
    "stop_gradient": (
        lambda: gx.discretize(lambda x: jax.lax.stop_gradient(x), 0.1, region=ONE),
        "f uses jax.lax.stop_gradient",
    ),
    "own derivative": (lambda: gx.discretize(lambda x: _half(x), 0.1, region=ONE), "the derivative rule of `_half`"),
    "method": (lambda: gx.discretize(jnp.sin, 0.1, "heun", region=ONE), "must be one of euler, rk4, taylor, zoh"),
    "dt": (lambda: gx.discretize(jnp.sin, -0.1, region=ONE), "positive number"),
    "order of another method": (
        lambda: gx.discretize(jnp.sin, 0.1, "rk4", region=ONE, order=3),
        'is for method="taylor"',
    ),
    "order": (lambda: gx.discretize(jnp.sin, 0.1, region=ONE, order=0), "integer from 1 on"),
    "cells": (lambda: gx.discretize(jnp.sin, 0.1, region=ONE, cells=[2, 2]), "one for each of the 1 states"),
    "region": (lambda: gx.discretize(jnp.sin, 0.1, region=[0, 1]), "`region` must be a gsisio_jax.Interval"),
    "G": (lambda: gx.discretize(jnp.sin, 0.1, region=ONE, G=[1.0]), r"finite matrix of shape \(1, p\)"),
    "disturbance": (
        lambda: gx.discretize(jnp.sin, 0.1, region=ONE, disturbance=Interval.entire(1)),
        "`disturbance` must be finite",
    ),
    "shape of f": (
        lambda: gx.discretize(lambda x: x[:1], 0.1, region=SWING),
        r"discretize: f must return an array of shape \(2,\)",
    ),
    "dtype": (lambda: gx.discretize(jnp.sin, 0.1, region=ONE, dtype=int), "must be a floating type"),
    "inputs of another size": (
        lambda: gx.discretize(plants.pendulum, 0.1, region=SWING, G=[[0.0], [1.0]], input_bounds=SWING),
        r"`input_bounds` must be a box of shape \(1,\), got shape \(2,\)",
    ),
    "no error": (
        lambda: gx.discretize(jnp.sin, 0.1, region=ONE, bound=False).noise(ONE),
        "there is no bound of the error",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_refused(name):
    call, message = WRONG[name]
    with pytest.raises(ValueError, match=message) as error:
        call()
    assert len(str(error.value)) < 400


def test_euler_needs_no_derivative_rule():
    for function in (lambda x: -jax.lax.stop_gradient(x), lambda x: -2 * _half(x)):
        model = gx.discretize(function, 0.1, "euler", region=ONE)
        assert model.error.upper[0] > 0.9 * abs(np.exp(-0.1) - 0.9)
