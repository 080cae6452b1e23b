"""Boxes that are certain although up to q outputs of any step are wrong: the truth, exact sets, and votes."""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog

import gsisio_jax as gx
from gsisio_jax import Interval, Status

TURN = 0.95 * np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
C = np.array([[1.0, 0], [0, 1], [1, 1]])
G = np.array([[1.0], [0.5]])
W, V = np.array([0.02, 0.02]), np.array([0.1, 0.1, 0.1])
ROWS, RUNS = 8, 2000
INITIAL = Interval.symmetric([2.0, 2.0])
EXACT = 4  # steps of the exact program


def designed(tolerate):
    system = gx.System(lambda x: TURN @ x, lambda x: C @ x, G=G, H=np.zeros((3, 1)))
    noise = gx.Noise(Interval.symmetric(W), Interval.symmetric(V))
    return gx.design_observer(system, noise, Interval.symmetric([5.0, 5.0]), tolerate=tolerate)


@pytest.fixture(scope="module")
def observers():
    return designed(1), designed(0)


@pytest.fixture(scope="module")
def run(observers):
    return jax.vmap(lambda initial, y: gx.estimate(observers[0], initial, y), (None, 0))


def records(seed, count, rows=ROWS):
    """States (S, T, 2), measurements as they should be, and with at most one wrong output in any step: from well inside
    the noise to a thousand times it."""
    rng = np.random.default_rng(seed)
    x, states, seen = rng.uniform(-2, 2, (count, 2)), [], []
    for _ in range(rows):
        states.append(x)
        seen.append(x @ C.T + rng.uniform(-V, V, (count, 3)))
        x = x @ TURN.T + rng.normal(size=(count, 1)) @ G.T + rng.uniform(-W, W, (count, 2))
    y = np.stack(seen, 1)
    wrong = (rng.random((count, rows)) < 0.4)[..., None] & (rng.integers(3, size=(count, rows))[..., None] == range(3))
    size = rng.choice([-1, 1], y.shape) * 10 ** rng.uniform(-1.5, 2, y.shape)
    return np.stack(states, 1), y, np.where(wrong, y + size, y), np.where(wrong, size, 0)


def exact_hull(y):
    """Hull of x at the last step over all ways to leave one output of every step out, or None where none agrees."""
    T = len(y)
    size = 2 * T + 3 * (T - 1)  # x of every step, then w and d
    x, rest = np.eye(size)[: 2 * T].reshape(T, 2, size), np.eye(size)[2 * T :].reshape(T - 1, 3, size)
    equal = np.vstack(
        [x[k + 1] - TURN @ x[k] - rest[k, :2] - G @ rest[k, 2:] for k in range(T - 1)] or [np.zeros((0, size))]
    )
    side = np.concatenate([[2.0, 2.0], np.full(2 * T - 2, np.inf), *[[*W, np.inf]] * (T - 1)])
    lower, upper = np.full(2, np.inf), np.full(2, -np.inf)
    for left_out in product(range(3), repeat=T):
        kept = [[j for j in range(3) if j != out] for out in left_out]
        rows = np.vstack([C[kept[k]] @ x[k] for k in range(T)])
        seen = np.concatenate([y[k, kept[k]] for k in range(T)])
        found = [
            linprog(
                sign * x[T - 1, i], A_ub=np.vstack([rows, -rows]), b_ub=np.concatenate([seen + 0.1, 0.1 - seen]),
                A_eq=equal, b_eq=np.zeros(len(equal)), bounds=np.stack([-side, side], 1), method="highs",
            )
            for i in range(2) for sign in (1, -1)
        ]  # fmt: skip
        if all(one.status == 0 for one in found):
            lower = np.minimum(lower, [found[0].fun, found[2].fun])
            upper = np.maximum(upper, [-found[1].fun, -found[3].fun])
    return lower, upper


def test_boxes_hold_the_hull_of_all_exact_sets(run):
    _, _, y, wrong = records(0, RUNS)
    box = run(INITIAL, y).state
    hardest = np.argsort(-(wrong[:, :EXACT] != 0).any(-1).sum(1))[:3]
    for s in hardest:
        for k in range(EXACT):
            lower, upper = exact_hull(y[s, : k + 1])
            assert (box.lower[s, k] <= lower + 1e-9).all()
            assert (upper <= box.upper[s, k] + 1e-9).all()
            assert (box.width[s, k] <= 1.2 * (upper - lower)).all()  # and are no wider than that


