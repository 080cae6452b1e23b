"""The whole command on a small record: files, labels, guarantee, summary."""

from __future__ import annotations

import csv
import json
import subprocess
import sys

import jax
import numpy as np
import pytest
import xarray

import gsisio_jax as gx
from gsisio_jax.cli.config import read_config
from gsisio_jax.cli.logs import read_table
from gsisio_jax.cli.problem import build_problem, importable
from gsisio_jax.cli.progress import DelayedProgress
from gsisio_jax.cli.run import run


def read_boxes(path):
    with open(path, newline="") as stream:
        rows = list(csv.DictReader(stream))
    return {name: np.array([float(row[name] or "nan") for row in rows]) for name in rows[0]}, list(rows[0])


def test_files_and_guarantee(project):
    code, _out, err = project.run()
    assert (code, err) == (0, "")
    assert sorted(path.name for path in project.out.iterdir()) == ["boxes.csv", "cart.html", "cart.nc", "cart.png"]
    boxes, header = read_boxes(project.out / "boxes.csv")
    signals = ["position", "velocity", "force"]
    assert header == ["time", *(f"{name}_{side}" for name in signals for side in ("lower", "upper")), "status"]
    np.testing.assert_allclose(boxes["time"], 0.1 * np.arange(project.steps), atol=1e-12)
    states, force = project.truth()
    for name, truth in (("position", states[:, 0]), ("velocity", states[:, 1])):
        lower, upper = boxes[f"{name}_lower"][: project.jump], boxes[f"{name}_upper"][: project.jump]
        assert ((lower <= truth[: project.jump]) & (truth[: project.jump] <= upper)).all()
    before = slice(0, project.jump - 1)
    assert (boxes["force_lower"][before] <= force[before]).all()
    assert (force[before] <= boxes["force_upper"][before]).all()
    assert np.isnan(boxes["force_lower"][-1])
    assert np.isnan(boxes["force_upper"][-1])
    status = boxes["status"].astype(int)
    assert np.flatnonzero(status & gx.Status.CONFLICT).tolist() == [project.jump]
    assert set(np.flatnonzero(status & gx.Status.MISSING)) == {4, 5, 10}
    assert (project.out / "cart.png").read_bytes().startswith(b"\x89PNG")


def test_netcdf_is_labelled(project):
    assert project.run()[0] == 0
    boxes, _ = read_boxes(project.out / "boxes.csv")
    with xarray.open_dataset(project.out / "cart.nc", engine="netcdf4") as data:
        assert data.sizes == {"time": project.steps}
        assert data["time"].attrs["units"] == "s"
        for name in boxes:
            np.testing.assert_array_equal(data[name].values, boxes[name])
        assert data["velocity_upper"].attrs["units"] == "m/s"
        assert data["velocity_upper"].attrs["long_name"] == "upper bound of velocity"
        assert np.isnan(data["measured_position_measured"].values[[4, 5, 10]]).all()
        assert data["status"].attrs["flag_meanings"].split()[:2] == ["CONFLICT", "MISSING"]
        assert data["status"].attrs["flag_masks"].tolist()[:3] == [1, 2, 4]
        assert data["margin"].values[project.jump] < 0
        assert data.attrs["title"] == "Cart"
        assert "ertificate" in data.attrs["certificate"]
        assert data.attrs["library"].startswith("gsisio_jax ")
        alarms = json.loads(data.attrs["alarms"])
    assert [alarm["step"] for alarm in alarms] == [project.jump]
    assert alarms[0]["time"] == pytest.approx(0.1 * project.jump)
    assert alarms[0]["gap"] > 0
    assert alarms[0]["text"]


def test_summary_says_it_all(project):
    code, out, _ = project.run()
    assert code == 0
    lines = {" ".join(line.split()) for line in out.splitlines()}
    assert "steps 40, from 0 s to 3.9 s" in lines
    assert "missing rows 2, and 1 with some entries missing" in lines
    assert "conflicts 1, at 2.5 s" in lines
    for word in (
        "steps/s",
        "position [m]",
        "velocity [m/s]",
        "force [N]",
        "mean width",
        "last width",
        "unbounded steps",
        "certificate",
    ):
        assert word in out
    alarm = next(line for line in lines if line.startswith("2.5 s: "))
    assert any(unit in alarm for unit in (" m", " N"))
    assert any(name in alarm for name in ("position", "velocity", "force"))
    for name in ("cart.nc", "boxes.csv", "cart.png"):
        assert str(project.out / name) in out


