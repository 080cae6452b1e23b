"""Atoms against exact values: at points of boxes of every size, in both precisions, rounded outward."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from flint import arb, arb_poly, ctx, fmpq
from oracles.uncompiled import in_numpy

from gsisio_jax.inclusion.atom_bounds import BoxOfAtoms
from gsisio_jax.inclusion.atom_forms import from_node
from gsisio_jax.inclusion.atom_values import rule
from gsisio_jax.inclusion.atoms import Rows, States
from gsisio_jax.inclusion.expansion import Expansion
from gsisio_jax.inclusion.reader import expand
from gsisio_jax.inclusion.rules.sincos import _COSINE, _SINE, LIMIT, SLOT, half_sin_cos, sin_cos
from gsisio_jax.inclusion.rules.trig import wave_atom, wave_point
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval

PRECISIONS = [np.float64, np.float32]
mp.mp.dps = 60


def _positive(function):
    return lambda x, y: function(x) if x > 0 else None


# Name, function of numbers, the same in mpmath: None outside of the domain.
FUNCTIONS = [
    ("sqrt", lambda x, y: jnp.sqrt(x), lambda x, y: mp.sqrt(x) if x >= 0 else None),
    ("exp", lambda x, y: jnp.exp(x), lambda x, y: mp.exp(x)),
    ("log", lambda x, y: jnp.log(x), _positive(mp.log)),
    ("reciprocal", lambda x, y: 1 / x, lambda x, y: 1 / x if x else None),
    ("square", lambda x, y: x * x, lambda x, y: x * x),
    ("cube", lambda x, y: x**3, lambda x, y: x**3),
    ("tanh", lambda x, y: jnp.tanh(x), lambda x, y: mp.tanh(x)),
    ("atan", lambda x, y: jnp.arctan(x), lambda x, y: mp.atan(x)),
    ("logistic", lambda x, y: jax.nn.sigmoid(x), lambda x, y: 1 / (1 + mp.exp(-x))),
    ("log1p", lambda x, y: jnp.log1p(x), lambda x, y: mp.log1p(x) if x > -1 else None),
    ("rsqrt", lambda x, y: jax.lax.rsqrt(x), _positive(lambda x: 1 / mp.sqrt(x))),
    ("x^4", lambda x, y: x**4, lambda x, y: x**4),
    ("sin", lambda x, y: jnp.sin(x), lambda x, y: mp.sin(x)),
    ("cos", lambda x, y: jnp.cos(x), lambda x, y: mp.cos(x)),
    ("x y", lambda x, y: x * y, lambda x, y: x * y),
    ("x (1 - x)", lambda x, y: x * (1 - x), lambda x, y: x * (1 - x)),
    (
        "sqrt(2 x + y / 3 + 1)",
        lambda x, y: jnp.sqrt(2 * x + y / 3 + 1),
        lambda x, y: mp.sqrt(2 * x + y / 3 + 1) if 2 * x + y / 3 + 1 > 0 else None,
    ),
    ("norm", lambda x, y: jnp.sqrt(x * x + y * y), lambda x, y: mp.sqrt(x * x + y * y)),
    ("x sin y", lambda x, y: x * jnp.sin(y), lambda x, y: x * mp.sin(y)),
    ("sin(x y)", lambda x, y: jnp.sin(x * y), lambda x, y: mp.sin(x * y)),
    ("exp(-x^2)", lambda x, y: jnp.exp(-x * x), lambda x, y: mp.exp(-x * x)),
    ("log(1 + x^2)", lambda x, y: jnp.log(1 + x * x), lambda x, y: mp.log(1 + x * x)),
    ("x / y", lambda x, y: x / y, lambda x, y: x / y if y else None),
]


def _all(x, u):
    return jnp.stack([f(x[0], x[1]) for _, f, _ in FUNCTIONS])


def _expansion(dtype) -> Expansion:
    found = expand(_all, 2, 0, dtype)
    assert found is not None
    return found


def _boxes(dtype, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Boxes of x and y: of all widths, points, one ulp wide, huge, tiny, half-infinite, at ends of domains."""
    random = np.random.default_rng(seed)
    pairs = []
    for _ in range(16):
        a = random.uniform(-2, 4, 2)
        pairs.append((a, a + 10 ** random.uniform(-12, 1, 2)))
    for _ in range(12):
        a = random.uniform(0, 3, 2)
        pairs.append((a, a + 10 ** random.uniform(-9, 1, 2)))
    for _ in range(4):
        a = random.uniform(0, 3, 2).astype(dtype)
        pairs += [(a, a), (a, np.nextafter(a, dtype(np.inf))), (-a, -a), (np.nextafter(-a, dtype(-np.inf)), -a)]
    inf = np.inf
    sides = [(0, 0), (0, 1), (-1, 1), (-1, 0), (-3, -1), (0, 1e-30), (1e-30, 2e-30), (1e-12, 1), (1e10, 1e10 + 1e6)]
    sides += [(1e6, 1e12), (-1e12, 1e3), (1, inf), (0, inf), (-inf, inf), (-inf, 0), (-inf, -1), (-inf, 2), (30, 60)]
    sides += [(-100, -50), (-80, 80), (1e-3, 1e3), (-1e-20, 1e-25), (3, 3.0001), (np.pi / 2 - 1e-3, np.pi / 2)]
    for a, b in sides:
        c, d = sides[random.integers(len(sides))]
        pairs += [((a, c), (b, d)), ((a, 0.5), (b, 0.75))]
    lower = np.array([p[0] for p in pairs]).astype(dtype)
    upper = np.array([p[1] for p in pairs]).astype(dtype)
    return lower, np.maximum(lower, upper)


