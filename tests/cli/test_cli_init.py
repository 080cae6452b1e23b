"""`gsisio init`: what it finds in a log, and that what it writes is read."""

from __future__ import annotations

import re
import sys
import tomllib

import numpy as np
import pytest

from gsisio_jax.cli import main
from gsisio_jax.cli.config import read_config
from gsisio_jax.cli.errors import UserError
from gsisio_jax.cli.init_columns import look_at
from gsisio_jax.cli.logs import TablePart, read_table
from gsisio_jax.cli.problem import build_problem, importable


def pump(rows=60):
    """A log with a decimal comma, units, a clock in milliseconds with a gap, and three ways of saying missing."""
    rng = np.random.default_rng(0)
    lines = ["# logger 7", "Time (ms);Level 1 [m];P,in (bar);state;valve"]
    for k in range(rows):
        level, pressure = (f"{value:.3f}".replace(".", ",") for value in rng.uniform(1, 2, 2))
        level = "" if k == 30 else level
        pressure = {5: "-9999", 9: "-9999", 17: "ERR"}.get(k, pressure[:-1])
        if k != 50:
            lines.append(f"{20 * k};{level};{pressure};RUN;1")
    return "\n".join(lines) + "\n"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "plant", raising=False)  # of another test; modules stay imported
    return tmp_path


