"""After a conflict restart believes the largest set of outputs that agrees with itself and the state bounds."""

import jax
import numpy as np
import pytest

import gsisio_jax as gx
from gsisio_jax import Interval, Status

TURN = 0.95 * np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
C = np.array([[1.0, 0], [0, 1], [1, 1], [1, -1]])
ROWS, K = 8, 4


@pytest.fixture(scope="module")
def run():
    system = gx.System(lambda x: TURN @ x, lambda x: C @ x, G=[[1.0], [0.5]], H=np.zeros((4, 1)))
    noise = gx.Noise(Interval.symmetric([0.02, 0.02]), Interval.symmetric(np.full(4, 0.1)))
    observer = gx.design_observer(system, noise, Interval.symmetric([5.0, 5.0]), sweeps=1)
    return jax.vmap(lambda y: gx.estimate(observer, Interval.symmetric([2.0, 2.0]), y))


def records(count):
    """The state jumps at row K, further than the input explains."""
    rng = np.random.default_rng(0)
    x, states, seen = rng.uniform(-2, 2, (count, 2)), [], []
    for k in range(ROWS):
        if k == K:
            x = x + np.array([-20.0, 40.0])
        states.append(x)
        seen.append(x @ C.T + rng.uniform(-0.1, 0.1, (count, 4)))
        x = x @ TURN.T + rng.normal(size=(count, 1)) * [1, 0.5] + rng.uniform(-0.02, 0.02, (count, 2))
    return np.stack(states, 1), np.stack(seen, 1)


def test_one_wrong_output_of_a_step_that_contradicts_the_past_is_left_out(run):
    x, y = records(400)
    which = np.arange(400) % 5  # 4: none
    for j in range(4):
        y[which == j, K, j] += 9
    est = run(y)
    status = np.asarray(est.status)
    assert (status[:, K] & Status.CONFLICT).all()
    assert not (np.delete(status, K, 1) & Status.CONFLICT).any()
    assert est.state.contains(x).all()  # at the conflict, too: the other three outputs know the state
    assert (np.asarray(est.state.width)[:, K] <= 0.2 * 2 + 1e-9).all()
    np.testing.assert_array_equal((status[:, K] & Status.MISSING) != 0, which < 4)


def test_where_several_sets_agree_their_hull_is_believed(run):
    """One of four outputs is missing and one of the others wrong: of three outputs of two states every two agree."""
    x, y = records(400)
    y[:, K, 3] = np.nan
    y[:, K, 1] += 9
    est = run(y)
    assert (np.asarray(est.status)[:, K] & Status.CONFLICT).all()
    assert est.state.contains(x).all()
    assert (np.asarray(est.state.width)[:, K].max(-1) > 8).all()
    assert np.isfinite(est.state.width).all()


def test_more_outputs_than_sets_are_tried():
    """21 outputs: even the sets without one of them are more than 20, so a wrong one leaves the state bounds."""
    n = 21
    system = gx.System(
        lambda x: 0.5 * x,
        lambda x: x,
        G=np.zeros((n, 0)),
        H=np.zeros((n, 0)),
        state_bounds=Interval.symmetric(np.ones(n)),
    )
    noise = gx.Noise(Interval.symmetric(np.full(n, 0.01)), Interval.symmetric(np.full(n, 0.1)))
    observer = gx.design_observer(system, noise, system.state_bounds, window=1, missing=False, sweeps=1)
    y = np.zeros((4, n))
    y[1, 0] = 5.0
    est = gx.estimate(observer, system.state_bounds, y)
    assert [bool(status & Status.CONFLICT) for status in np.asarray(est.status)] == [False, True, False, False]
    assert est.state.contains(np.zeros((4, n))).all()
    assert (np.asarray(est.state.width)[2:] <= 0.2 + 1e-9).all()
