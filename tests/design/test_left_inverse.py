"""Left inverses of [G; H]: exact input boxes against linear programs, and the smallest radius Theorem 1 can have."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles.input_hull import feasibility_slack, input_hull, program

from gsisio_jax import Interval
from gsisio_jax.design.basic_inverses import basic_left_inverses, circuits
from gsisio_jax.design.framer import framer_gains
from gsisio_jax.design.left_inverse import smallest_radius_inverse
from gsisio_jax.examples import paper
from gsisio_jax.interval.image import image

_ROWS, _INPUTS, _LINES = 56, 3, 8  # of the padded stack: C(8, 3) supports at most


def exact_input_box(rows, h):
    """The input box, as the observer would compute it online: K correct boxes, intersected."""
    boxes = image(rows, h)
    return Interval.unchecked(boxes.lower.max(0), boxes.upper.min(0))


def printed_box(S, lower, upper):
    """(eq:dup) with the gains of Lemma 3."""
    J = np.linalg.pinv(S)
    up, down = np.maximum(J, 0), np.maximum(-J, 0)
    return up @ lower - down @ upper, up @ upper - down @ lower


def instance(seed):
    """S (r, p) of full column rank and a box of h: generic, integer, or with zero and parallel rows; the box around a
    point that some d reaches, or anywhere; in one case of five with infinite sides, in one of five with points."""
    random = np.random.default_rng(seed)
    while True:
        p = int(random.integers(1, 4))
        r = int(random.integers(p, _LINES + 1))
        S = random.standard_normal((r, p)) if seed % 3 == 0 else random.integers(-2, 3, (r, p)).astype(float)
        if seed % 3 == 2:
            S[random.integers(r)] = 0
            S[random.integers(r)] = -1.7 * S[random.integers(r)]
        if np.linalg.matrix_rank(S) == p:
            break
    reachable = seed % 4 > 0
    center = S @ random.standard_normal(p) * 3 if reachable else random.standard_normal(r)
    lower, upper = center - random.exponential(1.0, r), center + random.exponential(1.0, r)
    if seed % 5 == 0:
        lower = np.where(random.random(r) < 0.3, -np.inf, lower)
        upper = np.where(random.random(r) < 0.3, np.inf, upper)
    if seed % 5 == 1 and reachable:
        lower[0] = upper[0] = center[0]
    return S, lower, upper


def padded(rows, count, inputs, lines):
    """Rows and inputs repeated, weights of absent lines zero: nothing changes, and all instances have one shape."""
    k, p, r = rows.shape
    rows = rows[np.minimum(np.arange(count), k - 1)][:, np.minimum(np.arange(inputs), p - 1)]
    return np.pad(rows, ((0, 0), (0, 0), (0, lines - r)))


@pytest.fixture(scope="module")
def thousand():
    """Instances, the truth about each (None: infeasible), and the boxes of `exact_input_box`, all in one call."""
    cases = [instance(seed) for seed in range(1000)]
    slack = np.array([feasibility_slack(*case) for case in cases])
    truth = [input_hull(*case) if s > 1e-7 else None for case, s in zip(cases, slack, strict=True)]
    inverses = [basic_left_inverses(S) for S, _, _ in cases]
    assert all(found.complete and not found.note for found in inverses)
    rows = np.stack([padded(found.rows, _ROWS, _INPUTS, _LINES) for found in inverses])
    h = [np.stack([np.pad(case[i], (0, _LINES - len(case[i]))) for case in cases]) for i in (1, 2)]
    boxes = jax.jit(jax.vmap(exact_input_box))(jnp.asarray(rows), Interval(*h))
    return cases, slack, truth, np.asarray(boxes.lower), np.asarray(boxes.upper)


def test_input_boxes_equal_the_linear_programs(thousand):
    """Theory 7: the minimum over basic left inverses is the exact bound, infinite exactly where d is unbounded."""
    cases, _, truth, lower, upper = thousand
    compared, infinite = 0, 0
    for k, ((S, _, _), hull) in enumerate(zip(cases, truth, strict=True)):
        if hull is None:
            continue
        p = S.shape[1]
        for mine, exact in ((lower[k, :p], hull[0]), (upper[k, :p], hull[1])):
            np.testing.assert_allclose(mine, exact, rtol=1e-7, atol=1e-7, err_msg=f"instance {k}")
        compared += 1
        infinite += not np.isfinite(hull).all()
    assert compared > 600
    assert infinite > 30


def test_circuits_refuse_exactly_the_infeasible_boxes(thousand):
    """Farkas: some d reaches the box of h if and only if c h contains 0 for every circuit c."""
    cases, slack, _, _, _ = thousand
    refused = []
    for S, lower, upper in cases:
        found = circuits(S)
        assert found.complete
        h = [np.where(found.rows > 0, x, np.where(found.rows < 0, y, 0)) for x, y in ((lower, upper), (upper, lower))]
        low, high = ((found.rows * np.where(found.rows == 0, 0, side)).sum(1) for side in h)
        refused.append((low > 0).any() or (high < 0).any())
    clear = np.abs(slack) > 1e-7
    assert (np.array(refused) == (slack < 0))[clear].all()
    assert np.count_nonzero(slack[clear] < 0) > 100


def test_printed_boxes_contain_the_exact_ones_and_are_tight_for_square_matrices(thousand):
    """P13 and Lemma 3: the pseudo-inverse always gives a correct box; the smallest one if [G; H] is square."""
    cases, _, truth, lower, upper = thousand
    square, wider = 0, 0
    for k, ((S, low, high), hull) in enumerate(zip(cases, truth, strict=True)):
        if hull is None or not (np.isfinite(low).all() and np.isfinite(high).all()):
            continue
        p = S.shape[1]
        printed = printed_box(S, low, high)
        size = 1e-9 * np.maximum(1, np.abs(printed)).max()
        assert (printed[0] <= lower[k, :p] + size).all()
        assert (printed[1] >= upper[k, :p] - size).all()
        if len(S) == p:
            np.testing.assert_allclose(printed, hull, rtol=1e-7, atol=1e-7)
            square += 1
        else:
            wider += (printed[1] - printed[0] > 1.01 * (upper - lower)[k, :p]).any()
    assert square > 50
    assert wider > 300


def test_printed_box_is_not_tight_for_a_tall_matrix():
    """P13: G = H = 1, h in [0, 2] x [0, 1]. (eq:dup) gives [0, 3/2]; every compatible d lies in [0, 1]."""
    S, low, high = np.array([[1.0], [1.0]]), np.zeros(2), np.array([2.0, 1.0])
    np.testing.assert_allclose(printed_box(S, low, high), [[0.0], [1.5]], atol=1e-15)
    hull = input_hull(S, low, high)
    assert hull is not None
    np.testing.assert_allclose(hull, [[0.0], [1.0]], atol=1e-15)
    box = exact_input_box(jnp.asarray(basic_left_inverses(S).rows), Interval(low, high))
    np.testing.assert_allclose([box.lower, box.upper], [[0.0], [1.0]], atol=1e-14)


def test_every_row_is_a_left_inverse_on_independent_rows_and_none_comes_twice():
    """The paper's [G; H]: six pairs of rows, the two of H parallel. Each row comes once."""
    S = np.vstack([paper.G, paper.H])
    found = basic_left_inverses(S)
    assert found.complete
    for i in range(2):
        rows = np.unique(found.rows[:, i], axis=0)
        np.testing.assert_allclose(rows @ S, np.broadcast_to(np.eye(2)[i], (len(rows), 2)), atol=1e-14)
        assert (np.count_nonzero(rows, axis=1) <= 2).all()
        assert len(np.unique(rows != 0, axis=0)) == len(rows)
    # d2 stands on the first row of G alone, on the second with either row of H, and on nothing else.
    supports = {tuple(np.flatnonzero(row)) for row in found.rows[:, 1]}
    assert supports == {(0,), (1, 2), (1, 3)}


