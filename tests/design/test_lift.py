"""Combinations of later outputs that are free of d, against runs in fractions; and which delay a plant needs."""

from fractions import Fraction

import jax.numpy as jnp
import numpy as np
import pytest

import gsisio_jax as gx
from gsisio_jax import Interval
from gsisio_jax.plant.later_outputs import lifted_rows
from gsisio_jax.plant.lift import lifted


def exact(matrix):
    return np.vectorize(Fraction, otypes=[object])(np.asarray(matrix, float)) if np.size(matrix) else np.zeros(
        np.shape(matrix), object
    )  # fmt: skip


def runs(A, a, C, c, G, H, B, D, delay, seed):
    """x[0], f(x[0]), g(x[0]), y, u, w, v of a run in fractions; d is huge."""
    rng = np.random.default_rng(seed)

    def draw(rows, size):
        return exact(rng.normal(size=(rows, size)))

    (n, p), (l, m), rows = np.shape(G), np.shape(D), delay + 1
    x, u, w, v = draw(1, n)[0], draw(rows, m), draw(rows, n), draw(rows, l)
    d = exact(1e12 * rng.normal(size=(rows, p)))
    first, ys = x, []
    A, a, C, c, G, B, D = map(exact, (A, a, C, c, G, B, D))
    for k in range(rows):
        ys.append(C.dot(x) + c + D.dot(u[k]) + H.dot(d[k]) + v[k])
        x = A.dot(x) + a + B.dot(u[k]) + G.dot(d[k]) + w[k]
    return A.dot(first) + a, C.dot(first) + c, np.array(ys), u, w, v


# Numbers of few bits, so that all weights are floating numbers; H of rank one as decimals, which are none.
SMALL = np.array([[12, 3, 0, 2], [-5, 8, 2, 0], [2, 0, 10, 5], [0, 3, 0, 14]]) / 16
OUT = np.array([[16, 0, 0, 0], [0, 0, 5, 0], [0, 16, 0, 11]]) / 16
G = np.array([[8, 0], [4, 0], [0, 0], [0, 2]]) / 16
B, D = np.array([[2], [0], [11], [0]]) / 16, np.array([[0], [5], [0]]) / 16
FREE, RANK_ONE = np.zeros((3, 2)), np.array([[0.1, -0.3], [0.2, -0.6], [0.0, 0.0]])


@pytest.mark.parametrize("H", [FREE, RANK_ONE], ids=["none", "rank one"])
@pytest.mark.parametrize("delay", [1, 2])
def test_rows_hold_exactly_whatever_the_input(delay, H):
    a, c = np.array([0.1, -1 / 3, 0, 0]), np.array([0, 7.1, 0])
    system = gx.System(lambda x, u: SMALL @ x + a + B @ u, lambda x: OUT @ x + c, G=G, H=H, D=D)
    rows = lifted_rows(system, delay, np.float64)
    rows = lifted_rows(system, delay, np.float64, more=((0.5, 0.25, *[0.0] * (len(rows.free) - 2)),))
    assert not rows.blocked
    decimals = np.vectorize(lambda h: Fraction(repr(float(h))), otypes=[object])(H)
    f, g, y, u, w, v = runs(SMALL, a, OUT, c, G, decimals, B, D, delay, delay)
    f = f + exact(B).dot(u[0])
    assert len(rows.entries) >= delay
    for r in range(len(rows.entries)):
        right = [Fraction(p) * f[i] for i, pieces in rows.of_f[r] for p in pieces]
        right += [Fraction(p) * g[i] for i, pieces in rows.of_g[r] for p in pieces]
        right += map(Fraction, rows.constant[r])
        for weights, values in ((-rows.outputs[r], y - v), (rows.known[r], u), (rows.process[r], w)):
            right += [Fraction(weight) * e for weight, e in zip(weights, values.ravel(), strict=True)]
        assert sum(right, Fraction(0)) == 0


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_weights_of_many_bits_are_sums_of_numbers_of_that_type(dtype):
    """Decimals have many bits, and a third has no end; what outputs see of f is given in pieces, exactly."""
    A = np.array([[0.7, 0.1], [-0.3, 0.9]], dtype)
    system = gx.System(lambda x: A @ x, lambda x: x[:1] / 3, G=np.zeros((2, 0)), H=np.zeros((1, 0)))
    rows, of_f = lifted_rows(system, 3, dtype), np.array([Fraction(1, 3), Fraction(0)])
    for r, i in enumerate((1, 2, 3)):
        assert all(p == float(dtype(p)) for _, pieces in rows.of_f[r] for p in pieces)
        found = {j: sum(map(Fraction, pieces)) for j, pieces in rows.of_f[r]}
        scale = Fraction(rows.outputs[r].max().item())
        assert found == {j: scale * value for j, value in enumerate(of_f) if value}
        assert rows.outputs[r].tolist() == [float(scale) if k == i else 0.0 for k in range(4)]
        of_f = of_f.dot(exact(A))