def _points(lower, upper, random) -> list[np.ndarray]:
    """Corners, and points inside."""
    largest = 1e4 if lower.dtype == np.float32 else 1e8
    a, b = np.maximum(lower, -largest), np.minimum(upper, largest)
    a, b = np.minimum(a, upper), np.maximum(b, lower)
    corners = [np.where(mask, b, a) for mask in ([0, 0], [0, 1], [1, 0], [1, 1])]
    share = random.uniform(0, 1, (3, 2))
    inside = [np.clip((a + (b - a) * s).astype(a.dtype), a, b) for s in share]
    return [p.astype(lower.dtype) for p in (*corners, *inside)]


def _bounds_of(found: Expansion, weights, dtype, mode: str = "outward"):
    """Of rows on boxes: joint and natural bounds, slopes, offsets."""

    @in_numpy
    @jax.vmap
    def call(lower, upper):
        with rounding.using(mode):
            rows: Rows = found.rows(weights, dtype)
            states = States.of(Interval.unchecked(lower, upper), found.terms)
            atoms = found.bounds(states, jnp.zeros(0, dtype))
            center, radius = rows.joint(states, atoms)
            natural, both = rows.natural(states, atoms), rows.bounds(states, atoms)
            return center, radius, natural.lower, natural.upper, both.lower, both.upper

    return call


def _reference(point) -> list:
    x, y = (mp.mpf(float(v)) for v in point)
    return [exact(x, y) for _, _, exact in FUNCTIONS]


def _misses(dtype, mode: str) -> list[str]:
    """Where exact values lie outside of what the rows of single functions say."""
    lower, upper = _boxes(dtype)
    found = _expansion(dtype)
    results = [np.asarray(v) for v in _bounds_of(found, np.eye(len(FUNCTIONS)), dtype, mode)(lower, upper)]
    random = np.random.default_rng(1)
    misses = []
    for k in range(len(lower)):
        for point in _points(lower[k], upper[k], random):
            for j, value in enumerate(_reference(point)):
                if value is None:
                    continue
                center, radius, low, high, least, most = (r[k, j] for r in results)
                assert not np.isnan([center, low, high, least, most]).any()
                assert radius >= 0
                joint = mp.inf if np.isinf(radius) else mp.mpf(float(radius))
                right = abs(value - mp.mpf(float(center))) <= joint
                right = right and low <= value <= high and least <= value <= most
                if not right:
                    misses.append(
                        f"{FUNCTIONS[j][0]} on {lower[k]} {upper[k]} at {point}: {[r[k, j] for r in results]}"
                    )
    return misses


