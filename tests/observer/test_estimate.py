"""`estimate` against a Python loop over NumPy operations, against `start` and `step`, in batches, and in float32."""

from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import systems
from oracles.numpy_program import numpy_function

import gsisio_jax as gx
from gsisio_jax.observer.step import advance, blank

STEPS = 25
NAN = np.nan


@dataclass
class Run:
    """A designed observer and a record of it, with missing entries, to compare different ways of computing."""

    observer: gx.Observer
    initial: gx.Interval
    y: np.ndarray
    u: Any
    noise: gx.Noise


def target() -> systems.Case:
    """A linear system with state bounds: position and velocity with a speed limit and an unknown acceleration.

    The state map counts how often it is traced.
    """

    def f(x):
        traces.append(1)
        return jnp.stack([x[0] + 0.1 * x[1], x[1]])

    slow = gx.Interval([-np.inf, -3.0], [np.inf, 3.0])
    return systems.Case(
        system=gx.System(f, lambda x: x, G=[[0.005], [0.1]], H=np.zeros((2, 1)), state_bounds=slow),
        noise=gx.Noise(systems.ball([1e-3] * 2), systems.ball([0.1, 0.2])),
        initial=systems.ball([5.0, 1.0]),
        region=gx.Interval.entire(2),
        steps=STEPS,
        d=lambda key, steps: jax.random.normal(key, (steps, 1)),
    )


traces: list[int] = []


def paper_with_bounds() -> systems.Case:
    """S1 with bounds of its states: without them any record could be explained, by some d, after row 0."""
    case = systems.s1()
    plant = case.system
    bounded = gx.System(plant.f, plant.g, plant.G, plant.H, state_bounds=systems.ball([6.0, 6.0]))
    return replace(case, system=bounded)


def _run(case: systems.Case, holes: list[Any], push: Any = 0.0, rounding: Any = "outward", **design: Any) -> Run:
    """A record with `holes` missing, and `push` added to row 14: a contradiction. To nearest less is compiled."""
    case = replace(case, steps=STEPS)
    record, _ = case.simulate(jax.random.key(1))
    y = np.array(record.y)
    for where in holes:
        y[where] = NAN
    y[14] += push
    observer = case.design(**design).with_rounding(rounding)
    return Run(observer, case.initial, y, jnp.asarray(case.u(STEPS)), case.noise)


@pytest.fixture(scope="module")
def paper():
    """The paper's example with state bounds; row 14 contradicts even those."""
    return _run(
        paper_with_bounds(), [5, (9, 0)], push=np.array([10.0, 40.0]), rounding="nearest", missing=False, cells=1
    )


@pytest.fixture(scope="module")
def linear():
    """A linear system with state bounds and lost rows; row 14 contradicts the rows before."""
    return _run(target(), [4, (8, 1), (11, 0), 12], push=np.array([50.0, 0.0]))


@pytest.fixture(scope="module")
def small():
    """The linear system once more, as small as it gets: for tests that compile many variants of the same thing."""
    run = _run(target(), [2], rounding="nearest", missing=False)
    return replace(run, y=run.y[:5], u=run.u[:5])


@pytest.fixture(scope="module")
def tanks():
    """Six tanks: f takes the known input, and states are bounded below."""
    return _run(systems.s5(), [7, (15, 0)], rounding="nearest", missing=False)


@pytest.fixture(scope="module", params=["paper", "linear", "tanks"])
def run(request):
    return request.getfixturevalue(request.param)


def assert_equal(got: Any, expected: Any, rtol: float = 1e-12):
    """All boxes and margins to `rtol` of their size, all else exactly."""
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        a, b = np.asarray(a), np.asarray(b)
        assert a.shape == b.shape
        if np.issubdtype(a.dtype, np.floating):
            size = np.abs(b[np.isfinite(b)]).max(initial=0.0)
            np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol * size)
        else:
            np.testing.assert_array_equal(a, b)


def numpy_loop(run: Run, hold: bool = False, noise: Any = None) -> gx.Estimate:
    """The same step in a Python loop over rows, every operation by NumPy."""
    observer, noise = run.observer.astype(np.float64), noise or (lambda k: run.noise)
    carry = blank(observer, run.initial)
    step = numpy_function(partial(advance, observer, hold=hold), carry, run.y[0], run.u[0], noise(0))
    outputs = []
    for k in range(len(run.y)):
        carry, out = step(carry, run.y[k], run.u[k], noise(k))
        outputs.append(out)
    return gx.estimation.collect(observer, outputs)


