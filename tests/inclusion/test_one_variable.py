"""Sums of clips, ramps and maxima of one number are bounded as one function, against fractions."""

from __future__ import annotations

import random
from fractions import Fraction
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles.uncompiled import in_numpy

import gsisio_jax as gx
from gsisio_jax import Interval, inclusion
from gsisio_jax.inclusion.atoms import States
from gsisio_jax.inclusion.reader import expand
from gsisio_jax.inclusion.rules.hinge_tables import hinge_table
from gsisio_jax.interval import rounding
from gsisio_jax.scalar.graph import Graph, Number
from gsisio_jax.scalar.hinges import Bends, value_at
from gsisio_jax.scalar.unroll import collected, evaluate

STARTS = [i / 50 for i in range(50)]
WEIGHTS = [1 + 0.5 * np.sin(i) for i in range(50)]


def _curve(x):
    """An open-circuit voltage of 50 clips that meet but for rounding, less another state."""
    total = sum(w * jnp.clip(x[0], a, a + 0.02) for a, w in zip(STARTS, WEIGHTS, strict=True))
    return [3 + total - x[1]]


def _exact_curve(x0: Fraction, x1: Fraction) -> Fraction:
    total = Fraction(3)
    for a, w in zip(STARTS, WEIGHTS, strict=True):
        total += Fraction(float(w)) * min(max(x0, Fraction(a)), Fraction(a + 0.02))
    return total - x1


# One function of one direction each, as JAX and in fractions.
SHAPES = [
    (
        "dead zones",
        lambda x: jnp.maximum(x[0] - 1, 0) + jnp.minimum(x[0] + 1, 0) - 0.3 * jnp.abs(x[0] - 0.1) + 0.7 * x[0],
        lambda a, b: max(a - 1, 0) + min(a + 1, 0) - F(0.3) * abs(a - F(0.1)) + F(0.7) * a,
    ),
    (
        "largest of lines",
        lambda x: jnp.max(
            jnp.array([-1.0, 0.1, 0.5, 2.0], x.dtype) * x[0] + jnp.array([0.0, 0.2, -0.3, -1.7], x.dtype)
        ),
        lambda a, b: max(F(s) * a + F(c) for s, c in ((-1.0, 0.0), (0.1, 0.2), (0.5, -0.3), (2.0, -1.7))),
    ),
    (
        "ramps of a sum",
        lambda x: sum(jax.nn.relu(3 * x[0] - 2 * x[1] - k) * (-1) ** k for k in range(4)) - x[1],
        lambda a, b: sum(max(3 * a - 2 * b - k, 0) * (-1) ** k for k in range(4)) - b,
    ),
    (
        "vector of clips",
        lambda x: jnp.sum(jnp.clip(x[1] - jnp.arange(-2.0, 2.0, 0.5, x.dtype), 0.0, 0.5)) / 3,
        lambda a, b: sum(min(max(b - F(k), 0), F(0.5)) for k in np.arange(-2.0, 2.0, 0.5)) / 3,
    ),
    (
        "within each other",
        lambda x: jnp.abs(jnp.abs(jnp.abs(x[0]) - 1) - 0.5) + jnp.clip(x[0], -0.1, 0.2),
        lambda a, b: abs(abs(abs(a) - 1) - F(0.5)) + min(max(a, F(-0.1)), F(0.2)),
    ),
]


def F(value) -> Fraction:
    return Fraction(float(value))


def _boxes(seed: int, count: int) -> np.ndarray:
    generator = np.random.default_rng(seed)
    lower = generator.uniform(-2.5, 2, (count, 2))
    wide = 10 ** generator.uniform(-6, 0.6, (count, 2)) * (generator.uniform(size=(count, 2)) > 0.1)
    return np.stack([lower, lower + wide], 1)


def _points(box: np.ndarray, count: int = 12) -> list[tuple[Fraction, Fraction]]:
    generator = random.Random(str(box.tobytes()))
    corners = [(F(box[i, 0]), F(box[j, 1])) for i in (0, 1) for j in (0, 1)]
    return corners + [
        (
            F(box[0, 0]) + Fraction(generator.random()) * (F(box[1, 0]) - F(box[0, 0])),
            F(box[0, 1]) + Fraction(generator.random()) * (F(box[1, 1]) - F(box[0, 1])),
        )
        for _ in range(count)
    ]


