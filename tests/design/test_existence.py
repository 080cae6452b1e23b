"""Two different refusals: proved absence, and a search that failed; and the other errors of `design_observer`."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import systems

import gsisio_jax as gx
from gsisio_jax import Interval
from gsisio_jax.design.feedthrough import factorise


def design(f, g, G, H, region=None, dw=0.1, dv=0.1, **options):
    n, l = len(G), len(H)
    system = gx.System(f, g, G, H, **options)
    noise = gx.Noise(systems.ball([dw] * n), systems.ball([dv] * l))
    return gx.design_observer(system, noise, Interval.entire(n) if region is None else region, missing=False)


def test_invisible_direction_is_proved_and_named():
    with pytest.raises(gx.ObserverDoesNotExist) as error:
        design(lambda x: 0.5 * x, lambda x: x[:1], np.eye(2), np.zeros((1, 2)))
    assert "(0, 1)" in str(error.value)
    assert "input_bounds" in str(error.value)


@pytest.mark.parametrize(("weight", "moved"), [(0.0, [[0.0], [0.0], [2.0]]), (0.3, [[0.0], [0.3], [-1.0]])])
def test_invisible_direction_of_a_nonlinear_plant(weight, moved):
    """y = sin(x1) + x2 + a x3 never sees an input that moves x2 and x3 as -a to 1."""
    with pytest.raises(gx.ObserverDoesNotExist) as error:
        design(lambda x: 0.5 * jnp.tanh(x), lambda x: jnp.stack([jnp.sin(x[0]) + x[1] + weight * x[2]]), moved, [[0.0]])
    assert "(1)" in str(error.value)


def test_state_or_input_bounds_along_the_direction_lift_the_proof():
    arguments = (lambda x: 0.5 * x, lambda x: x[:1], np.eye(2), np.zeros((1, 2)))
    bounded_input = design(*arguments, input_bounds=Interval([-np.inf, -1.0], [np.inf, 1.0]))
    assert bounded_input.certificate.certified
    bounded_state = design(*arguments, state_bounds=Interval([-np.inf, -3.0], [np.inf, 3.0]))
    assert bounded_state.certificate.certified


def test_direction_visible_elsewhere_is_no_proof():
    """The slope of x2^3 vanishes at the centre of the region, but not everywhere: no proof, only no design."""
    with pytest.raises(gx.NoDesignFound, match="region around another point"):
        design(
            lambda x: 0.5 * x,
            lambda x: jnp.stack([x[0] + x[1] ** 2]),
            [[0.0], [1.0]],
            [[0.0]],
            region=systems.ball([1.0, 1.0]),
        )


def test_output_too_flat_for_a_finite_box():
    """g = tanh on all of R: bounded, so its affine bounds are horizontal and lose the direction."""
    with pytest.raises(gx.NoDesignFound, match="state_bounds"):
        design(lambda x: 0.5 * x, lambda x: jnp.tanh(x), [[1.0]], [[0.0]], region=systems.ball([1.0]))
    bounded = design(
        lambda x: 0.5 * x,
        lambda x: jnp.tanh(x),
        [[1.0]],
        [[0.0]],
        region=systems.ball([1.0]),
        state_bounds=systems.ball([2.0]),
    )
    assert bounded.certificate.implicit_rate < 1


def test_closed_form_serves_where_the_first_sweep_is_not_finite():
    """x + 0.4 sin(3x) on R: its affine bounds are finite, |N_z| R < 1 fails; 2x + tanh: it holds."""
    observer = design(lambda x: 0.5 * x, lambda x: 2 * x + jnp.tanh(x), [[1.0]], [[0.0]], region=systems.ball([3.0]))
    assert observer.first.gains == (0,)
    est = gx.estimate(observer, Interval.entire(1), np.zeros((4, 1)))
    assert np.isfinite(est.state.width).all()


def test_derivatives_must_be_bounded_on_the_region():
    with pytest.raises(gx.NoDesignFound, match=r"`sqrt`, used at .*test_existence.py:\d+, has an unbounded derivative"):
        design(
            lambda x: jnp.sqrt(x), lambda x: x, [[1.0]], [[0.0]],
            region=Interval([0.0], [1.0]), state_bounds=Interval([0.0], [np.inf]),
        )  # fmt: skip


def test_negative_controls_get_no_certificate():
    """S4a has invariant zeros at -1, S7's control one at 1.0128: rank holds, widths must not be promised."""
    for case in (systems.s4(False), systems.s7_negative()):
        certificate = case.design(missing=False).certificate
        assert not certificate.certified
        assert not certificate.self_consistent
        assert np.isinf(certificate.steady_width).all()
        assert "NONE" in str(certificate)


