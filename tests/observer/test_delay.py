"""Observers with a delay: what they are given and return, in runs; and how near they come to the exact hull."""

from fractions import Fraction
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles.delayed_plants import PLANTS
from oracles.exact_plant import Plant, is_tight, tight_records
from oracles.record_hull import exact_hull
from oracles.uncompiled import in_numpy

import gsisio_jax as gx
from gsisio_jax import Interval, Status

STEPS = 24


@lru_cache
def designed(name, **options):
    (A, C, G, H, w, v, _), _ = PLANTS[name]
    system = gx.System(lambda x: A @ x, lambda x: C @ x, G=G, H=H / 10)
    noise = gx.Noise(Interval.symmetric(w), Interval.symmetric(v))
    return gx.design_observer(system, noise, Interval.entire(len(A)), delay="auto", **options)


def start_box(name):
    return Interval.symmetric(PLANTS[name][0][-1])


def simulated(name, seed, size=3.0, vertices=False, steps=STEPS):
    """x, y, d; the first state on a face or a corner of its box."""
    (A, C, G, H, w, v, first), _ = PLANTS[name]
    rng = np.random.default_rng(seed)

    def draw(radius):
        sides = rng.choice([-1.0, 1.0], len(radius))
        return np.asarray(radius) * (sides if vertices else rng.uniform(-1, 1, len(radius)))

    x, xs, ys = np.asarray(first) * rng.choice([-1.0, 0.3, 1.0], len(first)), [], []
    d = size * rng.normal(size=(steps, G.shape[1]))
    for k in range(steps):
        xs.append(x)
        ys.append(C @ x + H / 10 @ d[k] + draw(v))
        x = A @ x + G @ d[k] + draw(w)
    return np.array(xs), np.array(ys), d


@pytest.fixture(scope="module")
def spring():
    return designed("spring", sweeps=1)


@pytest.fixture(scope="module")
def record(spring):
    x, y, d = simulated("spring", 0)
    return x, y, d, gx.estimate(spring, start_box("spring"), y)


def test_boxes_are_the_exact_hull_of_a_mass_on_a_spring(spring, record):
    """Position to within its noise; speed from two positions: width (2 * .02 + .002) / .1."""
    x, _, d, est = record
    assert est.delay == 1
    np.testing.assert_allclose(est.state.width[1:-1], [[0.02, 0.42]] * (STEPS - 2), rtol=1e-9)
    np.testing.assert_allclose(spring.certificate.steady_width, [0.02, 0.42], rtol=1e-9)
    assert np.asarray(est.state.contains(x)).all()
    assert np.asarray(est.input.contains(d[:-1])).all()
    # The last row lacks the measurement that would show its speed, and the input that leads to it.
    assert np.isinf([est.state.width[-1, 1], est.input.width[-1, 0]]).all()
    assert est.status[-1] == Status.MISSING | Status.UNBOUNDED
    assert not est.status[:-1].any()
    assert spring.certificate.recoverable
    widths = np.asarray(est.input.width)[2:-1]
    assert (widths <= spring.certificate.input_width * (1 + 1e-9)).all()
    np.testing.assert_allclose(spring.certificate.widths(spring.noise), spring.certificate.steady_width)
    np.testing.assert_allclose(spring.certificate.input_widths(spring.noise), spring.certificate.input_width)


def test_steps_come_one_late_and_are_those_of_the_record(spring, record):
    _, y, _, est = record
    carry, out = gx.start(spring, start_box("spring"), y[0])
    assert int(out.status) == Status.PENDING
    assert np.isinf([out.state.lower, out.state.upper]).all()
    outputs = [out]
    for row in [*y[1:], np.full(1, np.nan)]:  # one missing row finishes the last step
        carry, out = gx.step(spring, carry, row)
        outputs.append(out)
    whole = gx.estimation.collect(spring, outputs)
    # One program for all rows and one for a row round in other places.
    assert jax.tree.all(jax.tree.map(lambda a, b: bool(jnp.allclose(a, b, rtol=1e-12, atol=1e-12)), whole, est))


def check_contained(observer, name):
    """d up to 1e6, noise at its vertices, the first state on faces and corners of its box."""
    for seed in range(30):
        x, y, d = simulated(name, seed, size=(1.0, 1e3, 1e6)[seed % 3], vertices=True)
        est = gx.estimate(observer, start_box(name), y)
        for box, truth in ((est.state, x), (est.input, d[:-1])):
            room = 1e-15 * np.abs(truth).max()  # the record is rounded
            assert ((box.lower - room <= truth) & (truth <= box.upper + room)).all()
        assert not (np.asarray(est.status) & Status.CONFLICT).any()


def test_contained_whatever_the_input(spring):
    check_contained(spring, "spring")


