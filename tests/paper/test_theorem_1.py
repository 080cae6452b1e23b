"""What Theorem 1 of the paper really needs, computed: theory 2.1-2.5 and 2.7 (P13 is in tests/design)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gsisio_jax as gx
from gsisio_jax import Interval, inclusion
from gsisio_jax.design.framer import framer_gains
from gsisio_jax.design.left_inverse import smallest_radius_inverse
from gsisio_jax.examples import paper

PRINTED_K = np.array([[0.0267, 0, 0.0666, 0.1061], [0.4177, 2.1203, 1.0817, 2.0209]])
PRINTED_L = np.array([[0, 0.1017, 0, 0], [0.5194, 1.1814, 1.2787, 1.9302]])


def plant(random, deficient):
    """A linear plant with m = 2 known inputs; H of rank below p, zero included, or of full column rank."""
    while True:
        n, l, p = (int(random.integers(1, high)) for high in (5, 5, 4))
        rank = int(random.integers(0, min(l, p - 1) + 1)) if deficient else p
        H = random.standard_normal((l, rank)) @ random.standard_normal((rank, p))
        G, B, D = random.standard_normal((n, p)), random.standard_normal((n, 2)), random.standard_normal((l, 2))
        if rank <= l and np.linalg.matrix_rank(np.vstack([G, H])) == p:
            return gx.System(lambda x: x, lambda x, l=l: jnp.zeros(l) + x.sum(), G, H, B, D)


def any_left_inverse(random, system):
    """The pseudo-inverse plus any row that [G; H] annihilates."""
    S = np.vstack([system.G, system.H])
    J = np.linalg.pinv(S)
    return J + random.standard_normal(J.shape) @ (np.eye(len(S)) - S @ J)


def singularity(matrix):
    """Smallest over largest singular value."""
    values = np.linalg.svd(matrix, compute_uv=False)
    return values[-1] / max(values[0], 1.0)


def test_p1_the_existence_condition_fails_for_every_rank_deficient_feedthrough():
    """P1, (eq:existence) with I - K1 + L1 as in the example: I - G J1 annihilates G v where H v = 0, for every J."""
    random = np.random.default_rng(0)
    plants = [paper.system()] + [plant(random, deficient=True) for _ in range(200)]
    for system in plants:
        for J in (None, any_left_inverse(random, system)):
            gains = framer_gains(system, J)
            condition = np.eye(system.n) - gains.K1 + gains.L1
            np.testing.assert_allclose(condition, np.eye(system.n) - system.G @ gains.J1, atol=1e-12)
            v = np.linalg.svd(system.H)[2][-1]
            Gv = system.G @ v
            assert np.linalg.norm(Gv) > 1e-6
            assert np.linalg.norm(condition @ Gv) < 1e-9 * np.linalg.norm(Gv) * max(1, np.abs(gains.J).max())
            assert singularity(condition) < 1e-9


def test_p1_full_rank_feedthrough_meets_it_with_the_pseudo_inverse():
    """P1: J1 G d = d needs H d = 0, so I - K1 + L1 has rank n for H of full column rank and the pseudo-inverse."""
    random = np.random.default_rng(1)
    for _ in range(200):
        system = plant(random, deficient=False)
        gains = framer_gains(system)
        assert singularity(np.eye(system.n) - gains.K1 + gains.L1) > 1e-9


def test_p1_the_other_rank_is_a_condition_of_its_own():
    """P1: G = H = [[1, 1], [1, -1]] has full rank, yet K1 + L1 = |G||J1| has the eigenvalue 1, and with H = G / 2 the
    ranks are fine but rho = 1.6, so there is no framer: with full rank too the choice of J decides. J1 = 0 serves both.
    """
    G = np.array([[1.0, 1.0], [1.0, -1.0]])

    def gains(H, J=None):
        return framer_gains(gx.System(lambda x: x, lambda x: x, G, H), J)

    ranks = [np.linalg.matrix_rank(np.eye(2) - gains(G).K1 + sign * gains(G).L1) for sign in (1, -1)]
    assert ranks == [2, 1]
    np.testing.assert_allclose(gains(G).K1 + gains(G).L1, np.full((2, 2), 0.5), atol=1e-15)
    weak = gains(G / 2)
    assert [np.linalg.matrix_rank(np.eye(2) - weak.K1 + sign * weak.L1) for sign in (1, -1)] == [2, 2]
    assert weak.rho == pytest.approx(1.6)
    for H in (G, G / 2):
        assert gains(H, smallest_radius_inverse(G, H)).rho == 0


def test_p1_the_condition_as_printed_has_matrices_of_different_shapes():
    """P1, (eq:existence): K2 and L2 are n x l, so I - K2 + L2 has a meaning for l = n only. In the paper's example both
    printed ranks are 2 with the computed K, L, but the boxes cross all the same (P4): it is no condition for a framer.
    """
    literal = framer_gains(paper.system())
    for condition in (np.eye(2) - literal.K1 - literal.L1, np.eye(2) - literal.K2 + literal.L2):
        assert singularity(condition) > 0.5
    system = gx.System(lambda x: x, lambda x: x[:1], np.eye(2), np.zeros((1, 2)))
    gains = framer_gains(system)
    assert gains.K2.shape == gains.L2.shape == (2, 1)


def test_p2_no_finite_box_from_earlier_outputs(ranges):
    """P2: add a v to d[k-1], H v = 0. y[0..k-1] stay as they are, x[k] moves by a G v: any correct box from them is
    infinite. Run on the paper's plant; (eq:xup) returns a finite one from y[0], which x[1] leaves by any distance.
    """
    v = np.array([3.0, 1.0])
    assert np.abs(paper.H @ v).max() < 1e-16
    random = np.random.default_rng(2)
    steps = 6
    w, noise = random.uniform(-paper.NOISE, paper.NOISE, (2, steps, 2))
    d = random.standard_normal((steps, 2))
    start = random.uniform(paper.INITIAL_LOWER, paper.INITIAL_UPPER)

    def run(d):
        x, y = [start], []
        for k in range(steps):
            y.append(paper.output_map(x[-1], np) + paper.H @ d[k] + noise[k])
            x.append(paper.state_map(x[-1], np) + paper.G @ d[k] + w[k])
        return np.array(x), np.array(y)

    x, y = run(d)
    for a in (1.0, -1e3, 1e6):
        moved = d.copy()
        moved[-1] += a * v
        x_moved, y_moved = run(moved)
        np.testing.assert_array_equal(x_moved[:-1], x[:-1])
        np.testing.assert_allclose(y_moved, y, rtol=0, atol=1e-15 * max(1, abs(a)) + 1e-15)
        np.testing.assert_allclose(x_moved[-1] - x[-1], a * paper.G @ v, rtol=1e-9)

    moved = d.copy()
    moved[0] += 1e6 * v
    x_moved, y_moved = run(moved)
    gains, low, high = framer_gains(paper.system()), *(np.asarray(side[0]) for side in ranges[2])
    radius = np.full(2, paper.NOISE)
    sides = (high[:2], low[:2]), (high[2:], low[2:]), (radius, -radius), (radius, -radius)
    up, down = one_step(gains.K, gains.L, *sides, y[0])
    again = one_step(gains.K, gains.L, *sides, y_moved[0])
    np.testing.assert_allclose(again, (up, down), atol=1e-8)
    assert max(np.abs(up).max(), np.abs(down).max()) < 10
    assert np.abs(x_moved[1]).min() > 1e4


def width_recursion(K, L, width_f, width_g, width_w, width_v):
    """(eq:xup), upper half minus lower half: y cancels, and so does the singular matrix I - K1 + L1."""
    (K1, K2), (L1, L2) = np.split(K, 2, axis=1), np.split(L, 2, axis=1)
    known = (np.eye(2) + K1 + L1) @ (width_f + width_w) + (K2 + L2) @ (width_g + width_v)
    return np.linalg.solve(np.eye(2) - K1 - L1, known)


def one_step(K, L, f, g, w, v, y):
    """(eq:xup) and (eq:framerx) as printed, for n = l = 2 and B = D = 0: (x_up, x_low); boxes are pairs (up, low)."""
    (K1, K2), (L1, L2), eye = np.split(K, 2, axis=1), np.split(L, 2, axis=1), np.eye(2)
    A_x = np.block([[eye - K1, L1], [L1, eye - K1]])
    A_f = np.block([[eye + L1, -K1], [-K1, eye + L1]])
    A_g = np.block([[L2, -K2], [-K2, L2]])
    A_y = np.vstack([K2 - L2, K2 - L2])
    right = A_f @ (np.concatenate(f) + np.concatenate(w)) + A_g @ (np.concatenate(g) + np.concatenate(v)) + A_y @ y
    return np.split(np.linalg.pinv(A_x) @ right, 2)


def test_p3_radius_below_one_is_what_a_framer_needs():
    """P3: rho(|G||J1|) < 1 if and only if I - [K1 L1; L1 K1] has a nonnegative inverse (and then it is a framer)."""
    random = np.random.default_rng(3)
    seen = []
    for k in range(200):
        system = plant(random, deficient=k % 4 == 0)
        gains = framer_gains(system, any_left_inverse(random, system) if k % 2 else None)
        if abs(gains.rho - 1) < 1e-6:
            continue
        matrix = np.eye(2 * system.n) - np.block([[gains.K1, gains.L1], [gains.L1, gains.K1]])
        regular = singularity(matrix) > 1e-9
        nonnegative = regular and (np.linalg.inv(matrix) >= -1e-9 * np.abs(np.linalg.inv(matrix)).max()).all()
        assert nonnegative == (gains.rho < 1)
        seen.append(nonnegative)
    assert 20 < sum(seen) < len(seen) - 50


def test_p3_rank_deficient_feedthrough_has_radius_one_or_more_for_every_left_inverse():
    """P3, Perron-Frobenius: |J1||G||v| >= |J1 G v| = |v| where H v = 0."""
    random = np.random.default_rng(4)
    for _ in range(200):
        system = plant(random, deficient=True)
        for J in (None, *(any_left_inverse(random, system) for _ in range(3))):
            assert framer_gains(system, J).rho >= 1 - 1e-7


def test_p3_no_left_inverse_of_the_papers_example_goes_below_one():
    """P3: the best left inverse by linear programs has rho = 1 on the paper's G, H, the pseudo-inverse 1.927."""
    assert framer_gains(paper.system(), smallest_radius_inverse(paper.G, paper.H)).rho == pytest.approx(1, abs=1e-6)


