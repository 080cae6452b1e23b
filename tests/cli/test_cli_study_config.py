"""Tables ``[sweep]`` and ``[monte_carlo]``: one line for every mistake, and what they mean. No observer is run here."""

from __future__ import annotations

import sys
import types
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
import pytest
from cart_study import CONFIG, lines_of_table, problem_of, run, write

import gsisio_jax as gx
from gsisio_jax import Interval, examples
from gsisio_jax.cli import main
from gsisio_jax.cli.config import read_config
from gsisio_jax.cli.errors import UserError
from gsisio_jax.cli.labelled import date_attributes
from gsisio_jax.cli.logs.config import TablePart
from gsisio_jax.cli.problem import importable, used_box
from gsisio_jax.cli.study_arguments import UniformInput, initial_of, noise_of, read_records, simulated
from gsisio_jax.examples import paper


@pytest.fixture(scope="module")
def cart(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder of the table; the model can be imported."""
    path = tmp_path_factory.mktemp("cart")
    write(path)
    with importable(path):
        yield path


PUSH = '"study_cart_model:push"'
MISTAKES = {
    "no table": ("sweep", "[table]\n", "[tabel]\n", ["unknown section tabel", "did you mean table?"]),
    "axis": ("sweep", "[sweep.axes.noise]", "[sweep.axes.niose]", ["sweep.axes.niose", "did you mean noise?"]),
    "axis key": ("sweep", "scale = [1, 2, 4]", "scales = [1]", ["sweep.axes.noise.scales", "did you mean scale?"]),
    "alias": ("monte-carlo", "from = 0.5", "form = 0.5", ["monte_carlo.axes.noise.form", "did you mean from?"]),
    "ends": ("monte-carlo", "count = 3\n", "", ["monte_carlo.axes.noise: needs scale = [...], or from, to and count"]),
    "both": ("sweep", "[1, 2, 4]", "[1]\nto = 3", ["sweep.axes.noise: give either scale or from"]),
    "log": ("monte-carlo", "from = 0.5", "from = 0", ['spacing = "log" needs from and to above 0']),
    "negative": ("sweep", "[1, 2, 4]", "[1, -2]", ["every scale must be a finite number"]),
    "infinite": ("sweep", "[1, 2, 4]", "[1, inf]", ["every scale must be a finite number"]),
    "twice": ("sweep", "[1, 2, 4]", "[1, 2, 1]", ["a scale is there twice"]),
    "no scale": ("sweep", "[1, 2, 4]", "[]", ["scale has no entry"]),
    "reduction": ("sweep", "batch = 2", 'reduce = ["finall"]', ['unknown reduction "finall"; did you mean final?']),
    "reductions": ("sweep", "batch = 2", "reduce = [3]", ["sweep.reduce: 3 is no reduction; known are final"]),
    "no reduction": ("sweep", "batch = 2", "reduce = []", ["sweep.reduce: must name at least one of final"]),
    "same twice": ("sweep", "batch = 2", 'reduce = ["max", "max"]', ["sweep.reduce: max is there 2 times"]),
    "quantile": ("sweep", "batch = 2", "reduce = [{quantiles = [2]}]", ["sweep.reduce: quantiles", "between 0 and 1"]),
    "truth": ("sweep", "batch = 2", 'reduce = ["error"]', ["sweep: reduce", "needs the truth", "monte-carlo"]),
    "picture": ("sweep", "batch = 2", 'picture = "rms"', ["sweep: picture", "one of those in reduce"]),
    "batch": ("sweep", "batch = 2", "batch = 0", ["sweep.batch must be greater than or equal to 1"]),
    "records": ("sweep", "batch = 2", 'records = "old/*.csv"', ["sweep.records: no file matches old/*.csv"]),
    "record kind": ("sweep", "batch = 2", "records = [3]", ["sweep.records: must be a file, a pattern"]),
    "columns": ("sweep", 'y = ["pos", "vel"]', 'y = ["pos"]', ["table.y has 1 column, the system has 2 outputs"]),
    "unbounded": ("sweep", "upper = [10.0, 12.0]", "upper = [10.0, inf]", ["sweep.axes.initial", "must be bounded"]),
    "runs": ("monte-carlo", "runs = 20", "runs = 0", ["monte_carlo.runs: must be a number of runs, at least 1"]),
    "no runs": ("monte-carlo", "runs = 20\n", "", ["monte_carlo.runs is missing"]),
    "steps": ("monte-carlo", "steps = 12", "steps = 1.5", ["monte_carlo.steps must be a valid integer", "1.5"]),
    "draw": (
        "monte-carlo",
        '"study_cart_model:corner"',
        '"corners"',
        ['monte_carlo.draw: must be "uniform", "vertices" or'],
    ),
    "draw kind": ("monte-carlo", "model:corner", "model:NUMBER", ["draw", "must be a function, got int"]),
    "amplitude": ("monte-carlo", PUSH, "{amplitude = [3, 1]}", ["d.amplitude has 2 values, the system has 1"]),
    "amplitude sign": ("monte-carlo", PUSH, "{amplitude = [-3.0]}", ["monte_carlo.d: amplitude must hold finite"]),
    "input": ("monte-carlo", PUSH, "{size = [3.0]}", ["monte_carlo.d: must read", "{amplitude ="]),
    "input name": ("monte-carlo", PUSH, '"study_cart_model:pull"', ["monte_carlo.d", "no attribute pull"]),
    "x0 size": ("monte-carlo", "steps = 12", "steps = 12\nx0 = {radius = [1]}", ["monte_carlo.x0 has 1 values"]),
    "x0 outside": (
        "monte-carlo",
        "steps = 12",
        "steps = 12\nx0 = {radius = [1, 11]}",
        ["x0 leaves the", "in velocity"],
    ),
    "x0 missing": ("monte-carlo", "upper = [10.0, 12.0]", "upper = [10.0, inf]", ["give monte_carlo.x0"]),
    "known input": (
        "monte-carlo",
        "_model:cart",
        "_model:pushed",
        ["monte_carlo.u is missing", "1 known input: give", "u = [0.0]"],
    ),
    "function of a known input": (
        "monte-carlo",
        "steps = 12",
        'steps = 12\nu = "study_cart_model:push"',
        ["push, called with the number of steps, raised TypeError", "it must return an array (steps, 0)"],
    ),
    "no known input": ("monte-carlo", "steps = 12", "steps = 12\nu = [1]", ["monte_carlo.u has 1 values", "no known"]),
}


@pytest.mark.parametrize(("command", "old", "new", "parts"), MISTAKES.values(), ids=MISTAKES.keys())
def test_a_mistake_is_one_line_and_costs_nothing(cart, tmp_path, command, old, new, parts):
    text = CONFIG.replace('"cart.csv"', f"'{cart / 'cart.csv'}'")
    # Tables of the other command are left out: a mistake would be found in both.
    cut = text.index("[monte_carlo]")
    text = text[:cut] if command == "sweep" else text[: text.index("[table]")] + text[cut:]
    assert old in text
    (tmp_path / "cart.toml").write_text(text.replace(old, new))
    code, out, err = run(command, str(tmp_path / "cart.toml"), "--out", str(tmp_path / "out"))
    assert (code, out, err.count("\n")) == (2, "", 1), err
    assert err.startswith("gsisio: cart.toml: "), err
    for part in parts:
        assert part in err
    assert not (tmp_path / "out").exists()


def test_tables_that_a_command_needs(cart, tmp_path):
    text = CONFIG
    without = {
        "monte-carlo": (text[: text.index("[monte_carlo]")], "monte_carlo is missing"),
        "sweep": (text[: text.index("[sweep]")], "sweep is missing"),
    }
    begin, end = text.index("[table]"), text.index("[sweep]")
    alone = text[:begin] + text[end:]
    nothing = text[: text.index("[sweep.axes")]
    for command, (config, part) in [
        *without.items(), ("sweep", (alone, "table is missing")), ("estimate", (alone, "table is missing")),
        ("sweep", (nothing, "nothing varies")),
    ]:  # fmt: skip
        (tmp_path / "cart.toml").write_text(config.replace('"cart.csv"', f"'{cart / 'cart.csv'}'"))
        code, out, err = run(command, str(tmp_path / "cart.toml"), "--out", str(tmp_path / "out"))
        assert (code, out, err.count("\n")) == (2, "", 1), err
        assert part in err


def test_reductions_with_numbers(cart, tmp_path):
    names = '["final", {quantiles = [0.5, 0.9]}, {settle = 3}]'
    config, _ = problem_of(tmp_path, 'reduce = ["final"]', f"reduce = {names}")
    assert config.monte_carlo is not None
    assert config.monte_carlo.reduce == ["final", gx.study.quantiles(0.5, 0.9), gx.study.settle(3)]


def test_multiples_of_noise_and_initial_box(cart, tmp_path):
    config, problem = problem_of(tmp_path, "scale = [1, 2, 4]", 'scale = [0, 3]\nof = "v"')
    assert config.sweep is not None
    noise, initial = noise_of(problem, config.sweep.axes, ""), initial_of(problem, config.sweep.axes, "")
    assert (noise.name, initial.name) == ("measurement_noise_scale", "initial_scale")
    np.testing.assert_allclose(noise.value.v.lower, [[0, 0], [-0.3, -0.6]])
    np.testing.assert_allclose(noise.value.v.upper, [[0, 0], [0.3, 0.3]])
    np.testing.assert_array_equal(noise.value.w.upper, [[0.001, 0.001]] * 2)
    np.testing.assert_allclose(initial.value.lower, [[-10, -10], [-5, -4.5]])
    np.testing.assert_allclose(initial.value.upper, [[10, 12], [5, 6.5]])


def test_true_states_start_in_every_initial_box(cart, tmp_path):
    scales = "steps = 12\n[monte_carlo.axes.initial]\nscale = [2, 0.5, 1]\n"
    text = CONFIG[: CONFIG.index("draw =")].replace("steps = 12", scales)
    config, problem = problem_of(tmp_path, CONFIG, text)
    assert config.monte_carlo is not None
    wanted = simulated(config, config.monte_carlo, problem, "cart.toml")
    np.testing.assert_allclose([wanted["x0"].lower, wanted["x0"].upper], [[-5, -4.5], [5, 6.5]])
    assert wanted["d"] is None
    amplitude = text.replace("steps = 12", "steps = 12\nd = {amplitude = [2]}")
    config, _ = problem_of(tmp_path, CONFIG, amplitude)
    assert config.monte_carlo is not None
    assert simulated(config, config.monte_carlo, problem, "cart.toml")["d"] == UniformInput((2.0,))
    config, problem = problem_of(tmp_path, CONFIG, text.replace("steps = 12", "steps = 12\nx0 = {radius = [6, 1]}"))
    assert config.monte_carlo is not None
    with pytest.raises(UserError, match="x0 leaves the smallest of the initial boxes in position"):
        simulated(config, config.monte_carlo, problem, "cart.toml")


def test_records_of_different_lengths(cart, tmp_path):
    for folder, steps in (("b", 4), ("a", 6)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "log.csv").write_text("\n".join(lines_of_table(steps)) + "\n")
    config, _ = problem_of(tmp_path, "batch = 2", 'records = ["b/log.csv", "*/*.csv"]')
    assert config.sweep is not None
    assert config.table is not None
    found = read_records(config.table, config.sweep.records, tmp_path, "cart.toml")
    assert found.y.coordinate.tolist() == ["b/log.csv", "a/log.csv"]
    assert found.length.value.tolist() == [4, 6]
    assert (found.steps, found.u, found.time) == (6, None, None)
    assert np.isnan(found.y.value[0, 4:]).all()
    np.testing.assert_array_equal(found.y.value[0, :4], found.y.value[1, :4])
    alone = read_records(config.table, "a/log.csv", tmp_path, "cart.toml")
    np.testing.assert_array_equal(alone.y, found.y.value[1])
    assert alone.length is None


def test_the_quiet_record_of_the_paper_example():
    path = examples.config_path("paper")
    config, record = read_config(path), paper.record(noise=paper.QUIET_NOISE)
    assert config.sweep is not None
    assert config.monte_carlo is not None
    stored = np.loadtxt(path.parent / config.sweep.records, delimiter=",", skiprows=1)
    np.testing.assert_allclose(stored, np.column_stack(list(record.values())), rtol=0, atol=1e-12)
    # The multiples of the noise bounds that the example runs through are all true of it, and so is the initial box.
    assert config.sweep.axes.noise is not None
    assert config.sweep.axes.initial is not None
    assert config.sweep.axes.noise.scales().min() * paper.NOISE >= paper.QUIET_NOISE
    assert config.sweep.axes.initial.scales().min() >= 1


def test_uniform_inputs_fill_their_bounds():
    draw = UniformInput((0.0, 2.0))
    keys = jax.random.split(jax.random.key(0), 2000)
    d = np.asarray(jax.vmap(draw, (0, None, None))(keys, 0, np.zeros(3)))
    assert d.shape == (2000, 2)
    assert (d[:, 0] == 0).all()
    assert (np.abs(d[:, 1]) <= 2).all()
    assert d[:, 1].min() < -1.98
    assert d[:, 1].max() > 1.98
    assert abs(d[:, 1].mean()) < 0.1
    assert hash(draw) == hash(UniformInput((0.0, 2.0)))


@pytest.mark.parametrize("command", ["sweep", "monte-carlo"])
def test_help_shows_the_tables(command, capsys):
    with pytest.raises(SystemExit):
        main([command, "--help"])
    text = capsys.readouterr().out
    for part in ("--fresh", "Ctrl-C", f"[{command.replace('-', '_')}]", f"gsisio {command} paper"):
        assert part in text
    assert max(map(len, text.splitlines())) <= 110


def test_a_record_knows_the_zone_of_its_dates(tmp_path):
    (tmp_path / "log.csv").write_text("t,y\n2026-03-28 20:00:00,1\n2026-03-28 20:01:00,2\n")
    table = {"file": "log.csv", "sample_time": 60.0, "y": ["y"]}
    for time, zone in (({"column": "t"}, ""), ({"column": "t", "zone": "Europe/Berlin"}, "Europe/Berlin")):
        assert read_records(TablePart.model_validate(table | {"time": time}), None, tmp_path, "log.toml").zone == zone
    assert date_attributes("Europe/Berlin")["zone"] == "Europe/Berlin"
    assert "zone" not in date_attributes("")


def test_boxes_that_a_module_holds(cart, tmp_path, monkeypatch):
    module = types.ModuleType("plant_of_boxes")
    module.model = types.SimpleNamespace(
        error=Interval([-1e-3, -2e-3], [1e-3, 0.0]), region=Interval.symmetric([3.0, 2.0])
    )
    monkeypatch.setitem(sys.modules, "plant_of_boxes", module)
    error, states = '{use = "plant_of_boxes:model.error"}', 'use = "plant_of_boxes:model.region"'
    _, problem = problem_of(tmp_path, "w = {radius = [0.001, 0.001]}", f"w = {error}")
    assert problem.noise.w is module.model.error
    with pytest.raises(UserError, match=r"noise.v.use: plant_of_boxes:model.error has the shape \(2,\), and"):
        used_box("plant_of_boxes:model.error", "cart.toml: noise.v.use", 1, "outputs")
    config, problem = problem_of(tmp_path, "steps = 12", f"steps = 12\nx0 = {{{states}}}")
    assert config.monte_carlo is not None
    first = simulated(config, config.monte_carlo, problem, "cart.toml")["x0"]
    np.testing.assert_array_equal([first.lower, first.upper], [[-3, -2], [3, 2]])
