"""Lemma 5 (widths and their limits), as printed and as corrected, against the paper's own recursion on S2."""

import full_rank_controls as controls
import numpy as np
import pytest

import gsisio_jax as gx
from gsisio_jax import Interval
from gsisio_jax.paper.lipschitz import lipschitz_constants
from gsisio_jax.paper.stability import Stability, stability
from gsisio_jax.paper.widths import width_bounds

STEPS = 60


@pytest.fixture(scope="module")
def found() -> dict[str, tuple[Stability, Stability]]:
    """(printed, corrected) on (a) to (d)."""
    out = {}
    for variant in "abcd":
        case, maps = controls.s2(variant), controls.plant(variant)
        derivative = (Interval(*maps.df), Interval(*maps.dg))
        constants = lipschitz_constants(case.system, case.region, derivative=derivative)
        out[variant] = tuple(
            stability(case.system, case.noise, case.region, printed, constants=constants) for printed in (True, False)
        )
    return out


def run(variant: str, lower, upper, seed: int = 0, steps: int = STEPS) -> controls.Run:
    case = controls.s2(variant)
    d = controls.unknown_input(steps)
    return controls.run(case.system, controls.plant(variant), case.noise, lower, upper, d, seed)


SCALAR_NOISE = gx.Noise(Interval.symmetric([0.1]), Interval.symmetric([0.2]))


def scalar(sign: float = 1.0) -> gx.System:
    """x+ = .2 x + s d + w, y = .1 x + s d + v: J = s (1/2, 1/2), rho = 1/2, T_f = 3, T_g = 1, L = .7."""
    return gx.System(_fifth, _tenth, G=[[sign]], H=[[sign]])


def _fifth(x):
    return 0.2 * x


def _tenth(x):
    return 0.1 * x


SCALAR_MAPS = controls.Plant(
    _fifth, _tenth, (np.array([[0.2]]), np.array([[0.2]])), (np.array([[0.1]]), np.array([[0.1]]))
)


def scalar_run(sign: float, width: float, steps: int = STEPS) -> controls.Run:
    d = 3 * np.sin(np.arange(steps))[:, None]
    return controls.run(scalar(sign), SCALAR_MAPS, SCALAR_NOISE, [-width / 2], [width / 2], d)


def scalar_stability(sign: float = 1.0, printed: bool = False) -> Stability:
    return stability(scalar(sign), SCALAR_NOISE, Interval.entire(1), printed)


def below(measured, bound) -> bool:
    return bool((measured <= bound * (1 + 1e-9) + 1e-9).all())


@pytest.mark.parametrize("variant", "abcd")
def test_measured_widths_stay_below_the_corrected_sequences(variant, found):
    """Norms and components, of states and of inputs, from the printed box, small ones and a point; no box misses."""
    case = controls.s2(variant)
    center, width = np.asarray(case.initial.center), np.asarray(case.initial.width)
    for share, seed in ((1.0, 0), (0.1, 1), (0.0, 2), (3.0, 3)):
        seen = run(variant, center - share * width / 2, center + share * width / 2, seed)
        assert seen.misses() == 0
        bounds = width_bounds(found[variant][1], share * width, STEPS)
        assert below(np.linalg.norm(seen.x_width, axis=1), bounds.state)
        assert below(np.linalg.norm(seen.d_width, axis=1), bounds.input)
        assert below(seen.x_width, bounds.state_elementwise)
        assert below(seen.d_width, bounds.input_elementwise)
        assert below(np.linalg.norm(bounds.state_elementwise, axis=1), bounds.state)
        assert below(np.linalg.norm(bounds.input_elementwise, axis=1), bounds.input)
        assert below(np.linalg.norm(seen.x_width, axis=1).max(), bounds.uniform)
        assert below(np.linalg.norm(seen.x_width, axis=1).max(), bounds.weighted)


def test_contractive_control_reaches_its_limits(found):
    """(d): L < 1; sequences converge to their limits, the elementwise one is tighter, and the width ends below both."""
    result = found["d"][1]
    bounds = width_bounds(result, [3.1, 3.1], 400)
    assert result.condition_i
    assert bounds.state[-1] == pytest.approx(bounds.state_limit)
    assert bounds.input[-1] == pytest.approx(bounds.input_limit)
    np.testing.assert_allclose(bounds.state_elementwise[-1], bounds.state_elementwise_limit)
    np.testing.assert_allclose(bounds.input_elementwise[-1], bounds.input_elementwise_limit)
    assert np.linalg.norm(bounds.state_elementwise_limit) < 0.9 * bounds.state_limit
    assert bounds.weighted_limit == pytest.approx(bounds.state_limit, rel=1e-3)
    last = run("d", [-1.1, -2], [2, 1.1]).x_width[-1]
    assert (last <= bounds.state_elementwise_limit * (1 + 1e-9)).all()


