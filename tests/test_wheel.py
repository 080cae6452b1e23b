"""The wheel is complete: it installs into an empty environment and runs from outside of the checkout."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

import gsisio_jax

ROOT = Path(__file__).parents[1]
RUN = """
import numpy as np, gsisio_jax as gx
system = gx.System(lambda x: 0.5 * x, lambda x: x, G=[[1.0]], H=[[0.0]])
noise = gx.Noise(w=gx.Interval.symmetric([0.1]), v=gx.Interval.symmetric([0.2]))
observer = gx.design_observer(system, noise, region=gx.Interval.entire(1))
boxes = gx.estimate(observer, gx.Interval.entire(1), np.array([[1.0], [2.0]]))
print(gx.__file__)
print(boxes.state.contains(np.array([[1.0], [2.0]])).all())
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    command = ["wheel", "--no-deps", "--no-build-isolation", "--quiet", "--wheel-dir", str(folder), str(ROOT)]
    _run([sys.executable, "-m", "pip", *command], folder)
    (built,) = folder.glob("*.whl")
    return built


def _run(command, folder):
    """Standard output of a command that must succeed. PYTHONPATH would let it find the checkout."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment["PIP_DISABLE_PIP_VERSION_CHECK"] = "1"
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_wheel_holds_every_file_of_the_package(wheel):
    """Modules, configurations, data, and the mark for type checkers; and nothing of tests or documents."""
    with zipfile.ZipFile(wheel) as archive:
        inside = {name for name in archive.namelist() if ".dist-info/" not in name}
    package = {p.relative_to(ROOT).as_posix() for p in (ROOT / "gsisio_jax").rglob("*") if p.is_file()}
    assert inside == {name for name in package if "__pycache__" not in name}
    assert "gsisio_jax/py.typed" in inside


def test_the_wheel_runs_from_outside_of_the_checkout(wheel, tmp_path):
    venv.create(tmp_path / "env", with_pip=False)
    python = tmp_path / "env" / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet", "--no-deps"]
    _run([*pip, str(wheel)], tmp_path)
    (packages,) = (tmp_path / "env" / "lib").glob("python*/site-packages")
    # What it depends on comes from this environment: a path alone, so that an editable install of it stays out.
    paths = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
    (packages / "dependencies.pth").write_text("\n".join(sorted(paths)) + "\n")
    where, holds = _run([str(python), "-c", RUN], tmp_path).splitlines()
    assert Path(where).is_relative_to(tmp_path)
    assert holds == "True"
    gsisio = str(python.with_name("gsisio"))
    assert _run([gsisio, "--version"], tmp_path) == f"gsisio {gsisio_jax.__version__}\n"
    assert "1.655" in _run([gsisio, "design", "paper"], tmp_path)  # its configuration is in the package


def test_one_version_everywhere():
    cited = re.search(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert cited is not None
    assert cited[1] == gsisio_jax.__version__
    assert f"## {gsisio_jax.__version__}\n" in (ROOT / "CHANGELOG.md").read_text()
