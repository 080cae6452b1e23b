"""Outputs of different rates: rows that look back to where the slow one came, and what is promised for it."""

from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest
from oracles.record_hull import exact_hull

import gsisio_jax as gx
from gsisio_jax import Interval

STEP, EVERY = 0.1, 5
A = np.array([[1, STEP, 0], [0, 1, 0], [0, 0, 1.0]])
C = np.array([[0, 1.0, 1], [1, 0, 0]])
W, V = np.array([2 * STEP**2 / 2, 2 * STEP, 1e-3]), np.array([0.05, 1.0])
NOISE = gx.Noise(Interval.symmetric(W), Interval.symmetric(V))
START = np.full(3, 50.0)


@cache
def vehicle():
    """Position, speed and the bias of the encoder, which measures speed and bias; every fifth row has a position."""
    return gx.System(lambda x: A @ x, lambda x: C @ x, G=np.zeros((3, 0)), H=np.zeros((2, 0)))


@cache
def designed(window="auto"):
    return gx.design_observer(vehicle(), NOISE, Interval.entire(3), rates=[1, EVERY], window=window, sweeps=1)


def slow(y, every=EVERY):
    """The record without the second output in all but every fifth row."""
    return np.where((np.arange(len(y)) % every != 0)[:, None] & [False, True], np.nan, y)


def run(observer, y):
    return gx.estimate(observer, Interval.symmetric(START), y)


def test_the_promise_is_the_width_of_the_exact_program_over_the_window():
    """A record at rest has the widest boxes of all; the program knows of the last two periods, as the rows do."""
    observer = designed(2 * EVERY)
    promised = observer.certificate.rate_width
    assert promised.shape == (EVERY, 3)
    exact = exact_hull(A, C, W, V, np.full(3, 1e6), slow(np.zeros((2 * EVERY + 1, 2))))
    np.testing.assert_allclose(promised[0], exact, rtol=1e-6)
    width = np.asarray(run(observer, slow(np.zeros((41, 2)))).state.width)
    np.testing.assert_allclose(width[-EVERY - 1 : -1], promised, rtol=1e-6)


def test_no_run_is_wider_than_promised_and_all_hold_the_truth():
    """Noise at its vertices; then the pattern breaks, and the widths settle again."""
    observer, rng = designed(), np.random.default_rng(0)
    promised = observer.certificate.rate_width
    for _ in range(2):
        x, states, seen = rng.uniform(-1, 1, 3), [], []
        for _ in range(110):
            states.append(x)
            seen.append(C @ x + V * rng.choice([-1, 1], 2))
            x = A @ x + W * rng.choice([-1, 1], 3)
        y = slow(np.array(seen))
        y[60:67] = np.nan
        box = run(observer, y).state
        assert box.contains(np.array(states)).all()
        width = np.asarray(box.width)
        assert np.isfinite(width).all()
        for settled in (range(40, 60), range(95, 110)):
            assert all((width[k] <= promised[k % EVERY] * (1 + 1e-9)).all() for k in settled)


def test_the_promise_follows_the_noise_and_is_printed():
    certificate = designed().certificate
    doubled = gx.Noise(Interval.symmetric(2 * W), Interval.symmetric(2 * V))
    np.testing.assert_allclose(certificate.rates.settled(doubled), 2 * certificate.rate_width, rtol=1e-5)
    assert "outputs every 1, 5 rows" in str(certificate)
    states, inputs = certificate.settled_widths  # what pictures and reports show
    np.testing.assert_array_equal(states, certificate.rate_width.max(0))
    assert np.isinf(inputs).all()


def test_states_that_no_output_tells_have_no_promise_and_the_others_keep_theirs():
    """A third state that adds up noise, seen by nothing; the slow output alone sees the second one."""
    F = np.diag([0.9, 1.0, 1.0])
    system = gx.System(lambda x: F @ x, lambda x: x[:2], G=np.zeros((3, 0)), H=np.zeros((2, 0)))
    noise = gx.Noise(Interval.symmetric([0.1, 0.1, 0.1]), Interval.symmetric([0.5, 0.5]))
    found = gx.design_observer(system, noise, Interval.entire(3), rates=(1, 4), certify=False).certificate
    np.testing.assert_allclose(found.rate_width[:, 1], [1.0, 1.2, 1.4, 1.6], rtol=1e-6)
    assert np.isfinite(found.rate_width[:, 0]).all()
    assert np.isinf(found.rate_width[:, 2]).all()


def test_where_slopes_vary_boxes_hold_and_nothing_is_promised():
    system = gx.System(
        lambda x: jnp.stack([x[0] + STEP * x[1], x[1] - STEP * jnp.sin(x[0])]),
        lambda x: jnp.stack([x[1], x[0]]),
        G=np.zeros((2, 0)),
        H=np.zeros((2, 0)),
    )
    noise = gx.Noise(Interval.symmetric([1e-3, 1e-2]), Interval.symmetric([0.1, 0.05]))
    observer = gx.design_observer(system, noise, Interval.symmetric([2.0, 2.0]), rates=(1, 4), sweeps=1)
    assert observer.certificate.rates is None
    assert any("`rates`" in note for note in observer.certificate.notes)
    rng, x, states, seen = np.random.default_rng(1), np.array([1.0, 0]), [], []
    for _ in range(30):
        states.append(x)
        seen.append(x[::-1] + rng.uniform(-1, 1, 2) * [0.1, 0.05])
        x = np.array([x[0] + STEP * x[1], x[1] - STEP * np.sin(x[0])]) + rng.uniform(-1, 1, 2) * [1e-3, 1e-2]
    box = gx.estimate(observer, Interval.symmetric([2.0, 2.0]), slow(np.array(seen), 4)).state
    assert box.contains(np.array(states)).all()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"rates": 5}, "2 whole numbers, for each output"),
        ({"rates": [1]}, "2 whole numbers"),
        ({"rates": [1, 0]}, "2 whole numbers"),
        ({"rates": [1, 2.0]}, "2 whole numbers"),
        ({"rates": [17, 19]}, "at most 200 rows"),
        ({"rates": [1, 5], "missing": False}, "cannot go with missing=False"),
        ({"rates": [1, 5], "form": "prediction"}, "cannot go with form"),
        ({"rates": [1, 5], "delay": 1}, "cannot go with delay"),
        ({"rates": [1, 5], "tolerate": 1}, "cannot go with tolerate"),
    ],
)
def test_rates_that_cannot_be(options, words):
    with pytest.raises(ValueError, match=words):
        gx.design_observer(vehicle(), NOISE, Interval.entire(3), **options)
