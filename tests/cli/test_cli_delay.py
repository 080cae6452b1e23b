"""The key `design.delay`: boxes stand at the steps that they are of, in memory, on the disk, and row by row."""

from __future__ import annotations

import csv
import json
from types import SimpleNamespace

import jax
import numpy as np
import pytest
import xarray

import gsisio_jax as gx
from gsisio_jax.cli import boxes, checkpoint, run
from gsisio_jax.cli.boxes import Boxes

# A force on a mass on a spring, whose position is measured.
MODEL = """\
import jax.numpy as jnp

import gsisio_jax as gx


def f(x):
    return jnp.stack([x[0] + 0.1 * x[1], -0.4 * x[0] + 0.96 * x[1]])


def late():
    return gx.System(f=f, g=lambda x: x[:1], G=[[0.0], [0.1]], H=[[0.0]])
"""
EDITS = (
    ("cart_model:cart", "late_model:late"),
    (', {name = "velocity_measured", unit = "m/s"}]', "]"),
    ("v = {radius = [0.1, 0.1]}", "v = {radius = [0.1]}"),
    ('y = ["pos", "vel"]', 'y = ["pos"]'),
    ("sweeps = 1", 'sweeps = 1\nmissing = false\ndelay = "auto"'),
)


@pytest.fixture
def late(project, monkeypatch):
    """The project with a delay, chunks of 8 rows, files written 16 rows at a time, a checkpoint after every chunk."""
    (project.folder / "late_model.py").write_text(MODEL)
    for old, new in EDITS:
        project.edit(old, new)
    monkeypatch.setattr(run.run, "__defaults__", (8, *run.run.__defaults__[1:]))
    monkeypatch.setattr(Boxes.parts, "__defaults__", (16,))
    monkeypatch.setattr(checkpoint, "EVERY", 0.0)
    return project


def test_boxes_of_a_delay_stand_at_their_own_steps(late, monkeypatch):
    code, out, _ = late.run("--format", "json")
    assert (code, json.loads(out)["delay"]) == (0, 1)
    whole = (late.out / "boxes.csv").read_bytes()
    with xarray.open_dataset(late.out / "cart.nc") as data:
        assert data.attrs["delay"] == 1
        data = data.load()
    system = gx.System(lambda x: jax.numpy.array([[1, 0.1], [-0.4, 0.96]]) @ x, lambda x: x[:1], [[0.0], [0.1]], [[0]])
    noise = gx.Noise(gx.Interval.symmetric([1e-3, 1e-3]), gx.Interval.symmetric([0.1]))
    observer = gx.design_observer(system, noise, gx.Interval.entire(2), missing=False, sweeps=1, delay=1)
    y = data["measured_position_measured"].values[:, None]
    est = gx.estimate(observer, gx.Interval.symmetric([10.0, 10.0]), y)
    for i, name in enumerate(("position", "velocity")):
        np.testing.assert_allclose(data[f"{name}_upper"], est.state.upper[:, i], rtol=1e-12)
    np.testing.assert_allclose(data["force_lower"][:-1], est.input.lower[:, 0], rtol=1e-12)
    np.testing.assert_array_equal(data["status"], est.status)
    assert "up to 1 step later" in (late.out / "cart.html").read_text("utf-8")

    # On the disk, interrupted after the third chunk and gone on with: the same files.
    save, saved = checkpoint.Checkpoint.save, []

    def saving(self, *args):
        save(self, *args)
        saved.append(1)
        if len(saved) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(boxes, "IN_MEMORY", 1)
    monkeypatch.setattr(checkpoint.Checkpoint, "save", saving)
    assert late.run("--out", str(late.folder / "again"))[0] == 130
    assert late.run("--out", str(late.folder / "again"), "--resume")[0] == 0
    assert (late.folder / "again" / "boxes.csv").read_bytes() == whole

    # Row by row: a line comes when its step is finished, the last one at the end of the table.
    left = [(late.folder / "cart.csv").read_bytes()]
    stream = SimpleNamespace(read1=lambda size: left.pop() if left else b"")
    monkeypatch.setattr("sys.stdin", SimpleNamespace(buffer=stream))
    code, out, _ = late.run_main("estimate", str(late.folder / "cart.toml"), "-", "--follow")
    lines = [json.loads(line) for line in out.splitlines()]
    rows = list(csv.DictReader(whole.decode().splitlines()))
    assert (code, len(lines)) == (0, len(rows))
    for step, (line, row) in enumerate(zip(lines, rows, strict=True)):
        assert (line["step"], line["time"], line["status"]) == (step, float(row["time"]), int(row["status"]))
        told = [np.nan if value is None else value for value in line["state"]["velocity"]]
        written = [float(row[f"velocity_{side}"]) for side in ("lower", "upper")]
        # One program for all rows and one for a row round in other places.
        np.testing.assert_allclose(told, np.where(np.isfinite(written), written, np.nan), rtol=1e-12)


def test_a_delay_of_the_wrong_kind_is_refused(project):
    project.edit("sweeps = 1", "sweeps = 1\ndelay = -1")
    project.refused("design.delay")