def test_p3_with_radius_above_one_every_box_from_an_uncrossed_one_is_crossed():
    """P3: with the left Perron vector u > 0 of K1 + L1, (1 - rho) u'(x_up - x_low) = u'((I + K1 + L1)(Df + Dw) +
    (K2 + L2)(Dg + Dv)) > 0 whatever the data, so u'(x_up - x_low) < 0. (A_y and y drop out.)
    """
    random = np.random.default_rng(5)
    above = 0
    for _ in range(200):
        system = plant(random, deficient=True)
        gains = framer_gains(system)
        if gains.rho < 1 + 1e-6:
            continue
        n, l = system.n, system.l
        values, vectors = np.linalg.eig((gains.K1 + gains.L1).T)
        u = np.abs(np.real(vectors[:, np.abs(values).argmax()]))
        widths = random.exponential(1.0, n), random.exponential(1.0, l), 0.1 + random.random(n), random.random(l)
        centers = [random.standard_normal(len(width)) for width in widths]
        f, g, w, v = (np.concatenate([c + s / 2, c - s / 2]) for c, s in zip(centers, widths, strict=True))
        right = gains.A_f @ f + gains.A_g @ g + gains.A_w @ w + gains.A_v @ v
        right = right + gains.A_y @ random.standard_normal(l) + gains.A_u @ random.standard_normal(2)
        # A_x is singular (P1): what is rounding must not be inverted.
        x = np.linalg.pinv(gains.A_x, rcond=1e-10) @ right
        width = x[:n] - x[n:]
        known = (np.eye(n) + gains.K1 + gains.L1) @ (widths[0] + widths[2])
        known = known + (gains.K2 + gains.L2) @ (widths[1] + widths[3])
        np.testing.assert_allclose((1 - gains.rho) * (u @ width), u @ known, rtol=1e-6)
        assert width.min() < 0
        above += 1
    assert above > 80