@pytest.mark.parametrize("runs", [RUNS, pytest.param(100_000, marks=pytest.mark.soak)])
def test_the_truth_is_never_missed_and_without_votes_it_is(runs, run, observers):
    x, clean, y, wrong = records(1, runs)
    est = run(INITIAL, y)
    assert est.state.contains(x).all()
    assert not (np.asarray(est.status) & Status.CONFLICT).any()
    assert np.isfinite(est.state.width).all()
    plain = jax.vmap(lambda y: gx.estimate(observers[1], INITIAL, y).state)(y)
    assert (~np.asarray(plain.contains(x)).all(-1)).mean() > 0.03
    # Votes: a gross fault is named, and hardly ever anything else; a clean step loses nothing.
    kept, gross = np.asarray(est.kept), np.abs(wrong) > 5
    assert not kept[gross].any()
    assert (kept[gross.any(-1)] == ~gross[gross.any(-1)]).mean() > 0.999
    np.testing.assert_array_equal((np.asarray(est.status) & Status.OUTVOTED) != 0, ~kept.all(-1))
    undisturbed = run(INITIAL, clean)
    assert np.asarray(undisturbed.kept).all()
    assert not np.asarray(undisturbed.status).any()
    # From an unknown start, too.
    unknown = run(Interval.entire(2), y).state
    assert unknown.contains(x).all()
    assert np.isfinite(unknown.width).all()


def test_missing_outputs_and_steps_with_more_faults_than_are_tolerated(run):
    x, y, _, _ = records(2, RUNS)
    y[:500, 3, 1] = np.nan  # one is missing, and one of the others wrong
    y[:500, 3, 0] += 50
    y[500:1000, 3] = np.nan
    y[1000:1500, 3, :2] += [30, -50]
    jump = np.array([30.0, -20.0])
    y[1500:, 3:] += C @ jump  # the state jumps, so the past is what disagrees; once
    x[1500:, 3:] += jump
    for k in range(4, ROWS):
        y[1500:, k] -= C @ jump
        y[1500:, k] += C @ np.linalg.matrix_power(TURN, k - 3) @ jump
        x[1500:, k] += np.linalg.matrix_power(TURN, k - 3) @ jump - jump
    est = run(INITIAL, y)
    status, ok = np.asarray(est.status), np.asarray(est.state.contains(x)).all(-1)
    conflict = (status & Status.CONFLICT) != 0
    assert ok[:1000].all()
    assert not conflict[:1000].any()
    assert (status[:1000, 3] & Status.MISSING).all()
    assert not np.asarray(est.kept)[:1000, 3, 1].any()
    # One bad step is the end of nothing: every miss lies at it or under a conflict, and the truth is held after it.
    runs, steps = np.nonzero(~ok[1000:1500])
    assert ((steps == 3) | conflict[1000:1500][runs, steps]).all()
    assert ok[1000:1500, 5:].all()
    assert np.isfinite(est.state.width[:, 5:]).all()
    assert conflict[1500:, 3].all()
    assert not conflict[1500:, 4:].any()
    assert ok[1500:].all()
    assert not any(np.isnan(leaf).any() for leaf in jax.tree.leaves(est))


def test_online_and_from_files_it_is_the_same_and_hold_believes_the_past(run, observers, tmp_path):
    x, _, y, _ = records(3, 1)
    observers[0].save(tmp_path / "observer")
    observer = gx.load_observer(tmp_path / "observer", observers[0].system)
    carry, out = gx.start(observer, INITIAL, y[0, 0], on_conflict="hold")
    outs = [out]
    for k in range(1, ROWS):
        measured = y[0, k] + [30, -50, 0] if k == 5 else y[0, k]
        carry, out = gx.step(observer, carry, measured, on_conflict="hold")
        outs.append(out)
        gx.save_carry(tmp_path / "carry", carry, observer, k + 1)
        carry, _ = gx.load_carry(tmp_path / "carry", observer)
    found, whole = gx.estimation.collect(observer, outs), run(INITIAL, np.tile(y, (RUNS, 1, 1)))
    for mine, its in ((found.state.lower, whole.state.lower), (found.state.upper, whole.state.upper)):
        np.testing.assert_allclose(mine[:5], its[0, :5], rtol=1e-12)
    np.testing.assert_array_equal(found.kept[:5], whole.kept[0, :5])
    # What no guess about y[5] explains is left out altogether.
    assert [alarm.step for alarm in found.alarms()] == [5]
    assert found.state.contains(x[0]).all()
    assert not found.kept[5].any()


