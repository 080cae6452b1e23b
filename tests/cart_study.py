"""A cart whose studies the tests of the command line run: its model, its configuration and its table."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path

import numpy as np

from gsisio_jax.cli import main
from gsisio_jax.cli.config import Config, read_config
from gsisio_jax.cli.problem import Problem, build_problem

MODEL = '''\
"""A cart on a line: position and velocity are measured, the force is unknown."""
import jax.numpy as jnp

import gsisio_jax as gx


def f(x):
    return jnp.stack([x[0] + 0.1 * x[1], x[1]])


def g(x):
    return x


def cart():
    return gx.System(f=f, g=g, G=[[0.005], [0.1]], H=[[0.0], [0.0]])


def pushed():
    return gx.System(f=f, g=g, G=[[0.005], [0.1]], H=[[0.0], [0.0]], B=[[0.005], [0.1]])


def corner(key, k, x, noise):
    return noise.w.upper, jnp.where(k % 2 == 0, noise.v.lower, noise.v.upper)


def push(key, k, x):
    return 3 * jnp.cos(k + x[:1])


NUMBER = 3
'''

CONFIG = """\
title = "Cart"
[system]
use = "study_cart_model:cart"
[signals]
state = [{name = "position", unit = "m"}, {name = "velocity", unit = "m/s"}]
input = [{name = "force", unit = "N"}]
[noise]
w = {radius = [0.001, 0.001]}
v = {lower = [-0.1, -0.2], upper = [0.1, 0.1]}
[region]
lower = [-inf, -inf]
upper = [inf, inf]
[initial]
lower = [-10.0, -10.0]
upper = [10.0, 12.0]
[design]
gains = 1
missing = false
sweeps = 1
bounds = ["affine"]
[table]
file = "cart.csv"
time = "t"
sample_time = 0.1
y = ["pos", "vel"]
[sweep]
batch = 2
[sweep.axes.noise]
scale = [1, 2, 4]
[sweep.axes.initial]
scale = [1, 0.5]
[monte_carlo]
runs = 20
steps = 12
draw = "study_cart_model:corner"
d = "study_cart_model:push"
reduce = ["final"]
[monte_carlo.axes.noise]
from = 0.5
to = 2
count = 3
spacing = "log"
"""

STEPS = 15


def lines_of_table(steps: int = STEPS) -> list[str]:
    """A cart pushed back and forth, with noise inside of the stated bounds."""
    x, random = np.array([1.0, 0.5]), np.random.default_rng(3)
    rows = ["t,pos,vel"]
    for k in range(steps):
        y = x + random.uniform([-0.1, -0.2], [0.1, 0.1])
        rows.append(f"{k / 10},{float(y[0])!r},{float(y[1])!r}")
        x = np.array([x[0] + 0.1 * x[1], x[1]]) + 2 * np.sin(k) * np.array([0.005, 0.1])
    return rows


def run(*arguments: str) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of the command."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(list(arguments))
    return code, out.getvalue(), err.getvalue()


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below the folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def problem_of(folder: Path, old: str = "", new: str = "") -> tuple[Config, Problem]:
    """The configuration with one change, and what it describes; its model must be importable."""
    (folder / "cart.toml").write_text(CONFIG.replace(old, new))
    config = read_config(folder / "cart.toml")
    return config, build_problem(config, "cart.toml")


def write(folder: Path) -> None:
    """The model, the configuration and the table."""
    (folder / "study_cart_model.py").write_text(MODEL)
    (folder / "cart.toml").write_text(CONFIG)
    (folder / "cart.csv").write_text("\n".join(lines_of_table()) + "\n")