@pytest.fixture(scope="module")
def ranges():
    """Ranges of f and g on the printed initial box and on 199 boxes inside it: of the engine, and sampled (inside)."""
    random = np.random.default_rng(6)
    share = np.sort(random.random((2, 200, 2)), axis=0)
    share[:, 0] = [[0], [1]]
    boxes = [paper.INITIAL_LOWER + s * (paper.INITIAL_UPPER - paper.INITIAL_LOWER) for s in share]

    def both(x):
        return jnp.concatenate([paper.state_map(x), paper.output_map(x)])

    bounds = inclusion.natural(both)
    natural = jax.jit(jax.vmap(bounds))(Interval(*boxes))
    grid = np.stack(np.meshgrid(*[np.linspace(0, 1, 41)] * 2), axis=-1).reshape(-1, 1, 2)
    points = np.moveaxis(boxes[0] + grid * (boxes[1] - boxes[0]), -1, 0)
    values = np.concatenate([paper.state_map(points, np), paper.output_map(points, np)])
    return boxes, natural, (values.min(1).T, values.max(1).T)


@pytest.mark.parametrize("gains", ["computed", "printed"])
def test_p4_the_papers_example_crosses_at_the_first_step(ranges, gains):
    """P4: rho = 1.927 with the computed K, L and 3.3 with the printed ones. From the printed initial box and from 199
    boxes inside it, 200 records: x_up < x_low in some component at k = 1, so no state is inside. This holds with the
    natural bounds of f and g and with their sampled ranges, which no correct bounds can undercut.
    """
    computed = framer_gains(paper.system())
    K, L = (computed.K, computed.L) if gains == "computed" else (PRINTED_K, PRINTED_L)
    radius = np.abs(np.linalg.eigvals((K + L)[:, :2])).max()
    assert radius == pytest.approx({"computed": 1.927, "printed": 3.331}[gains], abs=1e-3)
    boxes, natural, sampled = ranges
    random = np.random.default_rng(7)
    noise = np.full(2, paper.NOISE)
    crossed = 0
    for k in range(200):
        x0 = boxes[0][k] + random.random(2) * (boxes[1][k] - boxes[0][k])
        y = paper.output_map(x0, np) + paper.H @ random.standard_normal(2) + random.uniform(-noise, noise)
        for low, high in ((natural.lower[k], natural.upper[k]), (sampled[0][k], sampled[1][k])):
            low, high = np.asarray(low), np.asarray(high)
            up, down = one_step(K, L, (high[:2], low[:2]), (high[2:], low[2:]), (noise, -noise), (noise, -noise), y)
            width = width_recursion(K, L, (high - low)[:2], (high - low)[2:], 2 * noise, 2 * noise)
            np.testing.assert_allclose(up - down, width, rtol=1e-9, atol=1e-9)
            crossed += (up < down).any()
    assert crossed == 400


