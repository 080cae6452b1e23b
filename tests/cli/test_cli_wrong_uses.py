"""Wrong uses of the command line beside wrong keys (test_cli_config) and cells (test_cli_table): files, folders, words.

Each ends with exit code 2 and at most five lines that say what came and what to do; nothing is written.
"""

from __future__ import annotations

import pytest

OUT = ("estimate", "cart.toml", "--out", "out")
# name: (file to write before and its content, words of the command, parts of the message)
FILES = {
    "misspelt example": ({}, ("estimate", "fligt"), ["fligt: no such file", "built-in example", "flight"]),
    "empty configuration": ({"cart.toml": b""}, OUT, ["cart.toml", "missing"]),
    "binary configuration": ({"cart.toml": b"\x00\xff"}, OUT, ["cart.toml: not valid TOML"]),
    "table as configuration": ({}, ("estimate", "cart.csv"), ["cart.csv", "TOML"]),
    "empty table": ({"cart.csv": b""}, OUT, ["cart.csv", "empty"]),
    "binary table": ({"cart.csv": bytes(range(128, 256))}, OUT, ["cart.csv"]),
    "no table": ({"cart.csv": None}, OUT, ["cart.csv: cannot read the table: No such file"]),
    "out is a file": ({}, (*OUT[:3], "cart.csv"), ["cart.csv"]),
    "out below a file": ({}, (*OUT[:3], "cart.csv/x"), ["cart.csv/x"]),
    "design of nothing": ({}, ("design", "nothing.toml"), ["nothing.toml: no such file"]),
    "study without its table": ({}, ("sweep", "cart.toml"), ["sweep"]),
    "runs without their table": ({}, ("monte-carlo", "cart.toml"), ["monte_carlo"]),
    "init of nothing": ({}, ("init", "nothing.csv"), ["nothing.csv"]),
    "init of an empty table": ({"cart.csv": b""}, ("init", "cart.csv", "--out", "out"), ["cart.csv"]),
    "init over a file": ({}, ("init", "cart.csv", "--out", "."), ["cart.toml"]),
    "another table of no name": ({}, ("estimate", "cart.toml", "b.csv", "--out", "out"), ["b.csv"]),
}
KEYS = {
    "delay": ('delay = "long"', ['design.delay: must be a whole number, at least 0, or "auto"; got', "'long'"]),
    "delay below 0": ("delay = -1", ["design.delay: must be a whole number, at least 0", "got -1"]),
    "window": ("window = 2.5", ["design.window", "2.5"]),
    "split": ("split = -3", ["design.split: must be a whole number, at least 1", "got -3"]),
    "cells": ("cells = 0", ["design.cells: must be a whole number, at least 1", "got 0"]),
    "misspelt window": ("windw = 3", ["unknown key design.windw", "did you mean window?"]),
    "bounds": ('bounds = ["afine"]', ["`bounds` must name some of affine", "'afine'"]),
    "certify": ('certify = "no"', ["design.certify", "'no'"]),
    "rounding": ('rounding = "up"', ["rounding"]),
    "twice": ("sweeps = 2", ["cart.toml: not valid TOML"]),
}
WORDS = {
    "no command": ((), "required: COMMAND"),
    "misspelt command": (("estimat", "cart.toml"), "'estimat'"),
    "misspelt option": (("estimate", "cart.toml", "--outt", "x"), "--outt"),
    "no configuration": (("estimate",), "required: CONFIG"),
    "three files": (("estimate", "cart.toml", "cart.csv", "b.csv"), "b.csv"),
    "no folder": (("estimate", "cart.toml", "--out", ""), 'argument --out: must be the name of a folder, got ""'),
    "init into none": (("init", "cart.csv", "--out="), 'got ""; the one at hand is "."'),
    "reproduce with a folder": (("reproduce", "nothing"), "unrecognized arguments: nothing"),
}


@pytest.fixture
def here(project, monkeypatch):
    (project.folder / "cart.toml").write_text(project.config)
    monkeypatch.chdir(project.folder)
    return project


@pytest.mark.parametrize(("files", "words", "parts"), FILES.values(), ids=FILES)
def test_files_and_folders(here, files, words, parts):
    for name, content in files.items():
        path = here.folder / name
        path.unlink() if content is None else path.write_bytes(content)
    here.refuses(words, parts)


@pytest.mark.parametrize(("key", "parts"), KEYS.values(), ids=KEYS)
def test_values_of_the_design(here, key, parts):
    (here.folder / "cart.toml").write_text(here.config.replace("sweeps = 1", f"sweeps = 1\n{key}"))
    here.refuses(OUT, parts)


@pytest.mark.parametrize(("words", "part"), WORDS.values(), ids=WORDS)
def test_words(here, capsys, words, part):
    with pytest.raises(SystemExit) as stop:
        here.run_main(*words)
    err = capsys.readouterr().err
    assert stop.value.code == 2
    assert part in err, err
    assert err.count("\n") <= 5, err
