"""`sweep` against single calls of `estimate` and NumPy; tiles; what a sweep refuses and what it compiles."""

import importlib
import io
import sys
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas
import pytest
import systems
import xarray

import gsisio_jax as gx
from gsisio_jax.plot.dates import zone_of
from gsisio_jax.study import Context, Kept, Reduction, Variable, quantiles, settle
from gsisio_jax.study.kernel import fingerprint, tile_size
from gsisio_jax.study.labels import Labels
from gsisio_jax.study.reductions import _quantiles, resolve
from gsisio_jax.study.row_source import Recorded

T = 14
RECORDS, BOXES = 4, 2
LEVELS = np.array([0.15, 0.2, 0.5])
QUANTILES = (0.0, 0.3, 1.0)
ALL = ("final", "max", "mean", "rms", settle(4), "first_conflict", "status", "coverage", "error",
       quantiles(*QUANTILES), "boxes")  # fmt: skip
traces: list[int] = []


@dataclass
class Study:
    """An observer and what a study of it takes: boxes x records x noise levels."""

    observer: gx.Observer
    initial: gx.Interval
    y: np.ndarray
    noise: gx.Noise
    length: np.ndarray
    truth: tuple[np.ndarray, np.ndarray]

    @property
    def arguments(self) -> dict[str, Any]:
        return {
            "initial": gx.grid("box", self.initial),
            "y": self.y,
            "noise": gx.grid("level", self.noise, coordinate=LEVELS, unit="m"),
            "length": self.length,
            "truth": self.truth,
        }


@pytest.fixture(scope="module")
def study() -> Study:
    """The paper's example with state bounds, so that records can contradict: one does, and one has missing rows."""
    case = replace(systems.s1(), steps=T)
    plant = case.system
    bounded = gx.System(plant.f, plant.g, plant.G, plant.H, state_bounds=systems.ball([6.0, 6.0]))
    observer = replace(case, system=bounded).design(missing=False).with_rounding("nearest")
    runs, d = jax.vmap(case.simulate)(jax.random.split(jax.random.key(3), RECORDS))
    y = np.array(runs.y)
    y[1, 7] += [10.0, 40.0]
    y[2, 3], y[2, 5, 0] = np.nan, np.nan
    scale = np.array([1.0, 1.3])[:, None]
    noise = LEVELS[:, None] * np.ones(2)
    return Study(
        observer,
        gx.Interval(case.initial.lower * scale, case.initial.upper * scale),
        y,
        gx.Noise(gx.Interval.symmetric(noise), gx.Interval.symmetric(noise)),
        np.array([T, T, 9, 1]),
        (np.asarray(runs.x), np.asarray(d)),
    )


@pytest.fixture(scope="module")
def swept(study):
    """Everything at once, in tiles of 7, the last of which is not full."""
    return gx.sweep(study.observer, **study.arguments, reduce=ALL, batch=7)


def single(study, box, record, level):
    noise = gx.Noise(study.noise.w[level], study.noise.v[level])
    return gx.estimate(study.observer, study.initial[box], study.y[record], noise=noise, length=study.length[record])


