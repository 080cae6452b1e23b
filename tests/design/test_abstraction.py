"""Affine abstraction: sound everywhere, optimal against an independent solver, sigma by formula, refusals."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from oracles.inclusion_functions import values
from oracles.inclusion_points import points
from scipy import optimize

from gsisio_jax.design.abstraction import affine_abstraction
from gsisio_jax.design.abstraction_sigma import on_boxes
from gsisio_jax.examples.paper import output_map, state_map
from gsisio_jax.interval import Interval, rounding

# Name in the oracle: the same function in JAX, and where its argument starts (it is 1 wide).
SINGLE = {
    "sin": (jnp.sin, -0.3), "cos": (jnp.cos, -0.3), "exp": (jnp.exp, -0.5), "expm1": (jnp.expm1, -0.5),
    "log": (jnp.log, 0.4), "log1p": (jnp.log1p, -0.4), "sqrt": (jnp.sqrt, 0.3), "cbrt": (jnp.cbrt, 0.3),
    "square": (jnp.square, -0.6), "sinh": (jnp.sinh, -0.3), "cosh": (jnp.cosh, -0.3), "tanh": (jnp.tanh, -0.3),
    "logistic": (lax.logistic, 0.0), "erf": (lax.erf, -0.2), "atan": (jnp.arctan, -0.2), "asin": (jnp.arcsin, -0.4),
    "acos": (jnp.arccos, -0.4), "asinh": (jnp.arcsinh, -0.4), "atanh": (jnp.arctanh, -0.4), "abs": (jnp.abs, -0.3),
    "relu": (jax.nn.relu, -0.3), "softplus": (jax.nn.softplus, -0.3), "cube": (lambda t: t**3, -0.3),
    "fourth": (lambda t: t**4, -0.3), "reciprocal": (lambda t: 1 / t, 0.5), "two to the": (lambda t: 2.0**t, 0.0),
}  # fmt: skip
BOX = Interval([-0.5, 1.0], [0.5, 3.0])


def argument(x, start):
    """From `start` to `start + 1` over BOX."""
    return start + 0.5 + 0.5 * x[0] - 0.25 * (x[1] - 2.0)


def many(x):
    pair = [x[0] * x[1], x[0] / x[1], jnp.maximum(x[0], x[1] - 2), jnp.sin(x[0] * x[1])]
    return jnp.stack([f(argument(x, start)) for f, start in SINGLE.values()] + pair)


def many_truth(x):
    x = x.T
    pair = [x[0] * x[1], x[0] / x[1], np.maximum(x[0], x[1] - 2), np.sin(x[0] * x[1])]
    return np.stack([values(name, argument(x, start)) for name, (_, start) in SINGLE.items()] + pair, axis=-1)


def square(x):
    return x * x


def bent(x):
    """Three variables: planes have freedom there, and the linear program is not solved by least squares."""
    return jnp.stack([x[0] * x[1] * x[2], jnp.sin(x[0] + x[1] * x[2]), jnp.exp(x[0] - x[2])])


def kinked(x):
    return jnp.stack([jnp.abs(x[0]), jax.nn.relu(x[0] + x[1])])


BENT_BOX = Interval([-1.0, 0.0, 0.2], [1.5, 1.0, 1.0])


def cells_of(planes):
    """One entry per cell: lower, upper, then slopes and offsets."""
    n = planes.upper_slope.shape[-1]
    return zip(
        planes.region.lower.reshape(-1, n), planes.region.upper.reshape(-1, n),
        planes.lower_slope.reshape(-1, *planes.lower_slope.shape[-2:]),
        planes.upper_slope.reshape(-1, *planes.upper_slope.shape[-2:]),
        planes.lower_offset.reshape(-1, planes.lower_offset.shape[-1]),
        planes.upper_offset.reshape(-1, planes.upper_offset.shape[-1]), strict=True,
    )  # fmt: skip


def assert_sound(planes, truth, count=4000):
    """Inside, on faces and at corners; the room is that of the oracle's own rounding."""
    for low, high, lower_slope, upper_slope, lower_offset, upper_offset in cells_of(planes):
        x = points(low, high, count)
        value = truth(x)
        room = 1e-13 * (1 + np.abs(value))
        assert (x @ lower_slope.T + lower_offset <= value + room).all()
        assert (value <= x @ upper_slope.T + upper_offset + room).all()