def test_known_input_bounds_serve_as_rows():
    """Inputs with bounds: rows and bounds together give the exact box, and circuits see contradictions with them."""
    random = np.random.default_rng(5)
    verdicts = []
    for _ in range(40):
        S = random.integers(-2, 3, (5, 3)).astype(float)
        if np.linalg.matrix_rank(S) < 3:
            continue
        free = np.array([True, False, random.random() < 0.5])
        bounds = [(-np.inf, np.inf) if f else tuple(np.sort(random.normal(size=2))) for f in free]
        center = S @ random.standard_normal(3) + 0.3 * random.standard_normal(5)
        low, high = center - 1, center + 1
        hull = input_hull(S, low, high, bounds)
        d = np.array(bounds).T

        def span(rows, S=S, free=free, h=(low, high), d=d, target: Any = 0.0):
            bounded = np.flatnonzero(~free)
            weights = np.concatenate([rows, (target - rows @ S)[..., bounded]], axis=-1)
            sides = [np.concatenate([h[i], d[i][bounded]]) for i in (0, 1)]
            return (np.minimum(weights * sides[0], weights * sides[1]).sum(-1),
                    np.maximum(weights * sides[0], weights * sides[1]).sum(-1))  # fmt: skip

        least, most = span(circuits(S, free).rows)
        assert ((least > 1e-9) | (most < -1e-9)).any() == (hull is None)
        verdicts.append(hull is None)
        if hull is not None:
            rows = basic_left_inverses(S, free).rows
            boxes = span(rows, target=np.eye(3))
            np.testing.assert_allclose(boxes[0].max(0), hull[0], rtol=1e-7, atol=1e-7)
            np.testing.assert_allclose(boxes[1].min(0), hull[1], rtol=1e-7, atol=1e-7)
    assert 3 < sum(verdicts) < len(verdicts) - 3