def expected_of(study, box, record, level):
    """What the reductions should be, in NumPy, from the boxes of a single call."""
    est = jax.tree.map(np.asarray, single(study, box, record, level))
    steps = study.length[record]
    x, d = study.truth[0][record], study.truth[1][record]
    out: dict[str, Any] = {}
    rows = {"state": (est.state[:steps], x[:steps]), "input": (est.input[: steps - 1], d[: steps - 1])}
    for of, (found, truth) in rows.items():
        width, count = found.width, len(found.width)
        empty = np.full(2, np.nan)
        out[f"{of}_width_final"] = width[-1] if count else empty
        out[f"{of}_width_max"] = width.max(0) if count else empty
        out[f"{of}_width_mean"] = width.mean(0) if count else empty
        out[f"{of}_width_rms"] = np.sqrt((width**2).mean(0)) if count else empty
        finite = np.isfinite(width).all()
        out[f"{of}_width_quantile"] = (
            np.quantile(width, QUANTILES, axis=0) if count and finite else np.full((len(QUANTILES), 2), np.nan)
        )
        inside = (found.lower <= truth) & (truth <= found.upper)
        out[f"{of}_coverage"] = inside.mean(0) if count else empty
        miss = np.maximum(np.maximum(found.lower - truth, truth - found.upper), 0)
        out[f"{of}_miss"] = miss.max(0) if count else np.zeros(2)
        error = np.where(np.isfinite(width), np.abs(found.center - truth), np.inf)
        out[f"{of}_error_rms"] = np.sqrt((error**2).mean(0)) if count else empty
        out[f"{of}_error_max"] = error.max(0) if count else empty
    steady = study.observer.certificate.widths(gx.Noise(study.noise.w[level], study.noise.v[level]))
    wide = np.flatnonzero((est.state.width[:steps] > 4 * steady).any(1))
    since = wide[-1] + 1 if wide.size else 0
    out["settled_at"] = since if since < steps else np.nan
    conflicts = np.flatnonzero(est.status[:steps] & gx.Status.CONFLICT)
    out["first_conflict"] = conflicts[0] if conflicts.size else np.nan
    out["conflicts"] = conflicts.size
    out["status_any"] = np.bitwise_or.reduce(est.status[:steps])
    out["status"] = est.status
    out |= {"state_lower": est.state.lower, "state_upper": est.state.upper}
    last = np.full((1, 2), np.nan)
    out |= {"input_lower": np.vstack([est.input.lower, last]), "input_upper": np.vstack([est.input.upper, last])}
    return out


def assert_close(got, expected, name=""):
    got, expected = np.asarray(got), np.asarray(expected)
    if got.dtype.kind == "i":
        np.testing.assert_array_equal(got, expected, err_msg=name)
        return
    finite = np.abs(expected[np.isfinite(expected)])
    # What cancels is as precise as the numbers it comes from.
    np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-12 * finite.max(initial=1.0), err_msg=name)


def test_every_reduction_equals_numpy_on_single_estimates(study, swept):
    rng = np.random.default_rng(0)
    cases = rng.permutation([(b, r, v) for b in range(BOXES) for r in range(RECORDS) for v in range(3)])[:14]
    assert {1, 2, 3} <= {r for _, r, _ in cases}
    for box, record, level in cases:
        one = swept.isel(box=box, run=record, level=level)
        expected = expected_of(study, box, record, level)
        for name, value in expected.items():
            if "quantile" in name and np.isnan(value).all():
                continue
            assert_close(one[name], value, f"{name} of case {(box, record, level)}")
    assert set(expected) == set(swept.data_vars) - {
        "steady_width", "predicted_state_width", "predicted_input_width"
    }  # fmt: skip
    assert (swept.first_conflict.isel(run=1) == 7).all()
    assert swept.settled_at.notnull().any()
    assert swept.settled_at.isnull().any()


def test_the_dataset_is_labelled(study, swept):
    assert swept.state_width_final.dims == ("box", "run", "level", "state")
    assert swept.state_lower.dims == ("box", "run", "level", "time", "state")
    assert swept.state_width_quantile.dims == ("box", "run", "level", "quantile", "state")
    assert swept.settled_at.dims == ("box", "run", "level")
    assert swept.level.attrs["units"] == "m"
    np.testing.assert_array_equal(swept.level, LEVELS)
    np.testing.assert_array_equal(swept["quantile"], QUANTILES)
    assert swept.state.values.tolist() == ["x1", "x2"]
    assert swept.status_any.attrs["flag_meanings"].startswith("CONFLICT MISSING")
    assert swept.attrs["tile"] == 7
    assert "Certificate" in swept.attrs["certificate"]