def test_p5_the_printed_gains_do_not_follow_from_the_printed_matrices():
    """P5: K = G^- J^- + G^+ J^+ and L = G^- J^+ + G^+ J^- with J = pinv [G; H], against the printed numbers."""
    gains = framer_gains(paper.system())
    np.testing.assert_allclose(gains.K, [[0.0884, 0, 0, 0.1572], [0.1768, 1.3988, 0.1100, 0.3143]], atol=5e-5)
    np.testing.assert_allclose(gains.L, [[0, 0.2279, 0.0629, 0], [0.4047, 0.4558, 0.1257, 0.2750]], atol=5e-5)
    np.testing.assert_allclose(gains.K - gains.L, paper.G @ gains.J, atol=1e-12)
    np.testing.assert_allclose(gains.K + gains.L, np.abs(paper.G) @ np.abs(gains.J), atol=1e-12)
    assert np.abs(gains.K - PRINTED_K).max() > 1.7
    assert np.abs(gains.L - PRINTED_L).max() > 1.6


def test_p5_the_printed_gains_belong_to_no_left_inverse():
    """P5: K - L = G J for some left inverse J would make (K - L)[G; H] = G. The printed ones miss that by more than
    their four decimals can explain; that is how rk(I - K1 + L1) = 2 could be printed: the true matrix has rank 1 (P1).
    """
    S = np.vstack([paper.G, paper.H])
    gains = framer_gains(paper.system())
    np.testing.assert_allclose((gains.K - gains.L) @ S, paper.G, atol=1e-12)
    gap = np.abs((PRINTED_K - PRINTED_L) @ S - paper.G).max()
    assert gap > 0.01 > 2 * 1e-4 * np.abs(S).sum(axis=0).max()
    ranks = [np.linalg.matrix_rank(np.eye(2) - (K - L)[:, :2], tol=1e-9) for K, L in
             ((gains.K, gains.L), (PRINTED_K, PRINTED_L))]  # fmt: skip
    assert ranks == [1, 2]


