"""`gsisio examples`: what there is, and files to start from; and a simulated example run by its name."""

import json
import subprocess
import sys

import pytest

from gsisio_jax import examples
from gsisio_jax.cli import main


def test_the_list_has_a_sentence_each(capsys):
    assert main(["examples"]) == 0
    out = " ".join(capsys.readouterr().out.split())
    for name, sentence in examples.teaches().items():
        assert f"{name} {sentence}" in out


@pytest.mark.parametrize("name", ["sir", "flight"])
def test_files_to_start_from(name, tmp_path, capsys):
    out = tmp_path / "new" / "folder"
    assert main(["examples", name, "--out", str(out)]) == 0
    assert f"run it with: gsisio estimate {out / name}.toml" in capsys.readouterr().out
    assert (out / f"{name}.toml").read_bytes() == examples.config_path(name).read_bytes()
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    assert len(before) == 2
    assert main(["examples", name, "--out", str(out)]) == 2
    assert "is there already, and nothing is written over" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["examples", "sri"], "examples: no example is called sri; there are: flight, paper"),
        (["examples", "--out", "x"], "examples: --out needs the NAME of the example to write"),
        (["estimate", "sri"], "sri: no such file, and no built-in example of that name (there are: flight, paper"),
    ],
)
def test_wrong_uses(words, said, capsys):
    assert main(words) == 2
    assert said in capsys.readouterr().err


def test_a_simulated_example_runs_by_its_name(tmp_path, capsys):
    """As the flight does: the same four files, in a folder of its name."""
    assert main(["estimate", "tclab", "--out", str(tmp_path), "--format", "json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert (figures["steps"], figures["alarm_count"]) == (51, 0)
    assert {path.name for path in tmp_path.iterdir()} == {"tclab.nc", "tclab.csv", "tclab.png", "tclab.html"}


def test_records_are_simulated_in_float64():
    """Also by a command that has not yet said so to JAX: noise bounds of 1e-6 leave no room for float32."""
    code = "from gsisio_jax.cli.app import _configuration as read; path, _ = read('battery')"
    code += "; print((path.parent / 'battery_record.csv').read_text())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == examples.config_path("battery").with_name("battery_record.csv").read_text().split()