def test_the_certificate_stands_beside_what_was_measured(study, swept):
    assert swept.predicted_state_width.dims == ("level", "state")
    for level in range(len(LEVELS)):
        noise = gx.Noise(study.noise.w[level], study.noise.v[level])
        certificate = study.observer.certificate
        assert_close(swept.predicted_state_width[level], certificate.widths(noise))
        assert_close(swept.predicted_input_width[level], certificate.input_widths(noise))
    np.testing.assert_array_equal(swept.steady_width, study.observer.certificate.steady_width)


@dataclass(frozen=True)
class Lowest(Reduction):
    """A user's own reduction: the smallest lower bound of state 1."""

    name = "lowest"

    def init(self, first, context):
        return first.state.lower[0]

    def update(self, state, out, k, context):
        return jnp.minimum(state, out.state.lower[0])

    def finish(self, state, steps, context):
        return {"lowest": state}

    def describe(self):
        return {"lowest": Variable((), "smallest lower bound of state 1", "m")}


@dataclass(frozen=True)
class Corners(Kept):
    """One that keeps rows and does not say how they are labelled."""

    name = "corners"

    def row(self, out, k, context):
        return k, out.state.lower

    def finish(self, state, steps, context):
        return {"steps": state[0], "corners": state[1]}


# A linear plant that compiles fast: for the ways of calling ----------------------------------------------------------


def _f(x):
    traces.append(1)
    return jnp.stack([x[0] + 0.1 * x[1], 0.9 * x[1]])


@pytest.fixture(scope="module")
def linear() -> systems.Case:
    return systems.Case(
        system=gx.System(_f, lambda x: x, G=[[0.0], [0.1]], H=np.zeros((2, 1)), B=[[0.0], [1.0]]),
        noise=gx.Noise(systems.ball([1e-3] * 2), systems.ball([0.1, 0.2])),
        initial=systems.ball([5.0, 1.0]),
        region=gx.Interval.entire(2),
        steps=T,
        d=lambda key, steps: jax.random.normal(key, (steps, 1)),
        u=lambda steps: np.sin(np.arange(steps))[:, None],
    )


@pytest.fixture(scope="module")
def plain(linear) -> dict[str, Any]:
    """Eleven boxes on one record."""
    record, _ = linear.simulate(jax.random.key(0))
    radius = np.linspace(0.5, 5, 11)[:, None] * np.ones(2)
    observer = linear.design(missing=False).with_rounding("nearest")  # less to compile
    return {
        "observer": observer,
        "initial": gx.Interval.symmetric(radius),
        "y": np.asarray(record.y),
        "u": linear.u(T),
    }


@pytest.fixture(scope="module")
def in_tiles_of_four(plain):
    return gx.sweep(**plain, batch=4)


@pytest.fixture(scope="module")
def whole(plain):
    """In one tile, with reductions of one's own besides."""
    return gx.sweep(**plain, reduce=("final", "max", "mean", Lowest(), Corners()))


def test_tiles_of_another_size_agree(whole, in_tiles_of_four):
    assert (whole.attrs["tile"], in_tiles_of_four.attrs["tile"]) == (11, 4)
    for name in in_tiles_of_four.data_vars:
        np.testing.assert_allclose(whole[name], in_tiles_of_four[name], rtol=1e-12)


def test_equal_tiles_give_equal_bits_and_compile_once(plain, in_tiles_of_four):
    """Seven of the eleven cases, at other places of the tiles."""
    before = len(traces)
    shifted = plain | {"initial": plain["initial"][4:], "y": plain["y"].copy()}
    part = gx.sweep(**shifted, batch=4)
    for name in ("state_width_final", "input_width_mean"):
        np.testing.assert_array_equal(part[name], in_tiles_of_four[name][4:])
    # The size of a tile takes one abstract look at the first step; the program is there already.
    assert len(traces) - before <= 6