@pytest.mark.parametrize("dtype", PRECISIONS)
def test_exact_values_are_contained(dtype):
    assert _misses(dtype, "outward") == []


@pytest.mark.parametrize("dtype", PRECISIONS)
def test_to_nearest_they_are_not(dtype):
    misses = " ".join(_misses(dtype, "nearest"))
    assert all(name in misses for name in ("sqrt", "exp", "log", "reciprocal", "square", "x y"))


@pytest.mark.parametrize("dtype", PRECISIONS)
def test_weights_that_cancel(dtype):
    lower, upper = _boxes(dtype, 3)
    moderate = (np.abs(lower) < 100).all(1) & (np.abs(upper) < 100).all(1)
    lower, upper = lower[moderate], upper[moderate]
    random = np.random.default_rng(2)
    weights = random.normal(0, 1, (8, len(FUNCTIONS))).astype(np.float32).astype(np.float64)
    names = [name for name, *_ in FUNCTIONS]
    big = 2.0**20
    # Nearly equal near some boxes, or everywhere but for rounding: 1 + tanh(x / 2)... of the logistic function; x y at
    # x = y and the square; exp and 1 + x.
    for row, pair in enumerate([("x y", "square"), ("tanh", "atan"), ("x (1 - x)", "square"), ("sin", "tanh")]):
        weights[row] = 0
        weights[row, names.index(pair[0])] = big
        weights[row, names.index(pair[1])] = -big * (1 - 2.0**-18)
    unknown = [k for k, name in enumerate(names) if name in ("sqrt", "log", "reciprocal", "rsqrt", "log1p", "x / y")]
    weights[4:, unknown] = 0
    weights[6, names.index("sqrt")], weights[7, names.index("log")] = 3, -5
    weights[:, names.index("sqrt(2 x + y / 3 + 1)")] = 0
    results = [np.asarray(v) for v in _bounds_of(_expansion(dtype), weights, dtype)(lower, upper)]
    checked = 0
    for k in range(len(lower)):
        for point in _points(lower[k], upper[k], random)[:5]:
            values = _reference(point)
            for r, row in enumerate(weights):
                if any(w and v is None for w, v in zip(row, values, strict=True)):
                    continue
                exact = mp.fsum(mp.mpf(w) * v for w, v in zip(row, values, strict=True) if w)
                center, radius, low, high, least, most = (v[k, r] for v in results)
                assert np.isinf(radius) or abs(exact - mp.mpf(float(center))) <= mp.mpf(float(radius)), (r, lower[k])
                assert low <= exact <= high, (r, lower[k], upper[k])
                assert least <= exact <= most, (r, lower[k], upper[k])
                checked += 1
    assert checked > 500


def test_no_wider_than_by_the_rules_of_the_engine():
    lower, upper = _boxes(np.float64, 5)
    usual = ((upper - lower > 1e-3) & (np.abs(lower) < 1e3) & (np.abs(upper) < 1e3)).all(1)
    far = ~np.isfinite(lower).all(1) | ~np.isfinite(upper).all(1)
    found = _expansion(np.float64)

    @in_numpy
    @jax.vmap
    def both(lower, upper):
        with rounding.using("outward"):
            states = States.of(Interval.unchecked(lower, upper), found.terms)
            box, old = BoxOfAtoms(states, None, found.terms), []
            for atom in found.atoms:
                arguments = [box.argument(t) for t in atom.arguments]
                old.append(from_node(rule(atom, [t.node(box.domain) for t in arguments]), states, found.terms))
                box.add(atom, True)
            return [
                [(jnp.stack([jnp.asarray(s) for s in b.slope]), b.radius, b.range.lower, b.range.upper) for b in bounds]
                for bounds in (box.found, old)
            ]

    new, old = jax.tree.map(np.asarray, both(lower, upper))
    half = 0.5 * (upper - lower)
    for atom, (slope, radius, low, high), (old_slope, old_radius, old_low, old_high) in zip(
        found.atoms, new, old, strict=True
    ):
        for k in np.flatnonzero(usual | far):
            size = 1e-11 * (1 + sum(abs(side) for side in (old_low[k], old_high[k]) if np.isfinite(side)))
            assert low[k] >= old_low[k] - size, (atom.name, lower[k], upper[k])
            assert high[k] <= old_high[k] + size, (atom.name, lower[k], upper[k])
            if usual[k]:
                width = np.sum(abs(slope[k]) * half[k]) + radius[k]
                before = np.sum(abs(old_slope[k]) * half[k]) + old_radius[k]
                assert width <= before * (1 + 1e-9) + size, (atom.name, lower[k], upper[k], width, before)
            else:
                assert np.isfinite(radius[k]) or not np.isfinite(old_radius[k]), (atom.name, lower[k], upper[k])


