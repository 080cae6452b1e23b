"""`monte_carlo` against a plant simulated by hand and single calls of `estimate`; its statistics against SciPy."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import systems
import xarray as xr
from scipy import stats

import gsisio_jax as gx
from gsisio_jax import study
from gsisio_jax.study.plant import _inside

T = 12
LEVELS = np.array([0.1, 0.2])
START = systems.ball([1.0, 1.0])


def f(x):
    return jnp.stack([0.6 * x[0] + 0.2 * jnp.sin(x[1]), 0.5 * x[1] - 0.1 * x[0]])


PLANT = gx.System(f, lambda x: jnp.stack([x[0], x[0] + x[1]]), G=[[0.0], [1.0]], H=[[0.1], [0.0]])


def noises(levels):
    box = gx.Interval.symmetric(np.asarray(levels)[:, None] * np.ones(2))
    return gx.grid("level", gx.Noise(box, box), coordinate=levels)


def manoeuvre(key, k, x):
    return 3 * jax.random.normal(key, (1,)) + x[:1]


@pytest.fixture(scope="module")
def observer():
    noise = gx.Noise(systems.ball([0.1, 0.1]), systems.ball([0.1, 0.1]))
    found = gx.design_observer(PLANT, noise, systems.ball([3.0, 3.0]), missing=False, sweeps=1, window=1)
    return found.with_rounding("nearest")  # less to compile


def carlo(observer, **change):
    usual = {"key": 5, "runs": 6, "steps": T, "x0": START, "d": manoeuvre, "progress": False}
    return gx.monte_carlo(observer, **usual | change)


@pytest.fixture(scope="module")
def kept(observer):
    return carlo(observer, noise=noises(LEVELS), reduce=None, batch=4)


@pytest.fixture(scope="module")
def reduced(observer):
    return carlo(observer, noise=noises(LEVELS), reduce=("final", "mean", "settle"), batch=12)


def swinging(key, k, x, noise):
    """Noise by a law that NumPy can repeat: between the middle and a bound, turning with k and with the state."""
    sign = jnp.where((k % 3 == 0) ^ (x > 0), -1.0, 1.0)
    return noise.w.center + 0.9 * sign * noise.w.radius, noise.v.center - 0.8 * sign * noise.v.radius


def test_a_run_is_the_plant_estimated(observer):
    """d, noise and first state by laws without chance: the plant by hand in NumPy, then a plain call of `estimate`."""
    d = 5 * np.random.default_rng(0).normal(size=(T, 1))
    start = np.array([0.4, -0.7])
    found = carlo(observer, runs=1, x0=start, initial=START, d=d, draw=swinging, reduce=None)
    radius = 0.1
    x, y, states = start, np.empty((T, 2)), []
    for k in range(T):
        sign = np.where((k % 3 == 0) ^ (x > 0), -1.0, 1.0)
        states.append(x)
        y[k] = np.asarray(PLANT.g(x)) + PLANT.H @ d[k] - 0.8 * sign * radius
        x = np.asarray(PLANT.f(x)) + PLANT.G @ d[k] + 0.9 * sign * radius
    run = found.isel(run=0)
    np.testing.assert_allclose(run.state_true, states, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(run.input_true[:-1], d[:-1], rtol=1e-12)
    assert np.isnan(run.input_true[-1]).all()
    est = gx.estimate(observer, START, y)
    for name, box in (("state", est.state), ("input", est.input)):
        for side in ("lower", "upper"):
            expected = np.asarray(getattr(box, side))
            got = run[f"{name}_{side}"].values[: len(expected)]
            np.testing.assert_allclose(got, expected, rtol=1e-8, atol=1e-8)
    assert (run.status == np.asarray(est.status)).all()


def test_boxes_hold_the_truth_and_reductions_are_those_of_the_boxes(kept, reduced):
    inside = (kept.state_lower <= kept.state_true) & (kept.state_true <= kept.state_upper)
    assert inside.all()
    np.testing.assert_allclose(
        reduced.state_width_final, (kept.state_upper - kept.state_lower).isel(time=-1).values, rtol=1e-12
    )
    assert (reduced.state_coverage == 1).all()
    assert (reduced.input_coverage == 1).all()
    assert (reduced.state_miss == 0).all()
    assert reduced.first_miss.isnull().all()
    assert reduced.broken_at.isnull().all()
    assert reduced.attrs["missed"].startswith("0 of 6 runs; with confidence 0.95 less than 0.393")
    assert pytest.approx(0.393, abs=1e-3) == 1 - 0.05 ** (1 / 6)


def test_runs_can_be_had_alone_and_levels_share_their_numbers(observer, kept):
    alone = carlo(observer, runs=[4, 2], steps=T - 3, noise=noises(LEVELS), reduce=None, batch=4)
    assert alone.run.values.tolist() == [4, 2]
    np.testing.assert_allclose(alone.state_true, kept.state_true.sel(run=[4, 2]).isel(time=slice(0, T - 3)), rtol=1e-10)
    # Equal shares of the noise at both levels: the plants start in one point, and then drift apart slowly.
    first = kept.state_true.isel(time=0)
    np.testing.assert_array_equal(first.isel(level=0), first.isel(level=1))
    assert len(np.unique(first.isel(level=0, state=0))) == 6
    again = carlo(observer, key=jax.random.key(5), noise=noises(LEVELS), reduce=None, batch=4)
    xr.testing.assert_identical(again, kept)
    assert not np.allclose(
        carlo(observer, key=6, noise=noises(LEVELS), reduce=None, batch=4).state_true, kept.state_true
    )


def test_noise_lies_in_its_bounds_and_reaches_them():
    box = gx.Interval(np.array([-1.0, 0.0, 2.0]), np.array([3.0, 0.0, 2.5]))
    keys = jax.random.split(jax.random.key(0), 2000)
    for vertices in (False, True):
        drawn = np.asarray(jax.vmap(lambda key, v=vertices: _inside(key, box, v))(keys))
        assert (drawn >= box.lower).all()
        assert (drawn <= box.upper).all()
        share = (drawn[:, [0, 2]] - box.lower[[0, 2]]) / np.asarray(box.width)[[0, 2]]
        if vertices:
            assert set(np.unique(share)) == {0.0, 1.0}
            assert np.abs(share.mean(0) - 0.5).max() < 0.05
            assert abs(np.corrcoef(share.T)[0, 1]) < 0.1
        else:
            assert stats.kstest(share.ravel(), "uniform").pvalue > 0.01


def test_the_summary_is_that_of_scipy(reduced):
    values = reduced.state_width_mean.values  # level, run, state
    found = reduced.state_width_mean_summary
    assert found.dims == ("level", "state", "statistic")
    mean, error = values.mean(1), stats.sem(values, axis=1)
    low, high = stats.t.interval(0.95, 5, loc=mean, scale=error)
    expected = mean, low, high, values.std(1, ddof=1), values.min(1), np.median(values, 1), values.max(1)
    np.testing.assert_allclose(found.isel(statistic=slice(0, 7)), np.stack(expected, -1), rtol=1e-12)
    assert (found.sel(statistic="share") == 1).all()


def test_a_summary_with_numbers_missing_infinite_or_alone():
    rows = [[1.0, np.nan, np.nan, 2.0], [2.0, np.nan, 5.0, np.inf], [6.0, np.nan, 7.0, 4.0]]
    found = study.summary(xr.Dataset({"width": (("run", "case"), rows)}), confidence=0.9).width_summary
    table = {name: found.sel(statistic=name).values for name in study.STATISTICS}
    np.testing.assert_array_equal(table["mean"], [3, np.nan, 6, np.inf])
    np.testing.assert_array_equal(table["median"], [2, np.nan, 6, 4])
    np.testing.assert_array_equal(table["min"], [1, np.nan, 5, 2])
    np.testing.assert_array_equal(table["max"], [6, np.nan, 7, np.inf])
    np.testing.assert_allclose(table["share"], [1, 0, 2 / 3, 1])
    low, high = stats.t.interval(0.9, 1, loc=6, scale=1)
    np.testing.assert_allclose([table["mean_lower"][2], table["mean_upper"][2]], [low, high])
    assert table["mean_lower"][3] == table["mean_upper"][3] == np.inf
    one = study.summary(xr.Dataset({"width": ("run", [3.0])})).width_summary
    assert one.sel(statistic="mean") == 3
    assert np.isnan(one.sel(statistic="mean_upper"))


def test_a_miss_ends_the_study_and_names_the_run(observer):
    """An observer that takes an output for free of the unknown input which is not."""
    T2, banks = observer.T2 + 1.0, (observer.gains, observer.inverses)
    false = eqx.tree_at(
        lambda o: (o.T2, o.gains.output, o.inverses.output),
        replace(observer, recovery=()), (T2, *(bank.remainder @ T2 for bank in banks)),
    )  # fmt: skip
    with pytest.raises(gx.ContainmentLost) as raised:
        carlo(false, runs=[3, 9])
    message = str(raised.value)
    recorded = carlo(false, runs=[3, 9], on_miss="record")
    assert recorded.attrs["guaranteed"] is False
    missed = recorded.first_miss.dropna("run")
    number, step = int(missed.run[0]), int(missed[0])
    assert f"in run {number} at step {step}" in message
    assert "a box misses the truth (x" in message
    assert "jax.random.wrap_key_data(jax.numpy.array([0, 5], dtype='uint32'))" in message
    assert f"runs=[{number}], steps={step + 1}" in message
    assert recorded.attrs["missed"].startswith(f"{missed.size} of 2 runs")
    # As the message says.
    key = jax.random.wrap_key_data(jnp.array([0, 5], dtype="uint32"))
    seen = carlo(false, key=key, runs=[number], steps=step + 1, reduce=None, on_miss="record").isel(run=0)
    outside = (seen.state_true < seen.state_lower) | (seen.state_true > seen.state_upper)
    assert outside.isel(time=-1).any() or np.isfinite(seen.first_miss)


def test_a_run_that_leaves_its_own_bounds_ends_the_study(observer):
    def draw(key, k, x, noise):
        return noise.w.upper * (1 + ((k == 1) & (x[0] < 0))), noise.v.lower

    def d(key, k, x):
        return jnp.where((k == 3) & (x[0] > 0), jnp.inf, jnp.ones(1))

    with pytest.raises(gx.ContainmentLost, match=r"promise nothing.* in run 0 at step"):
        carlo(observer, x0=np.array([1.0, 0.0]), draw=draw, d=d)
    for start, step, bit in (([1.0, 0.0], 3, 4), ([-1.0, -1.0], 1, 3)):
        found = carlo(observer, x0=np.array(start), draw=draw, d=d, on_miss="record")
        assert (found.broken_at == step).all()
        assert (found.broken == 1 << bit).all()
    with pytest.raises(gx.ContainmentLost, match="the first state lies outside of the initial box"):
        carlo(observer, x0=np.array([1.0, 0.0]), initial=gx.Interval([5.0, 5.0], [6.0, 6.0]), draw=draw, d=d)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"runs": 0}, "`runs` must be a number of runs, at least 1"),
        ({"runs": [-1]}, "`runs` must be a number of runs"),
        ({"steps": 0}, "`steps` must be the number of measurements"),
        ({"key": "seed"}, "`key` must be one key"),
        ({"x0": gx.Interval.entire(2)}, "`x0` must be a finite box"),
        ({"x0": [1.0]}, "`x0` must be a box, a finite point"),
        ({"x0": lambda key: jnp.zeros(2)}, "give the box of the observer as `initial`"),
        ({"d": np.zeros((3, 1))}, r"`d` must be a finite array \(12, 1\)"),
        ({"d": lambda key, k, x: x}, r"d\(key, k, x\) must return \(1,\), got \(2,\)"),
        ({"d": lambda x: x}, "must be a function that JAX can trace"),
        ({"draw": lambda key, k, x, noise: x}, r"must return \(2,\) and \(2,\)"),
        ({"draw": "corners"}, '"uniform", "vertices" or a function'),
        ({"on_miss": "warn"}, '"raise" or "record"'),
        ({"confidence": 95}, "between 0 and 1"),
        ({"reduce": "median"}, "unknown reduction"),
    ],
)
def test_what_is_refused(observer, change, message):
    with pytest.raises(ValueError, match=message):
        carlo(observer, **change)


def test_a_store_is_gone_on_with_and_knows_the_functions(observer, tmp_path, reduced):
    path = tmp_path / "runs.zarr"
    usual = {"noise": noises(LEVELS), "reduce": ("final", "mean", "settle"), "batch": 12}
    first = carlo(observer, store=path, **usual)
    xr.testing.assert_equal(first, reduced)
    xr.testing.assert_equal(
        carlo(observer, store=path, **usual | {"d": lambda key, k, x: manoeuvre(key, k, x)}), reduced
    )
    for change in ({"d": lambda key, k, x: 2 * manoeuvre(key, k, x)}, {"key": 6}, {"draw": "vertices"}, {"runs": [1]}):
        with pytest.raises(ValueError, match="another study"):
            carlo(observer, store=path, **usual | change)


def test_a_half_infinite_box_that_misses_is_told():
    """Its width is infinite, and is no measure of rounding."""
    box = gx.Interval([0.0, -np.inf, 0.0, -np.inf, 0.0], [np.inf, -1.0, np.inf, np.inf, 1e3])
    truth = jnp.array([-5.0, -1.0 + 1e-6, -0.0, 7.0, -1e-8])
    inside, outside = study.containment.Containment(True).compare((jnp.zeros(5), jnp.zeros(5)), box, truth)
    np.testing.assert_array_equal(inside, [0, 0, 1, 1, 1])  # the last one may be rounding, of numbers up to 10^3
    np.testing.assert_allclose(outside, [5, 1e-6, 0, 0, 0])
    nothing = gx.Interval.unchecked(jnp.full(5, jnp.nan), jnp.full(5, jnp.nan))
    inside, outside = study.containment.Containment(True).compare((jnp.zeros(5), jnp.zeros(5)), nothing, truth)
    assert not inside.any()
    assert (outside > 0).all()
