"""`gsisio estimate` on a log as it comes: uneven rows whose time step the plant takes as a known input."""

from __future__ import annotations

import csv

import jax
import numpy as np
import pytest

from gsisio_jax.cli import main

MODEL = '''\
"""A cart, logged at uneven times: u is (push, seconds to the next row)."""
import jax.numpy as jnp

import gsisio_jax as gx


def f(x, u):
    push, dt = u
    return jnp.stack([x[0] + dt * x[1] + dt**2 / 2 * push, x[1] + dt * push])


def g(x, u):
    return x


def cart():
    return gx.System(f=f, g=g, G=[[0.0], [1.0]], H=[[0.0], [0.0]], m=2)
'''

CONFIG = """\
[system]
use = "uneven_cart:cart"
[noise]
w = {radius = [1e-9, 1e-9]}
v = {radius = [0.01, 0.01]}
[region]
lower = [-inf, -20.0]
upper = [inf, 20.0]
[u_region]
lower = [-2.0, 0.0]
upper = [2.0, 1.0]
[initial]
lower = [-10.0, -10.0]
upper = [10.0, 10.0]
[table]
file = "uneven.csv"
time = {column = "Zeit", unit = "ms"}
dt = "as_input"
y = ["Weg", "v"]
u = ["Schub"]
[table.columns]
Weg = {unit = "mm"}
v = {unit = "km/h"}
[design]
sweeps = 1
"""
STEPS = 30


def record():
    """Whole milliseconds (T,), true states (T, 2), pushes (T,)."""
    rng = np.random.default_rng(5)
    stamps = np.cumsum(rng.integers(50, 950, STEPS))
    push, states = rng.uniform(-1, 1, STEPS).round(2), np.zeros((STEPS, 2))
    jump = rng.uniform(-0.5, 0.5, STEPS)
    for k in range(STEPS - 1):
        dt = (stamps[k + 1] - stamps[k]) / 1000
        position, speed = states[k]
        states[k + 1] = position + dt * speed + dt**2 / 2 * push[k], speed + dt * push[k] + jump[k]
    return stamps, states, push


@pytest.fixture
def folder(tmp_path):
    before = jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
    (tmp_path / "uneven_cart.py").write_text(MODEL)
    (tmp_path / "uneven.toml").write_text(CONFIG)
    stamps, states, push = record()
    noise = np.random.default_rng(1).uniform(-0.009, 0.009, states.shape)
    lines = ["Zeit;Weg;v;Schub", "ms;mm;km/h;m/s²"]
    for stamp, (position, speed), value in zip(stamps, states + noise, push, strict=True):
        lines.append(f"{stamp};{1000 * position:.3f};{3.6 * speed:.5f};{value:.2f}".replace(".", ","))
    (tmp_path / "uneven.csv").write_text("\r\n".join(lines) + "\r\n", encoding="cp1252")
    yield tmp_path
    jax.config.update("jax_enable_x64", before)


def test_uneven_rows_with_the_time_step_as_input(folder, capsys):
    code = main(["estimate", str(folder / "uneven.toml"), "--out", str(folder / "out"), "--progress", "never"])
    captured = capsys.readouterr()
    assert code == 0, captured.err
    assert "table         semicolons between cells, decimal comma, 1 line of units, cp1252" in captured.out
    stamps, states, _ = record()
    with open(folder / "out" / "uneven.csv") as stream:
        rows = list(csv.DictReader(stream))
    np.testing.assert_array_equal([float(row["time"]) for row in rows], stamps / 1000)
    assert {row["status"] for row in rows} == {"0"}
    for index, name in enumerate(("x1", "x2")):
        lower, upper = (np.array([float(row[f"{name}_{side}"]) for row in rows]) for side in ("lower", "upper"))
        assert (lower <= states[:, index]).all()
        assert (states[:, index] <= upper).all()
        # Not the initial box: narrower than the measurement alone at most of the steps.
        assert np.mean(upper - lower) < 0.0201


def test_the_time_step_counts_as_the_last_known_input(folder, capsys):
    (folder / "uneven.toml").write_text(CONFIG.replace('u = ["Schub"]\n', ""))
    assert main(["estimate", str(folder / "uneven.toml"), "--out", str(folder / "out")]) == 2
    assert 'table.u has 0 columns and dt = "as_input" adds the time step as the last' in capsys.readouterr().err
    assert not (folder / "out").exists()
