"""What a certificate says of recovery is what linear programs over whole records say: per state, from R^n and after
lost rows."""

import jax
import numpy as np
import pytest
from recovery_plants import PLANTS, designed, records
from scipy.optimize import linprog

import gsisio_jax as gx


def exact_width(name, rows, state, start=np.inf):
    """Width of the hull of a state at the last of these steps, all measurements 0 (those of a pattern False are lost),
    the first state within +-start, the inputs free: the largest over all data, as noise and boxes are symmetric."""
    A, C, G, H, w, v = PLANTS[name]
    (l, n), p, T = C.shape, G.shape[1], len(rows)
    size = T * (n + p + l) + (T - 1) * n
    x, d, noise, drift = np.split(np.eye(size), np.cumsum([T * n, T * p, T * l]))
    equal = [x[(k + 1) * n :][:n] - A @ x[k * n :][:n] - G @ d[k * p :][:p] - drift[k * n :][:n] for k in range(T - 1)]
    equal += [
        C @ x[k * n :][:n] + H @ d[k * p :][:p] + noise[k * l :][:l] for k, measured in enumerate(rows) if measured
    ]
    sides = np.concatenate(
        [np.broadcast_to(start, n), np.full((T - 1) * n + T * p, np.inf), np.tile(v, T), np.tile(w, T - 1)]
    )
    equal = np.vstack(equal) if equal else np.zeros((0, size))
    found = linprog(
        -x[(T - 1) * n + state], A_eq=equal, b_eq=np.zeros(len(equal)), bounds=np.stack([-sides, sides], 1),
        method="highs",
    )  # fmt: skip
    assert found.status in (0, 2, 3, 4)
    return -2 * found.fun if found.status == 0 else np.inf


def first_finite(name, lost, rows_after, start):
    n = len(PLANTS[name][0])
    width = np.array([
        [exact_width(name, [True] * (start < np.inf) + [False] * lost + [True] * (k + 1), i, start) for i in range(n)]
        for k in range(rows_after)
    ])  # fmt: skip
    found = np.where(np.isfinite(width).any(0), np.argmax(np.isfinite(width), 0), np.inf)
    return found, width


@pytest.mark.parametrize("name", PLANTS)
def test_every_state_is_known_when_the_exact_program_says_so(name):
    certificate = designed(name).certificate
    said = certificate.rows_until_finite()
    rows = int(max(said[np.isfinite(said)])) + 1
    steps, width = first_finite(name, 0, rows, np.inf)
    np.testing.assert_array_equal(said, steps)
    exact = width[np.where(np.isfinite(steps), steps, -1).astype(int), np.arange(len(steps))]
    if rows > 1:  # rows of least noise: the width is that of the exact program
        np.testing.assert_allclose(certificate.recovery_width, exact, rtol=1e-5)
    else:
        assert (np.asarray(certificate.recovery_width) <= exact * (1 + 1e-5)).all()
    settled = np.asarray(certificate.steady_width) / 2
    for lost in (1, 2, 3, len(steps) + 1):
        said, possible = certificate.rows_until_finite(lost), first_finite(name, lost, rows, 2.0)[0]
        np.testing.assert_array_equal(said, possible)
        assert (said <= steps).all()
        # Settled boxes, the gap, and rows up to that one: no box of all this can be narrower than the exact program.
        then = certificate.recovered_width(lost)
        exact = np.array([
            exact_width(name, [True] + [False] * lost + [True] * int(row + 1), i, settled) if row < np.inf else np.inf
            for i, row in enumerate(said)
        ])  # fmt: skip
        assert (then >= exact * (1 - 1e-6)).all()
        if lost == 1:
            assert (then[said < np.inf] <= 1.7 * exact[said < np.inf]).all()


def test_a_state_that_only_a_box_before_the_gap_bounds_comes_back():
    """Two states are never known from R^n, but a row over one lost row leans on the box before it."""
    observer, name = designed("one row only"), "one row only"
    np.testing.assert_array_equal(observer.certificate.rows_until_finite(), [np.inf, 0, np.inf, 0])
    np.testing.assert_array_equal(observer.certificate.rows_until_finite(lost=1), [0, 0, 0, 0])
    np.testing.assert_array_equal(observer.certificate.rows_until_finite(lost=2), [np.inf, 0, np.inf, 0])
    x, y = records(name, range(500), 12)
    y[:, 6] = np.nan
    state = jax.vmap(lambda y: gx.estimate(observer, gx.Interval.symmetric(np.full(4, 2.0)), y).state)(y)
    assert state.contains(x).all()
    assert np.isfinite(state.width[:, 7:]).all()