@pytest.mark.parametrize("chunk", [1, 7, 1000])
def test_chunks_give_the_numbers_of_estimate(project, chunk):
    jax.config.update("jax_enable_x64", True)
    path = project.folder / "cart.toml"
    path.write_text(project.config)
    config = read_config(path)
    with importable(project.folder):
        problem = build_problem(config, "cart.toml")
    table = read_table(project.folder / "cart.csv", config.table)
    with DelayedProgress("never") as progress:
        outcome = run(problem, [table], "restart", progress, chunk=chunk)
    whole = gx.estimate(outcome.observer, problem.initial, table.y)
    (ours,) = outcome.boxes.parts()
    np.testing.assert_array_equal(ours["state_lower"], whole.state.lower)
    np.testing.assert_array_equal(ours["state_upper"], whole.state.upper)
    np.testing.assert_array_equal(ours["input_lower"][:-1], whole.input.lower)
    np.testing.assert_array_equal(ours["input_upper"][:-1], whole.input.upper)
    for name in ("status", "margin", "source"):
        np.testing.assert_array_equal(ours[name], getattr(whole, name))


def test_one_row_is_enough(project):
    project.write_table(["t,pos,vel", "5,1,1"])
    assert project.run()[0] == 0
    boxes, _ = read_boxes(project.out / "boxes.csv")
    assert boxes["time"].tolist() == [5.0]
    assert np.isnan(boxes["force_lower"]).all()


def test_a_system_object_known_inputs_and_default_names(project):
    project.edit("cart_model:cart", "cart_model:CART")
    begin, end = project.config.index("[signals]"), project.config.index("[noise]")
    project.config = project.config[:begin] + project.config[end:]
    begin = project.config.index("[outputs]")
    project.config = project.config[:begin]
    assert project.run()[0] == 0
    _, header = read_boxes(project.out / "cart.csv")
    assert header == ["time", "x1_lower", "x1_upper", "x2_lower", "x2_upper", "d1_lower", "d1_upper", "status"]

    project.edit("cart_model:CART", "cart_model:pushed_cart")
    project.edit('y = ["pos", "vel"]', 'y = ["pos", "vel"]\nu = ["t"]')
    project.refused("rows of the grid are absent before it")
    project.write_table(["t,pos,vel", *(f"{k / 10},0,0" for k in range(8))])
    assert project.run()[0] == 0


def test_own_picture_transform_and_parquet(project):
    import pandas

    frame = pandas.read_csv(project.folder / "cart.csv", na_values=["n/a"])
    frame.assign(t=frame["t"] * 1000).to_parquet(project.folder / "cart.parquet")
    project.edit('"cart.csv"', '"cart.parquet"\ntransform = "cart_model:in_seconds"')
    project.edit("[outputs]", '[outputs]\ndraw = "cart_model:draw"')
    code, out, err = project.run()
    assert (code, err) == (0, "")
    assert "conflicts 1, at 2.5 s" in " ".join(out.split())
    assert (project.out / "cart.png").read_bytes() == b"own picture of Cart"


def test_design_prints_the_certificate_alone(project):
    (project.folder / "cart.csv").unlink()
    code, out, err = project.run(command="design")
    assert (code, err) == (0, "")
    assert "state 1 is position [m]" in out
    assert "input 1 is force [N]" in out
    assert "Certificate" in out
    assert not project.out.exists()


def test_default_folder_is_named_after_the_configuration(project, monkeypatch):
    monkeypatch.chdir(project.folder)
    path = project.folder / "cart.toml"
    path.write_text(project.config)
    code, out, _ = project.run_main("estimate", str(path))
    assert code == 0
    assert "results/cart/cart.nc" in out
    assert (project.folder / "results" / "cart" / "cart.png").is_file()


