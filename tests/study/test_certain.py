"""Simulated runs that are, exactly, those of the plant as stated; and what the slack of the others may hide."""

from dataclasses import dataclass
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np

import gsisio_jax as gx
from gsisio_jax import Interval, study
from gsisio_jax.plant.simulation import measured
from gsisio_jax.study import certain
from gsisio_jax.study.containment import Containment

A, G, H = np.array([[0.1, 0.7], [-0.3, 1.1]]), np.array([[0.1], [0.3]]), np.array([[0.0], [0.7]])
PLANT = gx.System(lambda x: A @ x, lambda x: x, G=G, H=H)


def _held(total, parts):
    """What is left of a sum, in fractions, without the products of these parts (matrix, vector)."""

    def product(row, vector):
        return sum(Fraction(str(a)) * Fraction(float(b)) for a, b in zip(row, vector, strict=True))

    return [Fraction(float(v)) - sum(product(matrix[i], b) for matrix, b in parts) for i, v in enumerate(total)]


def _outside(found, x, d, box, matrix, of_d):
    low, high = ([Fraction(float(v)) for v in side] for side in (box.lower, box.upper))
    return sum(
        not all(a <= v <= b for a, v, b in zip(low, _held(*row), high, strict=True))
        for row in ((t, ((matrix, s), (of_d, e))) for t, s, e in zip(found, x, d, strict=True))
    )


def test_noise_on_its_bounds_is_within_them_for_certain():
    """With the decimals as they are written. A sum that is only rounded is outside in many of these."""
    rng, box = np.random.default_rng(0), Interval.symmetric([0.1, 0.3])
    x, d, sign = 100 * rng.normal(size=(60, 2)), 1e3 * rng.normal(size=(60, 1)), rng.choice([-1.0, 1.0], (60, 2))
    noise, u = sign * np.asarray(box.upper), np.zeros(0)
    for function, matrix, of_d in ((certain.next_state, A, G), (certain.measurement, np.eye(2), H)):

        def step(strict, function=function):
            return jax.jit(jax.vmap(lambda x, d, w: function(PLANT, x, d, u, w, box, strict)))(x, d, noise)

        found, exact = step(True)
        assert np.asarray(exact).all()
        assert _outside(found, x, d, box, matrix, of_d) == 0
        assert np.abs(np.asarray(found) - x @ matrix.T - d @ of_d.T - noise).max() < 1e-11
        assert _outside(step(False)[0], x, d, box, matrix, of_d) > 10


def test_without_room_nothing_is_certain():
    for box in (Interval([0.0, -1.0], [0.0, 1.0]), Interval([0.0, -1.0], [1e-17, 1.0])):
        arguments = PLANT, np.ones(2), np.ones(1), np.zeros(0), np.asarray(box.upper), box
        assert not certain.next_state(*arguments, True)[1]


def test_an_output_that_is_drawn_wrong_stays_wrong():
    """It was pulled into its bounds, so that no run of an observer that tolerates wrong outputs had one."""
    arguments = PLANT, np.ones(2), np.ones(1), np.zeros(0), np.array([5.0, 0.01]), Interval.symmetric([0.1, 0.1])
    np.testing.assert_allclose(measured(*arguments)[0], [6.0, 1.71])
    found, exact = certain.measurement(*arguments, True)
    np.testing.assert_allclose(found, [6.0, 1.71])
    assert exact  # of the others; whether so many may be wrong is another question


def test_a_wide_box_hides_no_miss():
    """A share of its width is more than rounding, where boxes usually are narrower; an exact truth needs no slack."""
    box, none = Interval([0.0, 0.0], [1e10, 1.0]), jnp.zeros(2)
    compare = Containment(True).compare
    np.testing.assert_array_equal(compare((none, none), box, jnp.array([-5.0, -1e-10]), False, jnp.ones(2))[0], [0, 1])
    np.testing.assert_array_equal(compare((none, none), box, jnp.array([-1e-12, -1e-10]), True, jnp.ones(2))[0], [0, 0])


@dataclass(frozen=True)
class Exact(study.Reduction):
    """At how many steps the truth was known to be exact."""

    name = "exact"

    def init(self, first, context):
        return jnp.asarray(context.exact, float)

    def update(self, state, out, k, context):
        return state + context.exact

    def finish(self, state, steps, context):
        return {"exact": state}


def test_studies_of_vertices_hold_boxes_against_an_exact_truth():
    system = gx.System(lambda x: 0.9 * x, lambda x: x, G=np.zeros((1, 0)), H=np.zeros((1, 0)))
    noise = gx.Noise(Interval.symmetric([0.1]), Interval.symmetric([0.3]))
    observer = gx.design_observer(system, noise, Interval.entire(1), missing=False, sweeps=1, window=1)
    for draw, exact in (("vertices", 8), ("uniform", 0)):
        found = gx.monte_carlo(
            observer, 1, 20, 8, Interval([-1.0], [1.0]), reduce=Exact(), draw=draw, on_miss="record", progress=False
        )
        assert (found.exact == exact).all()
        assert found.attrs["missed"].startswith("0 of 20")