def test_states_that_nothing_shows_are_named():
    """The second state never shows; the first is measured."""
    system = gx.System(lambda x: [0.5 * x[0], 0.9 * x[1]], lambda x: x[:1], G=np.zeros((2, 0)), H=np.zeros((1, 0)))
    noise = gx.Noise(gx.Interval.symmetric([0.1, 0.1]), gx.Interval.symmetric([0.1]))
    region, fast = gx.Interval.symmetric([2.0, 2.0]), {"sweeps": 1, "window": 1}
    certificate = gx.design_observer(system, noise, region, **fast).certificate
    np.testing.assert_array_equal(certificate.rows_until_finite(), [0, np.inf])
    np.testing.assert_array_equal(certificate.rows_until_finite(lost=3), [0, 0])  # its box was finite, and stays so
    assert "state 2                0             2         never           inf" in str(certificate)
    for wrong in (0, 1.5, True):
        for call in (certificate.rows_until_finite, certificate.recovered_width):
            with pytest.raises(ValueError, match=rf"{call.__name__}: `lost` must be a number of rows, at least 1"):
                call(wrong)
    without = gx.design_observer(system, noise, region, missing=False, **fast).certificate
    with pytest.raises(ValueError, match="must be that of a design with missing=True"):
        without.rows_until_finite()


# Bounds that a run without input and noise is nearer to on one side: there boxes are cut by them.
BOUNDS = {
    "a state near its bound": {"state_bounds": ([-np.inf, 0.0], [np.inf, 100.0]), "input_bounds": ([-1.0], [1.0])},
    "a bound on one side": {"state_bounds": ([-np.inf, 0.0], [np.inf, np.inf]), "input_bounds": ([-1.0], [1.0])},
    "an input that is never 0": {"input_bounds": ([5.0], [7.0])},
}


def held_after_gaps(observer, initial, y, gaps, lost):
    """Widths (gaps, n) in the first row after gaps that begin in these rows, in front of which boxes had settled."""
    rows, certificate = np.array(gaps), observer.certificate
    records = np.tile(y, (len(gaps), 1, 1))
    for record, gap in zip(records, gaps, strict=True):
        record[gap : gap + lost] = np.nan
    width = np.asarray(jax.vmap(lambda y: gx.estimate(observer, initial, y))(records).state.width)
    assert (width[range(len(gaps)), rows - 1] <= certificate.steady_width * (1 + 1e-4)).all()
    assert (certificate.rows_until_finite(lost) == 0).all()
    after = width[range(len(gaps)), rows + lost]
    assert (after <= certificate.recovered_width(lost) * (1 + 2e-4)).all()
    return after


@pytest.mark.parametrize("name", BOUNDS)
def test_widths_after_a_gap_are_promised_for_any_data(name):
    """The promise was what a run from the middle of the region shows, whose boxes bounds may cut more than others."""
    A, G = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.0], [1.0]])
    bounds = {key: gx.Interval(*sides) for key, sides in BOUNDS[name].items()}
    system = gx.System(lambda x: A @ x, lambda x: x[:1], G=G, H=[[0.0]], **bounds)
    noise = gx.Noise(gx.Interval.symmetric([1e-3, 1e-3]), gx.Interval([0.0], [0.02]))
    region = gx.Interval([-100.0, 0.0], [100.0, 100.0])
    observer = gx.design_observer(system, noise, region, window=1, sweeps=1)
    x, y, push = np.array([0.0, 50.0]), [], 6.0 * ("never" in name)
    for _ in range(8):
        y.append(x[:1] + 0.01)
        x = A @ x + G[:, 0] * push
    after = held_after_gaps(observer, gx.Interval([-1.0, 49.0], [1.0, 51.0]), np.array(y), (4,), 2)
    assert (after.max(0) >= 0.9 * observer.certificate.recovered_width(2)).all()


def test_widths_after_a_gap_are_promised_wherever_it_lies_in_a_block():
    """Of an input that is constant for four steps the promise was that of gaps in one place: .46 in place of .77."""
    A = np.array([[0.44, -0.92, 1.1], [-0.13, 0.35, 0.51], [0.16, 0.12, -0.89]])
    C = np.array([[-0.18, -0.54, 0.0], [-2.7, -1.56, -0.29], [0.26, -0.2, 0.0]])
    more = {"input_rate": [0.195], "input_constant": 4}
    system = gx.System(lambda x: A @ x, lambda x: C @ x, G=[[-1.13], [0.45], [0.32]], H=[[0.0], [0.0], [-0.81]], **more)
    noise = gx.Noise(gx.Interval.symmetric([0.003, 0.013, 0.006]), gx.Interval.symmetric([0.016, 0.149, 0.012]))
    observer = gx.design_observer(system, noise, gx.Interval.entire(3), window=1, sweeps=1)
    after = held_after_gaps(observer, gx.Interval.symmetric([0.1] * 3), np.zeros((15, 3)), (8, 9, 10, 11), 3)
    assert after[:, 2].max() > 0.7