@pytest.mark.parametrize("dtype", PRECISIONS)
def test_gradients_are_finite(dtype):
    lower, upper = _boxes(dtype)
    found = _expansion(dtype)

    def outputs(sides):
        with rounding.using("outward"):
            states = States.of(Interval.unchecked(*sides), found.terms)
            atoms = found.bounds(states, jnp.zeros(0, dtype))
            every = [atoms.slope.ravel(), atoms.center, atoms.radius, atoms.range.lower, atoms.range.upper]
            every = jnp.concatenate(every)
            return jnp.where(jnp.isfinite(every), every, 0)

    sides = np.stack([lower, upper], 1)
    gradient = in_numpy(jax.vmap(jax.grad(lambda ends: outputs(ends).sum())))(sides)
    assert np.isfinite(gradient).all(), [(lower[k], upper[k]) for k in np.argwhere(~np.isfinite(gradient))[:5, 0]]


def _hard(dtype) -> np.ndarray:
    """Arguments of sines: random ones of all sizes, near multiples of pi/2, tiny, next to the limit."""
    random = np.random.default_rng(4)
    limit = LIMIT[np.dtype(dtype).name]
    turns = np.concatenate([np.arange(-20, 21), random.integers(-int(limit / 1.6), int(limit / 1.6), 60)])
    near = np.array([float(mp.pi / 2 * int(k)) for k in turns]).astype(dtype)
    near = np.concatenate([near, np.nextafter(near, dtype(np.inf)), np.nextafter(near, dtype(-np.inf))])
    wide = random.uniform(-1, 1, 60) * 10 ** random.uniform(-12, np.log10(limit) - 0.01, 60)
    edge = [np.nextafter(dtype(limit), dtype(0)), -np.nextafter(dtype(limit), dtype(0)), 1e-30, -1e-35, 0, np.pi / 4]
    found = np.concatenate([near, wide.astype(dtype), np.array(edge, dtype)]).astype(dtype)
    return found[(np.abs(found) < limit) & ((found == 0) | (np.abs(found) >= np.finfo(dtype).tiny))]


