"""A gain of the plant without an output is a gain of the plant, and those are kept that bring something."""

import numpy as np
import pytest

from gsisio_jax import Interval
from gsisio_jax.design.feedthrough import factorise
from gsisio_jax.design.gain_selection import main_gain
from gsisio_jax.design.gains_without_outputs import gains_without_outputs, reduced
from gsisio_jax.design.problem import GainProblem


def problem(seed, feedthrough):
    """Two states, one input, three outputs, the last of them poor."""
    rng = np.random.default_rng(seed)
    F, E, G = 0.6 * rng.standard_normal((2, 2)), rng.standard_normal((3, 2)), rng.standard_normal((2, 1))
    H = np.array([[1.0], [-0.5], [0.0]]) if feedthrough else np.zeros((3, 1))
    T2, none = factorise(H).T2, np.zeros(0)
    C = T2 @ E
    free, dw, dv = np.array([True]), np.full(2, 0.02), np.array([0.1, 0.1, 2.0])
    return GainProblem(F, 0 * F, E, 0 * E, T2, C, 0 * C, G, H, free, dw, dv, none, none)


@pytest.mark.parametrize("feedthrough", [False, True])
def test_the_smaller_plant_sees_what_the_plant_sees_without_that_output(feedthrough):
    whole = problem(0, feedthrough)
    for j in range(3):
        less, mixed = reduced(whole, j)
        others = np.delete(np.arange(3), j)
        np.testing.assert_allclose((mixed @ whole.T2)[:, j], 0, atol=1e-15)
        np.testing.assert_allclose(less.T2 @ less.H, 0, atol=1e-15)
        assert np.linalg.matrix_rank(less.T2) == 2 - np.linalg.matrix_rank(whole.H[others])


@pytest.mark.parametrize("feedthrough", [False, True])
def test_gains_kept_cancel_the_input_and_one_leaves_the_poor_output_out(feedthrough):
    region, poor = Interval.entire(2), 0
    for seed in range(6):
        whole = problem(seed, feedthrough)
        main = main_gain(whole, region)
        for gain in gains_without_outputs(whole, [main], region):
            np.testing.assert_allclose(whole.residual(gain), 0, atol=1e-9 * (1 + np.abs(gain).max()))
            weights = np.abs(gain[:, :3]) + np.abs(gain[:, 3:] @ whole.T2)
            for i, row in enumerate(weights):
                if not np.allclose(gain[i], main[i]):
                    assert row.min() < 1e-12  # of the output that was left out
                    poor += row[2] < 1e-12
    assert poor


def test_a_gain_that_is_there_already_is_not_kept_twice():
    whole = problem(0, False)
    main = main_gain(whole, Interval.entire(2))
    kept = gains_without_outputs(whole, [main], Interval.entire(2))
    assert kept
    assert not gains_without_outputs(whole, [main, *kept], Interval.entire(2))