def test_p7_the_implicit_equation_with_a_y_supplied():
    """P7, (eq:framerx): x_up = f_up + B u + w_up + G^+ d_up - G^- d_low (and the mirror), d from (eq:dup)-(eq:hlow), is
    an affine equation for (x_up, x_low). Its solution obeys A_x x = A_f f + A_g g + A_u u + A_w w + A_v v + A_y y with
    A_y = [K2 - L2; K2 - L2], m = 2; and (eq:xup) returns it where A_x is regular.
    """
    random = np.random.default_rng(8)
    for k in range(100):
        system = plant(random, deficient=False)
        gains = framer_gains(system, any_left_inverse(random, system) if k % 2 else None)
        n, l = system.n, system.l
        f, g, w, v = (random.standard_normal((2, size)) for size in (n, l, n, l))  # (up, low); order does not matter
        y, u = random.standard_normal(l), random.standard_normal(2)
        BD, J_up, J_low = np.vstack([system.B, system.D]) @ u, np.maximum(gains.J, 0), np.maximum(-gains.J, 0)
        G_up, G_low = np.maximum(system.G, 0), np.maximum(-system.G, 0)

        def propagate(x, n=n, f=f, g=g, w=w, v=v, y=y, BD=BD, J_up=J_up, J_low=J_low, G_up=G_up, G_low=G_low):
            h_up = np.concatenate([x[:n] - f[1] - w[1], y - g[1] - v[1]]) - BD
            h_low = np.concatenate([x[n:] - f[0] - w[0], y - g[0] - v[0]]) - BD
            d_up, d_low = J_up @ h_up - J_low @ h_low, J_up @ h_low - J_low @ h_up
            upper = f[0] + BD[:n] + w[0] + G_up @ d_up - G_low @ d_low
            return np.concatenate([upper, f[1] + BD[:n] + w[1] + G_up @ d_low - G_low @ d_up])

        offset = propagate(np.zeros(2 * n))
        slope = np.stack([propagate(e) - offset for e in np.eye(2 * n)], axis=1)
        if singularity(np.eye(2 * n) - slope) < 1e-3:
            continue
        x = np.linalg.solve(np.eye(2 * n) - slope, offset)
        stack = [pair.ravel() for pair in (f, g, w, v)]
        matrices = (gains.A_f, gains.A_g, gains.A_w, gains.A_v)
        right = sum(A @ q for A, q in zip(matrices, stack, strict=True)) + gains.A_y @ y + gains.A_u @ u
        size = max(1.0, np.abs(x).max(), np.abs(gains.A_x).max())
        np.testing.assert_allclose(gains.A_x @ x, right, rtol=0, atol=1e-10 * size**2)
        solved = (gains.M_f @ stack[0] + gains.M_g @ stack[1] + gains.M_w @ stack[2] + gains.M_v @ stack[3]
                  + gains.M_y @ y + gains.M_u @ u)  # fmt: skip
        np.testing.assert_allclose(solved, x, rtol=0, atol=1e-8 * size**2)
