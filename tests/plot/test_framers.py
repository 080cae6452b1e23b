"""Pictures: every panel is labelled without arguments, boxes are never drawn too small, mistakes are named."""

from __future__ import annotations

import json
import subprocess
import sys
from types import SimpleNamespace

import matplotlib.dates
import numpy as np
import pytest

from gsisio_jax import dataset, plot
from gsisio_jax.interval import Interval
from gsisio_jax.observer.alarms import Alarm
from gsisio_jax.observer.status import Status
from gsisio_jax.plot._framers import thinned
from gsisio_jax.plot.style import MAXIMUM_POINTS

STEPS = 30


@pytest.fixture
def est():
    """An estimate with two states and one input: wide at first, unbounded at 10, missing at 10, alarm at 20."""
    center = np.stack([np.sin(0.2 * np.arange(STEPS)), np.cos(0.2 * np.arange(STEPS))], axis=1)
    radius = np.full((STEPS, 2), 0.1)
    radius[0], radius[10, 0] = 1e6, np.inf
    status = np.zeros(STEPS, dtype=int)
    status[10], status[20] = Status.MISSING | Status.UNBOUNDED, Status.CONFLICT
    return SimpleNamespace(
        state=Interval(center - radius, center + radius),
        input=Interval(center[1:, :1] - 2, center[1:, :1] + 2),
        status=status,
        margin=np.where(status & 1, -0.5, 1.0),
        alarms=lambda: [Alarm(20, "state", 1, (), 0.5)],
    )


@pytest.fixture
def data(est):
    y = np.asarray(est.state.center).copy()
    y[10] = np.nan
    return dataset.to_dataset(
        est,
        time=0.5 * np.arange(STEPS),
        state_names=["left_tank", "right_tank"],
        state_units=["cm", "cm"],
        input_names=["leak"],
        input_units=["cm/s"],
        output_names=["left_tank_measured", "right_tank"],
        output_units=["cm", "cm"],
        y=y,
        title="Two tanks",
    )


def texts(axes):
    return [axis.get_ylabel().replace("\n", " ") for axis in axes]


@pytest.mark.parametrize("zone", ["", "Europe/Berlin", "+02:00"])
def test_dates_at_the_axis(est, data, zone):
    """From dates, and from seconds that say that they count from 1970; in the zone that is said."""
    dates = np.datetime64("2024-05-01T10:00:00", "ns") + 500_000_000 * np.arange(STEPS)
    dated = dataset.to_dataset(est, time=dates)
    assert json.loads(dated.attrs["alarms"])[0]["time"] == "2024-05-01T10:00:10"
    seconds = data.assign_coords(time=("time", 1714557600 + 0.5 * np.arange(STEPS), {"units": "s", "epoch": "1970"}))
    seconds.attrs["alarms"] = json.dumps([{"time": 1714557610.0}])
    for source in (dated, seconds):
        if zone:
            source["time"].attrs["zone"] = zone
        axis = plot.framers(source)[-1]
        axis.figure.canvas.draw()
        assert axis.get_xlabel() == (f"time ({zone})" if zone else "time")
        shown = axis.xaxis.get_major_formatter().format_ticks(axis.get_xticks())
        assert f"{12 if zone else 10}:00" in shown
        (alarm,) = (line for line in axis.lines if line.get_label() == "certified alarm")
        found = matplotlib.dates.num2date(alarm.get_xdata()[0]).timestamp()
        assert found == pytest.approx(1714557610, abs=1e-3)
        axis = plot.widths(source)[-1]
        assert axis.get_xlabel() == (f"time ({zone})" if zone else "time")


def test_a_dataset_needs_no_arguments(data):
    axes = plot.framers(data)
    assert texts(axes) == ["left tank [cm]", "right tank [cm]", "leak [cm/s]"]
    figure = axes[0].figure
    assert axes[-1].get_xlabel() == "time [s]"
    assert axes[0].get_xlabel() == ""
    assert figure.get_suptitle() == "Two tanks"
    labels = {text.get_text() for text in figure.legends[0].get_texts()}
    assert labels == {
        "no measurement", "guaranteed box (full height: not bounded)", "measured", "certified alarm",
    }  # fmt: skip


def test_many_alarms_are_one_object_with_one_label(data):
    times = [0.25 * step for step in range(60)]
    data.attrs["alarms"] = json.dumps([{"time": time} for time in times])
    axis = plot.framers(data, ["leak"])[0]
    (lines,) = (one for one in axis.collections if one.get_label() == "certified alarm")
    assert [segment[0][0] for segment in lines.get_segments()] == times
    assert [text.get_text() for text in axis.figure.legends[0].get_texts()].count("certified alarm") == 1


def test_widths_in_words_of_the_dataset(data):
    data["leak_lower"].attrs["widths"] = "width: mean 4, last 4"
    assert plot.framers(data, ["leak"])[0].get_title(loc="right") == "width: mean 4, last 4"


def test_measurements_find_their_signal_by_name_and_unit(est):
    def drawn(output_names, output_units):
        data = dataset.to_dataset(
            est,
            state_names=["east", "velocity_east"],
            state_units=["m", "m/s"],
            input_names=["force"],
            output_names=output_names,
            output_units=output_units,
            y=np.zeros((STEPS, 2)),
        )
        axes = plot.framers(data)
        return ["measured" in axis.get_legend_handles_labels()[1] for axis in axes]

    assert drawn(["reported_velocity_east", "northeast"], ["m/s", "m"]) == [False, True, False]
    assert drawn(["east", "force"], ["m", "N"]) == [True, False, False]


def test_a_huge_first_box_does_not_set_the_scale(data):
    for axis in plot.framers(data, ["left_tank", "right_tank"]):
        low, high = axis.get_ylim()
        assert -2 < low < -1
        assert 1 < high < 2