def test_the_two_files(folder, capsys):
    (folder / "pump.csv").write_text(pump())
    assert main(["init", "pump.csv"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "wrote pump.toml",
        "wrote plant.py",
        "fill in what says FILL_IN in both, then run: gsisio estimate pump.toml",
    ]
    text = (folder / "pump.toml").read_text()
    found = tomllib.loads(text)
    assert found["table"] == {
        "file": "pump.csv",
        "time": {"column": "Time (ms)", "unit": "ms"},
        "sample_time": 0.02,
        "y": ["Level 1 [m]", "P,in (bar)"],
        "missing": [-9999, "ERR"],
    }
    assert found["signals"]["output"] == [{"name": "Level 1", "unit": "m"}, {"name": "P_in", "unit": "bar"}]
    assert found["noise"]["v"] == {"radius": [0.0005, 0.005]}
    comments = " ".join(line.lstrip("# ") for line in text.splitlines() if line.startswith("#"))
    for words in (
        "semicolons between cells, decimal comma, comments after #, header in line 2",
        "A SUGGESTION",
        "59 rows on 60 steps",
        "resolution 0.01, 3 cells missing",
        "resolution 0.001, 1 cells missing",
        "state: text",
        "valve: 1 to 1, constant, not in y",
    ):
        assert words in comments

    # Unchanged: one error that lists everything. Then, one after the other filled in, what is left.
    unfilled = "gsisio: pump.toml: fill in what says FILL_IN: "
    plant = (folder / "plant.py").read_text()
    lines = [1 + plant[: found.start()].count("\n") for found in re.finditer("= FILL_IN|return FILL_IN", plant)]
    code = "in plant.py f (line {}), g (line {}), G (line {}), H (line {})\n".format(*lines)
    for command in ("estimate", "design"):
        assert main([command, "pump.toml"]) == 2
        assert capsys.readouterr().err == f"{unfilled}noise.w, initial.lower, initial.upper; {code}"
    filled = text.replace('w = "FILL_IN"', "w = {radius = [0.1, 0.1]}")
    filled = re.sub(r'(lower|upper) = "FILL_IN"', r"\1 = [0.0, 0.0]", filled)
    (folder / "pump.toml").write_text(filled)
    assert main(["estimate", "pump.toml"]) == 2
    assert capsys.readouterr().err == unfilled + code
    # The comments are the example that they say they are.
    (folder / "plant.py").write_text(re.sub(r"FILL_IN  # ", "", plant))
    config = read_config(folder / "pump.toml")
    with importable(folder):
        problem = build_problem(config, "pump.toml")
    assert (problem.system.n, problem.system.l, problem.system.p) == (2, 2, 1)
    table = read_table(folder / "pump.csv", config.table)
    assert table.y.shape == (60, 2)
    assert np.isnan(table.y).sum(axis=0).tolist() == [2, 4]

    before = {path: path.read_bytes() for path in folder.glob("p*.*")}
    assert main(["init", "pump.csv"]) == 2
    assert "pump.toml is there already; init overwrites nothing" in capsys.readouterr().err
    (folder / "pump.toml").unlink()
    assert main(["init", "pump.csv"]) == 2
    assert "plant.py is there already" in capsys.readouterr().err
    assert not (folder / "pump.toml").exists()
    assert all(path.read_bytes() == data for path, data in before.items() if path.exists())


@pytest.mark.parametrize(
    ("header", "stamps", "found"),
    [
        ("t", [0, 0.5, 1.0, 2.0], {"time": {"column": "t"}, "sample_time": 0.5}),
        ("timestamp", [1.7e9, 1.7e9 + 1, 1.7e9 + 2], {"time": {"column": "timestamp", "unit": "epoch"}}),
        ("stamp", [1700000000000, 1700000000100, 1700000000200], {"sample_time": 0.1}),
        ("when", ["2024-05-01T10:00:00", "2024-05-01T10:00:02", "2024-05-01T10:00:04"], {"sample_time": 2.0}),
        ("t", [0, 1, 1, 2, 3], {"on_duplicate": "first"}),
        ("time_s", [3, 1, 0, 2], {"sample_time": "FILL_IN"}),
        ("date", ["2024-05-01", "2024-05-03", "2024-05-02", ""], {"on_unsorted": "sort", "on_blank_time": "drop"}),
        ("time", [0, 0.13, 0.5, 1.7, 1.71, 9.9], {"time": {"column": "time"}, "sample_time": "FILL_IN"}),
        ("speed", [3, 1, 2], {"y": ["speed", "x"], "sample_time": "FILL_IN"}),
    ],
)
def test_clocks(folder, header, stamps, found):
    rows = [
        f"{stamp!r},{value}".replace("'", "") for stamp, value in zip(stamps, range(5, 5 + len(stamps)), strict=True)
    ]
    (folder / "log.csv").write_text("\n".join([f"{header},x", *rows]) + "\n")
    assert main(["init", "log.csv", "--out", "new"]) == 0
    table = tomllib.loads((folder / "new" / "log.toml").read_text())["table"]
    assert found.items() <= table.items()
    assert (folder / "new" / table["file"]).samefile(folder / "log.csv")


def test_a_jitter_beyond_the_usual_is_written_as_a_tolerance(folder):
    times = 10 * np.arange(300) + np.random.default_rng(2).uniform(-1.5, 1.5, 300)
    (folder / "log.csv").write_text("\n".join(["t_ms;x", *(f"{time:.3f};{k % 7}" for k, time in enumerate(times))]))
    assert main(["init", "log.csv"]) == 0
    table = tomllib.loads((folder / "log.toml").read_text())["table"]
    filled = TablePart(**table)
    assert table["time"].pop("tolerance") in (0.0015, 0.0016, 0.0017)
    assert table["time"] == {"column": "t_ms", "unit": "ms"}
    assert table["sample_time"] == pytest.approx(0.01, rel=1e-4)
    assert len(read_table(folder / "log.csv", filled).y) == 300


def test_units_below_the_header_are_no_missing_cells(folder):
    (folder / "log.csv").write_text("time;T;heater\n;degC;\n0;0.5;0\n1;0.6;1\n2;0.7;0\n")
    assert main(["init", "log.csv"]) == 0
    text = (folder / "log.toml").read_text()
    table = tomllib.loads(text)["table"]
    assert table["sample_time"] == 1.0
    assert "missing" not in table
    assert "1 line of units" in text


def test_parquet_and_what_cannot_be_read(folder, capsys):
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame({"t": [0.0, 0.1, 0.2], "speed [m/s]": [1.0, np.nan, 1.5], "n": [1, 2, 4]})
    frame.to_parquet(folder / "log.parquet")
    assert main(["init", "log.parquet"]) == 0
    table = tomllib.loads((folder / "log.toml").read_text())["table"]
    assert table["y"] == ["speed [m/s]", "n"]
    assert table["sample_time"] == 0.1
    (folder / "words.csv").write_text("a,b\nx,y\nz,w\n")
    for name, words in (("nowhere.csv", "no such file"), ("words.csv", "no column of numbers was found")):
        capsys.readouterr()
        assert main(["init", name, "--out", "other"]) == 2
        assert words in capsys.readouterr().err
    assert not (folder / "other").exists()


@pytest.mark.parametrize(
    ("values", "sentinels"),
    [
        ([1.0, 2.0, -9999, -9999, 3.0], (-9999,)),
        ([1.0, 2.0, -9999, 3.0], ()),
        ([-9999, -9999, -9998, -9990], ()),
        ([99, 99, 98, 97], ()),
        ([0.5, 0.25, 32767, 32767, -999, -999], (-999, 32767)),
    ],
)
def test_numbers_that_stand_for_missing(values, sentinels):
    assert look_at("x", np.array(values), ".", "").sentinels == sentinels


RNG = np.random.default_rng(3)


@pytest.mark.parametrize(
    ("cells", "resolution"),
    [
        ([f"{value:.3f}" for value in RNG.uniform(-300, 300, 12)], 1e-3),  # seldom logged: no two are near
        (["1.50", "0.00"] * 20, 1e-2),  # a switch
        ([f"{0.5 * k:.2f}" for k in RNG.integers(0, 400, 60)], 0.5),  # half degrees, not all of them
        ([f"{0.02 * k:.2f}" for k in range(10)], 1e-2),  # ten even digits are chance
        ([f"{0.02 * k:.2f}" for k in range(60)], 0.02),
        (["1.5e-3", "2e-3", "-1e-3"], 1e-4),
        (["3", "8", "20"], 1.0),
        (["1e3", "5e3", "2e4"], 1e3),
        ([repr(float(0.00488281 * k)) for k in RNG.integers(0, 1000, 400)], 0.00488281),  # counts times a scale
        (np.array([1, 5, 9]), 1.0),
        (np.array([0.25, 8.0, np.nan]), 0.01),
        (np.array([0.1, 8.0], np.float32), 0.1),
    ],
)
def test_the_resolution_is_never_larger_than_the_digits_say(cells, resolution):
    assert look_at("x", np.asarray(cells), ".", "").resolution == pytest.approx(resolution, rel=1e-5)


def test_degrees_become_radians(folder):
    lines = [f"{k};{0.5 * k:.1f};{k % 7};{k % 5}" for k in range(60)]
    (folder / "log.csv").write_text("\n".join(["t;Gierrate [deg/s];head (°);v [km/h]", *lines]) + "\n", "utf-8")
    assert main(["init", "log.csv"]) == 0
    text = (folder / "log.toml").read_text("utf-8")
    found = tomllib.loads(text)
    assert found["table"]["columns"] == {
        "Gierrate [deg/s]": {"unit": "deg/s", "to": "rad/s"},
        "head (°)": {"unit": "°", "to": "rad"},
    }
    assert [one["unit"] for one in found["signals"]["output"]] == ["rad/s", "rad", "km/h"]
    np.testing.assert_allclose(found["noise"]["v"]["radius"], [np.deg2rad(0.25), np.deg2rad(0.5), 0.5], rtol=1e-3)


@pytest.mark.parametrize(("every", "rates"), [(5, [1, 5]), (1, None), (150, None)])
def test_a_column_that_comes_every_so_many_rows_has_a_rate(folder, every, rates):
    """In 150 rows one that is there once has none, nor has one of which another cell is empty."""
    rows = [f"{k},{np.sin(k):.3f},{np.cos(k):.3f}" if k % every == 0 else f"{k},{np.sin(k):.3f}," for k in range(150)]
    (folder / "log.csv").write_text("\n".join(["t,fast,slow", *rows]) + "\n")
    assert main(["init", "log.csv"]) == 0
    assert tomllib.loads((folder / "log.toml").read_text()).get("design") == (rates and {"rates": rates})
    (folder / "gap.csv").write_text("\n".join(["t,fast,slow", *rows[:25], "25,.1,", *rows[26:]]) + "\n")
    assert main(["init", "gap.csv", "--out", "gap"]) == 0
    assert "design" not in tomllib.loads((folder / "gap" / "gap.toml").read_text())


def test_the_mark_in_a_list(folder):
    (folder / "a.toml").write_text('[noise]\nw = {radius = [1, "FILL_IN"]}\n')
    with pytest.raises(UserError, match=re.escape("a.toml: fill in what says FILL_IN: noise.w.radius[1]")):
        read_config(folder / "a.toml")