@pytest.mark.parametrize("options", [{}, {"mesh": 2}, {"slopes": "zero"}, {"tighten": False}, {"mesh": (1, 3)}])
def test_planes_hold_everywhere(options):
    """30 functions, kinks among them."""
    planes = affine_abstraction(many, BOX, smoothness="Lipschitz", **options)
    assert_sound(planes, many_truth)
    assert (planes.gap <= planes.theta + 2 * planes.sigma + 1e-12).all()
    assert planes.printed_theta.shape == planes.theta.shape[:-1]
    if options.get("slopes") == "zero":
        assert not planes.upper_slope.any()
        seen = many_truth(points(BOX.lower, BOX.upper, 4000))
        assert (planes.upper_offset - seen.max(0) <= 0.01 * np.ptp(seen, axis=0)).all(), "tight, too"


@pytest.mark.parametrize("smoothness", ["C2", "C1", "Lipschitz"])
def test_classes_in_three_variables(smoothness):
    for tighten in (True, False):
        planes = affine_abstraction(bent, BENT_BOX, smoothness=smoothness, tighten=tighten)
        assert_sound(planes, lambda x: np.asarray(jax.vmap(bent)(x)))
        if tighten:
            assert planes.verified == "engine"
            assert (planes.gap < 1.5 * planes.theta + 0.2).all()


def test_the_root_needs_only_its_modulus_of_continuity():
    """At 0 its slope is infinite. Best parallel planes: the chord and the tangent at 1/4."""
    planes = affine_abstraction(jnp.sqrt, Interval([0.0], [1.0]), smoothness="C0", constant=np.sqrt)
    assert_sound(planes, np.sqrt)
    np.testing.assert_allclose(planes.sigma, 2 * np.sqrt(0.5), rtol=1e-12)
    np.testing.assert_allclose(planes.gap, 0.25, rtol=2e-3)
    with pytest.raises(ValueError, match="needs the derivative bounded"):
        affine_abstraction(jnp.sqrt, Interval([0.0], [1.0]))


def printed_program(vertices, value, sigma):
    """(eq:abstraction) as printed, sigma included, for all components with one theta: the optimum, by SciPy."""
    n, m = vertices.shape[1], value.shape[1]
    rows, right = [], []
    for (s, x), i in itertools.product(enumerate(vertices), range(m)):
        up, low = np.zeros((m, n + 1)), np.zeros((m, n + 1))
        up[i] = low[i] = [*x, 1.0]
        rows += [[*(0 * up).ravel(), *low.ravel(), 0.0], [*(-up).ravel(), *(0 * low).ravel(), 0.0]]
        rows += [[*up.ravel(), *(-low).ravel(), -1.0]]
        right += [value[s, i] - sigma[i], -value[s, i] - sigma[i], 2 * sigma[i]]
    cost = np.zeros(2 * m * (n + 1) + 1)
    cost[-1] = 1.0
    return optimize.linprog(cost, np.array(rows), right, bounds=(None, None)).fun


@pytest.mark.parametrize(("f", "box"), [(square, Interval([-1.0], [2.0])), (bent, BENT_BOX)])
def test_theta_is_the_optimum_of_the_printed_program(f, box):
    planes = affine_abstraction(f, box, tighten=False)
    vertices = np.array(list(itertools.product(*zip(box.lower, box.upper, strict=True))))
    value = np.asarray(jax.vmap(f)(vertices))
    each = [printed_program(vertices, value[:, [i]], planes.sigma[[i]]) for i in range(value.shape[1])]
    np.testing.assert_allclose(planes.theta, each, atol=1e-7)
    np.testing.assert_allclose(planes.gap, np.array(each) + 2 * planes.sigma, atol=1e-7)
    np.testing.assert_allclose(planes.printed_theta, printed_program(vertices, value, planes.sigma), atol=1e-7)


