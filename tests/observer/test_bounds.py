"""Input bounds, noise that changes, known inputs, ragged records, hostile numbers, bad arguments."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gsisio_jax as gx
from gsisio_jax import Interval

ROUNDING = 1e-9
STEPS, BATCH = 30, 8


def batch(observer, initial, y, u, noise, length, on_conflict="restart"):
    def run(initial, y, u, noise, length):
        return gx.estimate(observer, initial, y, u, noise, on_conflict, length)

    return jax.vmap(run)(initial, y, u, noise, length)


def run(observer, initial, y, u=None, noise=None, length=None):
    """BATCH records at once, the noise bounds as (STEPS, .) per record: one compilation for every question."""
    noise = observer.noise if noise is None else noise
    widen = lambda a, *shape: jnp.asarray(np.broadcast_to(a, (BATCH, *shape, a.shape[-1])))  # noqa: E731
    noise = jax.tree.map(lambda a: widen(np.asarray(a), STEPS), noise)
    u = np.zeros((STEPS, 0)) if u is None else u
    length = np.full(BATCH, STEPS) if length is None else length
    initial = jax.tree.map(lambda a: widen(np.asarray(a)), initial)
    est = batch(observer, initial, jnp.asarray(y), widen(np.asarray(u), STEPS), noise, jnp.asarray(length))
    return jax.tree.map(np.asarray, est)


def record(est, i):
    return jax.tree.map(lambda leaf: leaf[i], est)


def has(est, bit):
    return (est.status & bit) > 0


# Inputs with known bounds ---------------------------------------------------------------------------------------------
A = np.array([[0.5, 0.3], [0.1, 0.4]])


def unseen(bound):
    """The second state is not measured in time for its input: y sees it one step late, through the first."""
    return gx.System(
        lambda x: jnp.asarray(A) @ x,
        lambda x: x[:1],
        G=[[0.0], [1.0]],
        H=[[0.0]],
        input_bounds=None if bound is None else Interval([-0.5 * bound], [bound]),
    )


UNSEEN_NOISE = gx.Noise(Interval.symmetric([0.05, 0.05]), Interval.symmetric([0.1]))


def simulate_unseen(seed, bound):
    rng = np.random.default_rng(seed)
    d = rng.uniform(-0.5 * bound, bound, (BATCH, STEPS, 1))
    d[:, ::3] = bound
    x, v = np.zeros((BATCH, STEPS, 2)), rng.uniform(-0.1, 0.1, (BATCH, STEPS, 1))
    for k in range(STEPS - 1):
        x[:, k + 1] = x[:, k] @ A.T + d[:, k] * [0.0, 1.0] + rng.uniform(-0.05, 0.05, (BATCH, 2))
    return x, x[..., :1] + v, d


@pytest.fixture(scope="module")
def bounded():
    """One observer; its bounds are numbers of the pytree and may change from run to run."""
    return gx.design_observer(unseen(2.0), UNSEEN_NOISE, Interval.entire(2), missing=False, sweeps=1)


def test_input_bounds_make_an_invisible_input_bearable(bounded):
    with pytest.raises(gx.ObserverDoesNotExist, match="input_bounds"):
        gx.design_observer(unseen(None), UNSEEN_NOISE, Interval.entire(2), sweeps=1)
    x, y, d = simulate_unseen(0, 2.0)
    est = run(bounded, Interval.symmetric([1.0, 1.0]), y)
    assert est.state.contains(x, -ROUNDING).all()
    assert est.input.contains(d[:, :-1], -ROUNDING).all()
    assert (est.input.lower >= -1.0).all()
    assert (est.input.upper <= 2.0).all()
    assert not est.status.any()
    assert (est.state.width[:, 10:] <= bounded.certificate.steady_width + 0.1).all()


def test_tighter_input_bounds_give_narrower_boxes(bounded):
    tight = gx.design_observer(unseen(0.5), UNSEEN_NOISE, Interval.entire(2), missing=False, sweeps=1)
    assert tight.certificate.steady_width[1] < bounded.certificate.steady_width[1]
    x, y, d = simulate_unseen(1, 0.5)
    narrow = run(tight, Interval.symmetric([1.0, 1.0]), y)
    wide = run(bounded, Interval.symmetric([1.0, 1.0]), y)
    assert narrow.state.contains(x, -ROUNDING).all()
    assert narrow.input.contains(d[:, :-1], -ROUNDING).all()
    assert (narrow.state.width <= wide.state.width + ROUNDING).all()
    assert (narrow.state.width[:, 5:, 1] < wide.state.width[:, 5:, 1]).all()


def test_at_a_conflict_the_input_box_is_the_input_bounds(bounded):
    _, y, _ = simulate_unseen(2, 2.0)
    y[0, 12] += 100
    est = record(run(bounded, Interval.symmetric([1.0, 1.0]), y), 0)
    assert has(est, gx.Status.CONFLICT).nonzero()[0].tolist() == [12]
    assert (est.input.lower[11], est.input.upper[11]) == (-1.0, 2.0)
    # y alone gives no whole box, so neither it nor the past is believed; the next row is the first again.
    assert est.state.width[12].tolist() == [np.inf, np.inf]
    assert est.state.width[13].tolist() == [pytest.approx(0.2), np.inf]
    assert np.isfinite(est.state.width[14]).all()
    assert not any(np.isnan(leaf).any() for leaf in jax.tree.leaves(est))


def test_hostile_numbers_never_give_nan(bounded):
    """Infinite initial box, huge measurements, no noise, nothing measured at all."""
    _, y, _ = simulate_unseen(3, 2.0)
    y[0], y[1], y[2, ::2], y[3, 7:] = np.nan, 1e12, -1e12, np.nan
    y[4], y[5, 3], y[6, 4] = 1e300, 1e300, np.inf  # inside a batch an infinite entry counts as missing
    none = gx.Noise(Interval.symmetric([0.0, 0.0]), Interval.symmetric([0.0]))
    for noise in (None, none):
        for initial in (Interval.entire(2), Interval([-np.inf, 0.0], [0.0, np.inf]), Interval.point([0.0, 0.0])):
            est = run(bounded, initial, y, noise=noise)
            assert not any(np.isnan(leaf).any() for leaf in jax.tree.leaves(est))
            for box in (est.state, est.input, est.current_input):
                assert (box.lower <= box.upper).all()
            unbounded = np.isinf(est.state.lower).any(-1) | np.isinf(est.state.upper).any(-1)
            np.testing.assert_array_equal(has(est, gx.Status.UNBOUNDED), unbounded)
            np.testing.assert_array_equal(has(est, gx.Status.MISSING), ~np.isfinite(y).all(-1))


# Ragged records and short ones ----------------------------------------------------------------------------------------
def test_length_equals_trailing_nan_and_the_shorter_record(bounded):
    _, y, _ = simulate_unseen(4, 2.0)
    length = np.array([STEPS, 1, 2, 10, 17, 29, 10, 3])
    initial = Interval.symmetric([1.0, 1.0])
    ragged = run(bounded, initial, y, length=length)
    cut = np.where((np.arange(STEPS) < length[:, None])[..., None], y, np.nan)
    for got, expected in zip(*map(jax.tree.leaves, (ragged, run(bounded, initial, cut))), strict=True):
        np.testing.assert_array_equal(got, expected)
    alone = jax.tree.map(np.asarray, gx.estimate(bounded, initial, y[3, :10]))
    for got, expected in zip(*map(jax.tree.leaves, (record(ragged, 3), alone)), strict=True):
        np.testing.assert_allclose(got[: len(expected)], expected, rtol=1e-12, atol=1e-12)


# Known inputs, a direct feedthrough, and noise that changes with time -------------------------------------------------
KNOWN = gx.System(
    lambda x, u: jnp.stack([0.6 * x[0] + u[0] * jnp.sin(x[1]), 0.3 * x[1] + 0.2 * u[1]]),
    lambda x, u: jnp.stack([x[0] + u[0] * jnp.tanh(x[0]), x[1] * (1 + 0.1 * u[0])]),
    G=[[0.5], [0.2]],
    H=[[0.0], [2.0]],
    B=[[1.0, 0.0], [0.0, -1.0]],
    D=[[0.5, 0.0], [0.0, 3.0]],
)
KNOWN_NOISE = gx.Noise(Interval([-0.05, 0.0], [0.05, 0.1]), Interval([-0.1, -0.2], [0.1, 0.1]))


@pytest.fixture(scope="module")
def known():
    u_region = Interval([-0.3, -1.0], [0.3, 1.0])
    observer = gx.design_observer(
        KNOWN, KNOWN_NOISE, Interval.symmetric([3.0, 3.0]), missing=False, sweeps=1, u_region=u_region, window=1
    )
    return observer.with_rounding("nearest")  # less to compile


def drive(scale=1.0):
    k = np.arange(STEPS)
    return scale * np.stack([0.3 * np.sin(0.4 * k), np.cos(0.7 * k)], -1)


def simulate_known(u, noise=KNOWN_NOISE, size=1.0):
    keys = jax.random.split(jax.random.key(3), BATCH)
    d = size * np.random.default_rng(5).normal(size=(BATCH, STEPS, 1))
    sims = jax.vmap(lambda key, d: gx.simulate(KNOWN, key, jnp.array([0.5, -0.5]), d, noise, jnp.asarray(u)))(keys, d)
    return np.asarray(sims.x[:, :-1]), np.asarray(sims.y), d


def assert_inside(est, observer, x, d):
    assert est.state.contains(x, -ROUNDING).all()
    assert est.input.contains(d[:, :-1], -ROUNDING).all()
    assert est.current_input.contains(d @ observer.current_input_directions, -ROUNDING).all()
    assert not has(est, gx.Status.CONFLICT).any()


def test_known_inputs_in_every_place(known):
    assert known.current_input_directions.shape == (1, 1)
    u = drive()
    x, y, d = simulate_known(u)
    est = run(known, Interval.symmetric([1.0, 1.0]), y, u)
    assert_inside(est, known, x, d)
    assert np.isfinite(est.current_input.width).all()
    # The boxes are about the u that was given: with another one they miss.
    assert not run(known, Interval.symmetric([1.0, 1.0]), y, u + 0.5).state.contains(x).all()


def test_known_inputs_beyond_the_region_of_the_design(known):
    """The design's enclosures do not hold there: boxes must stay certain without them, and the status says so."""
    u = drive(4.0)
    x, y, d = simulate_known(u)
    est = run(known, Interval.symmetric([1.0, 1.0]), y, u)
    assert_inside(est, known, x, d)
    beyond = (np.abs(u) > [0.3, 1.0]).any(-1)
    beyond[1:] |= beyond[:-1]
    assert has(est, gx.Status.OUTSIDE_REGION)[:, beyond].all()