def test_what_cannot_be_tolerated_says_so():
    system = gx.System(lambda x: TURN @ x, lambda x: C @ x, G=G, H=np.zeros((3, 1)))
    noise = gx.Noise(Interval.symmetric(W), Interval.symmetric(V))
    region = Interval.symmetric([5.0, 5.0])
    wide = gx.System(lambda x: TURN @ x, lambda x: np.ones((9, 2)) @ x, G=np.zeros((2, 0)), H=np.zeros((9, 0)))
    many = gx.Noise(noise.w, Interval.symmetric(np.ones(9)))
    two = gx.System(lambda x: TURN @ x, lambda x: x, G=np.eye(2), H=np.zeros((2, 2)))
    for plant, bounds, options, says in (
        (system, noise, {"tolerate": 3}, r"below the number of outputs, 3, got 3: nothing .*; tolerate fewer"),
        (system, noise, {"tolerate": 1.5}, r"`tolerate` must be a whole number of outputs"),
        (wide, many, {"tolerate": 4}, r"at most 20 ways .* got 4 of 9, which are 126.*; tolerate fewer"),
        (system, noise, {"tolerate": 1, "window": 3}, r"with `tolerate`, `window` must be 1 .*, got 3"),
        (system, noise, {"tolerate": 1, "delay": 1}, r"with `tolerate`, `delay` must be 0"),
        (system, noise, {"tolerate": 1, "missing": False}, r"with `tolerate`, `missing` must be True"),
        (system, noise, {"tolerate": 1, "form": "prediction"}, r"with `tolerate`, `form` must be \"current\""),
        (
            two,
            gx.Noise(noise.w, Interval.symmetric(V[:2])),
            {"tolerate": 1},
            r"without output 1 of a step .* add outputs",
        ),
    ):
        with pytest.raises((ValueError, gx.NoDesignFound), match=says):
            gx.design_observer(plant, bounds, region, **options)


def test_what_believes_every_output_refuses_it(observers):
    y, noise = np.zeros((4, 3)), observers[0].noise
    system = gx.System(lambda x: TURN @ x, lambda x: C @ x, G=G, H=np.zeros((3, 1)), input_constant=2)
    with pytest.raises(ValueError, match=r"tightness: `observer` tolerates .* believes every output; .* tolerate=0"):
        gx.tightness(observers[0], INITIAL, y)
    with pytest.raises(ValueError, match=r"width_sensitivity: .* without `delay` and `tolerate`"):
        gx.width_sensitivity(observers[0], INITIAL, y)
    with pytest.raises(ValueError, match=r"tune_noise: .* without `delay` and `tolerate`, got TolerantObserver"):
        gx.tune_noise(observers[0], None)
    with pytest.raises(ValueError, match=r"design_observer: .*`input_constant`, .*; leave it out, or tolerate nothing"):
        gx.design_observer(system, noise, INITIAL, tolerate=1)
    turning = gx.System(lambda x: TURN @ x, lambda x: C @ x, G=G, H=np.zeros((3, 1)), periodic={0: 6.0})
    with pytest.raises(ValueError, match=r"with `tolerate`, no output or state may be periodic; unwrap the outputs"):
        gx.design_observer(turning, noise, INITIAL, tolerate=1)
    with pytest.raises(ValueError, match=r"allocate: .*`tolerate`"):
        gx.allocate(observers[0].system, noise, INITIAL, [1.0, 1.0], {"v": np.ones(3)}, tolerate=1)


def test_studies_take_it():
    """A sweep is its estimates. In simulated runs one gross fault a step is what was promised, two are more."""
    system = gx.System(lambda x: 0.9 * x, lambda x: jnp.stack([x[0], x[0]]), G=np.zeros((1, 0)), H=np.zeros((2, 0)))
    noise = gx.Noise(Interval.symmetric([0.02]), Interval.symmetric([0.1, 0.1]))
    observer = gx.design_observer(system, noise, Interval.symmetric([5.0]), tolerate=1)
    initial, twice, rng = Interval.symmetric([2.0]), 6, np.random.default_rng(4)
    x = rng.uniform(-2, 2, (20, 1, 1)) * 0.9 ** np.arange(ROWS)[:, None]
    y = x + rng.uniform(-0.1, 0.1, (20, ROWS, 2))
    y[:, ::2, 0] += 30
    est = jax.vmap(lambda y: gx.estimate(observer, initial, y))(y)
    found = gx.study.sweep(
        observer, initial, gx.grid("run", y), truth=gx.grid("run", (x, None)), reduce=("max", "coverage")
    )
    np.testing.assert_allclose(found.state_width_max, np.asarray(est.state.width).max(1), rtol=1e-12)
    assert (found.state_coverage == 1).all()

    def draw(key, k, x, noise):
        w, v = (
            jax.random.uniform(one, box.shape, minval=box.lower, maxval=box.upper)
            for one, box in zip(jax.random.split(key), (noise.w, noise.v), strict=True)
        )
        return w, v + 20 * (jax.random.permutation(key, 2) < jnp.where(k == twice, 2, k > 1))

    runs = gx.study.monte_carlo(observer, 0, 20, ROWS, initial, draw=draw, on_miss="record", reduce="final")
    assert (runs.broken_at == twice).all()
    assert (runs.broken == 8).all()
    assert (runs.first_miss.isnull() | (runs.first_miss >= twice)).all()
