"""Functions without a value in part of a box, and code that looks at that: against JAX itself."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from seen import checked, estimated, sides

from gsisio_jax import inclusion
from gsisio_jax.interval import Interval

PRECISIONS = pytest.mark.parametrize("dtype", [np.float64, np.float32], ids=["float64", "float32"])
INSIDE = (0.5, 0.75)
BOXES = {"partly": (-2.0, 4.0), "wholly outside": (-2.0, -1.0), "inside": INSIDE}


def root(x):
    return jnp.sqrt(x[0])


def last_root(count):
    return lambda x: jnp.where(lax.fori_loop(0, count, lambda i, s: jnp.sqrt(s + 0.1), x[0]) > 0, 1.0, -9.0)


def roots_seen(count):
    def turn(s, _):
        return jnp.sqrt(s) + 0.1, jnp.where(s >= -20, 1.0, -9.0)

    return lambda x: lax.scan(turn, x[0], None, length=count)[1]


def rows_seen(count):
    def turn(s, row):
        return s + 1, jnp.where(row >= -20, 1.0, -9.0)

    return lambda x: lax.scan(turn, 0.0, root(x) * jnp.ones(count))[1]


# What it is inside of the domain: value and derivative at t = 0.5 and t = 0.75 where that is known (else None).
LOOKS = {
    "isnan": (lambda x: jnp.where(jnp.isnan(root(x)), -5.0, root(x)), np.sqrt),
    "nan_to_num of a logarithm": (lambda x: jnp.nan_to_num(jnp.log(x[0]), nan=50.0), np.log),
    "nan_to_num of an angle": (lambda x: jnp.nan_to_num(jnp.arcsin(x[0]), nan=50.0), np.arcsin),
    "fmax": (lambda x: jnp.fmax(root(x), -3.0), np.sqrt),
    "fmax of arrays": (lambda x: jnp.fmax(-3.0, root(x) * jnp.ones(2)), np.sqrt),
    "fmin": (lambda x: jnp.fmin(7.0, root(x)), np.sqrt),
    "nansum": (lambda x: jnp.nansum(jnp.sqrt(x)), np.sqrt),
    "nanmax": (lambda x: jnp.nanmax(jnp.stack([root(x), -3.0])), np.sqrt),
    "equal to itself": (lambda x: jnp.where((t := root(x)) == t, t, -9.0), np.sqrt),
    "isfinite": (lambda x: jnp.where(jnp.isfinite(jnp.log(x[0])), jnp.log(x[0]), -9.0), np.log),
    "comparison": (lambda x: jnp.where(root(x) >= 0, 1.0, -9.0), np.ones_like),
    "product with a comparison": (lambda x: 3 * (root(x) >= 0), lambda t: 3 + 0 * t),
    "cond": (lambda x: lax.cond(root(x) >= 0, lambda: 1.0, lambda: -9.0), np.ones_like),
    "truth value": (lambda x: jnp.where((root(x) + 1).astype(bool), 1.0, -9.0), np.ones_like),
    "argmax": (lambda x: jnp.argmax(jnp.stack([5.0, root(x)])), np.zeros_like),
    "argmin": (lambda x: jnp.argmin(jnp.stack([-5.0, root(x)])), np.zeros_like),
    "searchsorted": (lambda x: jnp.searchsorted(jnp.arange(5.0), root(x)), np.ones_like),
    "digitize": (lambda x: jnp.digitize(root(x), jnp.arange(5.0)), np.ones_like),
    "cast": (lambda x: (root(x) + 1).astype(int), np.ones_like),
    "entry": (lambda x: jnp.array([1.0, 2.0, 3.0])[root(x).astype(int)], np.ones_like),
    "sort": (lambda x: jnp.sort(jnp.stack([root(x), 7.0, 8.0]))[:1], np.sqrt),
    "argsort": (lambda x: jnp.argsort(jnp.stack([root(x), 7.0, 8.0]))[0], np.zeros_like),
    "0 / 0": (lambda x: jnp.where(jnp.isnan(x[0] * 0 / (x[0] + 1)), -9.0, 1.0), np.ones_like),
    "power": (lambda x: jnp.where(x[0] ** 1.5 > -1, 1.0, -9.0), np.ones_like),
    "power of two numbers": (lambda x: jnp.where(x[0] ** x[0] > -1, 1.0, -9.0), np.ones_like),
    "sign": (lambda x: jnp.copysign(1.0, root(x)), np.ones_like),
    "constant NaN": (lambda x: jnp.nan_to_num(jnp.where(x[0] > 0.1, x[0], jnp.nan), nan=-7.0), np.copy),
    "comparison of a choice": (
        lambda x: jnp.where(jnp.where(x[0] > 0.1, x[0], jnp.nan) > -5, 1.0, -9.0), np.ones_like,
    ),
    "difference with itself": (lambda x: jnp.where(jnp.isnan((t := root(x)) - t), -9.0, 1.0), np.ones_like),
    "clip": (lambda x: jnp.nan_to_num(jnp.clip(root(x), 1, 2), nan=-7.0), np.ones_like),
    "sin x / x": (lambda x: jnp.nan_to_num(jnp.sin(x[0]) / x[0], nan=-7.0), None),
    "logit": (lambda x: jnp.nan_to_num(jax.scipy.special.logit(x[0]), nan=-7.0), None),
    "norm": (lambda x: jnp.nan_to_num(jnp.linalg.norm(jnp.sqrt(x)), nan=-7.0), np.sqrt),
    "cholesky": (lambda x: jnp.nan_to_num(jnp.linalg.cholesky(jnp.eye(2) * x[0]), nan=-7.0)[0, :1], np.sqrt),
    "remainder": (lambda x: jnp.nan_to_num(jnp.mod(1.0, x[0] + 1.0), nan=-7.0), None),
    "library function": (lambda x: jnp.isnan(jnp.hypot(root(x), 1.0)) * 9.0, np.zeros_like),
    "in a scan": (roots_seen(4), np.ones_like),
    "in a long scan": (roots_seen(40), np.ones_like),
    "after a loop": (last_root(4), np.ones_like),
    "after a long loop": (last_root(40), np.ones_like),
    "rows of a scan": (rows_seen(4), np.ones_like),
    "rows of a long scan": (rows_seen(40), np.ones_like),
}  # fmt: skip


@pytest.mark.parametrize("where", BOXES)
@pytest.mark.parametrize("name", LOOKS)
def test_what_looks_at_nan_stays_within_bounds(name, where):
    f, exact = LOOKS[name]
    lower, upper = BOXES[where]
    extra = [t for t in (-1.0, 0.0) if lower <= t <= upper]
    natural, jac = checked(f, lower, upper, extra=extra, count=12)
    if where == "inside" and exact is not None:
        # Nothing is lost where there is a value everywhere.
        ends = exact(np.array(INSIDE))
        np.testing.assert_allclose(sides(natural), ends, rtol=1e-9, atol=1e-12)
        assert np.isfinite([*np.ravel(jac.lower), *np.ravel(jac.upper)]).all()


@pytest.mark.parametrize("name", ["isnan", "fmax", "comparison", "cast", "argmax", "in a long scan"])
def test_in_single_precision(name):
    for lower, upper in BOXES.values():
        checked(LOOKS[name][0], lower, upper, np.float32, count=12)


def test_a_root_of_a_part_that_has_one_is_a_number():
    """The choice keeps the root off the part without a value, so what compares the result decides."""
    f = lambda x: jnp.where((y := jnp.where(x[0] > 0, jnp.sqrt(x[0]), 0.0)) > -1, y, -9.0)  # noqa: E731
    natural, _ = checked(f, -2, 4)
    np.testing.assert_allclose(sides(natural), [0, 2], atol=1e-9)


def test_functions_of_all_numbers_are_no_less_known():
    """Tests for NaN in what has a value everywhere cost nothing: on boxes without end, too."""
    box = Interval([-np.inf, 0.0], [np.inf, np.inf])
    form = inclusion.affine(lambda x: jnp.where(jnp.isnan(x * x[::-1]), 0.0, x))(box)
    assert form.slope.tolist() == [[1, 0], [0, 1]]
    plain = inclusion.natural(lambda x: jnp.where((p := x[0] * x[1]) == p, 1.0, 2.0))(box)
    assert sides(plain) == [1, 1]


def test_estimates_hold_what_looks_at_nan():
    def f(x):
        seen = jnp.where(jnp.isnan(jnp.sqrt(x[0])), -5.0, jnp.sqrt(x[0]))
        return jnp.stack([0.5 * x[0], 0.5 * x[1] + seen])

    states = estimated(f, v=1.5, least=1.0)
    assert states[:, 1].min() < -4