def test_separate_inputs_are_enumerated_separately():
    """Twelve inputs, each with two rows of its own: 24 choose 12 supports together, two for each input."""
    S = np.kron(np.eye(12), np.array([[1.0], [2.0]]))
    found = basic_left_inverses(S, cap=2)
    assert found.complete
    assert found.rows.shape == (2, 12, 24)
    assert circuits(S, cap=1).rows.shape == (12, 24)


def test_too_many_supports_are_said_and_what_is_left_is_correct():
    """Above the cap: a note, the pseudo-inverse, left inverses, and a box better than the printed one."""
    random = np.random.default_rng(3)
    S = random.standard_normal((9, 3))
    found, tests = basic_left_inverses(S, cap=80), circuits(S, cap=80)
    assert not found.complete
    assert "cap = 80" in found.note
    assert "cap = 80" in tests.note
    np.testing.assert_allclose(found.rows @ S, np.broadcast_to(np.eye(3), (len(found.rows), 3, 3)), atol=1e-12)
    np.testing.assert_allclose(tests.rows @ S, np.zeros((6, 3)), atol=1e-13)
    assert np.linalg.matrix_rank(tests.rows) == 6
    gap = [np.abs(found.rows[:, i] - np.linalg.pinv(S)[i]).max(axis=1).min() for i in range(3)]
    assert max(gap) < 1e-12
    every = jnp.asarray(basic_left_inverses(S).rows)
    few, exact, printed = np.zeros(3), np.zeros(3), np.zeros(3)
    for _ in range(20):
        h, spread = S @ random.standard_normal(3), random.exponential(1.0, 9)
        box = exact_input_box(jnp.asarray(found.rows), Interval(h - spread, h + spread))
        best = exact_input_box(every, Interval(h - spread, h + spread))
        low, high = printed_box(S, h - spread, h + spread)
        few, exact, printed = few + box.width, exact + best.width, printed + high - low
    assert (exact <= few).all()
    assert (few < printed).all()
    assert (few < 2 * exact).all()


def test_units_change_nothing():
    """Rows in other units, inputs in other units: the same supports, and rows that scale with them."""
    S = np.random.default_rng(11).integers(-2, 3, (6, 2)).astype(float)
    rows, columns = 10.0 ** np.array([-9, 6, 0, 3, -4, 8]), np.array([1e-3, 1e3])
    plain, scaled = basic_left_inverses(S), basic_left_inverses(S * rows[:, None] * columns)
    assert scaled.complete
    back = scaled.rows * columns[:, None] * rows

    def ordered(stack, i):
        found = np.unique(np.round(stack[:, i], 12) + 0.0, axis=0)
        return found[np.lexsort(found.T)]

    for i in range(2):
        np.testing.assert_allclose(ordered(back, i), ordered(plain.rows, i), rtol=1e-9, atol=1e-12)


def test_no_unknown_input():
    """p = 0: nothing to invert, and every entry of h must contain 0."""
    assert smallest_radius_inverse(np.zeros((2, 0)), np.zeros((1, 0))).shape == (0, 3)
    assert basic_left_inverses(np.zeros((3, 0))).rows.shape == (1, 0, 3)
    np.testing.assert_array_equal(circuits(np.zeros((3, 0))).rows, np.eye(3))


