"""The prediction form (paper, Theorem 1): right where rho(|G||J1|) < 1, and marked where it is not."""

import full_rank_controls
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import systems
from full_rank_controls import DF, DG

import gsisio_jax as gx
from gsisio_jax import Interval, Status
from gsisio_jax.design.framer import framer_gains

RUNS = 20
# Last widths of theory 12.2, decomposition bounds alone; (c) diverges.
PRINTED = {"a": (1.89, 3.44), "b": (1.44, 1.47), "c": None}


def derivative(variant: str) -> Interval:
    """The paper's way: bounds of the partial derivatives on all of R^2."""
    share = 0.5 if variant == "a" else 1.0
    return Interval(np.vstack([share * DF[0], DG[0]]), np.vstack([share * DF[1], DG[1]]))


def inside(box: Interval, value, slack=1e-12):
    """Up to rounding, which is bounded elsewhere."""
    return ((box.lower - slack <= value) & (value <= box.upper + slack)).all()


@pytest.mark.parametrize("variant", full_rank_controls.VARIANTS)
def test_full_rank_controls_with_decomposition_bounds(variant):
    """S2: the printed recursion equals the reference figures and never misses x, d or the current input."""
    case = full_rank_controls.s2(variant)
    observer = gx.design_observer(
        case.system,
        case.noise,
        case.region,
        form="prediction",
        bounds=["decomposition"],
        derivative=derivative(variant),
    )
    sims, ds = jax.vmap(case.simulate)(jax.random.split(jax.random.key(3), RUNS))
    estimates = jax.vmap(lambda y: gx.estimate(observer, case.initial, y))(sims.y)
    size = 1e-12 * (1 + np.abs(estimates.state.upper).max())
    assert inside(estimates.state, sims.x[:, :-1], size)
    assert inside(estimates.input, ds[:, :-1], size)
    assert inside(estimates.current_input, ds @ observer.current_input_directions, size)
    last = np.asarray(estimates.state.width[:, -1]).mean(0)
    if PRINTED[variant] is None:
        assert (last > 1e6).all()
    else:
        np.testing.assert_allclose(last, PRINTED[variant], rtol=0.02)
        assert not np.asarray(estimates.status).any()
    # Against the printed equations in NumPy, from the same measurements.
    plain = full_rank_controls.run(
        case.system, full_rank_controls.plant(variant), case.noise, case.initial.lower, case.initial.upper,
        full_rank_controls.unknown_input(30),
    )  # fmt: skip
    assert plain.misses() == 0


def test_current_input_is_that_of_lemma_4():
    """The printed bounds, with the decomposition function of g: no slopes to combine, so nothing can be tighter."""
    case = full_rank_controls.s2("a")
    options = {"bounds": ["decomposition"], "derivative": derivative("a")}
    observer = gx.design_observer(case.system, case.noise, case.region, form="prediction", **options)
    sim, _ = case.simulate(jax.random.key(8))
    estimate = gx.estimate(observer, case.initial, sim.y)
    maps = full_rank_controls.plant("a")
    weights = np.asarray(observer.current)  # Phi T1
    positive, negative = np.maximum(weights, 0), np.maximum(-weights, 0)
    lower, upper = np.asarray(estimate.state.lower), np.asarray(estimate.state.upper)
    for k in range(0, 200, 20):
        g_low = full_rank_controls.decomposition(maps.g, maps.dg, lower[k], upper[k]) + case.noise.v.lower
        g_up = full_rank_controls.decomposition(maps.g, maps.dg, upper[k], lower[k]) + case.noise.v.upper
        seen = weights @ np.asarray(sim.y[k])
        np.testing.assert_allclose(
            estimate.current_input.upper[k], seen + negative @ g_up - positive @ g_low, rtol=1e-9
        )
        np.testing.assert_allclose(
            estimate.current_input.lower[k], seen + negative @ g_low - positive @ g_up, rtol=1e-9
        )
    # Phi T1 H V1 = I: what is bounded is V1' d.
    np.testing.assert_allclose(weights @ case.system.H @ observer.current_input_directions, np.eye(2), atol=1e-12)


def test_default_bounds_are_tighter_and_keep_the_certificate():
    case = full_rank_controls.s2("a")
    observer = gx.design_observer(case.system, case.noise, systems.ball([2.5, 2.5]), form="prediction")
    certificate = observer.certificate
    assert certificate.self_consistent
    assert certificate.framer
    sim, d = case.simulate(jax.random.key(4))
    estimate = gx.estimate(observer, Interval(sim.x[0] - 0.3, sim.x[0] + 0.3), sim.y)
    assert inside(estimate.state, sim.x[:-1])
    assert inside(estimate.input, d[:-1])
    width = np.asarray(estimate.state.width)
    within = ((estimate.state.lower >= -2.5) & (estimate.state.upper <= 2.5)).all(1)
    promised = np.asarray(certificate.next_width(width[:-1], case.noise))
    kept = np.asarray(within[:-1])
    assert kept.sum() > 20
    assert (width[1:][kept] <= promised[kept] * (1 + 1e-12)).all()
    d_promised = np.asarray(certificate.input_width_after(width[1:], width[:-1], case.noise))
    assert (np.asarray(estimate.input.width)[kept] <= d_promised[kept] * (1 + 1e-12)).all()
    assert (np.asarray(estimate.status)[:-1][kept] & Status.OUTSIDE_REGION == 0).all()


