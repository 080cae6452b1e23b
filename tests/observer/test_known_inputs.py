"""A known input written inside of f or g is as good as one beside it, ``B u`` and ``D u``."""

from __future__ import annotations

from fractions import Fraction

import jax.numpy as jnp
import numpy as np
import pytest

import gsisio_jax as gx
from gsisio_jax import Interval
from gsisio_jax.observer.known_inputs import input_matrix

N, STEPS, LOST = 3, 24, 10
A = 0.9 * np.eye(N) + 0.1 * np.eye(N, k=1)
G, H = np.array([[1.0], [0.05], [0.02]]), np.zeros((2, 1))
B, D = np.array([[0.0], [0.0], [1.0]]), np.array([[0.3], [-0.2]])
NOISE = gx.Noise(Interval.symmetric([1e-3] * N), Interval.symmetric([0.01, 0.01]))


def _beside(B, D):
    return gx.System(lambda x: A @ x, lambda x: x[:2], G=G, H=H, B=B, D=D)


def _designed(system, noise=NOISE, **options):
    return gx.design_observer(
        system, noise, Interval.entire(system.n), u_region=Interval.symmetric([0.2] * system.m), **options
    )


def _same(a, b, tolerance=1e-11):
    for got, expected in ((a.state, b.state), (a.input, b.input)):
        np.testing.assert_array_equal(np.isinf(got.width), np.isinf(expected.width))
        np.testing.assert_allclose(got.lower, expected.lower, rtol=0, atol=tolerance)
        np.testing.assert_allclose(got.upper, expected.upper, rtol=0, atol=tolerance)


def _record(A, B, D, of_d=G):
    """Measurements with a lost row, and what is known of the input."""
    rng = np.random.default_rng(0)
    x, u, y = rng.uniform(-0.5, 0.5, N), 0.2 * np.sin(np.arange(STEPS) / 3)[:, None], []
    for k in range(STEPS):
        y.append(x[:2] + D @ u[k] + rng.uniform(-0.01, 0.01, 2))
        x = A @ x + B @ u[k] + of_d @ rng.normal(size=1)
    y = np.array(y)
    y[LOST] = np.nan
    return y, u


@pytest.mark.parametrize("window", [1, "auto"])
@pytest.mark.parametrize("of_g", [False, True])
def test_both_ways_of_writing_give_the_same_boxes(of_g, window):
    """From a box and from R^n, with a lost row, while u changes."""
    known = D if of_g else np.zeros((2, 1))
    g = (lambda x, u: x[:2] + D @ u) if of_g else (lambda x: x[:2])
    inside = gx.System(lambda x, u: A @ x + u[0] * B[:, 0], g, G=G, H=H, m=1)
    observers = [_designed(system, window=window) for system in (_beside(B, known), inside)]
    assert observers[1].certificate.rows_until_finite().tolist() == [0, 0, 1]
    for name in ("recovery_steps", "lost_row_steps"):
        assert getattr(observers[0].certificate, name) == getattr(observers[1].certificate, name)
    y, u = _record(A, B, known)
    for initial in (Interval.symmetric([1.0] * N), Interval.entire(N)):
        beside, within = (gx.estimate(o, initial, y, u, rounding="outward") for o in observers)
        _same(within, beside)
    assert np.isfinite(within.state.width[LOST + 2 :]).all()


def test_products_of_constants():
    """Euler's method: what multiplies u is no floating number."""
    h, of_u = 0.1, np.array([0.0, 0.3, 0.7])
    inside = gx.System(lambda x, u: x + h * (A @ x - x + u[0] * of_u), lambda x: x[:2], G=G, H=H, m=1)
    beside = gx.System(lambda x: x + h * (A @ x - x), lambda x: x[:2], G=G, H=H, B=h * of_u[:, None])
    matrix = input_matrix(inside, np.float64)
    exact = [Fraction(h) * Fraction(v) for v in of_u]
    assert [float(v) for v in exact] == matrix[:N, 0].tolist()
    assert exact[1] != Fraction(matrix[1, 0])
    y, u = _record(np.eye(N) + h * (A - np.eye(N)), h * of_u[:, None], np.zeros((2, 1)))
    found = [
        gx.estimate(_designed(s, window=1), Interval.entire(N), y, u, rounding="outward") for s in (beside, inside)
    ]
    assert np.isfinite(found[1].state.width[-1]).all()
    _same(*found)