def test_what_cannot_be_followed_is_named():
    system = gx.System(
        lambda x: jnp.stack([x[0] + x[1], jnp.sin(x[1]) + x[2], x[2]]), lambda x: [x[0], jnp.exp(x[1])],
        G=[[0.0], [0.0], [1.0]], H=[[0.0], [0.0]],
    )  # fmt: skip
    rows = lifted_rows(system, 1, np.float64)
    assert rows.entries == ((0,),)
    assert rows.blocked == "output 2 is not affine in x"
    assert "f of state 2, which output 1 needs, is not affine" in lifted_rows(system, 3, np.float64).blocked
    assert lifted(system, 1).l == 3


def seen(A, C, G, H=None, **options):
    n, l = len(A), len(C)
    H = np.zeros((l, np.shape(G)[1])) if H is None else H
    system = gx.System(lambda x: np.asarray(A, float) @ x, lambda x: np.asarray(C, float) @ x, G=G, H=H)
    noise = gx.Noise(Interval.symmetric(np.full(n, 0.1)), Interval.symmetric(np.full(l, 0.1)))
    return gx.design_observer(system, noise, Interval.entire(n), missing=False, sweeps=1, **options)


CHAIN = [[0.5, 1, 0], [0, 0.5, 1], [0, 0, 0.5]]
NEVER = [[0.5, 0, 0], [0, 0.5, 1], [0, 0, 0.5]]
FIRST, LAST = [[1, 0, 0]], [[0.0], [0], [1]]


def test_an_error_says_which_delay_would_do():
    with pytest.raises(gx.ObserverDoesNotExist, match=r"without a delay there.* 2 steps later: delay=2 gives .*k\+2\]"):
        seen(CHAIN, FIRST, LAST)
    with pytest.raises(gx.ObserverDoesNotExist, match=r"with delay=1 there is no .* 2 steps later: delay=2"):
        seen(CHAIN, FIRST, LAST, delay=1)
    assert seen(CHAIN, FIRST, LAST, delay="auto").delay == 2
    for delay in (0, 1, "auto"):
        with pytest.raises(gx.ObserverDoesNotExist, match="no observer exists, with no delay up to n = 3 steps"):
            seen(NEVER, FIRST, LAST, delay=delay)
    at_once = seen(CHAIN, FIRST, [[1.0], [0], [0]], delay="auto")
    assert isinstance(at_once, gx.Observer)
    assert at_once.delay == 0


def test_an_output_that_is_not_affine_is_no_proof():
    system = gx.System(lambda x: jnp.stack([x[0] + x[1], x[1]]), lambda x: jnp.sin(x[:1]), G=[[0.0], [1.0]], H=[[0.0]])
    noise = gx.Noise(Interval.symmetric([0.1, 0.1]), Interval.symmetric([0.1]))
    with pytest.raises(gx.NoDesignFound, match=r"no delay up to n = 2 steps was found.* output 1 is not affine in x"):
        gx.design_observer(system, noise, Interval.symmetric([1.0, 1.0]), delay="auto")
    with pytest.raises(gx.ObserverDoesNotExist, match="was not found out: output 1 is not affine in x"):
        gx.design_observer(system, noise, Interval.symmetric([1.0, 1.0]))


@pytest.mark.parametrize(("zero", "certified"), [(0.7, True), (2.5, False)])
def test_zeros_outside_of_the_unit_circle_leave_no_certificate(zero, certified):
    """x3+ = .5 x3 + (.5 - z) d, x2+ = x3 + d: with x1 = x2 = 0 for good, d = -x3 and x3+ = z x3."""
    A = [[0.5, 1, 0], [0, 0, 1], [0, 0, 0.5]]
    observer = seen(A, FIRST, [[0.0], [1], [0.5 - zero]], delay="auto")
    assert observer.delay == 1
    assert observer.certificate.certified is certified
