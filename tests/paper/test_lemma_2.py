"""Lemma 2: Lipschitz constants and width gains, as printed and as corrected; theory 2.11 and 2.12."""

import full_rank_controls as controls
import jax.numpy as jnp
import numpy as np
import pytest
import systems

import gsisio_jax as gx
from gsisio_jax import Interval
from gsisio_jax.examples import paper
from gsisio_jax.paper.lipschitz import PRINTED, LipschitzConstants, lipschitz_constants, norm_bound

MATRIX = np.array([[1.0, 1.0], [1.0, -1.0]])


@pytest.fixture(scope="module")
def everywhere() -> LipschitzConstants:
    """The paper's example on all of R^2."""
    return lipschitz_constants(paper.system(), Interval.entire(2))


def jacobian_f(c):
    """df of the paper's example, where c is the cosine; on R^2 every c in [-1, 1] occurs."""
    return np.array([[0.6 - 0.22 * c, -0.12 + 0.33 * c], [-0.2, -0.14]])


def jacobian_g(c, e):
    return np.array([[0.2 + 0.24 * c, 0.65 + 0.16 * c], [e, 0.0]])


def test_one_constant_for_all_rows_is_wrong():
    """P11: q(x) = (x1 + x2, x1 - x2) on [0, 1]^2. The exact bounds [0, 2] and [-1, 1] are 2 wide each; the printed
    Lemma 2 allows sqrt(2) ||(1, 1)|| = 2 for a norm that is 2 sqrt(2)."""
    plant = gx.System(lambda x: jnp.asarray(MATRIX) @ x, lambda x: x[:1], G=np.zeros((2, 0)), H=np.zeros((1, 0)))
    found = lipschitz_constants(plant, Interval(np.zeros(2), np.ones(2)))
    corners = np.array([[0, 0], [0, 1], [1, 0], [1, 1]]) @ MATRIX.T
    width = np.linalg.norm(np.ptp(corners, axis=0))
    size = np.linalg.norm(np.ones(2))
    assert width == pytest.approx(2 * np.sqrt(2))
    assert found.L_fd == pytest.approx(np.sqrt(2))
    assert width > 1.4 * found.L_fd * size
    assert width == pytest.approx(found.L_fd_corrected * size)
    np.testing.assert_allclose(found.W_f, np.abs(MATRIX))


def test_suprema_of_the_papers_example(everywhere):
    """P12: .942 and 1.171. The norm is convex in the cosines, so its supremum is at cosines +-1."""
    exact_f = max(np.linalg.norm(jacobian_f(c), 2) for c in (-1, 1))
    exact_g = max(np.linalg.norm(jacobian_g(c, e), 2) for c in (-1, 1) for e in (-1, 1))
    assert exact_f == pytest.approx(0.942, abs=5e-4)
    assert exact_g == pytest.approx(1.171, abs=5e-4)
    for exact, bound, attained in (
        (exact_f, everywhere.L_f, everywhere.L_f_attained),
        (exact_g, everywhere.L_g, everywhere.L_g_attained),
    ):
        assert exact <= bound <= exact * (1 + 1e-9)
        assert 0.99 * exact < attained <= exact * (1 + 1e-12)


def test_subdivision_closes_the_gap():
    """On the six tanks eleven entries vary together: the bound still meets the attained value to the tolerance."""
    case = systems.s5()
    fine = lipschitz_constants(case.system, case.region, case.u_region)
    assert fine.L_f_attained <= fine.L_f <= fine.L_f_attained * (1 + 1e-3)
    assert fine.L_f < norm_bound(np.asarray(fine.df.lower), np.asarray(fine.df.upper)) * (1 - 1e-4)
    # Independent: the Jacobian as printed in theory 12.1, at random points of the region.
    x = np.random.default_rng(0).uniform(case.region.lower, case.region.upper, (4000, 6))
    slope = 0.5 / np.sqrt(x)
    fast, slow = 0.5 * systems._S5, 0.5 * systems._S5 * systems._K5
    jacobian = np.broadcast_to(np.eye(6), (4000, 6, 6)).copy()
    for i, (left, own) in enumerate(((0, slow), (fast, fast), (slow, slow), (slow, slow), (slow, slow), (slow, slow))):
        jacobian[:, i, i] -= own * slope[:, i]
        if i:
            jacobian[:, i, i - 1] += left * slope[:, i - 1]
    seen = np.linalg.norm(jacobian, 2, axis=(1, 2)).max()
    assert 0.95 * fine.L_f_attained < seen <= fine.L_f