@pytest.fixture(scope="module")
def functions():
    return lambda x: jnp.stack([jnp.asarray(f(x), x.dtype) for _, f, _ in SHAPES])


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_bounds_contain_exact_values_and_slopes(functions, dtype):
    boxes = _boxes(0, 60).astype(dtype)
    run = in_numpy(
        jax.vmap(
            lambda a, b: (
                inclusion.natural(functions, rounding="outward")(Interval.unchecked(a, b)),
                inclusion.affine(functions, rounding="outward")(Interval.unchecked(a, b)),
                inclusion.jacobian(functions, rounding="outward")(Interval.unchecked(a, b)),
            )
        )
    )
    natural, form, slopes = jax.tree.map(np.asarray, run(boxes[:, 0], boxes[:, 1]))
    for k, box in enumerate(boxes):
        points = _points(box)
        for j, (name, _, exact) in enumerate(SHAPES):
            # A constant of f is one of the type of x.
            if dtype == np.float32 and name in ("dead zones", "largest of lines", "within each other"):
                continue
            values = [exact(*point) for point in points]
            for point, value in zip(points, values, strict=True):
                assert F(natural.lower[k, j]) <= value <= F(natural.upper[k, j]), (name, box)
                rest = value - sum(F(s) * p for s, p in zip(form.slope[k, j], point, strict=True))
                assert F(form.offset.lower[k, j]) <= rest <= F(form.offset.upper[k, j]), (name, box)
            for (p, v), (q, w) in pairwise(zip(points, values, strict=True)):
                # Some element of the Jacobian box explains every difference.
                moved = [b - a for a, b in zip(p, q, strict=True)]
                sides = [
                    sorted((F(slopes.lower[k, j, i]) * m, F(slopes.upper[k, j, i]) * m)) for i, m in enumerate(moved)
                ]
                assert sum(s[0] for s in sides) <= w - v <= sum(s[1] for s in sides), (name, box)


def test_ranges_are_those_of_the_whole(functions):
    """Of 50 clips: the hull of values, the slopes between knots; not the sum of the parts."""
    boxes = _boxes(1, 40) * 0.3 + 0.3
    run = in_numpy(
        jax.vmap(
            lambda a, b: (
                inclusion.affine(_curve, rounding="outward")(Interval.unchecked(a, b))[0],
                inclusion.jacobian(_curve, rounding="outward")(Interval.unchecked(a, b))[0],
            )
        )
    )
    form, slopes = jax.tree.map(np.asarray, run(boxes[:, 0], boxes[:, 1]))
    ends = np.array([*STARTS, 1.0])
    for k, box in enumerate(boxes):
        inner = ends[(box[0, 0] < ends) & (ends < box[1, 0])]
        curve = [_exact_curve(F(t), F(0)) for t in (box[0, 0], *inner, box[1, 0])]
        exact = [curve[0] - F(box[1, 1]), curve[-1] - F(box[0, 1])]  # it rises
        assert F(form.range.lower[k]) <= exact[0]
        assert exact[1] <= F(form.range.upper[k])
        assert float(F(form.range.upper[k]) - F(form.range.lower[k])) <= float(exact[1] - exact[0]) + 1e-12
        met = [w for i, w in enumerate(WEIGHTS) if ends[i] < box[1, 0] and box[0, 0] < ends[i + 1]]
        outside = [0.0] if box[0, 0] < 0 or box[1, 0] > 1 else []
        if box[1, 0] - box[0, 0] > 1e-6:
            # A knot itself is an end of a clip as a floating number, an ulp from ours.
            assert slopes.lower[k, 0] == pytest.approx(min(met + outside), abs=1e-9)
            assert slopes.upper[k, 0] == pytest.approx(max(met + outside), abs=1e-9)


def test_one_table_for_a_direction_in_rows():
    found = expand(lambda x, u: jnp.stack(_curve(x)), 2, 0, np.float64)
    assert found is not None
    assert [atom.name for atom in found.atoms] == ["table"]
    boxes = _boxes(2, 40) * 0.3 + 0.3

    @jax.jit
    @jax.vmap
    def bounds(a, b):
        with rounding.using("outward"):
            states = States.of(Interval.unchecked(a, b), found.terms)
            return found.rows(np.eye(1), np.float64).bounds(states, found.bounds(states, jnp.zeros(0)))

    image = jax.tree.map(np.asarray, bounds(boxes[:, 0], boxes[:, 1]))
    for k, box in enumerate(boxes):
        for point in _points(box):
            assert F(image.lower[k, 0]) <= _exact_curve(*point) <= F(image.upper[k, 0])


def test_lone_clips_stay_what_they_are():
    found = expand(lambda x, u: jnp.stack([jnp.clip(x[0], 0, 1) + jnp.clip(x[1], 0, 1)]), 2, 0, np.float64)
    assert found is not None
    assert "table" not in [atom.name for atom in found.atoms]


def _exact(number, points):
    """A number of a program in fractions."""
    if not isinstance(number, Number):
        return F(number)
    if number.name == "input":
        return points[number.order]
    values = [_exact(v, points) for v in number.operands]
    table = {
        "add": lambda a, b: a + b, "sub": lambda a, b: a - b, "mul": lambda a, b: a * b, "neg": lambda a: -a,
        "abs": abs, "max": max, "min": min, "clamp": lambda a, b, c: min(max(a, b), c),
    }  # fmt: skip
    return table[number.name](*values)