def test_progress_appears_only_when_asked_or_on_a_terminal(project, monkeypatch):
    assert project.run()[2] == ""
    monkeypatch.setattr(DelayedProgress.__init__, "__defaults__", ("auto", 0.0))
    assert "estimating" in project.run("--progress", "always")[2]
    assert project.run("--progress", "never")[2] == ""


def test_help_and_version_need_no_extra():
    code = (
        "import contextlib, io, json, sys\n"
        "for name in ('pandas', 'xarray', 'pydantic', 'rich', 'matplotlib', 'netCDF4'): sys.modules[name] = None\n"
        "from gsisio_jax.cli import main\n"
        "def call(words):\n"
        "    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:\n"
        "        try:\n"
        "            code = main(words)\n"
        "        except SystemExit as stop:\n"
        "            code = stop.code or 0\n"
        "    return code, out.getvalue(), err.getvalue()\n"
        "print(json.dumps([call(words) for words in json.loads(sys.argv[1])]))\n"
    )
    words = [["--version"], ["--help"], ["estimate", "--help"], ["estimate", "flight"], ["design", "flight"]]
    done = subprocess.run(
        [sys.executable, "-c", code, json.dumps(words)], capture_output=True, text=True, check=True
    )  # fmt: skip
    version, *helps, estimate, design = json.loads(done.stdout)
    assert done.stderr == ""
    assert version[0] == 0
    assert version[1].startswith("gsisio ")
    for returned, out, _ in helps:
        assert returned == 0
        assert "gsisio estimate flight" in out
    line = "gsisio: the command line needs {}; install it with: pip install 'gsisio_jax[cli]'\n"
    assert estimate == [2, "", line.format("pandas")]
    assert design == [2, "", line.format("pydantic")]


COMPASS = """\
import gsisio_jax as gx

def f(x):
    return x + 20.0

def g(x):
    return x

def plant():
    return gx.System(f=f, g=g, G=[[1.0]], H=[[0.0]], input_bounds=gx.Interval([-5.0], [5.0]))
"""


def test_an_angle_that_wraps(project):
    """A course in degrees, logged in [0, 360): named in the file, by name."""
    (project.folder / "compass_model.py").write_text(COMPASS)
    project.config = """\
[system]
use = "compass_model:plant"
[system.periodic]
compass = 360
[system.periodic_states]
course = 360
[signals]
state = [{name = "course", unit = "deg"}]
output = [{name = "compass", unit = "deg"}]
[noise]
w = {radius = [0.1]}
v = {radius = [2.0]}
[region]
lower = [-inf]
upper = [inf]
[initial]
lower = [-inf]
upper = [inf]
[table]
file = "cart.csv"
time = "t"
sample_time = 1
y = ["compass"]
[design]
sweeps = 1
[outputs]
csv = "boxes.csv"
"""
    course = 350.0 + 20.0 * np.arange(60) + np.cumsum(np.random.default_rng(0).uniform(-5, 5, 60))
    seen = np.mod(course + np.random.default_rng(1).uniform(-2, 2, 60), 360)
    project.write_table(["t,compass", *(f"{k},{value!r}" for k, value in enumerate(map(float, seen)))])
    code, _out, err = project.run()
    assert (code, err) == (0, "")
    boxes, _ = read_boxes(project.out / "boxes.csv")
    assert (boxes["status"] == 0).all()
    turns = 360 * np.rint((boxes["course_lower"] - course) / 360)
    assert (boxes["course_lower"] <= course + turns).all()
    assert (course + turns <= boxes["course_upper"]).all()
    assert len(set(turns)) == 1
    assert (boxes["course_upper"] - boxes["course_lower"] < 4.1).all()
    for old, new, part in (
        ("compass = 360", "course = 360", "system.periodic: there is no output course; they are: compass"),
        ("compass = 360", "compass = 0", "system: System: `periodic`[0] must be a positive, finite period"),
        ("compass = 360", 'compass = "turn"', "system.periodic.compass must be a valid number"),
        ("[system.periodic]\ncompass = 360\n", "", "system: System: state 0 is not periodic"),
    ):
        before = project.config
        project.edit(old, new)
        project.refused("cart.toml: " + part)
        project.config = before
