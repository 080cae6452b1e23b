"""Wrong uses of the command line that a second search found: values of the configuration, tables that are none, words.

Each ends with exit code 2 and at most five lines; nothing is written.
"""

from __future__ import annotations

import pytest

OUT = ("estimate", "cart.toml", "--out", "out")
# name: (text of the configuration, what stands in its place, parts of the message)
EDITS = {
    "negative noise": ("w = {radius = [0.001", "w = {radius = [-1", ["noise.w: radius has the negative value -1"]),
    "noise NaN": ("[0.001, 0.001]", "[nan, 0.001]", ["noise.w.radius[0]", "not nan"]),
    "noise of three": ("[0.001, 0.001]", "[1, 1, 1]", ["noise.w.radius has 3 values, the system has 2 states"]),
    "misspelt section": ("[noise]", "[nois]", ["unknown section nois; did you mean noise?"]),
    "misspelt side": ("lower", "lowr", ["unknown key region.lowr; did you mean lower?"]),
    "no attribute": ("cart_model:cart", "cart_model", ["system.use", '"module:attribute"']),
    "no such attribute": ("cart_model:cart", "cart_model:bus", ["system.use", "no attribute bus"]),
    "no such module": ("cart_model:cart", "car_model:cart", ["system.use: cannot import car_model"]),
    "file for a module": ("cart_model:cart", "cart_model.py:cart", ["system.use: cannot import cart_model.py"]),
    "step backwards": ("sample_time = 0.1", "sample_time = -0.1", ["table.sample_time", "greater than 0", "-0.1"]),
    "step in words": ("sample_time = 0.1", 'sample_time = "a"', ["table.sample_time", "'a'"]),
    "an output more": ('y = ["pos"', 'y = ["t", "pos"', ["table.y has 3 columns, the system has 2 outputs"]),
    "no outputs": ('y = ["pos", "vel"]', "y = []", ["table.y must have at least one entry, got []"]),
    "no such time": ('time = "t"', 'time = "zz"', ["no column 'zz'", "t, pos, vel, note"]),
    "no such table": ("cart.csv", "dart.csv", ["dart.csv: cannot read the table: No such file"]),
    "a folder": ('"cart.csv"', '"."', ["cannot read the table: Is a directory"]),
    "unit a number": ('unit = "m"', "unit = 3", ["signals.state[0].unit", "got 3"]),
    "gains true": ("sweeps = 1", "gains = true", ["design.gains: must be a whole number", "got True"]),
    "endless window": ("sweeps = 1", "window = 1000000", ["`window` must be at most 1000 steps", '"auto"']),
    "key of the API": ("sweeps = 1", "tolerate = 1", ["unknown key design.tolerate; the keys here are: gains"]),
    "key of another table": ("[outputs]", '[outputs]\non_conflict = "hold"', ["unknown key outputs.on_conflict"]),
    "section twice": ("[outputs]", "[noise]\n[outputs]", ["not valid TOML", "('noise',) twice"]),
}
TABLES = {
    "JSON": (b'{"a": 1}', ["no column 't'"]),
    "a page": (b"<html><body>no</body></html>", ["no column 't'"]),
    "half a workbook": (b"PK\x03\x04aaaa", ["damaged or ends too early"]),
    "half of gzip": (b"\x1f\x8b\x08aaaa", ["damaged or ends too early"]),
    "comments": (b"# a\n# b\n", ["no column 't'"]),
    "zeros": (b"\x00" * 100, ["not a table of text"]),
    "another header": (b"t,p,v\n", ["no column 'pos'", "t, p, v"]),
    "a column twice": (b"t,pos,pos,vel\n0,1,1,1\n", ["the column 'pos' is there 2 times"]),
}
WORDS = {
    "init of a configuration": (("init", "cart.toml", "--out", "o"), "row 2 has 1 cell, the header has"),
    "init into a file": (("init", "cart.csv", "--out", "cart.csv"), "cannot write to cart.csv"),
    "no such example": (("examples", "fligt"), "no example is called fligt; there are: flight"),
    "example into a file": (("examples", "flight", "--out", "cart.csv"), "cannot write to cart.csv"),
    "example of no table": (("estimate", "flight", "x.csv", "--out", "o"), "x.csv: cannot read the table"),
    "sweep of an example": (("sweep", "flight", "--out", "o"), "sweep is missing; gsisio sweep --help"),
    "an address": (("estimate", "https://x.org/a.toml"), "no such file, and no built-in example"),
    "a folder": (("estimate", "."), "this is a folder; give the TOML file in it"),
    "follow and resume": (("estimate", "cart.toml", "--resume", "--follow"), "leave out --resume"),
    "standard input alone": (("estimate", "-"), "-: no such file"),
}


@pytest.fixture
def here(project, monkeypatch):
    (project.folder / "cart.toml").write_text(project.config)
    monkeypatch.chdir(project.folder)
    return project


@pytest.mark.parametrize(("old", "new", "parts"), EDITS.values(), ids=EDITS)
def test_a_value_of_the_configuration(here, old, new, parts):
    text = here.config.replace(old, new, 1)
    assert text != here.config
    (here.folder / "cart.toml").write_text(text)
    here.refuses(OUT, parts)


@pytest.mark.parametrize(("content", "parts"), TABLES.values(), ids=TABLES)
def test_a_table_that_is_none(here, content, parts):
    (here.folder / "cart.csv").write_bytes(content)
    here.refuses(OUT, ["cart.csv", *parts])


@pytest.mark.parametrize(("words", "part"), WORDS.values(), ids=WORDS)
def test_words_that_do_not_fit(here, words, part):
    here.refuses(words, [part])