@pytest.mark.parametrize("variant", "abcd")
def test_printed_T_f_is_no_bound(variant, found):
    """P8: from a point, the first width is exactly the corrected ||dz||, above the printed one = delta^x_1."""
    printed, corrected = found[variant]
    seen = run(variant, [0.5, -0.5], [0.5, -0.5], steps=1)
    measured = np.linalg.norm(seen.x_width[1])
    assert measured == pytest.approx(np.linalg.norm(corrected.noise_width))
    assert measured > 1.001 * width_bounds(printed, np.zeros(2), 1, printed=True).state[1]


def test_printed_T_f_is_no_bound_at_any_step():
    """P8 on the scalar control: the printed T_f is 1, not 3; measured widths exceed the printed sequence by half."""
    printed = scalar_stability(printed=True)
    assert printed.T_f.item() == pytest.approx(1)
    assert scalar_stability().T_f.item() == pytest.approx(3)
    assert printed.condition_i
    seen = scalar_run(1.0, 2.0)
    bounds = width_bounds(printed, [2.0], STEPS, printed=True)
    assert (seen.x_width[1:, 0] > 1.5 * bounds.state[1:]).all()
    assert seen.misses() == 0


def test_corrected_bounds_are_attained_on_the_scalar_control():
    for sign in (1.0, -1.0):
        seen, bounds = scalar_run(sign, 2.0), width_bounds(scalar_stability(sign), [2.0], STEPS)
        np.testing.assert_allclose(seen.x_width[:, 0], bounds.state)
        np.testing.assert_allclose(seen.d_width[:, 0], bounds.input)
        np.testing.assert_allclose(seen.x_width, bounds.state_elementwise)
        np.testing.assert_allclose(seen.d_width, bounds.input_elementwise)


def test_printed_limit_is_below_the_limit_of_its_own_sequence(found):
    """P10: ||dz|| L / (1 - L) against ||dz|| / (1 - L); measured widths exceed it too."""
    for result in (found["d"][1], found["d"][0], scalar_stability()):
        bounds = width_bounds(result, np.zeros(len(result.noise_width)), 3000, printed=True)
        L, noise = result.contraction, np.linalg.norm(result.noise_width)
        assert L < 1
        assert bounds.state[-1] == pytest.approx(noise / (1 - L))
        assert bounds.state_limit == pytest.approx(noise * L / (1 - L))
        assert bounds.state_limit < 0.99 * bounds.state[-1]
    printed = width_bounds(found["d"][0], [3.1, 3.1], 1, printed=True).state_limit
    late = np.linalg.norm(run("d", [-1.1, -2], [2, 1.1]).x_width[20:], axis=1)
    assert late.min() > 1.02 * printed
    measured = scalar_run(1.0, 0.0).x_width[-1, 0]
    wrong, right = (width_bounds(scalar_stability(), [0.0], 1, printed=flag).state_limit for flag in (True, False))
    assert wrong < 0.75 * measured
    assert measured == pytest.approx(right)


def test_printed_J_hat_loses_negative_entries():
    """P10: with G = H = -1 the printed Jhat is 0, so is the printed input bound; the box of d is not a point."""
    bounds = width_bounds(scalar_stability(-1.0), [2.0], STEPS, printed=True)
    assert bounds.input.max() == 0
    assert bounds.input_limit == 0
    assert scalar_run(-1.0, 2.0).d_width.min() > 1


def test_input_bound_needs_both_widths():
    """P10: with |J| for Jhat, the bound from the width of x[k] alone is below the measured one while widths shrink."""
    result, seen = scalar_stability(), scalar_run(1.0, 100.0)
    now = np.abs(result.J1).item() * 1.2 + np.abs(result.J2).item() * 0.1  # (1 + L_fd) |J1| + L_gd |J2|
    noise = (np.abs(result.J1) @ result.width_w + np.abs(result.J2) @ result.width_v).item()
    alone = now * seen.x_width[1:, 0] + noise
    assert seen.d_width[0, 0] > alone[0] + 1
    assert below(seen.d_width[:, 0], width_bounds(result, [100.0], STEPS).input)


