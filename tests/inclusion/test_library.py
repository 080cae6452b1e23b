"""Functions that are known as a whole: tables, norms, softmax, activations; against NumPy and SciPy."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
from oracles.uncompiled import in_numpy
from sampled import SETTINGS, bounds, check

from gsisio_jax import Interval, inclusion

USUAL, WIDE, THREE = ([0.1, 0.1], [0.9, 0.9]), ([-1.0, -1.0], [1.0, 1.0]), ([0.1, -0.5, 0.3], [0.9, 0.4, 0.8])
EVERY = pytest.mark.parametrize(("rounding", "dtype"), SETTINGS, ids=["float64", "float32", "nearest"])
KNOTS = np.linspace(0.0, 1.0, 50)
TABLE = np.sin(5 * KNOTS) + 0.1 * np.cos(40 * KNOTS)
STEPS = np.array([[0.0, 0.0, 0.25, 0.25, 0.25, 0.5, 0.75, 0.75, 1.0, 1.0], [0, 1, 2, 9, 1, 0.5, 0.6, -1, 2, 3]])
FEW, VALUES = np.array([0.0, 0.25, 0.5, 1.0]), np.array([0.0, 1.0, 0.5, 2.0])


def _sigmoid(t):
    return 1 / (1 + np.exp(-t))


def _gelu_tanh(t):
    return 0.5 * t * (1 + np.tanh(np.sqrt(2 / np.pi) * (t + 0.044715 * t**3)))


CASES = {
    # name: function, oracle, box, how wide the range may be, and the Jacobian
    "table": (lambda x: jnp.interp(x, KNOTS, TABLE), lambda x: np.interp(x, KNOTS, TABLE),
              ([0.42], [0.97]), 1.02, 1.01),
    "ends of a table": (lambda x: jnp.interp(x, FEW, VALUES), lambda x: np.interp(x, FEW, VALUES),
                        ([-0.5, 0.35], [1.5, 0.55]), 1.02, 1.01),
    "table that jumps": (lambda x: jnp.interp(x, FEW, VALUES, left=-1.0, right=3.0),
                         lambda x: np.interp(x, FEW, VALUES, left=-1.0, right=3.0), ([-0.5], [1.5]), 1.02, None),
    "table with steps": (lambda x: jnp.interp(x, *STEPS), lambda x: np.interp(x, *STEPS), ([-0.5, 0.3], [1.5, 0.45]),
                         1.05, None),
    "table of a function": (lambda x: jnp.interp(jnp.sin(x[0]) + x[1], FEW, VALUES) * x[1],
                            lambda x: np.interp(np.sin(x[0]) + x[1], FEW, VALUES) * x[1], USUAL, 1.3, 3.0),
    "norm at 0": (jnp.linalg.norm, np.linalg.norm, WIDE, 1.01, 1.3),
    "norm": (jnp.linalg.norm, np.linalg.norm, THREE, 1.01, 1.1),
    "norms of rows": (lambda x: jnp.linalg.norm(jnp.stack([x, 1 + x[::-1]]), axis=1),
                      lambda x: np.linalg.norm(np.stack([x, 1 + x[::-1]]), axis=1), USUAL, 1.01, 1.1),
    "hypot": (lambda x: jnp.hypot(x[0], x[1]), lambda x: np.hypot(x[0], x[1]), WIDE, 1.01, 1.3),
    "root of squares": (lambda x: jnp.sqrt(x[0] ** 2 + x[1] * x[1] + 0.01),
                        lambda x: np.sqrt(x[0] ** 2 + x[1] ** 2 + 0.01), WIDE, 1.01, 1.3),
    "softmax": (jax.nn.softmax, scipy.special.softmax, THREE, 1.01, 2.5),
    "softmax by hand": (lambda x: jnp.exp(8 * x) / jnp.exp(8 * x).sum(), lambda x: scipy.special.softmax(8 * x),
                        WIDE, 1.01, 2.0),
    "logsumexp": (jax.nn.logsumexp, scipy.special.logsumexp, THREE, 1.01, 1.01),
    "log_softmax": (jax.nn.log_softmax, scipy.special.log_softmax, WIDE, 1.01, 1.01),
    "silu": (jax.nn.silu, lambda x: x * _sigmoid(x), ([-4.0, -1.0], [3.0, 0.5]), 1.01, 1.05),
    "silu by hand": (lambda x: x * jax.nn.sigmoid(x), lambda x: x * _sigmoid(x), WIDE, 1.01, 1.05),
    "gelu": (jax.nn.gelu, _gelu_tanh, ([-4.0, -1.0], [3.0, 0.5]), 1.01, 1.05),
    "gelu, exact": (lambda x: jax.nn.gelu(x, approximate=False), lambda x: x * scipy.special.ndtr(x),
                    ([-4.0, -1.0], [3.0, 0.5]), 1.01, 1.05),
    "mish": (jax.nn.mish, lambda x: x * np.tanh(np.log1p(np.exp(x))), ([-4.0, -1.0], [3.0, 0.5]), 1.01, 1.05),
    "soft_sign": (jax.nn.soft_sign, lambda x: x / (1 + abs(x)), WIDE, 1.01, 1.05),
    "sinc": (jnp.sinc, np.sinc, ([-0.4, 0.7], [2.7, 9.3]), 1.05, 1.2),
    "logit": (jax.scipy.special.logit, scipy.special.logit, USUAL, 1.01, 1.05),
    "celu": (lambda x: jax.nn.celu(x, 0.5), lambda x: np.where(x > 0, x, 0.5 * np.expm1(2 * np.minimum(x, 0))),
             ([-4.0, -1.0], [3.0, 0.5]), 1.01, 1.05),
    "entr": (jax.scipy.special.entr, scipy.special.entr, USUAL, 1.01, 1.05),
    "logaddexp2": (lambda x: jnp.logaddexp2(x[0], x[1]), lambda x: np.logaddexp2(x[0], x[1]), WIDE, 1.01, 1.05),
    "std": (jnp.std, np.std, THREE, 2.5, 2.5),
    "erfc": (jax.scipy.special.erfc, scipy.special.erfc, WIDE, 1.01, 1.05),
    "copysign": (lambda x: jnp.copysign(x[0], x[1]), lambda x: np.copysign(x[0], x[1]), WIDE, 1.01, None),
    "fmax": (lambda x: jnp.fmax(x[0], x[1]), lambda x: np.fmax(x[0], x[1]), WIDE, 1.01, 1.01),
    "powers": (lambda x: jnp.vander(x, 4), lambda x: np.vander(x, 4), WIDE, 1.01, 1.01),
    "angle, wrapped": (lambda x: jnp.arctan2(jnp.sin(x), jnp.cos(x)), lambda x: (x + np.pi) % (2 * np.pi) - np.pi,
                       ([2.0, 6.0], [3.0, 7.0]), 1.01, 1.01),
    "angle across the cut": (lambda x: jnp.arctan2(jnp.sin(x), jnp.cos(x)), lambda x: np.arctan2(np.sin(x), np.cos(x)),
                             ([3.0], [3.4]), 1.4, None),
}  # fmt: skip


@EVERY
@pytest.mark.parametrize("name", CASES)
def test_values_slopes_and_derivatives(name, rounding, dtype):
    fn, oracle, (lower, upper), loose, slopes = CASES[name]
    check(fn, oracle, lower, upper, rounding, dtype, loose, slopes)


def _pair(box):
    return np.ravel(box.lower).tolist() + np.ravel(box.upper).tolist()


def test_a_table_in_float32_serves_boxes_in_float64():
    """Made where JAX knows only float32, it stays one in a design, which is in float64."""
    knots, values = (jnp.asarray(part, jnp.float32) for part in (FEW, VALUES))
    exact = inclusion.natural(lambda x: jnp.interp(x, FEW, VALUES))(Interval([0.2], [0.6]))
    found = inclusion.natural(lambda x: jnp.interp(x, knots, values))(Interval([0.2], [0.6]))
    assert found.dtype == np.float64
    np.testing.assert_allclose(found.lower, exact.lower, atol=1e-6)
    np.testing.assert_allclose(found.upper, exact.upper, atol=1e-6)


def test_ranges_that_are_known():
    box = Interval(*WIDE)
    assert _pair(inclusion.natural(jnp.linalg.norm, "nearest")(box)) == [0, np.sqrt(2)]
    assert _pair(inclusion.jacobian(jnp.linalg.norm, "nearest")(box)) == [-1, -1, 1, 1]
    assert _pair(inclusion.natural(lambda x: jnp.interp(x, FEW, VALUES), "nearest")(Interval([0.2], [0.6]))) == [
        0.5,
        1.0,
    ]
    # Slopes of the segments that the box meets, not of those that it only touches.
    assert _pair(inclusion.jacobian(lambda x: jnp.interp(x, FEW, VALUES))(Interval([0.25], [0.5]))) == [-2, -2]
    assert _pair(inclusion.jacobian(lambda x: jnp.interp(x, FEW, VALUES))(Interval([0.2], [0.6]))) == [-2, 4]
    found = inclusion.natural(jax.nn.softmax)(Interval.entire(2))
    assert _pair(found) == [0, 0, 1, 1]


def test_tables_beyond_their_ends():
    """Extrapolated tables keep a bounded rest on half-lines; constant ones are bounded anywhere."""

    def f(x):
        return jnp.interp(x, FEW, VALUES, left="extrapolate", right="extrapolate")

    form = inclusion.affine(f, "nearest")(Interval([0.75], [np.inf]))
    assert form.slope == 3
    assert _pair(form.offset) == [-1, -1]
    assert _pair(inclusion.natural(f, "nearest")(Interval([-np.inf], [0.125]))) == [-np.inf, 0.5]
    assert _pair(inclusion.natural(lambda x: jnp.interp(x, FEW, VALUES))(Interval.entire(1))) == [0, 2]


def test_tables_that_jump_at_both_ends():
    """What is left of a slope holds the values beyond the ends, on infinite boxes and on wide ones."""

    def f(x):
        return jnp.interp(x, FEW, VALUES, left=-1.0, right=3.0)

    affine = jax.jit(inclusion.affine(f, "nearest"))
    for lower, upper in ((-np.inf, np.inf), (-np.inf, 0.5), (0.1, np.inf), (0.1, 1e80), (-1e80, 0.3), (-5.0, 7.0)):
        form = affine(Interval([lower], [upper]))
        t = np.clip([-1e300, -1e70, -1.0, -1e-9, 0.0, 0.2, 0.25, 0.6, 1.0, 1.0 + 1e-9, 3.0, 1e70, 1e300], lower, upper)
        rest = np.interp(t, FEW, VALUES, left=-1.0, right=3.0) - float(np.ravel(form.slope)[0]) * t
        slip = 1e-9 * (1 + abs(float(np.ravel(form.slope)[0]) * t))
        assert (form.offset.lower - slip <= rest).all()
        assert (rest <= form.offset.upper + slip).all()


def test_known_inputs_in_library_functions():
    """Numbers that are not known while tracing, in functions that are known as a whole: their rounding is bounded."""

    def each(u):
        pair = jnp.stack([u, 2 * u])
        parts = [jax.nn.silu(u), jax.nn.celu(u), jnp.sinc(u), jnp.hypot(u, u), jnp.std(pair), jnp.linalg.norm(pair)]
        return jnp.stack([*parts, jax.scipy.special.entr(u), jnp.searchsorted(FEW, u) * 1.0])

    def bounds_of(x, u):
        return [inclusion.natural(lambda x, u: x + each(u), r)(x, u) for r in ("outward", "nearest")]

    outward, nearest = jax.jit(bounds_of)(Interval([0.0], [0.0]), 0.437)
    u = 0.437
    silu, std, norm = u * _sigmoid(u), 0.5 * u, u * np.sqrt(5)
    exact = np.array([silu, u, np.sinc(u), u * np.sqrt(2), std, norm, -u * np.log(u), 2.0])
    assert (outward.lower < exact).all()
    assert (exact < outward.upper).all()
    assert np.allclose(nearest.lower, exact, 1e-12, 0)
    assert (outward.width < 1e-12).all()


def test_tables_with_steps():
    """At a step the table has its value on the right; the other one is a limit, of boxes that come from the left."""

    def f(x):
        return jnp.interp(x, *STEPS)

    natural, jacobian = in_numpy(inclusion.natural(f, "nearest")), in_numpy(inclusion.jacobian(f))
    for lower, upper, wanted in (
        (0.125, 0.25, [1, 2]), (0.25, 0.3, [0.9, 1]), (0.25, 0.25, [1, 1]), (0.2, 0.3, [0.9, 2]), (0.75, 1.0, [-1, 2]),
        (1.0, 1.0, [2, 2]), (1.0, 1.1, [2, 3]), (-0.1, 0.0, [0, 1]), (0.0, 0.1, [1, 1.4]), (-1.0, -0.5, [0, 0]),
    ):  # fmt: skip
        assert _pair(natural(Interval([lower], [upper]))) == pytest.approx(wanted)
    for lower, upper, wanted in ((0.25, 0.5, [-2, -2]), (0.0, 0.2, [4, 4]), (0.75, 0.9, [12, 12])):
        assert _pair(jacobian(Interval([lower], [upper]))) == pytest.approx(wanted)
    for lower, upper in ((0.2, 0.25), (0.2, 0.3), (0.9, 1.1), (-0.1, 0.0)):
        assert _pair(jacobian(Interval([lower], [upper]))) == [-np.inf, np.inf]


def test_random_tables_with_steps():
    rng = np.random.default_rng(0)
    for _ in range(8):
        places = rng.choice(np.linspace(-1, 1, 9), 6, replace=False)
        knots = np.sort([*places, *rng.choice(places, 2, replace=False)])
        values = rng.uniform(-2, 2, 8)

        def f(x, knots=knots, values=values):
            return jnp.interp(x, knots, values)

        affine = in_numpy(inclusion.affine(f))
        for _ in range(30):
            lower, upper = np.sort(rng.choice([*knots, *rng.uniform(-1.2, 1.2, 8)], 2))
            t = np.clip([*np.linspace(lower, upper, 60), *knots, *(knots - 1e-9), *(knots + 1e-9)], lower, upper)
            exact, form = np.interp(t, knots, values), affine(Interval([lower], [upper]))
            if knots[-2] == knots[-1]:
                exact = np.where(t == knots[-1], values[-2], exact)  # where NumPy has the one beyond
            rest = exact - float(np.ravel(form.slope)[0]) * t
            for box, found in ((form.range, exact), (form.offset, rest)):
                assert box.lower[0] <= found.min() + 1e-12
                assert found.max() <= box.upper[0] + 1e-12
            # Nothing is as far away as that: limits from the left are within 1e-9 of values.
            assert form.range.width[0] <= np.ptp(exact) + 1e-7


def test_a_table_with_a_period_is_walked_as_any_other_function():
    found = inclusion.natural(lambda x: jnp.interp(x, FEW, VALUES, period=1.0))(Interval([1.1], [1.2]))
    oracle = np.interp(np.linspace(1.1, 1.2, 100), FEW, VALUES, period=1.0)
    assert found.lower[0] <= oracle.min()
    assert oracle.max() <= found.upper[0]


def test_a_table_at_a_known_input():
    """An input that is not known while tracing is looked up; its rounding is bounded as well."""

    def bounds_of(x, u):
        return inclusion.natural(lambda x, u: x + jnp.interp(u, KNOTS, TABLE), "outward")(x, u)

    found = jax.jit(bounds_of)(Interval([0.0], [0.0]), 0.437)
    exact = np.interp(0.437, KNOTS, TABLE)
    assert found.lower[0] < exact < found.upper[0]
    assert found.upper[0] - found.lower[0] < 1e-14
    box = inclusion.natural(lambda x, u: x + jnp.interp(u, KNOTS, TABLE))(Interval([0.0], [0.0]), Interval(0.0, 1.0))
    assert abs(box.upper[0] - TABLE.max()) < 1e-15


@pytest.mark.parametrize("fn", [jnp.linalg.norm, jax.nn.softmax, jax.nn.logsumexp, jax.nn.gelu, jnp.sinc])
def test_points_and_infinite_boxes(fn):
    x = np.array([0.3, -0.7])
    exact = np.asarray(fn(x))
    at = bounds(fn, x, x, "outward", np.float64)
    assert (at["natural"].lower <= exact).all()
    assert (exact <= at["natural"].upper).all()
    assert (at["natural"].upper - at["natural"].lower < 1e-12).all()
    far = bounds(fn, [-np.inf, -1.0], [np.inf, 1.0], "outward", np.float64)
    for key in ("natural", "affine", "offset", "jacobian"):
        assert not np.isnan(far[key].lower).any()
        assert not np.isnan(far[key].upper).any(), key
        assert (far[key].lower <= far[key].upper).all()
    assert np.isfinite(far["slope"]).all()


def test_what_is_written_like_a_softmax_but_is_none():
    """Exponentials of one thing over the sum of another, and a sum over another axis."""
    other = lambda x: jnp.exp(x) / jnp.exp(2 * x).sum()  # noqa: E731
    check(other, lambda x: np.exp(x) / np.exp(2 * x).sum(), *USUAL, "outward", np.float64, 10.0, 100.0)

    def rows(x):
        m = jnp.outer(x, jnp.array([1.0, 2.0]))
        return jnp.exp(m) / jnp.exp(m).sum(0, keepdims=True)

    def oracle(x):
        return scipy.special.softmax(np.outer(x, [1.0, 2.0]), 0)

    check(rows, oracle, *USUAL, "outward", np.float64, 1.01, 20.0)
    shifted = lambda x: jnp.exp(x - x[0]) / jnp.exp(x - x[0]).sum()  # noqa: E731
    check(shifted, scipy.special.softmax, *USUAL, "outward", np.float64, 1.01, 20.0)
    # m is not common to all entries: no softmax of x.
    uneven = lambda x: jnp.exp(x - x**2) / jnp.exp(x - x**2).sum()  # noqa: E731
    check(uneven, lambda x: scipy.special.softmax(x - x**2), *USUAL, "outward", np.float64, 3.0, 20.0)