def test_the_parabola():
    """Chord above, tangent below: (b - a)^2/4 apart, where the printed widening gives twice as much."""
    a, b = 1.0, 3.0
    planes = affine_abstraction(square, Interval([a], [b]))
    np.testing.assert_allclose(planes.upper_slope, [[a + b]], rtol=1e-12)
    np.testing.assert_allclose(planes.lower_slope, [[a + b]], rtol=1e-12)
    np.testing.assert_allclose(planes.upper_offset, [-a * b], rtol=1e-12)
    np.testing.assert_allclose(planes.sigma, [(b - a) ** 2 / 4], rtol=1e-12)
    np.testing.assert_allclose(planes.gap, [(b - a) ** 2 / 4], rtol=1e-10)
    printed = affine_abstraction(square, Interval([a], [b]), tighten=False)
    np.testing.assert_allclose(printed.gap, [(b - a) ** 2 / 2], rtol=1e-10)
    gaps = [affine_abstraction(square, Interval([a], [b]), mesh=mesh).gap.max() for mesh in (1, 2, 4, 8)]
    np.testing.assert_allclose(np.divide(gaps[1:], gaps[:-1]), 0.25, rtol=1e-6)


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_half_the_diagonal_is_what_sigma_needs(n):
    """Reached by |x - c|^2 and by |x - c|, whose planes through the vertices are constant; and below Jung's radius."""
    half = np.linspace(1.0, 2.0, n)
    delta, box = float(np.linalg.norm(half)), Interval(-half, half)

    def ball(x):
        return jnp.sum(x * x)[None]

    smooth = affine_abstraction(ball, box, constant=2.0, tighten=False, budget=1)
    np.testing.assert_allclose(smooth.sigma, [delta**2], rtol=1e-12)
    # The error of interpolation at the center is all of sigma.
    np.testing.assert_allclose(smooth.upper_offset, 2 * smooth.sigma, rtol=1e-9)
    np.testing.assert_allclose(smooth.lower_offset, 0.0, atol=1e-9)
    for smoothness in ("Lipschitz", "C1"):
        found = affine_abstraction(ball, box, smoothness=smoothness, constant=2 * delta, budget=1)
        np.testing.assert_allclose(found.sigma, 2 * delta**2, rtol=1e-12)
    cone = affine_abstraction(lambda x: jnp.sqrt(jnp.sum(x * x) + 1e-24)[None], box, "Lipschitz", 1.0, budget=1)
    np.testing.assert_allclose(cone.lower_offset, 0.0, atol=1e-9)
    assert delta <= np.sqrt(n / (2 * (n + 1))) * 2 * delta * (1 + 1e-12)


def test_sigma_from_enclosed_derivatives():
    """As printed: norms of the enclosures. By default the sharper form, which does not depend on units."""

    def f(x):
        return jnp.stack([x[0] * x[1] + x[0] ** 2, 3 * x[0] - 4 * x[1]])

    box = Interval([0.0, 0.0], [0.2, 4.0])
    half, delta = np.array([0.1, 2.0]), np.hypot(0.1, 2.0)
    hessian = np.array([[2.0, 1.0], [1.0, 0.0]])
    printed, sharp = (affine_abstraction(f, box, tighten=tighten).sigma for tighten in (False, True))
    np.testing.assert_allclose(printed, [0.5 * np.linalg.norm(hessian, 2) * delta**2, 0.0], atol=1e-12)
    np.testing.assert_allclose(sharp, [float(0.5 * half @ hessian @ half), 0.0], atol=1e-12)
    printed, sharp = (affine_abstraction(f, box, "Lipschitz", tighten=tighten).sigma for tighten in (False, True))
    np.testing.assert_allclose(printed, [np.hypot(4.4, 0.2) * delta, 5 * delta], rtol=1e-12)
    np.testing.assert_allclose(sharp, [2.2 * half[0] + 0.1 * half[1], 0.0], atol=1e-12)


def test_who_proved_the_planes():
    box = Interval([0.0], [2.0])
    assert affine_abstraction(square, box, budget=100).verified == "engine"
    # One look at the whole box is not enough for a sine over more than a period.
    wave = {"f": lambda x: jnp.sin(4 * x), "region": box}
    few, enough = affine_abstraction(**wave, sigma=1.6, budget=1), affine_abstraction(**wave)
    assert (few.verified, enough.verified) == ("sigma", "engine")
    assert (few.gap > enough.gap + 0.1).all()
    for planes in (few, enough):
        assert_sound(planes, lambda x: np.sin(4 * x))
    with pytest.raises(ValueError, match=r"x = \[1.\] component 0 of f is .* below the plane .* larger `constant`"):
        affine_abstraction(**wave, constant=1.0)
    with pytest.raises(ValueError, match="below the plane"):
        affine_abstraction(square, box, sigma=0.5)


def test_bounds_without_the_engine():
    """An operation the engine does not know: sigma alone proves the planes, but only on the user's word."""

    def f(x):
        return lax.digamma(x)

    planes = affine_abstraction(f, Interval([1.0], [2.0]), constant=2.5)
    assert planes.verified == "sigma"
    assert_sound(planes, lambda x: np.asarray(jax.vmap(f)(x)))
    with pytest.raises(ValueError, match="digamma"):
        affine_abstraction(f, Interval([1.0], [2.0]))


@jax.custom_jvp
def hidden(x):
    return jnp.maximum(x, 0)


hidden.defjvp(lambda primals, tangents: (hidden(*primals), tangents[0]))