def test_the_sequence_is_its_closed_form_and_L_of_one_and_more():
    """L^k D + ||dz|| (1 - L^k) / (1 - L); L = 1: D + k ||dz||; beyond: finite sequence, no limit."""
    result, k = scalar_stability(), np.arange(31)
    noise = np.linalg.norm(result.noise_width)
    for L in (0.3, 0.999, 1.0, 1.2):
        bounds = width_bounds(result._replace(contraction=L), [2.0], 30)
        expected = 2 + k * noise if L == 1 else L**k * 2 + noise * (1 - L**k) / (1 - L)
        np.testing.assert_allclose(bounds.state, expected, rtol=1e-10)
        assert np.isfinite(bounds.state_limit) == (L < 1)
        assert np.isfinite(bounds.input_limit) == (L < 1)
        assert np.isfinite(bounds.uniform) == (L < 1)
    huge = width_bounds(result._replace(contraction=1e300), [2.0], 5)
    assert huge.state[-1] == np.inf
    assert not np.isnan(huge.input).any()


def test_bound_of_conditions_ii_and_iii(found):
    """Printed: no P exists, Delta^P_0 = inf, so ||D_0|| is left as the uniform bound: 0 from a point, and exceeded
    at once. Corrected: the larger of ||D_0|| and ||dz|| / (1 - L)."""
    printed, corrected = found["d"]
    wrong = width_bounds(printed, np.zeros(2), 5, printed=True)
    assert wrong.weighted == np.inf
    assert wrong.uniform == 0
    assert width_bounds(corrected, np.zeros(2), 5, printed=True).weighted == np.inf
    measured = np.linalg.norm(run("d", [0.5, -0.5], [0.5, -0.5]).x_width, axis=1).max()
    assert measured > 0.5
    right = width_bounds(corrected, np.zeros(2), 5)
    assert measured <= right.uniform <= right.weighted <= 1.001 * right.uniform
    wide = width_bounds(corrected, [30.0, 40.0], 5)
    assert wide.uniform == 50
    assert wide.weighted == pytest.approx(50, rel=1e-4)
    assert width_bounds(found["b"][1], [1.0, 1.0], 5).weighted == np.inf


def test_nothing_is_promised_where_the_boxes_are_no_framers():
    """H = 0: rho = 1. Elementwise limits are infinite, and no NaN arises from 0 * inf."""
    plant = gx.System(_fifth, _tenth, G=[[1.0]], H=[[0.0]])
    result = stability(plant, SCALAR_NOISE, Interval.entire(1))
    bounds = width_bounds(result, [1.0], 3)
    assert bounds.state_elementwise_limit.tolist() == [np.inf]
    assert bounds.input_elementwise_limit.tolist() == [np.inf]
    blind = gx.System(_fifth, _tenth, G=[[0.0]], H=[[1.0]])  # d enters y alone: J1 = 0
    limits = width_bounds(stability(blind, SCALAR_NOISE, Interval.entire(1)), [1.0], 3)
    assert limits.state_elementwise_limit == pytest.approx(0.25)
    assert limits.input_elementwise_limit == pytest.approx(0.425)
    # y does not see the unstable state: the box of d is as wide as v.
    apart = gx.System(lambda x: 2 * x, lambda x: 0 * x, G=[[0.0]], H=[[1.0]])
    limits = width_bounds(stability(apart, SCALAR_NOISE, Interval.entire(1)), [1.0], 3)
    assert limits.state_elementwise_limit.tolist() == [np.inf]
    assert (limits.input_limit, *limits.input_elementwise_limit) == pytest.approx((0.4, 0.4))


def test_errors_and_no_steps():
    result = scalar_stability()
    none = width_bounds(result, [2.0], 0)
    assert none.state.tolist() == [2.0]
    assert none.input.shape == (0,)
    assert none.input_elementwise.shape == (0, 1)
    for width in ([1.0, 2.0], [-1.0], [np.inf], [np.nan]):
        with pytest.raises(ValueError, match="initial_width"):
            width_bounds(result, width, 3)
    with pytest.raises(ValueError, match="steps"):
        width_bounds(result, [1.0], -1)