@pytest.mark.parametrize(("name", "window"), [("far mass", 1), ("at once", 3)])
def test_contained_and_tight(name, window):
    """Width over hull at most 1.25, never below 1; hulls by an oracle."""
    (A, C, G, H, w, v, first), delay = PLANTS[name]
    observer = designed(name, missing=False, window=window, sweeps=1)
    assert observer.delay == delay
    ratios, steps = [], [12, 17, 22 - delay]
    for seed in range(2):
        _, y, _ = simulated(name, seed)
        found = gx.tightness(observer, start_box(name), y, steps=steps)
        for k, hull in zip(found.steps, found.hull_width, strict=True):
            oracle = exact_hull(A, C, w, v, first, y[: k + delay + 1], G, H / 10, step=k)
            np.testing.assert_allclose(hull, oracle, rtol=1e-6)
        ratios.append(found.ratio)
    assert np.min(ratios) >= 1 - 1e-9
    assert np.mean(np.concatenate(ratios), axis=0).max() < 1.07  # measured: 1.06 at most
    assert np.max(ratios) < 1.25
    check_contained(observer, name)


@pytest.fixture(scope="module")
def exact():
    """A plant of numbers that are the same in both types."""
    (A, C, G, H, *_), _ = PLANTS["short orders"]
    plant = Plant(A, C, G, H, 10.0).astype(np.float32)
    A, C = plant.A.astype(np.float32), plant.C.astype(np.float32)
    system = gx.System(lambda x: jnp.asarray(A) @ x, lambda x: jnp.asarray(C) @ x, G=plant.G, H=plant.H)
    noise = gx.Noise(Interval.symmetric(np.full(3, 1e-9)), Interval.symmetric(np.full(2, 1e-9)))
    return plant, gx.design_observer(system, noise, Interval.entire(3), missing=False, delay=1, sweeps=1)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_rounding_costs_no_box(exact, dtype):
    """Records that hold exactly, with the tightest noise bounds there are: any rounding that is not counted misses."""
    plant, observer = exact
    noise, sizes = np.where(np.arange(60) % 2, 1e-6, 0), np.resize([1.0, 1e3, 1e6, 1e9], 60)
    record = tight_records(np.random.default_rng(3), plant, 60, 20, sizes, noise, dtype)
    assert is_tight(plant, record, 7, 9)
    first, w, v = (Interval.unchecked(*pair) for pair in ((record.x[:, 0],) * 2, record.w, record.v))
    est = jax.vmap(lambda start, y, w, v: gx.estimate(observer, start, y, noise=gx.Noise.unchecked(w, v)))(
        first, record.y, w, v
    )
    assert est.state.lower.dtype == dtype
    assert ((est.state.lower <= record.x) & (record.x <= est.state.upper)).all()
    d = record.d[:, :-1]
    assert ((est.input.lower <= d) & (d <= est.input.upper)).all()
    size = np.abs(record.x[:, :-3]) + 1e-3
    assert np.median(est.state.width[:, :-3] / size) < 400 * np.finfo(dtype).eps
    assert not (np.asarray(est.status) & Status.CONFLICT).any()


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_a_combination_is_known_to_within_its_rounding(exact, dtype):
    """Large measurements whose combination is small: what their products lose is in the noise. In fractions."""
    observer, rng = exact[1], np.random.default_rng(0)
    (weights,) = observer.inner.system.g.rows(dtype).outputs
    zero = gx.Noise(*(Interval.symmetric(np.zeros((2, size), dtype)) for size in (3, 2)))
    for _ in range(20):
        y = (1e9 * rng.normal(size=(2, 2))).astype(dtype)
        measured, bounds = observer.row(jnp.asarray(y), jnp.zeros((2, 0), dtype), zero)
        truth = sum(Fraction(float(t)) * Fraction(float(e)) for t, e in zip(weights, y.ravel(), strict=True))
        low, high = (
            Fraction(float(measured[2])) - Fraction(float(side[2])) for side in (bounds.v.upper, bounds.v.lower)
        )
        assert low <= truth <= high
        assert high - low < 1e11 * np.finfo(dtype).eps


def duffing(x):
    return jnp.stack([x[0] + 0.1 * x[1], x[1] + 0.1 * (-x[0] - 0.5 * x[0] ** 3 - 0.4 * x[1])])