def test_a_held_input_of_a_linear_plant():
    """`discretize` writes the input inside of f."""
    model = gx.discretize(
        lambda x, u: jnp.stack([x[1] - x[0], x[2] - x[1], u[0] - x[2]]), 0.1, "zoh",
        region=Interval.symmetric([5.0] * N), u_bounds=Interval.symmetric([0.2]), G=G, bound=False,
    )  # fmt: skip
    inside = model.system(lambda x: x[:2])
    matrix, rest = input_matrix(inside, np.float64), inside.f
    beside = gx.System(lambda x: rest(x, np.zeros(1)), lambda x: x[:2], G=inside.G, H=H, B=matrix[:N])
    slope = np.stack([np.asarray(rest(row, np.zeros(1)) - rest(np.zeros(N), np.zeros(1))) for row in np.eye(N)], 1)
    y, u = _record(slope, matrix[:N], np.zeros((2, 1)), of_d=np.asarray(inside.G))
    found = [gx.estimate(_designed(s, window=1), Interval.symmetric([1.0] * N), y, u) for s in (beside, inside)]
    assert np.isfinite(found[1].state.width[-1]).all()
    _same(*found)


def test_a_product_of_state_and_input_stays_what_it_was():
    bilinear = gx.System(lambda x, u: A @ x + 0.1 * u[0] * x, lambda x: x[:2], G=G, H=H, m=1)
    assert input_matrix(bilinear, np.float64) is None
    observer = _designed(bilinear, window=1)
    assert observer.recovery == ()


@pytest.mark.parametrize("cancels", [False, True])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_rows_hold_for_inputs_of_any_size(dtype, cancels):
    """From R^n, exactly: noise at its vertices, far below the rounding of what u adds; or of what B and D take away
    again, where only the rounding of the products is left."""
    h, v, count, size = dtype(0.1), 1e-16 if cancels else 1e-12, 40, 1e6
    A, b, c = (np.array(m, dtype) for m in ([[0.75, 0.25], [-0.125, 0.5]], [[0.3, -0.7], [0.9, 0.1]], [[0.6, 1.1]]))
    system = gx.System(
        lambda x, u: A @ x + h * (b @ u), lambda x, u: x[:1] + h * (c @ u), np.zeros((2, 0)), np.zeros((1, 0)),
        *((-(h * m).astype(float) for m in (b, c)) if cancels else ()), m=2,
    )  # fmt: skip
    exact_A = [[Fraction(float(q)) for q in row] for row in A]
    exact_B, exact_D = (
        [[Fraction(float(h)) * Fraction(float(q)) + Fraction(float(r)) for q, r in zip(*rows, strict=True)]
         for rows in zip(of_f, beside, strict=True)]
        for of_f, beside in ((b, system.B), (c, system.D))
    )  # fmt: skip
    noise = gx.Noise(Interval.symmetric([v, v]), Interval.symmetric([v]))
    observer = _designed(system, noise, missing=False, certify=False, sweeps=1, window=1)
    assert observer.recovery
    rng = np.random.default_rng(1)
    for _ in range(count):
        u = (size * rng.normal(size=(3, 2))).astype(dtype)
        x, states, seen = [Fraction(float(q)) for q in (1 if cancels else size) * rng.normal(size=2)], [], []
        for row in u:
            states.append(x)
            seen.append(x[0] + _dot(exact_D[0], row) + Fraction(v) * int(rng.choice([-1, 1])))
            of_w = [Fraction(v) * int(sign) for sign in rng.choice([-1, 1], 2)]
            x = [_dot(a, x) + _dot(b, row) + w for a, b, w in zip(exact_A, exact_B, of_w, strict=True)]
        y = np.array([[float(q)] for q in seen], dtype)  # what the machine holds counts as the measurement
        off = [abs(float(Fraction(float(a[0])) - b)) for a, b in zip(y, seen, strict=True)]
        of_v = ((v + np.array(off)) * (1 + 1e-6))[:, None]
        given = gx.Noise(noise.w, Interval(-of_v, of_v)).astype(dtype)
        box = gx.estimate(observer, Interval.entire(2).astype(dtype), y, u, noise=given, rounding="outward").state
        assert np.isfinite(box.width[1:]).all()
        for k in (1, 2):
            for i in range(2):
                assert Fraction(float(box.lower[k, i])) <= states[k][i] <= Fraction(float(box.upper[k, i]))


def _dot(weights, values):
    return sum(w * (q if isinstance(q, Fraction) else Fraction(float(q))) for w, q in zip(weights, values, strict=True))