def radius(G, J):
    return np.abs(np.linalg.eigvals(np.abs(J[:, : len(G)]) @ np.abs(G))).max()


def random_plant(random, deficient=True, larger=0):
    """G, H with [G; H] of full column rank; H of rank below p (0 included), or p."""
    while True:
        n, l, p = random.integers(2, 5) + larger, random.integers(1, 5), random.integers(1, 4) + larger
        rank = random.integers(0, min(l, p - 1) + 1) if deficient else p
        H = random.standard_normal((l, rank)) @ random.standard_normal((rank, p))
        G = random.standard_normal((n, p))
        if rank <= l and np.linalg.matrix_rank(np.vstack([G, H])) == p:
            return G, H


def test_smallest_radius_of_the_papers_example():
    """The paper's G, H: the pseudo-inverse has radius 1.927, the best left inverse 1, none less."""
    J = smallest_radius_inverse(paper.G, paper.H)
    assert framer_gains(paper.system(), J).rho == pytest.approx(1.0, abs=1e-6)
    assert framer_gains(paper.system()).rho == pytest.approx(1.9267, abs=1e-4)


def test_smallest_radius_is_a_minimum():
    """Dual certificate: with v the Perron vector, every left inverse has ``(|J1||G| v)_i >= phi_i(v)``, where

    phi_i(v) = max{d_i : |G d| <= |G| v, H d = 0}, so no radius lies below min_i phi_i(v) / v_i.
    """
    random = np.random.default_rng(2)
    improved = 0
    for k in range(25):
        G, H = random_plant(random, larger=k % 3)
        n, p = G.shape
        J, S = smallest_radius_inverse(G, H), np.vstack([G, H])
        np.testing.assert_allclose(J @ S, np.eye(p), atol=1e-9)
        values, vectors = np.linalg.eig(np.abs(J[:, :n]) @ np.abs(G))
        v = np.abs(np.real(vectors[:, np.abs(values).argmax()]))
        box = np.concatenate([np.abs(G) @ v, np.zeros(len(H))])
        lowest = [-(program(-np.eye(p)[i], S, -box, box) or 0) / v[i] for i in range(p) if v[i] > 1e-9]
        assert min(lowest) >= radius(G, J) * (1 - 1e-4)
        assert 1 - 1e-9 <= radius(G, J) <= radius(G, np.linalg.pinv(S)) * (1 + 1e-12)
        improved += radius(G, J) < 0.99 * radius(G, np.linalg.pinv(S))
    assert improved > 5


@pytest.mark.parametrize("gap", [1e-6, 1e-9, 1e-12])
def test_feedthrough_close_to_rank_deficient(gap):
    """Where H is as good as rank-deficient the result is an ordinary left inverse, not one made of rounding."""
    H = paper.H + np.diag([0, gap])
    J = smallest_radius_inverse(paper.G, H)
    np.testing.assert_allclose(J @ np.vstack([paper.G, H]), np.eye(2), atol=1e-9)
    assert radius(paper.G, J) < 1 + 1e-6


def test_full_rank_feedthrough_has_radius_zero():
    """P6: H of full column rank is inverted alone, J1 = 0, and the recursion of Theorem 1 is explicit."""
    random = np.random.default_rng(4)
    for _ in range(30):
        G, H = random_plant(random, deficient=False)
        J = smallest_radius_inverse(G, H)
        assert not J[:, : len(G)].any()
        np.testing.assert_allclose(J @ np.vstack([G, H]), np.eye(G.shape[1]), atol=1e-9)


@pytest.mark.parametrize("call", [basic_left_inverses, circuits])
@pytest.mark.parametrize(
    ("matrix", "message"),
    [([[1.0, 2.0], [2.0, 4.0]], "full column rank 2"), ([[np.nan]], "finite"), ([1.0], "finite matrix")],
)
def test_bad_matrices_are_refused(call, matrix, message):
    with pytest.raises(ValueError, match=message) as error:
        call(matrix)
    assert call.__name__ in str(error.value)


def test_bad_shapes_are_refused():
    with pytest.raises(ValueError, match="one column per unknown input"):
        smallest_radius_inverse([[1.0]], [[1.0, 2.0]])
    with pytest.raises(ValueError, match="`free` must have"):
        basic_left_inverses([[1.0]], free=[True, False])
    with pytest.raises(ValueError, match="`width` must have"):
        basic_left_inverses([[1.0]], width=[1.0, 2.0])