def test_a_nonlinear_spring():
    """Only what is measured later must be affine; known inputs of both steps count; the certificate holds."""
    system = gx.System(duffing, lambda x, u: x[:1] + 2 * u[0], G=[[0.0], [0.1]], H=[[0.0]], B=[[0.7], [0.1]], D=[[0.3]])
    noise = gx.Noise(Interval.symmetric([1e-3, 1e-2]), Interval.symmetric([0.01]))
    fast = {"delay": 1, "missing": False, "sweeps": 1}
    observer = gx.design_observer(
        system, noise, Interval.symmetric([2.0, 3.0]), u_region=Interval([-0.2], [0.2]), **fast
    )
    start, widths = Interval.symmetric([1.0, 1.0]), observer.certificate.steady_width
    u = 0.2 * np.sin(np.arange(40.0))[:, None]
    for seed in range(3):
        d = np.full((40, 1), 0.5 * (-1) ** seed)
        run = gx.simulate(system, seed, np.array([0.9, -0.5]), d, noise, u=u)
        est = gx.estimate(observer, start, run.y, u)
        assert np.asarray(est.state.contains(run.x[: len(run.y)])).all()
        inside = (np.asarray(est.status) & Status.OUTSIDE_REGION) == 0
        assert inside[5:-1].any()
        assert (np.asarray(est.state.width)[1:-1][inside[1:-1]] <= widths * (1 + 1e-6)).all()
    # Runs that agree with y[0..9] reach both sides of the position, and nearly those of the speed.
    found = gx.tightness(observer, start, run.y, u, steps=[8])
    assert not found.exact
    assert (found.ratio >= 1 - 1e-9).all()
    np.testing.assert_allclose(found.hull_width[0, 0], 0.02, rtol=1e-6)
    assert found.ratio[0, 1] < 1.6


def test_batches_and_gradients(record):
    """Speed from two positions is (4 v + 2 w1) / .1 wide for radii w1 and v."""
    y, spring = record[1], designed("spring", missing=False, sweeps=1, window=1)

    def width(scale):
        bounds = gx.Noise(Interval.symmetric(scale * jnp.array([1e-3, 1e-2])), spring.noise.v)
        return gx.estimate(spring, start_box("spring"), y[:4], noise=bounds).state.width[2, 1]

    found, slope = in_numpy(jax.vmap(jax.value_and_grad(width)))(np.array([0.1, 1.0, 3.0]))
    np.testing.assert_allclose(found, [0.402, 0.42, 0.46], rtol=1e-9)
    np.testing.assert_allclose(slope, 0.02, rtol=1e-6)


def test_lost_rows_and_conflicts(spring, record):
    x, y, _, est = record
    lost = y.copy()
    lost[10] = np.nan
    found = gx.estimate(spring, start_box("spring"), lost)
    assert np.asarray(found.state.contains(x)).all()
    same = [k for k in range(STEPS) if k not in (8, 9, 10, 11)]
    np.testing.assert_allclose(np.asarray(found.state.width)[same], np.asarray(est.state.width)[same], rtol=1e-9)
    assert [k for k in range(STEPS) if found.status[k] & Status.MISSING] == [9, 10, STEPS - 1]
    short = gx.estimate(spring, start_box("spring"), y, length=15)
    np.testing.assert_array_equal(short.state.lower[:14], est.state.lower[:14])
    assert [k for k in range(STEPS) if short.status[k] & Status.MISSING] == list(range(14, STEPS))


def test_what_later_measurements_contradict_is_an_alarm():
    observer = designed("at once", missing=False, window=3, sweeps=1)
    x, y, _ = simulated("at once", 1)
    y[12, 2] += 30.0
    est = gx.estimate(observer, start_box("at once"), y)
    alarms = est.alarms()
    assert alarms[0].step in (10, 11)  # from y[12], and one input less than outputs
    assert {j for alarm in alarms for j in alarm.outputs} <= {0, 1, 2}
    assert np.asarray(est.state.contains(x))[:10].all()


def test_results_say_so(spring, record):
    _, y, _, est = record
    data = gx.dataset.to_dataset(est, y=y)
    assert data.attrs["delay"] == 1
    assert "up to step k + 1" in data.attrs["comment"]
    assert "y[0..k+1]" in str(spring.certificate)
    assert "up to 1 step later" in gx.plot.framers(est)[0].figure.get_suptitle() + gx.plot.framers(est)[0].get_title()


def test_where_state_bounds_alone_make_an_observer_the_certificate_names_the_delay():
    """Infections of which nothing is known move the exposed, who fall ill later."""
    noise = gx.Noise(Interval.symmetric([1.0, 1.0]), Interval.symmetric([5.0]))
    system = gx.System(
        lambda x: np.array([[0.8, 0.0], [0.2, 0.9]]) @ x, lambda x: x[1:], G=[[1.0], [0.0]], H=[[0.0]],
        state_bounds=Interval([0.0, 0.0], [1e6, 1e6]),
    )  # fmt: skip
    dials = {"missing": False, "window": 1, "sweeps": 1}
    now, late = (gx.design_observer(system, noise, system.state_bounds, delay=delay, **dials) for delay in (0, 1))
    (note,) = now.certificate.notes
    assert now.window is late.window is None
    width = late.certificate.steady_width[0]
    assert now.certificate.steady_width[0] == 1e6
    assert width < 200
    assert note.startswith("of state 1 no more is promised than the state bounds")
    assert f"delay=1 promises a width of {width:.4g} of state 1" in note
    assert not any("no more" in one for one in late.certificate.notes)