def _random_function(generator: random.Random, depth: int):
    if depth == 0:
        return generator.choice([lambda x: x[0], lambda x: x[0] + 2 * x[1], lambda x: x[1]])
    a, b = (_random_function(generator, depth - 1) for _ in range(2))
    c, d = generator.uniform(-1, 1), generator.uniform(-1, 1)
    return generator.choice([
        lambda x: c * a(x) + b(x) - d, lambda x: jnp.maximum(a(x), b(x) + c), lambda x: jnp.abs(a(x) - c) - b(x),
        lambda x: jnp.minimum(a(x), c) + d * b(x), lambda x: jax.lax.clamp(-abs(c), 1.0 * a(x), abs(d)) - b(x),
    ])  # fmt: skip


@pytest.mark.parametrize("seed", range(12))
def test_reading_keeps_the_function(seed):
    generator = random.Random(seed)
    for _ in range(4):
        function = _random_function(generator, 4)
        closed = jax.make_jaxpr(function)(jnp.zeros(2))
        graph, bends = Graph(), Bends()
        inputs = [graph.input(np.dtype(float)) for _ in range(2)]
        (out,) = evaluate(graph, closed.jaxpr, closed.consts, [collected(inputs, (2,))])
        bent = bends.of(out.ravel()[0])
        assert bent is not None
        for _ in range(6):
            points = {x.order: Fraction(generator.uniform(-3, 3)) for x in inputs}
            at = {b: _exact(number, points) for b, number in bends.numbers.items()}
            value = bent.constant + sum(weight * at[b] for b, weight in bent.linear.items())
            for t, jumps in bent.hinges.items():
                value += value_at(F(0), F(0), jumps, sum(weight * at[b] for b, weight in t))
            assert value == _exact(out.ravel()[0], points)


def test_hinges_may_end_in_a_call():
    """`jnp.clip` is one equation, a call, and here the last one of a sum of hinges."""
    form = inclusion.affine(lambda x: jnp.clip(jnp.abs(x) + x, -0.4, 0.7))(Interval([-1.0], [2.0]))
    jac = inclusion.jacobian(lambda x: jnp.clip(jnp.abs(x) + x, -0.4, 0.7))(Interval([-1.0], [2.0]))
    assert (form.range.lower, form.range.upper, jac.lower, jac.upper) == (0.0, 0.7, 0.0, 2.0)


def test_error_of_a_table_is_exact():
    """Knots and values that are no floating numbers, and knots that rounding takes for one."""
    jumps = {Fraction(1, 3): Fraction(2, 7), Fraction(1, 3) + Fraction(1, 10**17): Fraction(-1, 7), Fraction(2): F(1)}
    found = hinge_table(Fraction(1, 11), Fraction(1, 13), jumps, np.float64)
    assert len(found.table.knots) == 2
    assert 0 < found.error < 1e-15
    points = np.array([-5.0, 0.0, 1 / 3, np.nextafter(1 / 3, 1), 0.7, 2.0, 30.0])
    with rounding.using("outward"):
        image = found.range(jnp.asarray(points), jnp.asarray(points))
    for t, low, high in zip(points, np.asarray(image.lower), np.asarray(image.upper), strict=True):
        assert F(low) <= value_at(Fraction(1, 11), Fraction(1, 13), jumps, F(t)) <= F(high)
        assert high - low < 1e-14 * (1 + abs(high))


def test_a_box_shrinks_under_fifty_clips():
    system = gx.System(
        lambda x: [x[0], 0.9 * x[1]], _curve, G=np.zeros((2, 0)), H=np.zeros((1, 0)), B=[[-0.001], [0.1]],
        D=[[-0.01]], m=1,
    )  # fmt: skip
    noise = gx.Noise(Interval.symmetric([1e-5, 1e-4]), Interval.symmetric([0.01]))
    region = Interval([0.0, -1.0], [1.0, 1.0])
    observer = gx.design_observer(system, noise, region, u_region=Interval([-1.0], [1.0]), sweeps=2)
    assert observer.certificate.promised
    x, records = np.array([0.6, 0.05]), []
    generator = np.random.default_rng(0)
    for k in range(60):
        u = np.array([np.sin(0.1 * k)])
        y = float(_exact_curve(F(x[0]), F(x[1]))) - 0.01 * u + generator.uniform(-0.01, 0.01, 1)
        records.append((x, u, y))
        x = np.array([x[0], 0.9 * x[1]]) + np.array([-0.001, 0.1]) * u
    states, inputs, outputs = (np.array(part) for part in zip(*records, strict=True))
    boxes = gx.estimate(observer, Interval([0.1, -0.2], [0.9, 0.2]), outputs, inputs).state
    assert ((boxes.lower <= states) & (states <= boxes.upper)).all()
    # Noise and voltage over the least slope of the curve on the box, with some room; it was 0.8 and stayed so.
    assert float(boxes.width[-1, 0]) < 0.02