def test_equals_a_numpy_loop(run):
    est = gx.estimate(run.observer, run.initial, run.y, run.u)
    assert_equal(est, numpy_loop(run))
    assert np.isfinite(est.state.width).any(axis=0).all()
    assert (np.asarray(est.status) & gx.Status.MISSING).any()


def test_equals_start_and_step(run):
    carry, out = gx.start(run.observer, run.initial, run.y[0], run.u[0])
    outputs = [out]
    for y, u in zip(run.y[1:], run.u[1:], strict=True):
        carry, out = gx.step(run.observer, carry, y, u)
        outputs.append(out)
    est = gx.estimate(run.observer, run.initial, run.y, run.u)
    assert_equal(gx.estimation.collect(run.observer, outputs), est)


@pytest.mark.parametrize("name", ["paper", "linear"])
def test_the_records_hold_one_conflict(name, request):
    """What the comparisons above compare: a conflict, after which the run goes on from y or the bounds alone."""
    run = request.getfixturevalue(name)
    est = gx.estimate(run.observer, run.initial, run.y)
    conflict = np.flatnonzero(np.asarray(est.status) & gx.Status.CONFLICT)
    assert 14 in conflict
    assert len(conflict) <= 2  # restarted from y[14], the row after may contradict that in turn
    assert est.margin[14] < 0
    assert len(est.alarms()) >= 1
    assert np.isfinite(est.state.width[-1]).all()
    missing = np.flatnonzero(np.asarray(est.status) & gx.Status.MISSING)
    np.testing.assert_array_equal(missing, np.flatnonzero(np.isnan(run.y).any(axis=1)))


def test_hold_equals_a_numpy_loop(linear):
    est = gx.estimate(linear.observer, linear.initial, linear.y, on_conflict="hold")
    np.testing.assert_array_equal(np.flatnonzero(np.asarray(est.status) & gx.Status.CONFLICT), [14])
    assert_equal(est, numpy_loop(linear, hold=True))


def varying(run: Run) -> gx.Noise:
    """Noise bounds (T, .) that shrink and grow."""
    share = 1 + 0.5 * np.sin(np.arange(len(run.y)))[:, None]
    return jax.tree.map(lambda bound: share * bound, run.noise)


def test_noise_that_changes_with_time(linear):
    noise = varying(linear)
    est = gx.estimate(linear.observer, linear.initial, linear.y, noise=noise)
    assert_equal(est, numpy_loop(linear, noise=lambda k: jax.tree.map(lambda bound: bound[k], noise)))


def test_one_bound_may_change_while_the_other_is_constant(small):
    noise = varying(small)
    constant = jax.tree.map(lambda bound: np.tile(bound, (len(small.y), 1)), small.noise)
    est = gx.estimate(small.observer, small.initial, small.y, noise=gx.Noise(small.noise.w, noise.v))
    expected = gx.estimate(small.observer, small.initial, small.y, noise=gx.Noise(constant.w, noise.v))
    assert_equal(est, expected)


def batch(run: Run, count: int = 3) -> tuple[gx.Interval, np.ndarray, gx.Noise]:
    """Several initial boxes, records and noise bounds; not all records miss the same entries."""
    random = np.random.default_rng(0)
    share = 1 + 0.5 * random.random((count, 1))
    initial = gx.Interval(run.initial.lower * share, run.initial.upper * share)
    y = run.y + 0.01 * random.random((count, *run.y.shape))
    y[0, 2] = NAN
    return initial, y, jax.tree.map(lambda bound: share * bound, run.noise)


@pytest.mark.parametrize("axes", [axes for axes in product([0, None], repeat=3) if axes != (None,) * 3])
def test_batches_equal_a_loop(small, axes):
    """vmap over initial, y and noise in every combination, under jit."""
    many = batch(small)
    single = (small.initial, small.y, small.noise)
    args = [b if axis == 0 else a for a, b, axis in zip(single, many, axes, strict=True)]

    def one(initial, y, noise):
        return gx.estimate(small.observer, initial, y, noise=noise)

    got = jax.jit(jax.vmap(one, in_axes=axes))(*args)
    for i in range(3):
        row = [a if axis is None else jax.tree.map(lambda x: x[i], a) for a, axis in zip(args, axes, strict=True)]  # noqa: B023
        assert_equal(jax.tree.map(lambda x: x[i], got), one(*row))  # noqa: B023


