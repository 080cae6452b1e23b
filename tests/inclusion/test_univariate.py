"""Every function of one variable: exact ranges, exact derivative ranges, exact rests, on every kind of interval."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from inclusion_functions import slopes, values
from inclusion_points import grid
from jax import lax
from mpmath import mp
from oracles.uncompiled import in_numpy

from gsisio_jax import inclusion
from gsisio_jax.interval import Interval

FUNCTIONS = {
    "sin": jnp.sin,
    "cos": jnp.cos,
    "tan": jnp.tan,
    "exp": jnp.exp,
    "exp2": jnp.exp2,
    "expm1": jnp.expm1,
    "log": jnp.log,
    "log1p": jnp.log1p,
    "sqrt": jnp.sqrt,
    "rsqrt": lax.rsqrt,
    "cbrt": jnp.cbrt,
    "square": jnp.square,
    "sinh": jnp.sinh,
    "cosh": jnp.cosh,
    "tanh": jnp.tanh,
    "logistic": lax.logistic,
    "erf": lax.erf,
    "erfc": lax.erfc,
    "atan": jnp.arctan,
    "asin": jnp.arcsin,
    "acos": jnp.arccos,
    "asinh": jnp.arcsinh,
    "acosh": jnp.arccosh,
    "atanh": jnp.arctanh,
    "abs": jnp.abs,
    "relu": jax.nn.relu,
    "softplus": jax.nn.softplus,
    "cube": lambda t: t**3,
    "fourth": lambda t: t**4,
    "fifth": lambda t: t**5,
    "power 2.5": lambda t: t**2.5,
    "power 0.3": lambda t: t**0.3,
    "power -1.5": lambda t: t**-1.5,
    "two to the": lambda t: 2.0**t,
    "reciprocal": lambda t: 1 / t,
    "minus second": lambda t: t**-2,
    "minus third": lambda t: t**-3,
}
DOMAINS = (
    dict.fromkeys(("log", "sqrt", "rsqrt", "power 2.5", "power 0.3", "power -1.5"), (0.0, np.inf))
    | dict.fromkeys(("asin", "acos", "atanh"), (-1.0, 1.0))
    | {"log1p": (-1.0, np.inf), "acosh": (1.0, np.inf)}
)
POLES = {"tan", "reciprocal", "minus second", "minus third"}
BOUNDED = {"sin", "cos", "tanh", "logistic", "erf", "erfc", "atan", "asin", "acos"}
# Ends of finite intervals; several lie across the turning points, one pair is far out, some are of one sign.
SPANS = [
    (-1.0, 2.0), (0.3, 0.9), (-2.5, -0.4), (-0.7, 0.7), (1.2, 8.0), (-9.0, 4.0), (0.0, 0.6), (-0.8, 0.0),
    (2.9, 3.4), (-11.0, -6.0), (0.05, 0.051),
]  # fmt: skip
INFINITE = [(-np.inf, np.inf), (-np.inf, -0.5), (-np.inf, 0.7), (0.2, np.inf), (-0.4, np.inf), (0.0, np.inf)]


def has_pole(name: str, a: float, b: float) -> bool:
    if name == "tan":
        return not np.isfinite(b - a) or bool(np.ceil((a - np.pi / 2) / np.pi) <= (b - np.pi / 2) / np.pi)
    return name in POLES and a <= 0 <= b


def cut(name: str, a: float, b: float) -> tuple[float, float] | None:
    """The part of an interval inside the domain, None if there is none."""
    low, high = DOMAINS.get(name, (-np.inf, np.inf))
    a, b = max(a, low), min(b, high)
    return (a, b) if a < b else None


def usable(name: str, spans) -> list[tuple[float, float]]:
    return [(a, b) for a, b in spans if (part := cut(name, a, b)) is not None and not has_pole(name, *part)]


def scalar(fn):
    return lambda x: fn(x[0])


def box(a, b):
    return Interval(np.array([a]), np.array([b]))


@functools.cache
def program(name):
    fn = scalar(FUNCTIONS[name])

    def call(lower, upper):
        box = Interval.unchecked(lower, upper)
        return inclusion.natural(fn)(box), inclusion.affine(fn)(box), inclusion.jacobian(fn)(box)

    return in_numpy(jax.vmap(call))


def over_all(name, spans):
    """Range, affine form and derivative on every interval; NumPy leaves, with the intervals along the first axis."""
    # Always the same number of intervals, so that everything is traced once.
    lower, upper = np.array((list(spans) * len(SPANS))[: len(SPANS)], float).T[..., None]
    return jax.tree.map(lambda leaf: np.asarray(leaf)[: len(spans)], program(name)(lower, upper))


def assert_exact(bounds, i, truth, scale, label, loose=1e-6):
    """A bound contains all values and is reached by one, up to rounding and the pitch of the grid."""
    low, high, least, most = bounds.lower[i], bounds.upper[i], truth.min(), truth.max()
    assert low <= least + 1e-12 * scale, (label, low, least)
    assert most <= high + 1e-12 * scale, (label, most, high)
    assert low == least or low >= least - loose * scale, (label, low, least)
    assert high == most or high <= most + loose * scale, (label, most, high)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_ranges_and_rests_are_exact_on_finite_intervals(name):
    spans = usable(name, SPANS)
    natural, form, _ = over_all(name, spans)
    for i, (a, b) in enumerate(spans):
        t = grid(*cut(name, a, b))
        truth = values(name, t)
        assert_exact(natural, i, truth, np.abs(truth[np.isfinite(truth)]).max(), (a, b))
        slope = form.slope[i, 0]
        rest = truth - slope * t
        scale = np.abs(rest[np.isfinite(rest)]).max() + abs(slope) * np.abs(t).max()
        # The rest of a wave is the sum of an even and an odd part, each exact.
        assert_exact(form.offset, i, rest, scale, (a, b), 0.1 if name in ("sin", "cos") else 1e-6)
        assert form.offset.width[i] <= natural.width[i] * (1 + 1e-12)
        assert form.range.lower[i] >= natural.lower[i]
        assert form.range.upper[i] <= natural.upper[i]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_derivative_ranges_are_exact_on_finite_intervals(name):
    spans = usable(name, SPANS)
    _, _, jac = over_all(name, spans)
    for i, (a, b) in enumerate(spans):
        part = cut(name, a, b)
        truth, ends = slopes(name, grid(*part, 4001)[1:-1]), slopes(name, np.array(part))
        low, high, scale = jac.lower[i, 0], jac.upper[i, 0], np.abs(truth).max()
        assert low <= truth.min() + 1e-9 * scale, (a, b)
        assert truth.max() <= high + 1e-9 * scale, (a, b)
        # Infinite is right only where the derivative is infinite at an end of the domain, or inside (cbrt).
        if name in ("abs", "relu") and 0 in part:
            left = -1.0 if name == "abs" else 0.0
            one_side = (1.0, 1.0) if part[1] > 0 else (left, left) if part[0] < 0 else (left, 1.0)
            assert (low, high) == one_side, "a box that ends at a kink knows its own side"
            continue
        steep = not np.isfinite(ends).all() or (name == "cbrt" and a <= 0 <= b)
        assert low >= truth.min() - 2e-2 * scale or (steep and low == -np.inf), (a, b, low)
        assert high <= truth.max() + 2e-2 * scale or (steep and high == np.inf), (a, b, high)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_infinite_intervals(name):
    spans = [(a, b) for a, b in INFINITE if cut(name, a, b) is not None]
    natural, form, jac = over_all(name, spans)
    for bounds in (natural, form.range, form.offset, jac):
        assert (bounds.lower <= bounds.upper).all()
        assert (bounds.lower < np.inf).all()
        assert (bounds.upper > -np.inf).all()
    assert np.isfinite(form.slope).all()
    for i, (a, b) in enumerate(spans):
        t = grid(*cut(name, a, b), 2001)
        truth, slope = values(name, t), form.slope[i, 0]
        t, truth = t[~np.isnan(truth)], truth[~np.isnan(truth)]
        ulps = 1e-12 * (1 + np.abs(truth))
        assert (natural.lower[i] - ulps <= truth).all(), (a, b)
        assert (truth <= natural.upper[i] + ulps).all(), (a, b)
        rest, slack = truth - slope * t, ulps + 1e-12 * np.abs(slope * t)
        assert (form.offset.lower[i] - slack <= rest).all(), (a, b)
        assert (rest <= form.offset.upper[i] + slack).all(), (a, b)
        if not has_pole(name, *cut(name, a, b)):
            steepness = slopes(name, t[1:-1])
            assert jac.lower[i, 0] <= steepness.min() + 1e-12, (a, b)
            assert steepness.max() <= jac.upper[i, 0] + 1e-12, (a, b)
        if name in BOUNDED:
            assert_exact(natural, i, truth, 1e3, (a, b))
            assert np.isfinite(form.offset.width[i])


@pytest.mark.parametrize("name", FUNCTIONS)
def test_zero_width_gives_value_and_derivative(name):
    spans = [(t, t) for t in (0.3, -0.6, 0.8, 1.7, 5.1) if cut(name, t, t + 1e-9) is not None]
    t = np.array(spans)[:, 0]
    value, slope = values(name, t), slopes(name, t)
    natural, form, jac = over_all(name, spans)
    for side in ("lower", "upper"):
        np.testing.assert_allclose(getattr(natural, side), value, rtol=1e-13)
        np.testing.assert_allclose(getattr(jac, side)[:, 0], slope, rtol=1e-12)
        # Where rounding leaves the rest a width, slope 0 with its width 0 may have been taken.
        rest = value - form.slope[:, 0] * t
        np.testing.assert_allclose(getattr(form.offset, side), rest, atol=1e-12 * np.abs(slope * t).max())
    flat = form.slope[:, 0] == 0
    np.testing.assert_allclose(form.slope[~flat, 0], slope[~flat], rtol=1e-12)
    assert not flat.all() or (slope == 0).all()


@pytest.mark.parametrize("name", ["tan", "reciprocal", "minus third"])
def test_poles_leave_nothing_known(name):
    bounds = inclusion.natural(scalar(FUNCTIONS[name]))(box(-1.0, 2.0))
    jac = inclusion.jacobian(scalar(FUNCTIONS[name]))(box(-1.0, 2.0))
    assert (bounds.lower, bounds.upper, jac.lower, jac.upper) == (-np.inf, np.inf, -np.inf, np.inf)


def test_one_sided_poles():
    reciprocal = inclusion.natural(lambda x: 1 / x)
    np.testing.assert_array_equal(reciprocal(box(0.0, 2.0)).lower, [0.5])
    np.testing.assert_array_equal(reciprocal(box(0.0, 2.0)).upper, [np.inf])
    np.testing.assert_array_equal(reciprocal(box(-4.0, 0.0)).upper, [-0.25])
    even = inclusion.natural(lambda x: x**-2)(box(-4.0, 2.0))
    np.testing.assert_array_equal([even.lower[0], even.upper[0]], [1 / 16, np.inf])


@pytest.mark.parametrize(("fn", "a", "b", "lower", "upper"), [
    (jnp.sqrt, -1.0, 4.0, 0.0, 2.0),
    (jnp.sqrt, 0.0, 4.0, 0.0, 2.0),
    (jnp.log, -1.0, np.e, -np.inf, 1.0),
    (jnp.log, 0.0, 1.0, -np.inf, 0.0),
    (jnp.sqrt, -2.0, -1.0, -np.inf, np.inf),
    (jnp.log, -2.0, -1.0, -np.inf, np.inf),
    (jnp.arcsin, 0.5, 3.0, np.pi / 6, np.pi / 2),
    (jnp.arccosh, -3.0, 1.0, 0.0, 0.0),
])  # fmt: skip
def test_domains(fn, a, b, lower, upper):
    bounds = inclusion.natural(fn)(box(a, b))
    np.testing.assert_allclose([bounds.lower[0], bounds.upper[0]], [lower, upper], atol=1e-15)
    form = inclusion.affine(fn)(box(a, b))
    np.testing.assert_allclose([form.range.lower[0], form.range.upper[0]], [lower, upper], atol=1e-15)
    assert np.isfinite(form.slope).all()
    assert not np.isnan(form.offset.lower).any()


def test_derivatives_in_closed_form():
    tanh = inclusion.jacobian(jnp.tanh)(box(-1.0, 2.0))
    np.testing.assert_allclose([tanh.lower[0, 0], tanh.upper[0, 0]], [1 - np.tanh(2) ** 2, 1], rtol=1e-14)
    root = inclusion.jacobian(jnp.sqrt)(box(0.0, 4.0))
    np.testing.assert_allclose([root.lower[0, 0], root.upper[0, 0]], [0.25, np.inf])
    bend = inclusion.jacobian(jax.nn.softplus)(box(-1.0, 2.0))
    np.testing.assert_allclose([bend.lower[0, 0], bend.upper[0, 0]], 1 / (1 + np.exp([1.0, -2.0])), rtol=1e-14)


def test_wide_sigmoid_is_cut_by_a_secant():
    # The tangent at the middle would leave a rest of width 4; slope 0 one of width 2.
    form = inclusion.affine(scalar(jnp.tanh))(box(-3.0, 3.0))
    assert form.offset.width < 0.9


@pytest.mark.parametrize(("function", "phase"), [(jnp.sin, 0.5), (jnp.cos, 0.0)], ids=["sin", "cos"])
@pytest.mark.parametrize("side", [1, -1], ids=["crest", "trough"])
def test_a_crest_is_found_and_none_is_made_up(function, phase, side):
    """Boxes of all widths that end next to a crest, or beyond it: the largest value is the true one, padded."""
    rng = np.random.default_rng(0)
    with mp.workdps(60):
        half = +mp.pi
        crests = [(phase + 2 * int(k) + (side < 0)) * half for k in rng.integers(-2000, 2000, 300)]
        ends = np.array([float(c) for c in crests])
        width, near = 10 ** rng.uniform(-9, 0.4, 300), rng.integers(-3, 4, 300) * np.spacing(abs(ends))
        ends = ends + np.where(rng.random(300) < 0.5, near, width * rng.random(300))
        starts = ends - width
        true = [
            mp.mpf(1) if mp.mpf(b) >= c else side * (mp.sin if function is jnp.sin else mp.cos)(mp.mpf(b))
            for b, c in zip(ends.tolist(), crests, strict=True)
        ]
    method = inclusion.natural(lambda x: side * function(x[0]), rounding="outward")
    bounds = in_numpy(jax.vmap(method))(Interval(starts[:, None], ends[:, None]))
    pad = 40 * np.finfo(float).eps * (2 + abs(ends))
    for upper, value, most in zip(np.asarray(bounds.upper).tolist(), true, pad.tolist(), strict=True):
        assert value <= upper <= value + most