def test_named_pairs_inputs_and_noise_over_time(plain):
    """Inputs paired with boxes on one axis, noise that changes with time on another (w alike for all), with `hold`."""
    u = np.stack([plain["u"], 2 * plain["u"]])
    growing = np.linspace(1, 2, T)[:, None] * np.array([0.1, 0.2])
    v = gx.Interval.symmetric(np.stack([growing, 2 * growing, 1e-3 * growing]))
    w = gx.Interval.symmetric(np.linspace(1, 3, T)[None, :, None] * [1e-3, 1e-3])
    noise = gx.Noise(w, v)
    arguments = {
        "initial": gx.grid("start", plain["initial"][:2], coordinate=["near", "far"]),
        "u": gx.grid("start", u),
        "noise": gx.grid("sensor", noise),
    }
    result = gx.sweep(plain["observer"], y=plain["y"], **arguments, reduce=("mean", "status"), on_conflict="hold")
    assert result.state_width_mean.dims == ("start", "sensor", "state")
    for i, s in [(0, 0), (1, 0), (0, 1), (1, 2)]:
        bounds = gx.Noise(w[0], v[s])
        est = gx.estimate(plain["observer"], plain["initial"][i], plain["y"], u=u[i], noise=bounds, on_conflict="hold")
        one = result.isel(start=i, sensor=s)
        assert_close(one.state_width_mean, np.asarray(est.state.width).mean(0))
        assert_close(one.status_any, np.bitwise_or.reduce(np.asarray(est.status)))
    assert result.conflicts.sel(sensor=2).sum() > 0
    # The promise is for the largest noise of the record.
    largest = gx.Noise(w[0, -1], v[1, -1])
    assert_close(result.predicted_state_width.sel(sensor=1), plain["observer"].certificate.widths(largest))


def test_one_case_in_single_precision(plain):
    """No axis at all; and the bounds of either call are cast outward in the same way."""
    initial = gx.Interval.symmetric(np.float32([1.0, 2.0]))
    y = plain["y"].astype(np.float32)
    names = {"state_names": ["place", "speed"], "state_units": ["m", "m/s"], "input_units": ["N"], "title": "two"}
    result = gx.sweep(
        plain["observer"],
        initial,
        y,
        u=plain["u"],
        reduce=("boxes", "first_conflict"),
        time=np.arange(T) * 0.1,
        **names,
    )
    assert result.state_lower.dtype == np.float32
    assert (result.state_lower.dims, result.first_conflict.shape) == (("time", "state"), ())
    est = gx.estimate(plain["observer"], initial, y, u=plain["u"])
    np.testing.assert_allclose(result.state_lower, est.state.lower, rtol=2e-6, atol=2e-6)
    np.testing.assert_array_equal(result.status, est.status)
    assert result.state.values.tolist() == ["place", "speed"]
    assert result.state_unit.values.tolist() == ["m", "m/s"]
    assert "units" not in result.state_lower.attrs
    assert result.input_lower.attrs["units"] == "N"
    assert result.time.attrs["units"] == "s"
    assert result.attrs["title"] == "two"


def test_rounding_to_nearest_is_marked_and_narrower(plain, whole):
    given = {key: value for key, value in plain.items() if key != "observer"}
    sound = gx.sweep(plain["observer"], **given, reduce=("max",), rounding="outward")
    assert sound.attrs["guaranteed"] is True
    assert whole.attrs["guaranteed"] is False
    wider = sound.state_width_max - whole.state_width_max
    assert (wider > 0).all()
    assert (wider < 1e-12 * whole.state_width_max).all()
    with pytest.raises(ValueError, match="sweep: `rounding` must be"):
        gx.sweep(plain["observer"], **given, rounding="up")