def test_a_batch_of_everything_equals_a_loop(paper):
    """The nonlinear example; some records of the batch conflict or miss entries where others do not."""
    initial, y, noise = batch(paper)
    y[1, 14] = paper.y[13]
    y[2, 5] = paper.y[6]
    got = jax.vmap(lambda i, y, n: gx.estimate(paper.observer, i, y, noise=n))(initial, y, noise)
    assert len(np.unique(np.asarray(got.status), axis=0)) == 3
    for i in range(3):
        row, bounds = jax.tree.map(lambda x: x[i], (initial, noise))  # noqa: B023
        assert_equal(jax.tree.map(lambda x: x[i], got), gx.estimate(paper.observer, row, y[i], noise=bounds))  # noqa: B023


def test_under_jit(small):
    inside = jax.jit(lambda initial, y: gx.estimate(small.observer, initial, y))(small.initial, small.y)
    assert_equal(inside, gx.estimate(small.observer, small.initial, small.y))


def test_new_numbers_compile_nothing(small):
    """Another initial box, record and noise of the same shapes: no trace of f, no compilation."""
    compiled = []

    def listen(event: str, *_: Any, **__: Any) -> None:
        if "compile" in event or "trace" in event:
            compiled.append(event)

    def again(share: float) -> None:
        initial = gx.Interval(small.initial.lower * share, small.initial.upper * share)
        noise = jax.tree.map(lambda bound: share * bound, small.noise)
        gx.estimate(small.observer, initial, small.y * share, noise=noise)
        carry, _ = gx.start(small.observer, initial, small.y[0] * share, noise=noise)
        gx.step(small.observer, carry, small.y[1] * share, noise=noise)

    again(1.0)
    before = len(traces)
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        again(1.5)
        assert compiled == []
        assert len(traces) == before
        # A record of another length: the step itself is known still.
        gx.estimate(small.observer, small.initial, small.y[:3])
        assert compiled
        assert len(traces) == before
        assert before > 0  # the counter does count
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


@pytest.fixture(scope="module")
def single(paper):
    """50 records of the paper's example in float32, with the float64 truth."""
    case = paper_with_bounds()

    @jax.jit
    @jax.vmap
    def run(key):
        record, d = case.simulate(key)
        low, high = (jnp.asarray(x, jnp.float32) for x in (case.initial.lower, case.initial.upper))
        narrow = gx.Interval.unchecked(jnp.nextafter(low, -jnp.inf), jnp.nextafter(high, jnp.inf))
        est = gx.estimate(paper.observer, narrow, record.y.astype(jnp.float32), rounding="outward")
        return est, record.x[:-1], d[:-1]

    return run(jax.random.split(jax.random.key(2), 50))


def test_float32_in_float32_out(single):
    est, _, _ = single
    for leaf in jax.tree.leaves(est):
        assert leaf.dtype in (jnp.float32, jnp.int32)


def test_float32_contains_the_float64_truth(single):
    est, x, d = single
    assert np.asarray(est.state.contains(x)).all()
    assert np.asarray(est.input.contains(d)).all()
    assert not (np.asarray(est.status) & (gx.Status.CONFLICT | gx.Status.UNBOUNDED)).any()


def test_a_float32_carry_goes_on_with_float64_data(small):
    """What was rounded outward once stays valid: the run continues in the wider type."""
    narrow = gx.Interval(*(np.float32(side) for side in (small.initial.lower, small.initial.upper)))
    carry, _ = gx.start(small.observer, narrow, small.y[0].astype(np.float32))
    assert carry.state.dtype == np.float32
    stepped, out = gx.step(small.observer, carry, small.y[1])
    resumed, rows = gx.estimation.resume(small.observer, carry, small.y[1:])
    numbers = [leaf.dtype for leaf in jax.tree.leaves((stepped, resumed)) if leaf.dtype != bool]
    assert set(numbers) == {np.dtype(np.float64)}
    np.testing.assert_allclose(rows.state.upper[0], out.state.upper, rtol=1e-12)
    exact = gx.estimate(small.observer, small.initial, small.y)
    np.testing.assert_allclose(rows.state.upper, exact.state.upper[1:], rtol=1e-5)