def test_printed_numbers_against_computed(everywhere):
    """P12, number by number."""
    a_f, b_f = np.asarray(everywhere.df.lower), np.asarray(everywhere.df.upper)
    np.testing.assert_allclose(b_f, PRINTED.df.upper, atol=1e-12)
    np.testing.assert_allclose(a_f, [[0.38, -0.45], [-0.2, -0.14]], atol=1e-12)
    off = ~np.isclose(a_f, PRINTED.df.lower, atol=1e-9)
    assert off.tolist() == [[False, True], [False, False]]
    assert PRINTED.df.lower[0, 1] == -0.52 < a_f[0, 1]  # still a bound
    for side in ("lower", "upper"):
        np.testing.assert_allclose(getattr(everywhere.dg, side), getattr(PRINTED.dg, side), atol=1e-12)
    np.testing.assert_allclose(everywhere.C_f, [[0, 0.21], [0, 0]], atol=1e-12)
    np.testing.assert_allclose(everywhere.C_g, [[0.04, 0], [1, 0]], atol=1e-12)
    printed_bounds = lipschitz_constants(paper.system(), Interval.entire(2), derivative=(PRINTED.df, PRINTED.dg))
    for name in ("C_f", "C_g"):  # nonnegative always: C = alpha - beta, one of them 0
        np.testing.assert_allclose(getattr(printed_bounds, name), getattr(everywhere, name), atol=1e-12)
        assert not np.allclose(getattr(PRINTED, name), getattr(everywhere, name), atol=0.1)
    assert PRINTED.C_g.min() < 0
    size_f, size_g = np.linalg.norm(PRINTED.C_f, 2), np.linalg.norm(PRINTED.C_g, 2)
    assert size_g == pytest.approx(0.378, abs=5e-4)
    assert PRINTED.L_f + 2 * size_f == pytest.approx(PRINTED.L_fd, abs=2e-3)
    assert PRINTED.L_g + 2 * size_g == pytest.approx(1.496, abs=5e-4)
    assert PRINTED.L_gd == 1.19
    assert (everywhere.L_fd, everywhere.L_gd) == pytest.approx((1.36193, 3.17259), abs=1e-5)
    assert (everywhere.L_fd_corrected, everywhere.L_gd_corrected) == pytest.approx((1.21924, 3.04811), abs=1e-5)


def test_the_printed_lipschitz_constant_of_f_holds_nowhere():
    """P12: .35 is below the norm of df at every point; .74 is below that of dg wherever |cos x1| > .74."""
    assert min(np.linalg.norm(jacobian_f(c), 2) for c in np.linspace(-1, 1, 2001)) > 0.43 > PRINTED.L_f
    assert min(np.linalg.norm(jacobian_g(c, 0.75), 2) for c in np.linspace(-1, 1, 2001)) > PRINTED.L_g


def test_width_gains_bound_the_decomposition(everywhere):
    """``q_d(x, y) - q_d(y, x) <= W_q (x - y)`` and its norm, on 4,000 boxes; a tenth less in W_g is too little."""
    maps = controls.plant("b")
    random = np.random.default_rng(2)
    short = 0
    for _ in range(2000):
        low = random.uniform(-6, 6, 2)
        up = low + random.uniform(0, 1, 2) * 10.0 ** random.uniform(-3, 1)
        for q, derivative, gain, size in (
            (maps.f, maps.df, everywhere.W_f, everywhere.L_fd_corrected),
            (maps.g, maps.dg, everywhere.W_g, everywhere.L_gd_corrected),
        ):
            width = controls.decomposition(q, derivative, up, low) - controls.decomposition(q, derivative, low, up)
            assert (width >= -1e-12).all()
            assert (width <= gain @ (up - low) + 1e-9).all()
            assert np.linalg.norm(width) <= size * np.linalg.norm(up - low) + 1e-9
            short += bool((width > 0.9 * gain @ (up - low) + 1e-12).any())
    assert short > 100


def test_norms_over_interval_matrices():
    random = np.random.default_rng(3)
    for rows, columns, varying in ((2, 2, 4), (3, 2, 6), (3, 3, 9), (1, 4, 2)):
        lower = random.normal(size=(5, rows, columns))
        upper = lower.copy()
        where = random.permutation(rows * columns)[:varying]
        upper.reshape(5, -1)[:, where] += random.uniform(0, 2, (5, varying))
        bound = norm_bound(lower, upper)
        corner = random.integers(0, 2, (400, 1, rows, columns)).astype(bool)
        share = np.concatenate([corner, random.uniform(size=(100, 1, rows, columns))])
        seen = np.linalg.norm(lower + share * (upper - lower), 2, axis=(-2, -1)).max(0)
        assert (seen <= bound).all()
        if varying <= 6:
            assert (seen >= bound * (1 - 1e-9)).all()
    assert norm_bound(np.array([[[-np.inf]], [[0.0]]]), np.array([[[0.0]], [[2.0]]])).tolist()[0] == np.inf
    assert norm_bound(np.zeros((3, 0, 2)), np.zeros((3, 0, 2))).tolist() == [0, 0, 0]


def test_errors_name_the_remedy():
    plant = paper.system()
    with pytest.raises(ValueError, match=r"region.*shape \(2,\)"):
        lipschitz_constants(plant, Interval.entire(3))
    with pytest.raises(ValueError, match=r"bounds of dg must have shape \(2, 2\)"):
        lipschitz_constants(plant, Interval.entire(2), derivative=(PRINTED.df, PRINTED.df[:1]))
    case = systems.s5()
    with pytest.raises(ValueError, match="u_region"):
        lipschitz_constants(case.system, case.region)
    with pytest.raises(ValueError, match="u_region"):
        lipschitz_constants(case.system, case.region, Interval.entire(5))
    cubic = gx.System(lambda x: x**3, lambda x: x, G=np.zeros((1, 0)), H=np.zeros((1, 0)))
    with pytest.raises(ValueError, match=r"derivative of f is not bounded.*smaller region"):
        lipschitz_constants(cubic, Interval.entire(1))
    assert lipschitz_constants(cubic, Interval([-1.0], [2.0])).L_f == pytest.approx(12, rel=1e-9)