def test_reductions_of_ones_own(whole):
    assert whole.lowest.dims == ("run",)
    assert whole.lowest.attrs["units"] == "m"
    assert whole.corners.dims == ("run", "corners_dim0", "corners_dim1")
    np.testing.assert_array_equal(whole.lowest, whole.corners[..., 0].min("corners_dim0"))
    np.testing.assert_array_equal(whole.steps, np.tile(np.arange(T), (11, 1)))


def test_a_long_study_computes_larger_programs_over_single_numbers(plain, in_tiles_of_four, monkeypatch):
    scan = importlib.import_module("gsisio_jax.scalar.scan")
    run, calls = scan.run, []
    monkeypatch.setattr(scan, "run", lambda *args: calls.append(1) or run(*args))
    monkeypatch.setattr(scan, "MOST_NUMBERS", 0)
    over_arrays = gx.sweep(**plain, batch=4, reduce="final")
    assert not calls
    monkeypatch.setattr(scan, "LONG_RUN", 100)  # 11 cases of 15 steps
    over_numbers = gx.sweep(**plain, batch=4, reduce="final")
    assert calls
    for found in (over_arrays, over_numbers):
        np.testing.assert_allclose(found.state_width_final, in_tiles_of_four.state_width_final, rtol=1e-9)


def test_a_store_holds_the_same_study_and_resumes(plain, in_tiles_of_four, tmp_path, monkeypatch):
    pytest.importorskip("zarr")
    stored = gx.sweep(**plain, batch=4, store=tmp_path / "study.zarr")
    for name in in_tiles_of_four.data_vars:
        np.testing.assert_array_equal(stored[name], in_tiles_of_four[name])
    module = importlib.import_module("gsisio_jax.study.job")
    monkeypatch.setattr(module, "run_cases", lambda *_: pytest.fail("computed again"))
    again = gx.sweep(**plain, batch=4, store=tmp_path / "study.zarr")
    np.testing.assert_array_equal(again.state_width_max, in_tiles_of_four.state_width_max)
    with pytest.raises(ValueError, match="another study"):
        gx.sweep(**plain | {"y": plain["y"] + 1}, batch=4, store=tmp_path / "study.zarr")


def test_the_fingerprint_tells_studies_apart_and_knows_a_study_again(study):
    arguments = study.arguments | {"truth": None}
    twin = replace(study.observer, system=replace_maps(study.observer.system))

    def of(observer=study.observer, reduce=SETTLED, **change):
        return fingerprint(observer, arguments | change, Recorded(), reduce, 7)

    assert of() == of(twin)
    moved = gx.grid("box", gx.Interval(study.initial.lower, np.nextafter(study.initial.upper, 9)))
    steeper = replace(study.observer, system=replace_maps(study.observer.system, 1.0000001))
    others = [of(initial=moved), of(steeper), of(reduce=(settle(5),)), of(reduce=(settle(4),))]
    # What is no array of the observer, and what a jitted part of f reads.
    system = study.observer.system
    others += [of(replace(study.observer, **change)) for change in ({"cells": (4, 1)}, {"corrections": 7})]
    plants = [replace_maps(system, jitted=add) for add in (1.0, 2.0)]
    plants += [replace_maps(system, input_constant=m) for m in (2, 3)]
    others += [of(replace(study.observer, system=plant)) for plant in plants]
    assert len({of(), *others}) == 11


SETTLED = (settle(3),)