def test_outside_region_means_a_box_that_leaves_it(known):
    u = drive()
    _, y, _ = simulate_known(u)
    _, far, _ = simulate_known(u, size=20.0)
    for record_y in (y, far):
        est = run(known, Interval.symmetric([1.0, 1.0]), record_y, u)
        outside = ((est.state.lower < -3.0) | (est.state.upper > 3.0)).any(-1)
        outside[:, 1:] |= outside[:, :-1]
        np.testing.assert_array_equal(has(est, gx.Status.OUTSIDE_REGION), outside)
    assert outside.any()


def test_noise_that_changes_with_time(known):
    u = drive()
    share = np.linspace(0.1, 1.0, STEPS)[:, None]
    box = lambda b: Interval(share * b.lower, share * b.upper)  # noqa: E731
    varying = gx.Noise(box(KNOWN_NOISE.w), box(KNOWN_NOISE.v))
    x, y, d = simulate_known(u, varying)
    narrow, wide = (run(known, Interval.symmetric([1.0, 1.0]), y, u, noise) for noise in (varying, None))
    assert_inside(narrow, known, x, d)
    assert_inside(wide, known, x, d)
    assert (narrow.state.width <= wide.state.width + ROUNDING).all()
    assert (narrow.state.width[:, 1 : STEPS // 2] < wide.state.width[:, 1 : STEPS // 2]).all()


# Arguments ------------------------------------------------------------------------------------------------------------
def test_one_row_is_a_record(known):
    est = gx.estimate(known, Interval.symmetric([1.0, 1.0]), np.zeros((1, 2)), np.zeros((1, 2)))
    assert (est.state.shape, est.input.shape, est.current_input.shape) == ((1, 2), (0, 1), (1, 1))
    assert (est.status.shape, est.margin.shape, est.alarms()) == ((1,), (1,), [])


Y, U, BOX = np.zeros((4, 2)), np.zeros((4, 2)), Interval.symmetric([1.0, 1.0])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((Interval.symmetric([1.0]), Y, U), "`initial` must be an Interval of shape"),
        (([0.0, 0.0], Y, U), "`initial` must be a"),
        ((BOX, np.zeros((4, 3)), U), "measurements must have shape"),
        ((BOX, np.zeros(2), U), "measurements must have shape"),
        ((BOX, np.zeros((0, 2)), np.zeros((0, 2))), "T >= 1"),
        ((BOX, np.full((4, 2), np.inf), U), "infinite; mark missing entries with NaN"),
        ((BOX, Y), "2 known inputs; give `u`"),
        ((BOX, Y, np.zeros((3, 2))), "one row per measurement"),
        ((BOX, Y, np.full((4, 2), np.nan)), "`u` must be finite"),
        ((BOX, Y, U, gx.Noise(Interval.symmetric([1.0]), Interval.symmetric([1.0, 1.0]))), "noise bounds of `w`"),
        ((BOX, Y, U, None, "ignore"), "`on_conflict` must be"),
        ((BOX, Y, U, None, "hold", 5), "`length` must be between 0 and the 4 rows"),
        ((BOX, Y, U, None, "hold", [4, 2]), "for many use jax.vmap"),
        ((BOX, Y, U, None, "hold", 2.5), "`length` must be one integer"),
    ],
)
def test_bad_arguments_of_estimate(known, arguments, words):
    with pytest.raises(ValueError, match=r"^estimate: ") as error:
        gx.estimate(known, *arguments)
    assert words in str(error.value)


def test_bad_arguments_name_the_call(known):
    with pytest.raises(ValueError, match=r"^start: measurements must have shape"):
        gx.start(known, BOX, np.zeros(3), np.zeros(2))
    with pytest.raises(ValueError, match=r"^start: the system has 2 known inputs"):
        gx.start(known, BOX, np.zeros(2))
