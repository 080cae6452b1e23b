"""Known rates, blocks of constancy and means of the unknown input: near the exact program, and never beyond it."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles.input_record_hull import exact_input_hull
from oracles.uncompiled import in_numpy

import gsisio_jax as gx
from gsisio_jax import Interval
from gsisio_jax.design import input_rows
from gsisio_jax.observer.residuals import input_row_residual

A, G = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.005], [0.1]])
W, V, START = np.array([1e-3, 1e-3]), np.array([0.1, 0.1]), np.array([1.0, 1.0])
NOISE = gx.Noise(Interval.symmetric(W), Interval.symmetric(V))
INITIAL = Interval.symmetric(START)
RATE, BLOCK, T, RUNS = 0.02, 6, 40, 24


def cart(**known):
    """Position and velocity are measured, and pushed by an unknown acceleration."""
    return gx.System(lambda x: A @ x, lambda x: x, G, np.zeros((2, 1)), **known)


def designed(**known):
    return gx.design_observer(cart(**known), NOISE, Interval.symmetric([5.0, 5.0]), missing=False, sweeps=1)


def record(seed, moves):
    """States, inputs and measurements; every second run on the vertices of the bounds, from corners and faces."""
    rng = np.random.default_rng(seed)
    unit = (lambda size: rng.choice([-1.0, 1.0], size)) if seed % 2 else (lambda size: rng.uniform(-1, 1, size))
    levels = np.repeat(10 * rng.normal(size=T // BLOCK + 1), BLOCK)[:T]
    d = 3 + np.cumsum(RATE * unit(T)) if moves == "rate" else levels
    x = [START * unit(2)]
    for k in range(T - 1):
        x.append(A @ x[-1] + G[:, 0] * d[k] + W * unit(2))
    return np.array(x), d[:-1, None], np.array(x) + V * unit((T, 2))


def records(moves):
    return tuple(map(np.array, zip(*(record(seed, moves) for seed in range(RUNS)), strict=True)))


def estimates(observer, y):
    return jax.vmap(partial(gx.estimate, observer, INITIAL))(y)


def misses(boxes, truth):
    return int((~np.asarray(boxes.contains(truth))).sum())


@pytest.fixture(scope="module")
def plain():
    return designed()


@pytest.fixture(scope="module")
def rated():
    """Observer, records, estimates; the last two records break the rate and lack measurements."""
    observer, (x, d, y) = designed(input_rate=[RATE]), records("rate")
    jump, gap = y[0].copy(), y[1].copy()
    after = np.arange(T - 20)
    jump[20:] += np.stack([0.5 * (0.1 * after) ** 2, 0.1 * after], 1) * 40  # an acceleration of 40 from step 20 on
    gap[15:18], gap[20:, 1] = np.nan, np.nan
    return observer, x, d, y, estimates(observer, np.concatenate([y, jump[None], gap[None]]))


@pytest.fixture(scope="module")
def blocked():
    observer, (x, d, y) = designed(input_constant=BLOCK), records("blocks")
    return observer, x, d, y, estimates(observer, y)


@pytest.fixture(scope="module")
def without(plain, rated, blocked):
    return {"rate": estimates(plain, rated[3]), "blocks": estimates(plain, blocked[3])}


@pytest.mark.parametrize(("kind", "limit", "gain"), [("rate", 1.03, 6), ("blocks", 1.03, 3)])
def test_as_tight_as_the_exact_program_nearly(kind, limit, gain, rated, blocked, without):
    known = {"rate": RATE} if kind == "rate" else {"constant": BLOCK}
    _, _, _, y, found = rated if kind == "rate" else blocked
    ratios, steps = [], np.concatenate([np.arange(3), np.arange(25, 25 + BLOCK)])
    for run in (0, 2, 4):  # on vertices the exact box is a point
        for k in steps:
            lower, upper = exact_input_hull(A, G, np.eye(2), W, V, START, y[run], int(k), **known)
            box = np.asarray(found.input.lower)[run, k, 0], np.asarray(found.input.upper)[run, k, 0]
            assert box[0] <= lower + 1e-9 * abs(lower)
            assert upper - 1e-9 * abs(upper) <= box[1]
            ratios.append((box[1] - box[0]) / (upper - lower))
    assert np.mean(ratios) < limit
    width, before = (np.asarray(result.input.width)[:RUNS:2, 20:].mean() for result in (found, without[kind]))
    assert before > gain * width


@pytest.mark.parametrize("kind", ["rate", "blocks"])
def test_boxes_hold_and_are_never_wider(kind, rated, blocked, without):
    _, x, d, _, found = rated if kind == "rate" else blocked
    found = jax.tree.map(lambda part: part[:RUNS], found)
    assert misses(found.state, x) == 0
    assert misses(found.input, d) == 0
    assert not np.asarray(found.status).any()
    for of in ("state", "input"):
        width, before = (np.asarray(getattr(result, of).width) for result in (found, without[kind]))
        assert (width <= before * (1 + 1e-9) + 1e-10).all()
    assert np.asarray(found.state.width)[:, 20:].mean() < 0.98 * np.asarray(without[kind].state.width)[:, 20:].mean()


def test_a_wrong_rate_is_a_conflict_and_lost_rows_are_none(rated):
    _, x, d, _, found = rated
    jump, gap = (jax.tree.map(lambda part, run=run: part[run], found) for run in (RUNS, RUNS + 1))
    first = np.flatnonzero(np.asarray(jump.status) & gx.Status.CONFLICT)
    assert 20 < first[0] < 24
    assert not (np.asarray(gap.status) & gx.Status.CONFLICT).any()
    assert misses(gap.state, x[1]) == 0
    assert misses(gap.input, d[1]) == 0
    assert np.isfinite(np.asarray(gap.input.width)[15:20]).all()  # a rate carries the box through the gap


def test_a_gross_fault_that_is_held_is_a_lost_row(rated):
    """`on_conflict="hold"`: boxes of inputs and states are those of the record without the row that lies."""
    observer, x, d, y, _ = rated
    faulty, lost = y[0].copy(), y[0].copy()
    faulty[20] += 50.0
    lost[20] = np.nan
    both = [gx.estimate(observer, INITIAL, rows, on_conflict="hold") for rows in (faulty, lost)]
    held = jax.tree.map(lambda *parts: np.stack(parts), *both)  # to trace a step for two takes ten times as long
    assert np.flatnonzero(np.asarray(held.status)[0] & gx.Status.CONFLICT).tolist() == [20]
    assert not (np.asarray(held.status)[1] & gx.Status.CONFLICT).any()
    for run in (0, 1):
        one = jax.tree.map(lambda part, run=run: part[run], held)
        assert misses(one.state, x[0]) == 0
        assert misses(one.input, d[0]) == 0
    np.testing.assert_allclose(held.state.width[0], held.state.width[1], rtol=1e-9)
    np.testing.assert_allclose(held.input.width[0, 22:], held.input.width[1, 22:], rtol=1e-9)


def test_two_inputs_one_of_them_in_the_outputs():
    """H != 0 and a rate for each input: boxes hold, and are no wider than without."""
    G2, H2 = np.hstack([G, np.zeros((2, 1))]), np.array([[0.0, 1.0], [0.0, 0.0], [0.0, 0.0]])
    C, v = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), np.array([0.1, 0.1, 0.1])
    noise = gx.Noise(Interval.symmetric(W), Interval.symmetric(v))
    rng = np.random.default_rng(3)
    d = np.array([3.0, -2.0]) + np.cumsum(rng.uniform(-1, 1, (T - 1, 2)) * [0.02, 0.01], axis=0)
    widths = []
    for known in ({"input_rate": [0.02, 0.01]}, {}):
        system = gx.System(lambda x: A @ x, lambda x: C @ x, G2, H2, **known)
        run = gx.simulate(system, jax.random.key(0), np.zeros(2), np.vstack([d, d[-1:]]), noise)
        observer = gx.design_observer(system, noise, Interval.symmetric([5.0, 5.0]), missing=False, sweeps=1)
        found = gx.estimate(observer, INITIAL, run.y)
        assert misses(found.state, run.x[:T]) == 0
        assert misses(found.input, d) == 0
        widths.append(np.concatenate([np.asarray(found.state.width)[:-1], np.asarray(found.input.width)], 1))
    assert (widths[0] <= widths[1] * (1 + 1e-9) + 1e-10).all()
    assert (widths[0][20:, 2:].mean(0) < 0.6 * widths[1][20:, 2:].mean(0)).all()


def test_step_by_step_and_from_a_file(rated, blocked, tmp_path):
    observer, _, _, y, found = blocked
    carry, out = gx.start(observer, INITIAL, y[0, 0])
    outputs = [out]
    for k in range(1, 14):
        carry, out = gx.step(observer, carry, y[0, k])
        outputs.append(out)
        if k == 9:
            observer.save(tmp_path / "observer.npz")
            observer = gx.load_observer(tmp_path / "observer.npz", cart(input_constant=BLOCK))
            gx.save_carry(tmp_path / "carry.npz", carry, observer)
            carry, _ = gx.load_carry(tmp_path / "carry.npz", observer)
    online = gx.estimation.collect(observer, outputs)
    for of in ("state", "input"):
        for side in ("lower", "upper"):
            rows, whole = (getattr(getattr(part, of), side) for part in (online, found))
            assert np.allclose(rows, np.asarray(whole)[0, : len(rows)], rtol=1e-12, atol=1e-12)
    with pytest.raises(ValueError, match=f"input_constant is {BLOCK} in the file and None here"):
        gx.load_observer(tmp_path / "observer.npz", cart())
    rated[0].save(tmp_path / "rated.npz")
    with pytest.raises(ValueError, match=r"input_rate is .* in the file and None here"):
        gx.load_observer(tmp_path / "rated.npz", cart())
    with pytest.raises(ValueError, match=r"input_rate.upper\[0\] is 0.02 in the file and 0.03 here"):
        gx.load_observer(tmp_path / "rated.npz", cart(input_rate=[0.03]))


def test_what_rows_leave_of_the_inputs_is_rounding(rated, blocked):
    for observer, *_ in (rated, blocked):
        rows = observer.input_rows
        left, left_now = input_row_residual(rows, observer.system, np.zeros((2, 1)))
        assert left.max() < 1e-9
        assert (np.asarray(rows.left) >= left).all()
        assert not left_now.any()  # no input shows in y[k] itself


def test_a_nonlinear_plant_in_float32_with_a_gradient(monkeypatch):
    """Both kinds of knowledge at once; the width falls where the noise bound does."""
    monkeypatch.setattr(input_rows, "_STEPS", 4)
    w, v = W[:1], V[:1]
    noise = gx.Noise(Interval.symmetric(w), Interval.symmetric(v))
    system = gx.System(
        lambda x: x - 0.1 * jnp.sin(x), lambda x: x, [[0.1]], [[0.0]], input_rate=[1.0], input_constant=4
    )
    observer = gx.design_observer(system, noise, Interval.symmetric([5.0]), missing=False, sweeps=1).astype("f4")
    rng, x, d, seen = np.random.default_rng(0), np.zeros(1), 0.5, []
    states, inputs = [], []
    for k in range(24):
        d = d + rng.uniform(-1, 1) if k % 4 == 0 and k else d
        states.append(x)
        inputs.append([d])
        seen.append(x + rng.uniform(-v, v))
        x = x - 0.1 * np.sin(x) + 0.1 * d + rng.uniform(-w, w)
    y = np.array(seen, np.float32)
    wide = gx.Noise(Interval.symmetric(w), Interval.symmetric(v + 1e-6)).astype(np.float32)
    initial = Interval.symmetric(START[:1]).astype(np.float32)

    def width(scale):
        noise = gx.Noise.unchecked(wide.w, Interval.unchecked(wide.v.lower * scale, wide.v.upper * scale))
        found = gx.estimate(observer, initial, y, noise=noise)
        return found.input.width.mean(), found

    slope, found = in_numpy(jax.grad(width, has_aux=True))(np.float32(1.0))
    assert misses(found.state, np.array(states, np.float32)) == 0
    assert misses(found.input, np.array(inputs, np.float32)[:-1]) == 0
    assert np.isfinite(slope)
    assert slope > 0
    within = np.asarray(found.input.width)[:, 0]
    assert within[11] < 0.7 * within[8]


def test_the_mean_is_exact(plain, without, rated):
    steps, y, d = 5, rated[3], rated[2]
    estimate = jax.tree.map(lambda part: part[0], without["rate"])
    found = gx.mean_input(plain, estimate, y[0], steps=steps)
    truth = np.array([d[0, i : i + steps].mean(0) for i in range(T - steps)])
    assert found.shape == truth.shape
    assert misses(found, truth) == 0
    for k in (steps, 20, T - 2):
        exact = exact_input_hull(A, G, np.eye(2), W, V, START, y[0], k, mean=steps)
        box = np.array([found.lower[k - steps + 1, 0], found.upper[k - steps + 1, 0]])
        assert box[0] <= exact[0] + 1e-9
        assert exact[1] - 1e-9 <= box[1]
        assert box[1] - box[0] < (exact[1] - exact[0]) * (1 + 1e-3)


def test_the_mean_over_a_gap_and_in_batches(plain, without, rated):
    y = rated[3][:3].copy()
    y[0, 20] = np.nan
    every = jax.tree.map(lambda part: part[:3], without["rate"])
    found = jax.vmap(lambda estimate, rows: gx.mean_input(plain, estimate, rows, steps=5))(every, y)
    truth = np.array([[rated[2][run, i : i + 5].mean(0) for i in range(T - 5)] for run in range(3)])
    assert misses(found, truth) == 0
    assert found.shape == (3, T - 5, 1)


@pytest.mark.parametrize(
    ("known", "message"),
    [
        ({"input_rate": [-0.1]}, "`input_rate` must not be negative, got .-0.1."),
        ({"input_rate": [0.1, 0.1]}, r"so it needs the shape \(1,\), got \(2,\)"),
        ({"input_rate": 0.1}, r"so it needs the shape \(1,\), got \(\)"),
        ({"input_rate": [float("nan")]}, "must not be negative"),
        ({"input_constant": 0}, "a whole number of steps of at least 1, got 0"),
        ({"input_constant": 2.0}, "a whole number of steps of at least 1, got 2.0"),
    ],
)
def test_what_cannot_be_known_is_refused(known, message):
    with pytest.raises(ValueError, match=f"System: .*{message}"):
        cart(**known)


def test_calls_that_know_nothing_of_it_say_so(rated, plain, without):
    for known in ({"input_rate": [1.0]}, {"input_constant": 2}):
        with pytest.raises(ValueError, match=rf"`{next(iter(known))}` is given, but there is no unknown input"):
            gx.System(lambda x: A @ x, lambda x: x, np.zeros((2, 0)), np.zeros((2, 0)), **known)
    with pytest.raises(ValueError, match="the system has `input_rate`, which says nothing in the prediction form"):
        gx.design_observer(cart(input_rate=[RATE]), NOISE, INITIAL, form="prediction")
    with pytest.raises(ValueError, match="monte_carlo: the system has `input_rate`, and drawn inputs"):
        gx.monte_carlo(rated[0], jax.random.key(0), 2, 5, np.zeros(2))
    with pytest.raises(ValueError, match="tightness: the system has `input_rate`, which the exact hull does not know"):
        gx.tightness(rated[0], INITIAL, rated[3][0])
    one = jax.tree.map(lambda part: part[0], without["rate"])
    for steps in (0, T, 1.5):
        with pytest.raises(ValueError, match=f"`steps` must be a whole number from 1 to {T - 1}"):
            gx.mean_input(plain, one, rated[3][0], steps=steps)


def test_rates_and_blocks_that_say_nothing_cost_nothing():
    system = cart(input_rate=[np.inf], input_constant=1)
    assert system.input_rate is None
    assert system.input_constant is None


def test_where_no_row_helps_there_is_none(monkeypatch):
    """Of a block of steps rows are found, and none is worth its time: that was an error of NumPy."""
    monkeypatch.setattr(input_rows, "_LEAST_GAIN", 1e9)
    system = gx.System(lambda x: 0.5 * x, lambda x: x, G=[[1.0]], H=[[0.0]], input_constant=2)
    noise = gx.Noise(Interval.symmetric([0.1]), Interval.symmetric([0.1]))
    found = gx.design_observer(system, noise, Interval.entire(1), missing=False, sweeps=1, window=1)
    assert found.input_rows is None


def test_an_input_in_blocks_of_a_plant_without_noise():
    """Boxes are points, and the logarithm of their width was a warning."""
    system = gx.System(lambda x: 0.5 * x, lambda x: x, G=[[1.0]], H=[[0.0]], input_constant=2)
    noise = gx.Noise(Interval.symmetric([0.0]), Interval.symmetric([0.0]))
    observer = gx.design_observer(system, noise, Interval.entire(1), missing=False, sweeps=1, window=1)
    assert (np.asarray(observer.certificate.steady_width) == 0).all()