def test_certificates_of_the_others():
    """S4b and S5 are certified and fit; on S1 the region decides; S9 is certified on a small region."""
    assert systems.s4(True).design(missing=False).certificate.self_consistent
    assert systems.s5().design(missing=False).certificate.self_consistent
    assert systems.s1(region=(1.0, 1.5)).design(missing=False).certificate.self_consistent
    empty = systems.s1(region=(1.0, 1.0)).design(missing=False).certificate
    assert empty.certified
    assert not empty.self_consistent
    assert empty.slack.min() < 0
    assert "EMPTY" in str(empty)


def test_region_auto_holds_its_own_width():
    case = systems.s1()
    found = gx.design_observer(case.system, case.noise, "auto", missing=False)
    assert found.certificate.self_consistent
    loud = dataclasses.replace(case, noise=gx.Noise(systems.ball([2.0] * 2), systems.ball([2.0] * 2)))
    with pytest.raises(gx.NoDesignFound, match="region"):
        gx.design_observer(loud.system, loud.noise, "auto", missing=False)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"region": Interval.entire(3)}, "`region`"),
        ({"region": "everywhere"}, "`region`"),
        ({"form": "prediction"}, "form"),
        ({"noise": gx.Noise(systems.ball([1.0]), systems.ball([1.0, 1.0]))}, "noise"),
        ({"u_region": Interval([0.0], [1.0])}, "u_region"),
        ({"sweeps": 0}, "sweeps"),
    ],
)
def test_bad_arguments(change, words):
    case = systems.s1()
    with pytest.raises(ValueError, match="design_observer") as error:
        gx.design_observer(**{"system": case.system, "noise": case.noise, "region": case.region, **change})
    assert words in str(error.value)


def test_u_region_is_asked_for():
    case = systems.s5()
    with pytest.raises(ValueError, match="u_region"):
        gx.design_observer(case.system, case.noise, case.region)


def test_left_null_space_is_exact_for_the_papers_matrix():
    """det of the paper's H is 7e-18 in floats, 0 in the decimals it is written in: T2 H must vanish exactly."""
    split = factorise(np.array([[-0.1, 0.3], [0.25, -0.75]]))
    assert split.rank == 1
    assert split.note == ""
    np.testing.assert_array_equal(split.T2, [[0.625, 0.25]])
    np.testing.assert_allclose(split.V1.T @ split.V2, 0, atol=1e-15)


def test_rank_by_declaration_is_noted():
    rng = np.random.default_rng(0)
    H = rng.normal(size=(4, 2)) @ rng.normal(size=(2, 3))
    split = factorise(H)
    assert split.rank == 2
    assert "nearest" in split.note
    assert np.abs(split.T2 @ H).max() < 1e-12
    assert factorise(np.zeros((3, 0))).rank == 0
    assert factorise(np.array([[0.0, 1.0], [0.0, 0.0], [0.0, 0.0]])).T2.tolist() == [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]


@pytest.mark.parametrize("through", [False, True])
def test_units_of_inputs_make_no_difference(through):
    """One in units 10^16 times those of the other: it was said to be proved invisible, and with a feedthrough that the
    measurements do not show it."""
    A, G = np.array([[0.9, 0.1], [-0.2, 0.8]]), np.array([[1.0, 0.3], [0.2, 1.0]])
    C = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    H = np.array([[1.0, 1.0], [1.0, -1.0], [0.0, 0.0]]) * through
    noise = gx.Noise(gx.Interval.symmetric([0.1, 0.1]), gx.Interval.symmetric([0.2, 0.2, 0.2]))
    found = []
    for unit in (np.ones(2), np.array([1e-8, 1e8])):
        system = gx.System(lambda x: A @ x, lambda x: C @ x, G=G * unit, H=H * unit)
        observer = gx.design_observer(system, noise, gx.Interval.entire(2), missing=False, sweeps=1, window=1)
        found.append((observer.certificate.steady_width, observer.certificate.input_width * unit))
    np.testing.assert_allclose(*found, rtol=1e-6)


def test_units_of_states_that_lie_far_apart_are_no_warning():
    system = gx.System(
        lambda x: jnp.array([[0.9, 1e-5], [-2e3, 0.8]]) @ x, lambda x: jnp.array([[1.0, 0.0], [1.0, 1e-4]]) @ x,
        G=[[1.0], [2e3]], H=np.zeros((2, 1)),
    )  # fmt: skip
    noise = gx.Noise(gx.Interval.symmetric([0.1, 1e3]), gx.Interval.symmetric([0.2, 0.2]))
    observer = gx.design_observer(system, noise, gx.Interval.entire(2), sweeps=1, window=1)
    np.testing.assert_allclose(observer.certificate.steady_width, [0.4, 8e3], rtol=1e-6)