@pytest.mark.parametrize("dtype", PRECISIONS)
def test_sines_are_as_accurate_as_stated(dtype):
    eps = float(np.finfo(dtype).eps)
    t = _hard(dtype)
    sine, cosine = (np.asarray(v) for v in jax.jit(sin_cos)(t))
    for x, s, c in zip(t, sine, cosine, strict=True):
        x = mp.mpf(float(x))
        assert abs(mp.sin(x) - mp.mpf(float(s))) <= eps * min(SLOT, 3 * abs(x))
        assert abs(mp.cos(x) - mp.mpf(float(c))) <= eps * SLOT
    r = np.abs(t[np.abs(t) <= math.pi])
    sine, cosine = (np.asarray(v) for v in jax.jit(half_sin_cos)(r))
    for x, s, c in zip(r, sine, cosine, strict=True):
        half = mp.mpf(float(x)) / 2
        assert abs(mp.sin(half) - mp.mpf(float(s))) <= eps * min(SLOT, 3 * half)
        assert abs(mp.cos(half) - mp.mpf(float(c))) <= eps * SLOT


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("cosine", [False, True])
def test_polynomials_are_as_close_as_stated(dtype, cosine):
    """What is left of the series after the polynomial, on every z = y^2, in balls; its tail alternates."""
    name, terms, pieces = np.dtype(dtype).name, 12, 1000
    given = [1, -0.5, *_COSINE[name]] if cosine else [1, *_SINE[name]]
    given = [arb(float(dtype(c))) for c in given] + [arb(0)] * (terms - len(given))
    before, ctx.prec = ctx.prec, 200
    try:
        series = [arb(fmpq((-1) ** i, math.factorial(2 * i + (not cosine)))) for i in range(terms)]
        left = arb_poly([exact - c for exact, c in zip(series, given, strict=True)])
        slope = left.derivative()
        end = (arb.pi() / 4 + arb(2) ** -20) ** 2
        tail = end**terms / math.factorial(2 * terms)
        for k in range(pieces):
            middle, around = end * (k + 0.5) / pieces, end * arb(0, 0.51 / pieces)
            value = left(middle) + around * slope(middle + around)
            assert abs(value) + tail <= (0.01 if cosine else 0.1) * float(np.finfo(dtype).eps) / 2
    finally:
        ctx.prec = before


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("cosine", [False, True])
def test_wave_atoms(dtype, cosine):
    exact = mp.cos if cosine else mp.sin
    m = _hard(dtype)
    random = np.random.default_rng(5)
    r = np.abs(random.uniform(0, 1, m.shape) * 10 ** random.uniform(-8, 0.6, m.shape)).astype(dtype)
    r[::5] = 0
    size = (np.abs(m) + r).astype(dtype)
    size = np.nextafter(size, dtype(np.inf))

    @jax.jit
    def call(m, r, size):
        with rounding.using("outward"):
            return wave_atom(cosine, m, r, size, 3), wave_point(cosine, m, size, 3)

    (slope, center, radius, natural, middle), point = jax.tree.map(np.asarray, call(m, r, size))
    for k in range(len(m)):
        at = mp.mpf(float(m[k]))
        for value, slip in ((middle[0][k], middle[1][k]), (point[0][k], point[1][k])):
            assert abs(exact(at) - mp.mpf(float(value))) <= mp.mpf(float(slip))
        for share in (-1, -0.61, 0, 0.37, 1):
            t = at + mp.mpf(float(r[k])) * mp.mpf(share)
            rest = exact(t) - mp.mpf(float(slope[k])) * t - mp.mpf(float(center[k]))
            assert abs(rest) <= mp.mpf(float(radius[k]))
            assert natural.lower[k] <= exact(t) <= natural.upper[k]


def test_what_is_linear_costs_nothing():
    found = expand(lambda x, u: jnp.stack([x[0] / 4 + 2 * x[1] - 3, x[0] - x[0], jnp.float64(2.0)]), 2, 0, np.float64)
    assert found is not None
    assert found.atoms == []
    first, second, third = found.outputs
    assert (first.coefficients, first.constant) == ({0: 0.25, 1: 2}, -3)
    assert (second.coefficients, second.constant, third.coefficients, third.constant) == ({}, 0, {}, 2)


def test_known_inputs_and_constants():
    def function(x, u):
        return jnp.stack([x[0] * u[0] + u[1], x[1] * x[1] / 3 - 2 / x[1], jnp.exp(u[0] - x[0]), u[0] * u[1] + x[0]])

    found = expand(function, 2, 2, np.float64)
    assert found is not None

    @in_numpy
    @jax.vmap
    def call(lower, upper, u):
        with rounding.using("outward"):
            states = States.of(Interval.unchecked(lower, upper), found.terms)
            box = found.rows(np.eye(4), np.float64).bounds(states, found.bounds(states, u))
            return box.lower, box.upper

    random = np.random.default_rng(6)
    lower = random.uniform(0.1, 2, (20, 2))
    upper = lower + 10 ** random.uniform(-9, 0.3, (20, 2))
    upper[::4] = lower[::4]
    u = random.normal(0, 2, (20, 2))
    low, high = (np.asarray(v) for v in call(lower, upper, u))
    for k in range(20):
        for point in _points(lower[k], upper[k], random):
            x, y, v, w = (mp.mpf(float(value)) for value in (*point, *u[k]))
            values = [x * v + w, y * y / 3 - 2 / y, mp.exp(v - x), v * w + x]
            assert all(low[k, i] <= value <= high[k, i] for i, value in enumerate(values))
