"""The example of docs/logs.md is run as it stands there, and says what is written there."""

from __future__ import annotations

import re
from pathlib import Path

import jax
import pytest

from gsisio_jax.cli import main

DOCUMENT = (Path(__file__).parents[3] / "docs" / "logs.md").read_text(encoding="utf-8")


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", DOCUMENT, re.DOTALL)


@pytest.fixture
def folder(tmp_path):
    before = jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
    (tmp_path / "log.csv").write_text(blocks("csv")[0])
    # A module name that no other test has: modules stay imported.
    (tmp_path / "plant_of_document.py").write_text(blocks("python")[0])
    (tmp_path / "log.toml").write_text(blocks("toml")[0].replace("plant:", "plant_of_document:"))
    yield tmp_path
    jax.config.update("jax_enable_x64", before)


def test_the_example_says_what_the_document_says(folder, capsys):
    assert len(blocks("toml")[0].splitlines()) <= 11  # one of them a heading
    code = main(["estimate", str(folder / "log.toml"), "--out", str(folder / "out")])
    captured = capsys.readouterr()
    assert code == 0, captured.err
    assert blocks("text")[0] in captured.out
    assert (folder / "out" / "log.csv").exists()


def test_the_error_is_the_one_of_the_document(folder, capsys):
    path = folder / "log.toml"
    path.write_text(path.read_text().replace('missing = ["---"]\n', ""))
    assert main(["estimate", str(path), "--out", str(folder / "out")]) == 2
    assert capsys.readouterr().err == blocks("text")[1]


def test_the_hint_is_the_one_of_the_document(folder, capsys):
    (folder / "log.csv").write_text("t,Weg,v\n0,1,2\n1000,1,2\n")
    path = folder / "log.toml"
    text = path.read_text().replace('{column = "Zeit", unit = "ms"}', '"t"').replace('"auto"', "1.0")
    path.write_text(text)
    assert main(["estimate", str(path), "--out", str(folder / "out")]) == 2
    assert capsys.readouterr().err == blocks("text")[2]