def test_rank_deficient_feedthrough_is_refused_with_rho_and_the_reason():
    case = systems.s1()
    with pytest.raises(gx.FramerNotGuaranteed, match=r"rho\(\|G\|\|J1\|\) = 1\.927.*rank 1 with 2.*form=\"current\""):
        gx.design_observer(case.system, case.noise, case.region, form="prediction")
    with pytest.raises(ValueError, match="full column rank"):
        gx.design_observer(case.system, case.noise, case.region, form="prediction", left_inverse="feedthrough")


def test_the_printed_recursion_crosses_at_once_and_says_so():
    """P4: 200 of 200 runs of the paper's example."""
    case = systems.s1()
    observer = gx.design_observer(
        case.system, case.noise, case.region, form="prediction", bounds=["natural"], allow_uncertified=True
    )
    assert "NO framer" in str(observer.certificate)
    sims, _ = jax.vmap(case.simulate)(jax.random.split(jax.random.key(5), 200))
    estimates = jax.vmap(lambda y: gx.estimate(observer, case.initial, y))(sims.y[:, :4])
    assert (np.asarray(estimates.status)[:, 1:] & Status.CROSSED != 0).all()
    assert (np.asarray(estimates.state.width)[:, 1].min(-1) < 0).all()
    assert not np.isnan(np.asarray(estimates.state.lower)).any()


def plant_with_known_input(rank: int = 2):
    """Affine, m = 2, feedthrough of full rank, offset noise boxes."""
    A, C = np.array([[0.6, 0.2, 0.0], [-0.1, 0.5, 0.1], [0.0, 0.3, 0.4]]), np.array([[1.0, 0, 0], [0, 1, 0.5]])
    system = gx.System(
        lambda x: jnp.asarray(A, x.dtype) @ x, lambda x: jnp.asarray(C, x.dtype) @ x,
        G=[[0.1, 0.0], [0.2, -0.1], [0.0, 0.1]], H=[[1.0, 0.2], [0.3, -1.0]],
        B=[[0.5, 0], [0, 1], [1, 1]], D=[[0.1, 0.2], [0, 0.3]],
    )  # fmt: skip
    noise = gx.Noise(Interval([-0.1, 0.0, -0.2], [0.2, 0.1, 0.0]), Interval([-0.1, 0.0], [0.0, 0.3]))
    return system, noise, A, C