@pytest.mark.parametrize(
    ("f", "message"),
    [
        (kinked, "second derivative"),
        (jax.nn.relu, "second derivative"),
        (lambda x: x * jnp.where(x > 0, 1.0, -1.0), "derivative bounded"),
        (lambda x: jnp.maximum(x, x[::-1]), "second derivative"),
        (jnp.floor, "the derivative"),
        (lambda x: x * lax.stop_gradient(x), "stop_gradient"),
        (hidden, "custom derivative rule"),
        (lambda x: lax.fori_loop(0, 2, lambda _, s: hidden(s), x), "custom derivative rule"),
    ],
)
def test_functions_that_are_not_twice_differentiable(f, message):
    with pytest.raises(ValueError, match=rf"{message}.*Lipschitz"):
        affine_abstraction(f, Interval([-1.0, -0.5], [1.0, 1.0]))


def reference(planes, box):
    """Cor. 1 cell by cell."""
    found = []
    for low, high, lower_slope, upper_slope, lower_offset, upper_offset in cells_of(planes):
        a, b = np.maximum(low, box.lower), np.minimum(high, box.upper)
        if (a <= b).all():
            lower = np.minimum(lower_slope * a, lower_slope * b).sum(-1) + lower_offset
            found.append((lower, np.maximum(upper_slope * a, upper_slope * b).sum(-1) + upper_offset))
    return np.min([f[0] for f in found], axis=0), np.max([f[1] for f in found], axis=0)


@pytest.mark.parametrize("mesh", [1, (3, 1, 2)])
def test_bounds_over_boxes(mesh):
    planes = affine_abstraction(bent, BENT_BOX, mesh=mesh)
    rng = np.random.default_rng(0)
    ends = rng.uniform(BENT_BOX.lower, BENT_BOX.upper, (2, 60, 3))
    ends[0, ::7], ends[1, ::5], ends[1, ::9] = BENT_BOX.lower, BENT_BOX.upper, ends[0, ::9]
    low, high = ends.min(0), ends.max(0)
    over = jax.jit(jax.vmap(lambda planes, a, b: planes.over(Interval.unchecked(a, b)), in_axes=(None, 0, 0)))
    bounds = over(planes, low, high)
    for a, b, lower, upper in zip(low, high, bounds.lower, bounds.upper, strict=True):
        np.testing.assert_allclose((lower, upper), reference(planes, Interval(a, b)), rtol=1e-12, atol=1e-12)
        value = np.asarray(jax.vmap(bent)(points(a, b, 20)))
        assert (lower <= value + 1e-12).all()
        assert (value - 1e-12 <= upper).all()
    # Outside in one side only, infinite, or NaN: nothing is known.
    low[:4], high[:4] = BENT_BOX.lower, BENT_BOX.upper
    low[0, 1], high[1, 2], low[2, 0], high[3, 0] = -1e-9, 1 + 1e-9, -np.inf, np.nan
    low[4], high[4] = 7.0, 8.0
    bounds = over(planes, low, high)
    assert (bounds.lower[:5] == -np.inf).all()
    assert (bounds.upper[:5] == np.inf).all()
    assert np.isfinite(bounds.lower[5:]).all()


def test_gradients_and_types():
    planes = affine_abstraction(square, Interval([1.0], [3.0]), mesh=2)

    @jax.jit
    def slope(planes, ends):
        return jax.grad(lambda e: planes.over(Interval.unchecked(e[:1], e[1:])).width.sum())(ends)

    # Over the first cell alone: the slope of both planes is 3 there; the region's own bounds keep their gradient.
    np.testing.assert_allclose(slope(planes, jnp.array([1.0, 1.5])), [-3.0, 3.0])
    np.testing.assert_allclose(slope(planes, jnp.array([1.0, 3.0])), [-3.0, 5.0])
    np.testing.assert_allclose(slope(planes, jnp.array([0.0, 3.0])), [0.0, 0.0])
    small = planes.astype(np.float32)
    bounds = small.over(Interval(np.array([1.25], np.float32), np.array([2.75], np.float32)))
    assert small.gap.dtype == bounds.dtype == np.float32
    assert (bounds.lower[0], bounds.upper[0]) == pytest.approx((1.5, 7.75), rel=1e-5)