def replace_maps(system, factor=None, jitted=None, **more):
    """The same plant with another function object for f, times a factor, or with an array added in a jitted part."""
    f = (lambda x: system.f(x)) if factor is None else (lambda x: factor * system.f(x))
    if jitted is not None:
        offset = np.full(system.n, jitted)
        added = jax.jit(lambda x: x + offset)
        f = lambda x: added(system.f(x))  # noqa: E731
    return gx.System(f, system.g, system.G, system.H, state_bounds=system.state_bounds, **more)


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_a_bar_appears_on_a_terminal_only(plain, in_tiles_of_four, monkeypatch):
    monkeypatch.setattr(importlib.import_module("gsisio_jax.study.bar"), "PATIENCE", 0.0)
    shown = []
    for stream in (Terminal(), io.StringIO()):
        with monkeypatch.context() as patch:
            patch.setattr(sys, "stderr", stream)
            gx.sweep(**plain, batch=4)
        shown.append(stream.getvalue())
    assert "/11.0" in shown[0]
    assert shown[1] == ""


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"reduce": "median"}, "unknown reduction 'median'; known are final, max, mean"),
        ({"reduce": ()}, "at least one"),
        ({"reduce": ("max", "max")}, "each of them once"),
        ({"reduce": ("coverage",)}, r"needs the truth; give truth=\(x, d\)"),
        ({"batch": 0}, "`batch` must be a number of cases per tile"),
        ({"state_names": ["only one"]}, "`state_names` has 1 entries, the system has 2"),
        ({"time": np.arange(3)}, r"`time` must have shape \(14,\)"),
        ({"on_conflict": "stop"}, '"restart" or "hold"'),
        ({"u": np.zeros((3, T, 1))}, "axis 'run' has 11 elements in `initial` and 3 in `u`"),
        ({"noise": gx.grid("level", gx.Noise(systems.ball([1.0, 1]), systems.ball([1.0, 1])))}, "no leading batch"),
    ],
)
def test_a_sweep_that_makes_no_sense_is_refused(plain, change, message):
    with pytest.raises(ValueError, match=f"^sweep: .*{message}"):
        gx.sweep(**plain | change)


def test_none_keeps_every_box():
    assert [reduction.name for reduction in resolve("sweep", None, truth=False)] == ["boxes"]


def test_nothing_settles_without_a_certificate():
    for steady, at in ((np.ones(2), 3.0), (np.array([1.0, np.inf]), np.nan)):
        np.testing.assert_array_equal(settle().finish(jnp.int32(3), 9, Context(steady))["settled_at"], at)


def test_quantiles_and_settling_refuse_nonsense():
    with pytest.raises(ValueError, match="between 0 and 1"):
        quantiles(95)
    with pytest.raises(ValueError, match="must be positive"):
        settle(0)


def test_quantiles_of_infinite_widths_are_numbers_or_infinite():
    widths = jnp.array([[3.0], [np.inf], [1.0], [np.inf]])
    np.testing.assert_array_equal(_quantiles(widths, 4, (0.0, 1 / 3, 0.5, 1.0))[:, 0], [1.0, 3.0, np.inf, np.inf])
    np.testing.assert_array_equal(_quantiles(widths, 3, (0.25,))[:, 0], [2.0])


def test_tiles_fill_the_memory_they_may_and_the_last_one_is_nearly_full():
    assert tile_size(1e12, 5) == 1
    for cases in (1, 1000, 70_000, 1_000_000):
        size = tile_size(4096.0, cases)
        tiles = -(-cases // size)
        assert size <= 65536
        assert tiles * size - cases < tiles


def test_a_clock_of_dates_is_seconds_since_1970_that_pictures_show_as_dates(plain):
    dates = pandas.date_range("2026-03-28 20:00", periods=T, freq="5min", tz="Europe/Berlin")
    system = plain["observer"].system

    def clock(time):
        labels = Labels.of("sweep", system, None, None, None, None, time, T)
        return xarray.DataArray(labels.time, dims="time", attrs=labels.clock).to_dataset(name="time")

    for time, zone in ((dates, "Europe/Berlin"), (dates.tz_localize(None), ""), (0.1 * np.arange(T), None)):
        assert zone_of(clock(time)) == zone
    assert clock(dates)["time"][0] == 1774724400.0
    with pytest.raises(ValueError, match="sweep: `time` has no date in row 1"):
        clock(np.array(["2026-03-28", "NaT"], "datetime64[s]").repeat([1, T - 1]))
