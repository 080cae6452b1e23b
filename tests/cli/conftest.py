"""A small project as a user would have it: a module, a configuration and a table in one folder."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import gsisio_jax as gx
from gsisio_jax.cli import main

MODEL = '''\
"""A cart on a line: position and velocity are measured, the force is unknown."""
import jax.numpy as jnp

import gsisio_jax as gx

STEP = 0.1


# Functions of the module, not lambdas: systems made twice then share their compiled observer.
def f(x):
    return jnp.stack([x[0] + STEP * x[1], x[1]])


def g(x):
    return x


def cart():
    return gx.System(f=f, g=g, G=[[STEP**2 / 2], [STEP]], H=[[0.0], [0.0]])


def pushed_cart():
    return gx.System(f=f, g=g, G=[[0.005], [0.1]], H=[[0.0], [0.0]], B=[[0.005], [0.1]])


CART = cart()


def wrong():
    return 3


def broken():
    raise KeyError("mass")


def in_seconds(frame):
    return frame.assign(t=frame["t"] / 1000.0)


def drops_all(frame):
    return frame.iloc[:0]


def draw(dataset, path):
    path.write_bytes(b"own picture of " + dataset.attrs["title"].encode())


def draw_fails(dataset, path):
    path.write_bytes(b"half")
    raise RuntimeError("no paint")
'''

CONFIG = """\
title = "Cart"
[system]
use = "cart_model:cart"
[signals]
state = [{name = "position", unit = "m"}, {name = "velocity", unit = "m/s"}]
input = [{name = "force", unit = "N"}]
output = [{name = "position_measured", unit = "m"}, {name = "velocity_measured", unit = "m/s"}]
[noise]
w = {radius = [0.001, 0.001]}
v = {radius = [0.1, 0.1]}
[region]
lower = [-inf, -inf]
upper = [inf, inf]
[initial]
lower = [-10.0, -10.0]
upper = [10.0, 10.0]
[table]
file = "cart.csv"
time = "t"
sample_time = 0.1
y = ["pos", "vel"]
missing = [-9999, "n/a"]
[design]
sweeps = 1
[outputs]
netcdf = "cart.nc"
csv = "boxes.csv"
picture = "cart.png"
"""

JUMP = 25  # the step at which the logged position becomes a lie
STEPS = 40


def trajectory() -> tuple[np.ndarray, np.ndarray]:
    """True states (T, 2) and forces (T,)."""
    time = 0.1 * np.arange(STEPS)
    force = 2 * np.sin(time)
    states = np.zeros((STEPS, 2))
    for k in range(STEPS - 1):
        states[k + 1] = states[k] @ [[1, 0], [0.1, 1]] + force[k] * np.array([0.005, 0.1])
    return states, force


def table() -> list[str]:
    """Lines of the table: header is line 1, step k is line k + 2; step 10 is absent, some cells are missing."""
    states, _ = trajectory()
    noise = np.random.default_rng(1).uniform(-0.1, 0.1, states.shape)
    lines = ["t,pos,vel,note"]
    for k, (position, velocity) in enumerate(states + noise):
        position += 5.0 * (k >= JUMP)
        lines.append(f"{0.1 * k:.1f},{position:.4f},{velocity:.4f},fine")
    lines[5] = "0.4,,0.1,fine"
    lines[6] = "0.5,-9999,n/a,fine"
    del lines[11]
    return lines


@dataclass
class Project:
    """The folder of one test."""

    folder: Path
    run_main: Callable[..., tuple[int, str, str]]
    config: str = CONFIG
    steps: int = STEPS
    jump: int = JUMP

    @staticmethod
    def truth() -> tuple[np.ndarray, np.ndarray]:
        """True states (T, 2) and forces (T,) behind the table."""
        return trajectory()

    @property
    def out(self) -> Path:
        return self.folder / "out"

    def edit(self, old: str, new: str) -> None:
        """Change the configuration."""
        assert old in self.config
        self.config = self.config.replace(old, new)

    def write_table(self, lines: list[str], name: str = "cart.csv") -> None:
        (self.folder / name).write_text("\n".join(lines) + "\n")

    def run(self, *more: str, command: str = "estimate") -> tuple[int, str, str]:
        """Run the command on the configuration; returns exit code, standard output and standard error."""
        path = self.folder / "cart.toml"
        path.write_text(self.config)
        options = ["--out", str(self.out)] if command == "estimate" and "--out" not in more else []
        return self.run_main(command, str(path), *options, *more)

    def refused(self, *parts: str, command: str = "estimate") -> str:
        """The run must end with exit code 2 and one line that holds the parts, and leave the folder as it was."""
        self.folder.joinpath("cart.toml").write_text(self.config)
        before = sorted(self.folder.rglob("*"))
        code, out, err = self.run(command=command)
        assert (code, out) == (2, ""), (code, out, err)
        assert err.startswith("gsisio: "), err
        assert err.count("\n") == 1, err
        for part in parts:
            assert part in err, (part, err)
        known = {*before, *self.folder.rglob("*.pyc"), *self.folder.rglob("__pycache__")}
        assert set(self.folder.rglob("*")) <= known
        return err

    def refuses(self, words: Iterable[str], parts: Iterable[str]) -> None:
        """These words must end with exit code 2 and few lines that hold the parts, and leave every file as it was."""
        before = {path: path.is_dir() or path.read_bytes() for path in self.folder.rglob("*")}
        code, out, err = self.run_main(*words)
        assert (code, out) == (2, ""), (code, out, err)
        assert err.startswith("gsisio: "), err
        assert err.count("\n") <= 5, err
        for part in parts:
            assert part in err, (part, err)
        after = {path for path in self.folder.rglob("*") if "__pycache__" not in str(path)}
        assert after == {path for path in before if "__pycache__" not in str(path)}
        assert all(found is True or path.read_bytes() == found for path, found in before.items())


@pytest.fixture(autouse=True)
def float64_as_before() -> Iterator[None]:
    """The command line turns 64-bit floats on for its own process; here other tests share it."""
    before = jax.config.read("jax_enable_x64")
    yield
    jax.config.update("jax_enable_x64", before)


_designs: dict[Any, Any] = {}


@pytest.fixture(scope="module", autouse=True)
def designed_once() -> Iterator[None]:
    """Commands that ask for the same observer, of one plant with equal bounds and options, get it from one design."""
    design = gx.design_observer

    def once(system: Any, noise: Any, region: Any, progress: bool | None = None, **options: Any) -> Any:
        leaves, structure = jax.tree.flatten((system, noise, region, options))
        values = [leaf if isinstance(leaf, str) else (np.asarray(leaf).dtype, np.shape(leaf)) for leaf in leaves]
        numbers = tuple(np.asarray(leaf).tobytes() for leaf in leaves)
        key = structure, tuple(values), numbers, jax.config.read("jax_enable_x64")
        if key not in _designs or progress:
            _designs[key] = design(system, noise, region, progress=progress, **options)
        return _designs[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gx, "design_observer", once)
        yield


@pytest.fixture
def project(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Project:
    def run_main(*arguments: str) -> tuple[int, str, str]:
        capsys.readouterr()
        code = main(list(arguments))
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    (tmp_path / "cart_model.py").write_text(MODEL)
    made = Project(tmp_path, run_main)
    made.write_table(table())
    return made