@pytest.mark.parametrize("left_inverse", ["pseudo", "feedthrough", "smallest"])
def test_closed_form_and_known_inputs_against_a_numpy_loop(left_inverse):
    """P6, P7: with A_y supplied and B, D in place, one linear fixed point per step, solved here anew."""
    system, noise, A, C = plant_with_known_input()
    options = {"left_inverse": left_inverse, "bounds": ["natural"]}  # exact here, and quick to compile
    observer = gx.design_observer(system, noise, Interval.entire(3), form="prediction", **options)
    random = np.random.default_rng(1)
    d, u = 5 * random.standard_normal((12, 2)), random.standard_normal((12, 2))
    sim = gx.simulate(system, jax.random.key(6), [0.1, 0.2, 0.3], d, noise, u)
    initial = Interval([-1.0] * 3, [1.0] * 3)
    estimate = gx.estimate(observer, initial, sim.y, u)
    assert inside(estimate.state, sim.x[:-1])
    assert inside(estimate.input, d[:-1])
    G, B, D = (np.asarray(matrix) for matrix in (system.G, system.B, system.D))
    J = np.asarray(observer.left_inverse)
    low, up = initial.lower, initial.upper
    for k in range(1, 12):
        f_low, f_up = np.minimum(A * low, A * up).sum(1), np.maximum(A * low, A * up).sum(1)
        g_low, g_up = np.minimum(C * low, C * up).sum(1), np.maximum(C * low, C * up).sum(1)
        f_low, f_up = f_low + B @ u[k - 1] + noise.w.lower, f_up + B @ u[k - 1] + noise.w.upper
        seen = np.asarray(sim.y[k - 1]) - D @ u[k - 1]
        h_low, h_up = seen - g_up - noise.v.upper, seen - g_low - noise.v.lower
        low, up = f_low, f_up
        for _ in range(400):  # x = f + B u + G d + w and d = J h, in turn: a contraction, as rho < 1
            full_low, full_up = np.concatenate([low - f_up, h_low]), np.concatenate([up - f_low, h_up])
            d_low = np.minimum(J * full_low, J * full_up).sum(1)
            d_up = np.maximum(J * full_low, J * full_up).sum(1)
            low = f_low + np.minimum(G * d_low, G * d_up).sum(1)
            up = f_up + np.maximum(G * d_low, G * d_up).sum(1)
        np.testing.assert_allclose(estimate.state.lower[k], low, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(estimate.state.upper[k], up, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(estimate.input.lower[k - 1], d_low, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(estimate.input.upper[k - 1], d_up, rtol=1e-9, atol=1e-9)


def test_left_inverses():
    system, noise, _, _ = plant_with_known_input()

    def design(left_inverse):
        return gx.design_observer(system, noise, Interval.entire(3), form="prediction", left_inverse=left_inverse)

    closed = design("feedthrough")
    assert float(closed.rho) == 0
    assert closed.certificate.certified
    np.testing.assert_array_equal(np.asarray(closed.left_inverse)[:, :3], 0)
    assert float(design("smallest").rho) <= min(float(design("pseudo").rho), 1e-6)
    given = framer_gains(system).J
    np.testing.assert_array_equal(design(given).left_inverse, given)
    with pytest.raises(ValueError, match="must satisfy J"):
        design(2 * given)
    with pytest.raises(ValueError, match="must have shape"):
        design(given[:, :-1])
    with pytest.raises(ValueError, match="left_inverse"):
        design("best")


def test_step_by_step_missing_rows_conflicts_and_gradients():
    system, noise, _, _ = plant_with_known_input()
    bounded = gx.System(
        system.f, system.g, system.G, system.H, system.B, system.D, state_bounds=systems.ball([9.0] * 3)
    )
    observer = gx.design_observer(
        bounded, noise, Interval.entire(3), form="prediction", left_inverse="feedthrough", bounds=["natural"]
    )
    d, u = np.ones((12, 2)), np.zeros((12, 2))
    sim = gx.simulate(system, jax.random.key(7), [0.1, 0.2, 0.3], d, noise, u)
    y = np.array(sim.y)
    y[3, 1] = np.nan
    y[8] += 1e3
    initial = systems.ball([1.0] * 3)
    estimate = gx.estimate(observer, initial, y, u)
    status = np.asarray(estimate.status)
    assert (status & Status.MISSING != 0).tolist() == [k == 3 for k in range(12)]
    assert (status & Status.CONFLICT != 0).tolist() == [k == 9 for k in range(12)]
    assert [alarm.step for alarm in estimate.alarms()] == [9]
    assert np.isfinite(np.asarray(estimate.state.upper)).all()  # the state bounds
    assert np.isinf(np.asarray(estimate.input.upper)[3]).any()
    assert inside(estimate.state[:9], sim.x[:9])
    carry, out = gx.start(observer, initial, y[0], u[0])
    for k in range(12):
        np.testing.assert_allclose(out.state.upper, estimate.state.upper[k], rtol=1e-12, atol=1e-12)
        assert int(out.status) == status[k]
        if k < 11:
            carry, out = gx.step(observer, carry, y[k + 1], u[k + 1])

    def last_width(scale):
        louder = gx.Noise(*(Interval(scale * box.lower, scale * box.upper) for box in (noise.w, noise.v)))
        return gx.estimate(observer, initial, y[:4], u[:4], noise=louder).state.width[-1].sum()

    gradient = jax.grad(last_width)(1.0)
    step = 1e-6
    assert float(gradient) == pytest.approx(float(last_width(1 + step) - last_width(1 - step)) / (2 * step), rel=1e-6)


def test_without_unknown_inputs_it_is_the_plain_observer():
    noise = gx.Noise(systems.ball([0.1]), systems.ball([0.2]))
    system = gx.System(lambda x: 0.5 * x, lambda x: x, G=np.zeros((1, 0)), H=np.zeros((1, 0)))
    observer = gx.design_observer(system, noise, Interval.entire(1), form="prediction")
    estimate = gx.estimate(observer, systems.ball([1.0]), np.zeros((3, 1)))
    np.testing.assert_allclose(estimate.state.upper[:, 0], [1.0, 0.6, 0.4])
    assert estimate.input.shape == (2, 0)
    np.testing.assert_allclose(observer.certificate.steady_width, [0.4])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"bounds": ["exact"]}, "`bounds` must name some of affine, natural"),
        ({"bounds": []}, "'none'"),
        ({"derivative": Interval.entire((2, 2))}, r"`derivative` must have shape \(4, 2\)"),
        ({"form": "filter"}, '"current" or "prediction"'),
    ],
)
def test_bad_options(options, message):
    case = full_rank_controls.s2("b")
    with pytest.raises(ValueError, match=message):
        gx.design_observer(case.system, case.noise, case.region, **{"form": "prediction"} | options)


def test_no_feedthrough_at_all_is_no_framer():
    """H = 0, and fewer outputs than inputs: rank-deficient, so refused."""
    case = systems.s4(full_state_measured=True)
    with pytest.raises(gx.FramerNotGuaranteed, match="rank 0 with 2 unknown inputs"):
        gx.design_observer(case.system, case.noise, case.region, form="prediction")
    system = gx.System(lambda x: 0.5 * x, lambda x: x[:1], G=np.eye(2), H=[[1.0, 0.0]])
    with pytest.raises(gx.FramerNotGuaranteed, match="rank 1 with 2 unknown inputs"):
        gx.design_observer(
            system, gx.Noise(systems.ball([0.1] * 2), systems.ball([0.1])), Interval.entire(2), form="prediction"
        )
