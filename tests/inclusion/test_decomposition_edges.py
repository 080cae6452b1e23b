"""Decomposition functions at their limits: no width, unknown derivatives, odd results, gradients, bad arguments."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles.uncompiled import in_numpy

from gsisio_jax import Interval, inclusion

FORMS = {
    "decomposition": inclusion.decomposition,
    "remainder": inclusion.remainder,
    "tight": inclusion.tight,
}


@pytest.mark.parametrize("form", FORMS)
def test_box_of_zero_width_with_unknown_derivative(form):
    """Nothing is known of the slope, and nothing need be."""
    box = FORMS[form](lambda x: 3 * x, Interval.entire((1, 1)))(Interval([0.5], [0.5]))
    assert box.lower.item() == box.upper.item() == 1.5


@pytest.mark.parametrize("form", FORMS)
def test_unknown_and_half_known_derivatives(form):
    """Infinite on both sides: nothing is known but the value at a point. On one side: the other one is used."""
    bounded = FORMS[form](lambda x: x**2, Interval([[-1.0]], [[np.inf]]))(Interval([-0.5], [2.0]))
    assert -2.25 <= bounded.lower.item() <= 0
    assert 4 <= bounded.upper.item() <= 6.5
    entire = FORMS[form](lambda x: x**2, Interval.entire((1, 1)))(Interval([-0.5], [2.0]))
    expected = [0, 4] if form == "tight" else [-np.inf, np.inf]
    assert [entire.lower.item(), entire.upper.item()] == expected


@pytest.mark.parametrize("form", FORMS)
def test_f_is_never_evaluated_at_infinity(form):
    """atan2(x^2, x) = atan(x) grows to pi/2, but atan2(inf, inf) is pi/4 in floating point."""
    box = FORMS[form](lambda x: jnp.arctan2(x[0] ** 2, x[0]), Interval([0.0], [0.5]))(Interval([1.0], [np.inf]))
    assert box.lower == pytest.approx(np.pi / 4)
    assert box.upper >= np.pi / 2


@pytest.mark.parametrize("form", FORMS)
def test_outside_the_domain_and_beyond_the_largest_number(form):
    """A corner without value says nothing, a pole even less; an overflow is no lower bound."""
    bound, box = FORMS[form], Interval([-1.0], [4.0])
    root = bound(lambda x: jnp.sqrt(x[0]))(box)
    assert (root.lower, root.upper) == (0 if form == "tight" else -np.inf, 2)
    pole = bound(lambda x: 1 / x[0])(box)
    assert (pole.lower, pole.upper) == (-np.inf, np.inf)
    large = bound(lambda x: jnp.exp(x[0]), Interval([0.0], [np.inf]))(Interval([800.0], [900.0]))
    assert (large.lower, large.upper) == (np.finfo(float).max, np.inf)


@pytest.mark.parametrize("form", FORMS)
def test_forms_of_results_and_arguments(form):
    """Trees, no rows, no coordinates, no result that is a float; arguments that are arrays or boxes; float32."""
    bound, box = FORMS[form], Interval([-1.0, 0.5], [1.0, 1.5])
    no_coordinate, short = Interval([], []), Interval(np.float32([-1, 0]), np.float32([1, 0.5]))
    tree, no_rows, constant, known, wide, single = jax.jit(
        lambda: (
            bound(lambda x: {"sign": x[0] > 2, "table": x[:, None] + x})(box),
            bound(lambda x: jnp.ones((0,)))(box),
            bound(lambda x: jnp.ones(2))(no_coordinate),
            bound(lambda x, u: x[0] + u["k"])(box, {"k": 0.5}),
            bound(lambda x, u: x[0] + u)(box, Interval(0.0, 2.0)),
            bound(lambda x: x[0] - x[1])(short),
        )
    )()
    assert (tree["sign"].lower.item(), tree["sign"].upper.item()) == (0, 0)
    np.testing.assert_allclose(tree["table"].lower, np.add.outer(box.lower, box.lower))
    np.testing.assert_allclose(tree["table"].upper, np.add.outer(box.upper, box.upper))
    assert no_rows.shape == (0,)
    np.testing.assert_array_equal([constant.lower, constant.upper], np.ones((2, 2)))
    assert (known.lower.item(), known.upper.item()) == (-0.5, 1.5)
    assert (wide.lower.item(), wide.upper.item()) == (-1.0, 3.0)
    assert single.dtype == np.float32
    assert (single.lower.item(), single.upper.item()) == (-1.5, 1.0)


def test_gradients_equal_difference_quotients():
    """Through the Jacobian enclosure, the corners and the centers; no NaN from infinite boxes."""

    def sides(ends):
        box = Interval.unchecked(*ends)
        jac = inclusion.jacobian(f)(box)
        found = [form(f, jac)(box) for form in FORMS.values()]
        value = jnp.stack([side for bounds in found for side in (bounds.lower, bounds.upper)])
        return jnp.where(jnp.isfinite(value), value, 0)

    def f(x):
        return x[0] * jnp.sin(x[1]) + x[0] ** 2

    ends, step = np.array([[-0.61, -0.37], [0.83, 0.52]]), 1e-6
    half_line = np.array([[-0.61, -np.inf], [np.inf, 0.52]])
    moves = step * np.eye(4).reshape(4, 2, 2)
    plain = in_numpy(jax.vmap(sides))
    quotient = (np.asarray(plain(ends + moves)) - np.asarray(plain(ends - moves))) / (2 * step)
    exact, infinite = np.asarray(in_numpy(jax.vmap(jax.jacrev(sides)))(np.stack([ends, half_line])))
    np.testing.assert_allclose(exact.reshape(6, 4), quotient.T, rtol=1e-6, atol=1e-7)
    assert np.isfinite(infinite).all()


@pytest.mark.parametrize(
    ("derivative", "message"),
    [
        (Interval.unchecked(np.array([[1.0, 0.0]]), np.array([[0.0, 1.0]])), r"lower <= upper.*\[1.0, 0.0\] at index"),
        (Interval.unchecked(np.array([[0.0, np.nan]]), np.ones((1, 2))), r"no NaN.*index \[0, 1\]"),
        (Interval.unchecked(np.zeros((1, 2)), np.array([[1.0, np.nan]])), r"no NaN.*index \[0, 1\]"),
        (Interval.unchecked(np.full((1, 2), np.inf), np.full((1, 2), np.inf)), "lower <= upper"),
        (Interval.unchecked(np.zeros((1, 2)), np.ones((1, 1))), "one shape"),
        (Interval(np.zeros((2, 2)), np.ones((2, 2))), r"\(1, 2\), got \(2, 2\)"),
        (Interval(np.zeros(2), np.ones(2)), r"\(1, 2\), got \(2,\)"),
        (np.ones((1, 2)), "must be an Interval.*ndarray"),
    ],
    ids=["crossed", "nan below", "nan above", "empty", "two shapes", "rows", "no row axis", "array"],
)
@pytest.mark.parametrize("form", [*FORMS, "decomposition_function"])
def test_bad_derivative_bounds(form, derivative, message):
    make = getattr(inclusion, form)
    where = (np.zeros(2), np.ones(2)) if form == "decomposition_function" else (Interval(np.zeros(2), np.ones(2)),)
    with pytest.raises(ValueError, match=rf"inclusion\.{form}: .*`derivative`.*{message}"):
        make(lambda x: x[:1], derivative)(*where)


def test_other_bad_arguments():
    def f(x, u=0.0):
        return x + u

    for name, form in FORMS.items():
        with pytest.raises(ValueError, match=rf"inclusion\.{name}: the first argument must be an Interval of shape"):
            form(f)(np.zeros(2))
        with pytest.raises(ValueError, match=rf"inclusion\.{name}: .*shape \(2, 2\)"):
            form(f)(Interval(np.zeros((2, 2)), np.ones((2, 2))))
    with pytest.raises(ValueError, match=r"remainder: .*at most 10, got n = 11; use inclusion\.tight"):
        inclusion.remainder(f)(Interval(np.zeros(11), np.ones(11)))
    assert jax.eval_shape(inclusion.tight(f), Interval(np.zeros(11), np.ones(11))).shape == (11,)
    unit = Interval(np.ones((1, 1)), np.ones((1, 1)))
    with pytest.raises(ValueError, match='"cases" or "optimal", got \'best\''):
        inclusion.decomposition_function(f, unit, "best")
    f_d = inclusion.decomposition_function(f, unit)
    with pytest.raises(ValueError, match=r"x and y must be points of shape \(n,\), got shapes \(1,\) and \(2,\)"):
        f_d(np.zeros(1), np.zeros(2))
    with pytest.raises(ValueError, match="must be arrays, got an Interval"):
        f_d(np.zeros(1), np.zeros(1), Interval(0.0, 1.0))
