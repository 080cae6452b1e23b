"""Algorithm 1 (GSISIO): four outputs per step, against the printed equations in NumPy and against Lemma 5."""

import full_rank_controls as controls
import jax.numpy as jnp
import numpy as np
import pytest

import gsisio_jax as gx
from gsisio_jax import Interval
from gsisio_jax.examples import paper
from gsisio_jax.paper import gsisio, lipschitz_constants, stability, width_bounds

STEPS = 40


def derivative(variant: str) -> Interval:
    maps = controls.plant(variant)
    return Interval(*(np.vstack([maps.df[i], maps.dg[i]]) for i in (0, 1)))


def measured(variant: str, seed: int) -> tuple[controls.Run, np.ndarray]:
    """The printed recursion in NumPy, and the measurements it saw (noise is drawn in this order: w, v)."""
    case, maps, d = controls.s2(variant), controls.plant(variant), controls.unknown_input(STEPS)
    plain = controls.run(case.system, maps, case.noise, case.initial.lower, case.initial.upper, d, seed)
    random = np.random.default_rng(seed)
    _, v = (paper.NOISE * (2 * random.uniform(size=(STEPS, 2)) - 1) for _ in range(2))
    return plain, maps.g(plain.x[:-1].T).T + d @ np.asarray(case.system.H).T + v


def call(system: gx.System, noise: gx.Noise, initial: Interval, y, **options):
    return gsisio(system.f, system.g, None, system.G, None, system.H, noise.w, noise.v, initial, y, **options)


