"""Heat maps and curves of studies: what is drawn is what is in the dataset, and failures are never hidden."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from matplotlib.collections import LineCollection, PolyCollection, QuadMesh
from matplotlib.figure import Figure
from plot.studies import LEVELS, SIZES, runs, swept, widths

from gsisio_jax import plot
from gsisio_jax.plot.scales import Scale, quantiles


def mesh_of(axis):
    (mesh,) = [one for one in axis.collections if isinstance(one, QuadMesh)]
    return mesh


def hatched(axis):
    return {one.get_label(): one for one in axis.collections if isinstance(one, PolyCollection)}


def line_of(axis, label):
    (line,) = [line for line in axis.lines if line.get_label() == label]
    return line


def legend_of(axes):
    return [text.get_text() for text in axes[0].figure.legends[0].get_texts()]


def bar_of(axis):
    return mesh_of(axis).colorbar


# Heat maps ------------------------------------------------------------------------------------------------------------
def test_a_heat_map_needs_no_arguments():
    axes = plot.heatmap(swept())
    assert len(axes) == 2
    figure = axes[0].figure
    assert figure.get_suptitle() == "Two tanks"
    assert [axis.get_title() for axis in axes] == ["tank level", "speed"]
    assert (axes[0].get_xlabel(), axes[0].get_ylabel()) == ("level [V]", "size [m]")
    assert (axes[1].get_xlabel(), axes[1].get_ylabel()) == ("level [V]", "")
    assert [bar_of(axis).ax.get_ylabel() for axis in axes] == ["last width [cm]", "last width [m/s]"]
    expected = widths()[np.argsort(SIZES), :, 0]
    expected[3, 5], expected[2, 0] = np.nan, np.nan
    drawn = np.ma.filled(mesh_of(axes[0]).get_array().reshape(4, 6), np.nan)
    np.testing.assert_array_equal(drawn, expected)
    assert set(legend_of(axes)) == {
        "infinite: not bounded", "no value", "border to widths above the certificate",
        "with conflicts: data contradict the bounds",
    }  # fmt: skip


def test_numeric_axes_are_to_scale_and_every_cell_holds_its_coordinate():
    (axis, _) = plot.heatmap(swept())
    assert (axis.get_xscale(), axis.get_yscale()) == ("log", "linear")
    corners = mesh_of(axis).get_coordinates()
    x, y = corners[0, :, 0], corners[:, 0, 1]
    np.testing.assert_allclose(x[1:-1], np.sqrt(LEVELS[1:] * LEVELS[:-1]))
    np.testing.assert_allclose(y, [0.5, 1.5, 2.5, 5.0, 9.0])


def test_cells_without_a_finite_value_are_hatched_where_they_are():
    (axis, _) = plot.heatmap(swept())
    found = hatched(axis)
    for label, size, level in (("infinite: not bounded", 7.0, LEVELS[5]), ("no value", 3.0, LEVELS[0])):
        (path,) = found[label].get_paths()
        assert path.contains_point((level, size))
        assert found[label].get_hatch()
    (axis,) = plot.heatmap(swept(), "settled_at")
    (path,) = hatched(axis)["never"].get_paths()
    assert all(path.contains_point((level, 7.0)) for level in LEVELS)


def test_the_border_runs_between_widths_above_and_below_the_certificate():
    (axis, _) = plot.heatmap(swept())
    (border,) = [one for one in axis.collections if isinstance(one, LineCollection)]
    # Widths are size * level, the certificate says 2.5 * level. The cell at (3, lowest level) is unknown.
    heights = {y for segment in border.get_segments() for _, y in segment}
    assert heights == {2.5}
    assert len(border.get_segments()) == len(LEVELS) - 1
    many = swept()
    many["state_width_final"] = many["state_width_final"] * 0 + 1e9
    (axis, _) = plot.heatmap(many)
    assert not [one for one in axis.collections if isinstance(one, LineCollection)]


def test_colors_are_logarithmic_where_the_numbers_call_for_it():
    flat = swept()
    flat["state_width_final"] = flat["state_width_final"].clip(5, 6)
    kinds = [type(mesh_of(axes[0]).norm).__name__ for axes in (
        plot.heatmap(swept()), plot.heatmap(flat), plot.heatmap(flat, log=True), plot.heatmap(swept(), log=False),
    )]  # fmt: skip
    assert kinds == ["LogNorm", "Normalize", "LogNorm", "Normalize"]
    with pytest.raises(ValueError, match="'state_width_final' has no positive values"):
        plot.heatmap(swept() * -1, log=True)


def test_one_number_everywhere_and_none_at_all_are_said():
    same = swept().assign(state_width_final=swept()["state_width_final"] * 0 + 1)
    for log in (None, True):
        (bar, _) = (bar_of(axis) for axis in plot.heatmap(same, log=log))
        assert bar.get_ticks().tolist() == [1.0]
    never = swept().assign(settled_at=swept()["settled_at"] * np.nan)
    (axis,) = plot.heatmap(never, "settled_at")
    assert axis.get_title() == "step of settling"
    assert legend_of([axis]) == ["never", "with conflicts: data contradict the bounds"]


def test_a_bit_mask_has_a_color_for_every_combination():
    (axis,) = plot.heatmap(swept(), "status_any")
    assert [text.get_text() for text in bar_of(axis).ax.get_yticklabels()] == ["OK", "unbounded", "conflict\nunbounded"]
    codes = mesh_of(axis).get_array().reshape(4, 6)
    assert codes[3].tolist() == [1] * 6
    assert codes[1].tolist() == [0, 2, 0, 0, 0, 0]


def test_categories_and_repeated_coordinates_have_one_place_each():
    for labels in (["one", "two", "three", "a name that is much too long for a tick"], [1.0, 1.0, 2.0, np.inf]):
        (axis, _) = plot.heatmap(swept().assign_coords(size=labels))
        assert mesh_of(axis).get_coordinates()[:, 0, 1].tolist() == [-0.5, 0.5, 1.5, 2.5, 3.5]
        assert axis.get_yticks().tolist() == [0, 1, 2, 3]
    assert len(Scale.of(xr.Dataset(coords={"n": [str(i) for i in range(500)]}), "n").words or []) == 500


def test_further_axes_are_drawn_by_median_or_worst_case_and_said():
    data = runs().expand_dims(gain=[1, 2])
    data["state_coverage"] = data["state_coverage"].transpose("level", "gain", "run", "state")
    axes = plot.heatmap(data, "state_coverage")
    assert axes[0].figure.get_suptitle() == "smallest over 60 cases (run)"
    assert mesh_of(axes[0]).get_array().min() == 0.9
    assert mesh_of(axes[1]).get_array().min() == 1.0
    axes = plot.heatmap(data, signal="x1")
    assert axes[0].figure.get_suptitle() == "median over 60 cases (run)"
    expected = np.median(runs()["state_width_final"].values[..., 0], axis=1)
    drawn = mesh_of(axes[0]).get_array().reshape(-1)
    np.testing.assert_allclose(np.unique(drawn), expected)
    axes = plot.heatmap(data, signal="x1", ax=Figure().subplots())
    assert axes.get_title() == "x1\nmedian over 60 cases (run)"


def test_long_axes_are_joined_without_losing_the_widest():
    width = np.ones((5000, 2, 1))
    width[4321, 1] = 50.0
    data = xr.Dataset({"state_width_final": (("box", "level", "state"), width)}, {"state": ["x1"]})
    (axis,) = plot.heatmap(data)
    assert mesh_of(axis).get_array().size == 2000
    assert mesh_of(axis).get_array().max() == 50.0
    assert axis.figure.get_suptitle() == "box: 5000 in 1000 groups, the worst of each"


# Curves ---------------------------------------------------------------------------------------------------------------
def test_few_cases_are_drawn_one_by_one_beside_the_certificate():
    axes = plot.curves(swept())
    assert axes[0].get_xlabel() == "level [V]"
    assert [axis.get_ylabel() for axis in axes] == ["last width [cm]", "last width [m/s]"]
    np.testing.assert_allclose(line_of(axes[1], "size = 2 m").get_ydata(), 20 * LEVELS)
    np.testing.assert_allclose(line_of(axes[1], "certificate: steady width").get_ydata(), 25 * LEVELS)
    assert line_of(axes[0], "certificate: steady width").get_linestyle() == "--"
    (triangles,) = [line for line in axes[0].lines if line.get_label() == "infinite"]
    assert triangles.get_xdata().tolist() == [LEVELS[5]]
    (axis,) = plot.curves(swept(), signal="leak")
    np.testing.assert_allclose(line_of(axis, "size = 1 m").get_ydata(), 3 * LEVELS)
    np.testing.assert_allclose(line_of(axis, "certificate: steady width").get_ydata(), 9 * LEVELS)


def test_many_cases_are_median_band_and_worst():
    data = runs()
    (axis, _) = plot.curves(data)
    width = data["state_width_final"].values[..., 0]
    np.testing.assert_allclose(line_of(axis, "median of 60 cases").get_ydata(), np.median(width, axis=1))
    np.testing.assert_allclose(line_of(axis, "largest of them").get_ydata(), width.max(axis=1))
    (band,) = [one for one in axis.collections if one.get_label() == "5 to 95 % of them"]
    corners = band.get_paths()[0].vertices
    for level, low, high in zip(LEVELS, *np.quantile(width, (0.05, 0.95), axis=1), strict=True):
        mine = corners[np.isclose(corners[:, 0], level), 1]
        np.testing.assert_allclose([mine.min(), mine.max()], [low, high])
    (axis, _) = plot.curves(data, "state_coverage")
    assert line_of(axis, "smallest of them").get_ydata().tolist() == [1, 1, 0.9, 1, 1, 1]
    (axis, _) = plot.curves(data, x="run")
    for label in ("level = 0.01", "level = 10"):
        # Six levels are more than are drawn one by one.
        assert label not in axis.get_legend_handles_labels()[1]
    promised = [line for line in axis.lines if line.get_linestyle() == "--"]
    assert sorted(float(line.get_ydata()[0]) for line in promised) == pytest.approx([0.03, 30.0])


def test_a_summary_shows_the_mean_with_its_confidence():
    (axis, _) = plot.curves(runs(), "state_width_final_summary")
    labels = axis.get_legend_handles_labels()[1]
    assert labels == ["mean", "95 % confidence of the mean", "largest", "certificate: steady width"]
    mean = runs()["state_width_final"].values[..., 0].mean(1)
    np.testing.assert_allclose(line_of(axis, "mean").get_ydata(), mean)


def test_quantiles_keep_infinite_and_unknown_values_at_the_bad_end():
    values = np.array([[1.0, 1.0], [np.inf, np.nan], [2.0, 2.0], [3.0, 3.0]])
    expected = [[1, 1], [2, 2], [2.5, 2.5], [np.inf, np.nan]]
    np.testing.assert_array_equal(quantiles(values, (0.0, 1 / 3, 0.5, 1.0)), expected)
    rng = np.random.default_rng(0).random((17, 3))
    np.testing.assert_allclose(quantiles(rng, (0.05, 0.5)), np.quantile(rng, (0.05, 0.5), axis=0))
    assert np.isinf(quantiles(values[:3], (0.9,))[0, 0])


# Mistakes -------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: plot.heatmap(swept().isel(size=0)), "heatmap: 2 swept axes are needed, the dataset has level: 6"),
        (lambda: plot.curves(swept().isel(size=0, level=0)), "curves: 1 swept axis is needed, the dataset has none"),
        (lambda: plot.heatmap(swept(), "width"), "no variable 'width' to draw; there are: state_width_final"),
        (lambda: plot.heatmap(swept(), signal="tank"), "no signal 'tank'; the signals are: tank_level, speed, leak"),
        (lambda: plot.curves(swept(), "settled_at", signal="leak"), "'settled_at' has no signal 'leak'; .* none"),
        (lambda: plot.heatmap(swept(), x="noise"), "has no axis 'noise'; its axes are: size, level"),
        (lambda: plot.heatmap(swept(), x="size", y="size"), "x and y are both 'size'; give two of: size, level"),
        (lambda: plot.curves(swept(), x="noise"), "has no axis 'noise'; its axes are: size, level"),
        (lambda: plot.heatmap([1, 2]), "heatmap: expected the dataset of gx.sweep or gx.monte_carlo, got list"),
        (lambda: plot.curves(swept(), ax=Figure().subplots()), "`ax` has 1 axes for 2 signals"),
    ],
)  # fmt: skip
def test_mistakes_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_one_axes_comes_back_as_it_is():
    for draw in (plot.heatmap, plot.curves):
        axis = Figure().subplots()
        assert draw(swept(), signal="speed", ax=axis) is axis
        assert axis.get_xlabel() == "level [V]"


def test_one_selected_signal_is_still_known():
    (axis,) = plot.heatmap(swept().isel(state=1))
    assert axis.get_title() == "speed"
    assert bar_of(axis).ax.get_ylabel() == "last width [m/s]"


def test_cases_with_conflicts_are_drawn_differently():
    """The element (size 2, second level) of the study has conflicts."""
    data = swept().sel(size=[1.0, 2.0])
    (axis, _) = plot.curves(data, x="level")
    plain, broken = (line_of(axis, f"size = {size} m") for size in (1, 2))
    assert (plain.get_linestyle(), broken.get_linestyle()) == ("-", "-.")
    cross = line_of(axis, "with conflicts")
    np.testing.assert_allclose(cross.get_xydata(), [[LEVELS[1], 2 * LEVELS[1]]])
    clean = swept().drop_vars("status_any")
    assert "with conflicts" not in legend_of(plot.curves(clean.sel(size=[1.0, 2.0]), x="level"))
    (axis, _) = plot.heatmap(swept())
    (path,) = hatched(axis)["with conflicts: data contradict the bounds"].get_paths()
    assert path.contains_point((LEVELS[1], 2.0))
    assert not path.contains_point((LEVELS[2], 2.0))


def test_conflicts_of_some_of_many_cases():
    data = runs()
    count = np.zeros((6, 60), int)
    count[1, 7], count[3] = 2, 1
    data["conflicts"] = (("level", "run"), count)
    (axis, _) = plot.curves(data, "state_width_final")
    np.testing.assert_allclose(line_of(axis, "conflicts in some cases").get_xdata(), LEVELS[[1]])
    np.testing.assert_allclose(line_of(axis, "conflicts in all cases").get_xdata(), LEVELS[[3]])
