"""Widths, funnels and framers of studies that kept their boxes."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure
from plot.studies import TIME, kept

from gsisio_jax import dataset, plot
from gsisio_jax.interval import Interval

CERTIFICATE = SimpleNamespace(settled_widths=(np.array([0.25]), np.array([0.75])))


def line_of(axis, label):
    (line,) = [line for line in axis.lines if line.get_label() == label]
    return line


def estimates(*lead):
    """Estimates of one state and one input with a box of radius 1 + k."""
    radius = np.broadcast_to(1.0 + np.arange(20)[:, None], (*lead, 20, 1))
    return SimpleNamespace(
        state=Interval(-radius, radius), input=Interval(-radius[..., 1:, :], radius[..., 1:, :]),
        status=np.zeros((*lead, 20), int), alarms=lambda: [], margin=np.zeros((*lead, 20)),
    )  # fmt: skip


def test_widths_by_noise_level_beside_their_certificates():
    axes = plot.widths(kept())
    assert [axis.get_ylabel().replace("\n", " ") for axis in axes] == ["width of position [m]", "width of force"]
    assert axes[1].get_xlabel() == "time [s]"
    width = (kept()["state_upper"] - kept()["state_lower"]).values[..., 0]
    # The lowest, the middle and the highest level, whatever their order.
    for index, level in ((1, "0.1"), (3, "0.3"), (0, "0.4")):
        line = line_of(axes[0], f"median of 30 cases, level = {level} V")
        np.testing.assert_allclose(line.get_ydata(), np.median(width[:, index], axis=0))
        dashed = [one for one in axes[0].lines if one.get_linestyle() == "--" and one.get_color() == line.get_color()]
        assert dashed[0].get_ydata()[0] == pytest.approx(2.2 * float(level))
    # No width of the input is certified.
    assert not [one for one in axes[1].lines if one.get_linestyle() == "--"]


def test_widths_of_one_level():
    data = kept().isel(level=2)
    (axis,) = plot.widths(data, "position")
    assert axis.get_yscale() == "linear"
    assert axis.get_title(loc="right") == "largest last 0.401, certificate 0.44"
    width = (data["state_upper"] - data["state_lower"]).values[..., 0]
    np.testing.assert_allclose(line_of(axis, "largest of them").get_ydata(), width.max(axis=0))
    assert axis.figure.get_suptitle() == "level = 0.2 V"
    data["state_upper"][4, 6] = np.inf
    (axis,) = plot.widths(data, "position")
    assert line_of(axis, "some not bounded").get_xdata().tolist() == [TIME[6]]


def test_widths_of_estimates():
    (x, d) = plot.widths(estimates(), certificate=CERTIFICATE)
    np.testing.assert_array_equal(line_of(x, "width of the guaranteed box").get_ydata(), 2.0 + 2 * np.arange(20))
    assert line_of(d, "certificate: steady width").get_linestyle() == "--"
    assert [line.get_ydata()[0] for axis in (x, d) for line in axis.lines[1:2]] == [0.25, 0.75]
    assert d.get_title(loc="right") == "last 40, certificate 0.75"
    (x, _) = plot.widths(estimates(3, 4))
    assert line_of(x, "median of 12 cases").get_ydata()[0] == 2.0
    labelled = dataset.to_dataset(estimates(), state_names=["position"], state_units=["m"])
    (x, d) = plot.widths(labelled, certificate=CERTIFICATE)
    assert [axis.lines[1].get_ydata()[0] for axis in (x, d)] == [0.25, 0.75]
    assert x.get_ylabel() == "width of position\n[m]"


def test_long_records_keep_their_widest_box():
    long = estimates()
    radius = np.ones((50_001, 1))
    radius[12_345] = 5.0
    long.state, long.input = Interval(-radius, radius), Interval(-radius[1:], radius[1:])
    long.status = np.zeros(50_001, int)
    line = line_of(plot.widths(long, "x1")[0], "width of the guaranteed box")
    assert len(line.get_ydata()) <= 3000
    assert line.get_ydata().max() == 10.0


def test_steps_with_conflicts_are_marked():
    """The status of every case of the study is CONFLICT at step 9; the first four of the second one are clean."""
    data = kept(8).isel(level=2)
    data["status"][:4] = 0
    (axis,) = plot.widths(data, "position")
    assert line_of(axis, "conflict in some cases").get_xdata().tolist() == [TIME[9]]
    assert line_of(axis, "median of 8 cases").get_linestyle() == "-."
    (axis,) = plot.funnel(data)
    assert line_of(axis, "conflict").get_xdata().tolist() == [TIME[9]]
    assert sum(line.get_linestyle() == "-." for line in axis.lines) == 8  # both sides of four cases
    est = estimates()
    est.status[[3, 5]] = 1
    (x, _) = plot.widths(est)
    assert line_of(x, "conflict").get_xydata().tolist() == [[3, 8.0], [5, 12.0]]
    assert line_of(x, "width of the guaranteed box").get_linestyle() == "-."
    (x, _) = plot.widths(estimates())
    assert line_of(x, "width of the guaranteed box").get_linestyle() == "-"


def hull_of(axis):
    band = next(one for one in axis.collections if str(one.get_label()).startswith("hull of"))
    return band.get_paths()[0].vertices


def test_a_funnel_is_drawn_around_the_truth():
    data = kept().isel(level=2)
    (axis,) = plot.funnel(data, truth={"position": np.sin(TIME)})
    assert axis.get_ylabel().replace("\n", " ") == "position minus truth [m]"
    corners = hull_of(axis)
    for when in TIME:
        mine = corners[np.isclose(corners[:, 0], when), 1]
        half = 0.2 + 5 * np.exp(-when)
        np.testing.assert_allclose([mine.min(), mine.max()], [-half, half])
    (bar,) = [one for one in axis.collections if hasattr(one, "get_segments")]
    ends = bar.get_segments()[0]
    assert ends[1, 1] - ends[0, 1] == pytest.approx(0.44)
    assert ends[0, 0] > TIME[-1]


def test_a_funnel_without_truth_is_drawn_as_it_is_if_it_can_have_one():
    data = kept()
    (axis,) = plot.funnel(data)
    assert axis.get_ylabel() == "position\n[m]"
    assert axis.figure.get_suptitle() == "level = 0.3 V"
    assert hull_of(axis)[:, 1].max() == pytest.approx(5.3)
    # Shifted apart, the boxes cannot be about one truth.
    shift = 100.0 * np.arange(30)[:, None, None, None]
    for side in ("lower", "upper"):
        data[f"state_{side}"] = data[f"state_{side}"] + shift
    (axis,) = plot.funnel(data, "position")
    assert axis.get_ylabel().replace("\n", " ") == "position minus middle of box [m]"
    assert hull_of(axis)[:, 1].max() == pytest.approx(5.3)
    truth = np.sin(TIME) + shift[..., 0]
    (axis,) = plot.funnel(data, truth={"position": np.broadcast_to(truth, (30, 4, 20))})
    assert hull_of(axis)[:, 1].max() == pytest.approx(5.3)


def test_framers_of_one_case_of_a_study():
    axes = plot.framers(kept().isel(box=3, level=1), truth={"position": np.sin(TIME), "force": np.zeros(21)})
    assert [axis.get_ylabel() for axis in axes] == ["position\n[m]", "force"]
    figure = axes[0].figure
    assert figure.get_suptitle() == "level = 0.1 V"
    labels = {text.get_text() for text in figure.legends[0].get_texts()}
    assert labels == {"no measurement", "guaranteed box", "certified alarm", "truth"}
    assert [line.get_xdata()[0] for line in axes[0].lines if line.get_label() == "certified alarm"] == [TIME[9]]
    one = kept().isel(box=[3], level=[1])
    assert len(plot.framers(one)) == 2


def test_a_kept_study_has_heat_maps_and_curves_too():
    (axis,) = plot.heatmap(kept())
    mesh = axis.collections[0]
    assert mesh.colorbar.ax.get_ylabel() == "last width [m]"
    last = (kept()["state_upper"] - kept()["state_lower"]).values[:, [1, 2, 3, 0], -1, 0]
    np.testing.assert_allclose(mesh.get_array().reshape(30, 4), last)
    (axis,) = plot.heatmap(kept().isel(level=0))
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("time [s]", "box")
    (axis,) = plot.curves(kept(), signal="force")
    # The input box of the last row is not known: the one before is drawn.
    width = (kept()["input_upper"] - kept()["input_lower"]).values[:, [1, 2, 3, 0], -2, 0]
    np.testing.assert_allclose(line_of(axis, "median of 30 cases").get_ydata(), np.median(width, axis=0))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: plot.framers(kept()), r"many \(box: 30, level: 4\); take one by .isel\(box=0, level=0\)"),
        (lambda: plot.widths(kept()[["status"]]), "widths: the dataset has no boxes over time"),
        (
            lambda: plot.widths(kept(), ["speed"]),
            "no signal 'speed'; the signals are: position, force",
        ),
        (lambda: plot.widths(kept(), certificate=3), "must be that of an observer .* got int"),
        (
            lambda: plot.widths(estimates(), certificate=SimpleNamespace(settled_widths=([1, 2], [1]))),
            "system with 2 states, here are 1: x1",
        ),
        (lambda: plot.widths([1.0]), "widths: expected an estimate, .* got list"),
        (lambda: plot.funnel(kept(), truth={"speed": TIME}), "funnel: there is no signal 'speed'"),
        (
            lambda: plot.funnel(kept(), truth={"position": TIME[:5]}),
            r"truth of 'position' must have shape \(20,\) or \(30, 4, 20\), got \(5,\)",
        ),
        (lambda: plot.funnel(kept(), ax=Figure().subplots(2)), "`ax` has 2 axes for 1 signals"),
    ],
)
def test_mistakes_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()