@pytest.mark.parametrize("variant", ["a", "d"])
def test_equals_the_printed_equations_and_lemma_5(variant):
    """(a): L = 1.8, the bounds grow; (d): L < 1, they settle. Rows are k = 1..T for x and k - 1 = 0..T-1 for d."""
    case = controls.s2(variant)
    plain, y = measured(variant, seed=3)
    assert plain.misses() == 0
    for printed in (False, True):
        found = call(
            case.system, case.noise, case.initial, y, bounds=["decomposition"], derivative=derivative(variant),
            printed=printed,
        )  # fmt: skip
        assert found.state.shape == found.input.shape == (STEPS, 2)
        for box, low, up in (
            (found.state, plain.x_lower[1:], plain.x_upper[1:]), (found.input, plain.d_lower, plain.d_upper),
        ):  # fmt: skip
            np.testing.assert_allclose(box.lower, low, rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(box.upper, up, rtol=1e-9, atol=1e-9)
        maps = controls.plant(variant)
        constants = lipschitz_constants(case.system, case.region, derivative=(Interval(*maps.df), Interval(*maps.dg)))
        known = stability(case.system, case.noise, case.region, printed, constants=constants)
        expected = width_bounds(known, case.initial.width, STEPS, printed)
        np.testing.assert_allclose(found.state_width_bound, expected.state[1:])
        np.testing.assert_allclose(found.input_width_bound, expected.input)
        if not printed:
            assert (np.linalg.norm(plain.x_width[1:], axis=1) <= found.state_width_bound).all()
            assert (np.linalg.norm(plain.d_width, axis=1) <= found.input_width_bound).all()
            assert (found.state_width_bound[-1] < 10) == (variant == "d")


def test_refuses_the_papers_example_unless_asked():
    """rho = 1.927: refused; asked for all the same, every box is crossed, and the bounds bound |upper - lower|."""
    system, noise = paper.system(), gx.Noise(*[Interval.symmetric([paper.NOISE] * 2)] * 2)
    initial = Interval(paper.INITIAL_LOWER, paper.INITIAL_UPPER)
    record = paper.record(steps=6)
    y = np.stack([record["y1"], record["y2"]], axis=1)
    options = {"bounds": ["decomposition"], "derivative": derivative("b")}
    with pytest.raises(gx.FramerNotGuaranteed, match=r"rho\(\|G\|\|J1\|\) = 1\.927"):
        call(system, noise, initial, y, **options)
    found = call(system, noise, initial, y, allow_uncertified=True, **options)
    assert (found.state.lower > found.state.upper).any(1).all()
    assert (np.linalg.norm(found.state.width, axis=1) <= found.state_width_bound).all()
    assert (np.linalg.norm(found.input.width, axis=1) <= found.input_width_bound).all()


G, H = np.array([[0.2], [0.1]]), np.array([[1.0], [0.5]])
B, D = np.array([[0.5], [0.0]]), np.array([[0.0], [0.3]])
SMALL = gx.Noise(Interval.symmetric([0.01, 0.02]), Interval.symmetric([0.03, 0.01]))


def _f(x):
    return jnp.stack([0.5 * x[0] + 0.1 * x[1] ** 2, 0.4 * x[1]])


def _f_u(x, u):
    return _f(x) + 0.5 * jnp.stack([u[0], 0 * u[0]])


def _g(x):
    return jnp.stack([0.2 * x[0], 0.3 * x[1]])


def simulate(u):
    """x (T + 1, 2), d (T, 1), y (T, 2) with known input u through B and D."""
    random = np.random.default_rng(0)
    x, d, y = [np.array([0.3, -0.2])], random.normal(size=(len(u), 1)), []
    for k in range(len(u)):
        w, v = (random.uniform(box.lower, box.upper) for box in (SMALL.w, SMALL.v))
        y.append(np.asarray(_g(x[-1])) + D @ u[k] + H @ d[k] + v)
        x.append(np.asarray(_f(x[-1])) + B @ u[k] + G @ d[k] + w)
    return np.array(x), d, np.array(y)


@pytest.fixture(scope="module")
def with_known_input():
    u = np.sin(np.arange(8.0))[:, None]
    return u, *simulate(u), Interval([0.2, -0.4], [0.4, 0.0])


def test_known_inputs_and_the_region_of_the_constants(with_known_input):
    """The derivative of f is not bounded on R^2. From the first box on that leaves the region no width is bounded."""
    u, x, d, y, initial = with_known_input
    matrices = (B, G, D, H, SMALL.w, SMALL.v, initial, y, u)
    with pytest.raises(ValueError, match="smaller region"):
        gsisio(_f, _g, *matrices, bounds=["mean_value"])
    region = Interval([-1.0, -0.5], [0.55, 0.5])
    found = gsisio(_f, _g, *matrices, region=region, bounds=["mean_value"])
    for truth, box in ((x[1:], found.state), (d, found.input)):
        assert ((box.lower - 1e-12 <= truth) & (truth <= box.upper + 1e-12)).all()
    inside = ((found.state.lower >= region.lower) & (found.state.upper <= region.upper)).all(1)
    assert inside[0]
    assert not inside.all()
    left = int(np.argmin(inside))
    assert np.isfinite(found.state_width_bound[: left + 1]).all()
    assert np.isinf(found.state_width_bound[left + 1 :]).all()
    assert len(found.state_width_bound) > left + 1
    np.testing.assert_array_equal(np.isinf(found.input_width_bound), np.isinf(found.state_width_bound))
    width = np.linalg.norm(found.state.width, axis=1)
    assert (width <= found.state_width_bound).all()


def test_bounds_of_unknown_width_promise_none(with_known_input):
    """f takes u, so m comes from u. Natural bounds alone are sound, but Lemma 2 does not speak of them."""
    u, x, d, _, initial = with_known_input
    y = simulate(u)[2] - u @ D.T
    found = gsisio(_f_u, _g, None, G, None, H, SMALL.w, SMALL.v, initial, y, u, bounds=["natural"])
    assert np.isinf(found.state_width_bound).all()
    assert np.isinf(found.input_width_bound).all()
    for truth, box in ((x[1:], found.state), (d, found.input)):
        assert ((box.lower - 1e-12 <= truth) & (truth <= box.upper + 1e-12)).all()


def test_errors_name_the_shape():
    box = Interval.symmetric(np.ones(2))
    with pytest.raises(ValueError, match=r"gsisio: `y` must have shape \(T, 2\)"):
        gsisio(_f, _g, None, G, None, H, box, box, box, np.zeros((0, 2)))
    with pytest.raises(
        ValueError, match=r"gsisio: the system has 1 known inputs; give `u` of shape \(5, 1\), got None"
    ):
        gsisio(_f, _g, B, G, D, H, box, box, box, np.zeros((5, 2)))