def test_an_estimate_is_drawn_with_numbered_names(est):
    axes = plot.framers(est, truth={"x1": np.zeros(STEPS), "d1": np.zeros(STEPS - 1)})
    assert texts(axes) == ["x1", "x2", "d1"]
    assert axes[-1].get_xlabel() == "step"
    assert "truth" in axes[0].get_legend_handles_labels()[1]
    assert "truth" not in axes[1].get_legend_handles_labels()[1]


def test_edges_end_where_the_band_of_an_input_ends(data):
    (axis,) = np.atleast_1d(plot.framers(data, signals=["leak"]))
    band = max(path.vertices[:, 0].max() for collection in axis.collections for path in collection.get_paths()[:1])
    edges = [line.get_xdata() for line in axis.lines if line.get_drawstyle() == "steps-mid"]
    assert [x.max() for x in edges] == [0.5 * (STEPS - 2)] * 2
    assert band == 0.5 * (STEPS - 2)


def test_own_axes_are_returned(data):
    from matplotlib.figure import Figure

    one = Figure().subplots()
    assert plot.framers(data, ["leak"], ax=one) is one
    assert one.get_xlabel() == "time [s]"
    several = Figure().subplots(2, 2)
    assert len(plot.framers(data, ax=several.ravel()[:3])) == 3
    with pytest.raises(ValueError, match="`ax` has 1 axes for 3 signals"):
        plot.framers(data, ax=one)


@pytest.mark.parametrize("count", [1, 5, 6, 7, 12])
def test_layouts_label_the_lowest_panels(est, count, tmp_path):
    box = Interval(np.zeros((STEPS, count)), np.ones((STEPS, count)))
    est.state, est.input = box, Interval(np.zeros((STEPS - 1, 0)), np.zeros((STEPS - 1, 0)))
    axes = plot.framers(est)
    assert len(axes) == count
    assert sum(axis.get_xlabel() == "step" for axis in axes) == (1 if count < 6 else 2)
    plot.save(est, tmp_path / "boxes.png")
    assert (tmp_path / "boxes.png").read_bytes().startswith(b"\x89PNG")


def test_thinning_keeps_every_box_inside():
    rng = np.random.default_rng(0)
    time = np.arange(50_001.0)
    lower = rng.normal(size=time.size)
    upper = lower + rng.random(time.size)
    at, bottom, top = thinned(time, lower, upper)
    assert len(at) <= MAXIMUM_POINTS
    group = np.searchsorted(at, time, side="right") - 1
    assert (bottom[group] <= lower).all()
    assert (upper <= top[group]).all()


def test_a_signal_that_is_never_bounded_is_drawn(est):
    est.state = Interval.entire((STEPS, 2))
    axes = plot.framers(est)
    assert axes[0].get_title(loc="right") == "never bounded"


def test_mistakes_are_named(data, est):
    with pytest.raises(ValueError, match="no signal 'tank'; the signals are: left_tank, right_tank, leak"):
        plot.framers(data, ["tank"])
    with pytest.raises(ValueError, match=r"truth of 'leak' must have shape \(30,\), got \(3,\)"):
        plot.framers(data, truth={"leak": [1, 2, 3]})
    est.state = Interval(np.zeros((4, STEPS, 2)), np.ones((4, STEPS, 2)))
    with pytest.raises(ValueError, match="one record is needed"):
        plot.framers(est)
    with pytest.raises(ValueError, match="must hold one record"):
        dataset.to_dataset(est)


def test_dataset_mistakes_are_named(est):
    with pytest.raises(ValueError, match="`state_names` has 1 entries, the estimate has 2"):
        dataset.to_dataset(est, state_names=["a"])
    with pytest.raises(ValueError, match=r"`time` must have shape \(30,\), got \(3,\)"):
        dataset.to_dataset(est, time=[1, 2, 3])
    with pytest.raises(ValueError, match=r"`y` must have shape \(30, l\), got \(3, 1\)"):
        dataset.to_dataset(est, y=np.zeros((3, 1)))


def test_dataset_has_defaults_for_everything(est):
    data = dataset.to_dataset(est)
    assert list(data.data_vars) == [
        "x1_lower", "x1_upper", "x2_lower", "x2_upper", "d1_lower", "d1_upper", "status", "margin",
    ]  # fmt: skip
    assert data["time"].values.tolist() == list(range(STEPS))
    assert np.isnan(data["d1_lower"].values[-1])


def test_a_missing_package_is_one_line():
    code = (
        "import sys; sys.modules['matplotlib'] = None; sys.modules['xarray'] = None\n"
        "from gsisio_jax import dataset, plot\n"
        "drawn = [(getattr(plot, name), [None]) for name in ('framers', 'widths', 'heatmap', 'curves', 'funnel')]\n"
        "for call, arguments in (*drawn, (plot.save, [None, 'x.png']), (dataset.to_dataset, [None])):\n"
        "    try: call(*arguments)\n"
        "    except ImportError as error: print(error)\n"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    line = "drawing a picture needs matplotlib; install it with: pip install 'gsisio_jax[plot]'"
    other = "a labelled dataset needs xarray; install it with: pip install 'gsisio_jax[cli]'"
    assert out.splitlines() == [line] * 6 + [other]


def test_importing_the_library_loads_no_optional_package():
    code = (
        "import sys, gsisio_jax, gsisio_jax.plot, gsisio_jax.dataset, gsisio_jax.cli\n"
        "print([m for m in ('pandas', 'matplotlib', 'xarray', 'pydantic', 'rich', 'netCDF4', 'cvxpy') "
        "if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
