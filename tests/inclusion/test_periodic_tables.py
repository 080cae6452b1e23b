"""Tables that repeat themselves, against fractions: sound to the last bit, and as narrow as their own values."""

from fractions import Fraction

import jax.numpy as jnp
import numpy as np
import pytest
from oracles.uncompiled import in_numpy

from gsisio_jax import Interval, inclusion

PERIODS = (1.0, 2 * np.pi, 24.0, 0.3)


def table(period, dtype, seed):
    """Knots in several periods, in any order; with one at the seam, and without."""
    rng = np.random.default_rng(seed)
    knots = rng.uniform(-period, 2 * period, 6).astype(dtype)
    knots[0] = 0 if seed % 2 else knots[0]
    return knots, rng.uniform(-2, 2, 6).astype(dtype), dtype(period)


def exactly(knots, values, period):
    """The function of the numbers that the model is made of."""
    places = np.mod(knots, period)
    order = np.argsort(places)
    around = np.concatenate([places[order][-1:] - period, places[order], places[order][:1] + period])
    t, v = [Fraction(float(x)) for x in around], [Fraction(float(x)) for x in values[order]]
    v = [v[-1], *v, v[0]]

    def at(x):
        x = Fraction(float(x)) % Fraction(float(period))
        i = next(i for i in range(1, len(t)) if x <= t[i])
        return v[i - 1] + (v[i] - v[i - 1]) * (x - t[i - 1]) / (t[i] - t[i - 1])

    return at


def boxes(rng, knots, period, dtype):
    """Short and long ones, near and far, that begin at seams and at knots."""
    for _ in range(60):
        lower = rng.uniform(-5, 5) * period * rng.choice([1, 1, 1000])
        if rng.random() < 0.4:
            lower = period * rng.integers(-3, 4) + rng.choice([0, rng.choice(knots)])
        lower = dtype(lower)
        upper = dtype(lower + period * 10 ** rng.uniform(-5, 0.2))
        turns = np.floor(lower / period) + np.arange(-3, 5)
        seams = [dtype(float(knot) + k * float(period)) for k in turns for knot in (0, *knots)]
        yield lower, upper, np.unique(np.clip([*np.linspace(lower, upper, 15), *seams], lower, upper).astype(dtype))


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("seed", range(4))
def test_values_and_what_is_left_of_a_slope(seed, dtype):
    knots, values, period = table(PERIODS[seed], dtype, seed)
    exact, eps = exactly(knots, values, period), float(np.finfo(dtype).eps)
    affine = in_numpy(inclusion.affine(lambda x: jnp.interp(x, knots, values, period=period), "outward"))
    for lower, upper, points in boxes(np.random.default_rng(seed), knots, period, dtype):
        form = affine(Interval(np.array([lower]), np.array([upper])))
        assert form.range.dtype == dtype
        found = [exact(x) for x in points]
        slope = Fraction(float(np.ravel(form.slope)[0]))
        rest = [value - slope * Fraction(float(x)) for value, x in zip(found, points, strict=True)]
        for box, truth in ((form.range, found), (form.offset, rest)):
            assert Fraction(float(box.lower[0])) <= min(truth)
            assert max(truth) <= Fraction(float(box.upper[0]))
        steepest = np.abs(np.diff(values)).max() / np.diff(np.sort(np.mod(knots, period))).min()
        room = 50 * eps * (4 + float(steepest) * (abs(float(lower)) + float(period)))
        assert form.range.width[0] <= float(max(found) - min(found)) + room


def test_derivatives_are_those_of_the_segments_that_a_box_meets():
    knots, values = np.array([0.0, 0.25, 0.75]), np.array([0.0, 1.0, 0.0])
    jacobian = in_numpy(inclusion.jacobian(lambda x: jnp.interp(x, knots, values, period=1.0), "nearest"))
    for lower, upper, low, high in (
        (0.05, 0.2, 4, 4), (1.05, 1.2, 4, 4), (-0.95, -0.8, 4, 4), (0.3, 0.7, -2, -2), (0.8, 0.9, 0, 0),
        (5.9, 6.1, 0, 4), (5.9, 6.4, -2, 4), (0.1, 7.0, -2, 4), (-np.inf, 0.1, -2, 4), (0.3, np.inf, -2, 4),
    ):  # fmt: skip
        found = jacobian(Interval([lower], [upper]))
        assert (found.lower.item(), found.upper.item()) == pytest.approx((low, high))


def test_long_boxes_hold_every_value_and_no_more():
    knots, values = np.array([0.1, 0.25, 0.75]), np.array([0.0, 1.0, -3.0])
    natural = in_numpy(inclusion.natural(lambda x: jnp.interp(x, knots, values, period=1.0)))
    for lower, upper in ((0.0, 1.0), (0.3, 1.4), (-np.inf, 0.0), (2.0, np.inf), (-1e300, 1e300), (1e17, 1.01e17)):
        found = natural(Interval([lower], [upper]))
        assert (found.lower.item(), found.upper.item()) == pytest.approx((-3, 1))


def test_a_table_whose_knots_coincide_in_its_period_is_bounded_as_other_code():
    def f(x):
        return jnp.interp(x, np.array([0.0, 0.5, 1.0]), np.array([0.0, 1.0, 2.0]), period=1.0)

    natural = inclusion.natural(f)
    found = natural(Interval([0.1], [0.4]))
    x = np.linspace(0.1, 0.4, 50)
    assert found.lower[0] <= (values := np.asarray(f(x))).min()
    assert values.max() <= found.upper[0]