def test_regions_without_width():
    """In one component: its slope is 0 and the rest as if it were a constant. In all: the value itself."""

    def f(x):
        return jnp.stack([x[0] * x[1], jnp.abs(x[1] - 1) + x[0]])

    planes = affine_abstraction(f, Interval([0.0, 1.0], [2.0, 1.0]), mesh=2, smoothness="Lipschitz")
    assert planes.upper_slope.shape == (2, 2, 2)
    np.testing.assert_allclose(planes.upper_slope, [[[1, 0], [1, 0]]] * 2, atol=1e-12)
    assert (planes.gap < 1e-12).all()
    point = affine_abstraction(f, Interval([0.5, 1.0], [0.5, 1.0]))
    assert not point.upper_slope.any()
    np.testing.assert_allclose([point.lower_offset, point.upper_offset], [[0.5, 0.5]] * 2, atol=1e-13)


@pytest.mark.parametrize("name", ["f", "g"])
def test_derivative_bounds_of_the_example(name):
    """The paper's bounds (a, b), by constant planes: all printed ones follow but a^f_12 = -.52, which is -.45."""
    a, b = {
        "f": ([0.38, -0.45, -0.2, -0.14], [0.82, 0.21, -0.2, -0.14]),
        "g": ([-0.04, 0.49, -1.0, 0.0], [0.44, 0.81, 1.0, 0.0]),
    }[name]
    plant = state_map if name == "f" else output_map

    def derivative(x):
        return jnp.ravel(jax.jacfwd(plant)(x))

    # The derivatives are periodic: these bounds hold on all of R^2.
    planes = affine_abstraction(derivative, Interval([-20.0] * 2, [20.0] * 2), slopes="zero")
    assert planes.verified == "engine"
    np.testing.assert_allclose(planes.lower_offset, a, atol=2e-3)
    np.testing.assert_allclose(planes.upper_offset, b, atol=2e-3)
    assert (planes.lower_offset <= np.add(a, 1e-12)).all()
    assert (planes.upper_offset >= np.subtract(b, 1e-12)).all()
    # On the example's initial box they are much narrower.
    box = Interval([-1.1, -2.0], [2.0, 1.1])
    local = affine_abstraction(derivative, box, slopes="zero")
    assert local.gap[0] < 0.5 * planes.gap[0]
    assert_sound(local, lambda x: np.asarray(jax.vmap(derivative)(x)))


BAD = {
    "infinite": (dict(region=Interval([0.0], [np.inf])), "finite.*component 0"),
    "NaN": (dict(region=Interval.unchecked(np.array([np.nan]), np.array([1.0]))), "finite"),
    "crossed": (dict(region=Interval.unchecked(np.array([1.0]), np.array([0.0]))), "lower <= upper"),
    "shape": (dict(region=Interval([[0.0]], [[1.0]])), "shape"),
    "states": (dict(region=Interval(np.zeros(13), np.ones(13))), "at most 12"),
    "mesh": (dict(mesh=0), "`mesh`"),
    "mesh shape": (dict(mesh=(2, 2)), "`mesh`"),
    "mesh size": (dict(mesh=100_000), "coarser"),
    "class": (dict(smoothness="C3"), "`smoothness`"),
    "slopes": (dict(slopes="none"), "`slopes`"),
    "constant": (dict(constant=-1.0), "`constant`"),
    "constant shape": (dict(constant=[1.0, 2.0, 3.0]), "`constant`"),
    "sigma": (dict(sigma=np.nan), "`sigma`"),
    "modulus": (dict(smoothness="C0"), "omega"),
    "scalar f": (dict(f=lambda x: x[0]), "ravel"),
    "pole": (dict(f=lambda x: 1 / x), "vertex"),
}


@pytest.mark.parametrize("name", BAD)
def test_errors(name):
    options, message = BAD[name]
    with pytest.raises(ValueError, match=rf"affine_abstraction: .*{message}"):
        affine_abstraction(**({"f": square, "region": Interval([0.0], [1.0])} | options))


def test_a_box_of_another_shape():
    planes = affine_abstraction(square, Interval([0.0], [1.0]))
    with pytest.raises(ValueError, match=r"Abstraction.over: an Interval of shape \(1,\)"):
        planes.over(Interval([0.0, 0.0], [1.0, 1.0]))


def test_programs_that_round_to_nearest_are_not_kept_for_those_that_round_outward():
    """Planes of a function are certain again after somebody asked for bounds without rounding."""
    low, high = np.array([[0.1, -0.7]]), np.array([[0.3, 1.1]])

    def f(x):
        return jnp.stack([0.3 * x[0] * x[1], jnp.sin(x[0]) - x[1] / 49])

    with rounding.using("nearest"):
        plain, _ = on_boxes("bounds", f, low, high)
    certain, _ = on_boxes("bounds", f, low, high)
    assert (certain.range.lower < plain.range.lower).all()
    assert (certain.range.upper > plain.range.upper).all()
