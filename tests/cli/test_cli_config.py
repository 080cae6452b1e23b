"""Every mistake in the configuration is one line that names the file and the key."""

from __future__ import annotations

import re
from typing import get_args

import pytest
from pydantic import BaseModel

from gsisio_jax.cli.config import Config
from gsisio_jax.cli.help import EXAMPLES

CASES = {
    "unknown key": ('time = "t"', 'tiem = "t"', ["cart.toml: unknown key table.tiem; did you mean time?"]),
    "misspelt key": ('missing = [-9999, "n/a"]', "mising = []", ["unknown key table.mising", "did you mean missing?"]),
    "unknown section": ("[outputs]", "[pictures]", ["unknown section pictures", "keys here are", "outputs"]),
    "misspelt section": ("[noise]", "[nois]", ["cart.toml: unknown section nois; did you mean noise?"]),
    "noise number": (
        "w = {radius = [0.001, 0.001]}",
        "w = 0.01",
        ["noise.w: must be a box, got 0.01", "radius = [0.01]"],
    ),
    "box of a module": (
        "w = {radius = [0.001, 0.001]}",
        'w = {use = "cart_model:STEP"}',
        ["cart.toml: noise.w.use: cart_model:STEP must be a gsisio_jax.Interval, got float"],
    ),
    "box of a module and numbers": (
        "w = {radius = [0.001, 0.001]}",
        'w = {use = "cart_model:STEP", radius = [1, 1]}',
        ["noise.w: give either use, or radius"],
    ),
    "region of a module and numbers": (
        "[region]",
        '[region]\nuse = "cart_model:STEP"',
        ["region: give either use, or auto"],
    ),
    "bare point": ("sample_time = 0.1", "sample_time = 1.", ["not valid TOML", " has 1., and a number needs digits"]),
    "noise list": ("w = {radius = [0.001, 0.001]}", "w = [1, 2]", ["noise.w: must be a box", "{ radius = [1, 2] }"]),
    "box of text": ("w = {radius = [0.001, 0.001]}", 'w = "0.1"', ["noise.w: must be a box", "radius = [...]"]),
    "signal key": ('name = "force", unit', 'name = "force", units', ["signals.input[0].units", "did you mean unit?"]),
    "wrong type": (
        "sample_time = 0.1",
        'sample_time = "0.1"',
        ["table.sample_time: must be a number", "'0.1'"],
    ),
    "sample time": (
        "sample_time = 0.1",
        "sample_time = 0",
        ['table.sample_time: must be a number of seconds greater than 0, or "auto"; got 0'],
    ),
    "reference": ("cart_model:cart", "cart_model.cart", ['system.use: must read "module:attribute"']),
    "module": ("cart_model:cart", "no_such_module:cart", ["system.use: cannot import no_such_module"]),
    "attribute": ("cart_model:cart", "cart_model:card", ["system.use: cart_model has no attribute card"]),
    "not a system": ("cart_model:cart", "cart_model:wrong", ["cart_model:wrong returned int, not a System"]),
    "not callable": ("cart_model:cart", "cart_model:STEP", ["must be a System or a function", "got float"]),
    "failing system": ("cart_model:cart", "cart_model:broken", ["cart_model:broken failed: KeyError: 'mass'"]),
    "arguments": ("[signals]", "[system.arguments]\nmass = 1\n[signals]", ["cart failed: TypeError", "'mass'"]),
    "noise size": (
        "w = {radius = [0.001, 0.001]}",
        "w = {radius = [0.001, 0.001, 0.001]}",
        ["cart.toml: noise.w.radius has 3 values, the system has 2 states"],
    ),
    "noise form": ("w = {radius = [0.001, 0.001]}", "w = {lower = [0, 0]}", ["noise.w: needs radius, or both lower"]),
    "noise twice": ("w = {radius = [0.001, 0.001]}", "w = {radius = [1], lower = [1]}", ["noise.w: give either"]),
    "noise sign": ("[0.001, 0.001]", "[-0.001, 0.001]", ["noise.w: radius has the negative value -0.001"]),
    "noise infinite": ("[0.001, 0.001]", "[0.001, inf]", ["Noise"]),
    "nan": ("lower = [-10.0, -10.0]", "lower = [-10.0, nan]", ["initial.lower[1]: must be a number, not nan"]),
    "crossed": ("lower = [-10.0, -10.0]", "lower = [-10.0, 11.0]", ["initial: bounds cross at index 1", "lower = 11"]),
    "lengths": ("lower = [-10.0, -10.0]", "lower = [-10.0]", ["initial: lower has 1 values, upper has 2"]),
    "initial size": ("10.0]", "10.0, inf]", ["initial"]),
    "region size": ("upper = [inf, inf]", "upper = [inf]", ["region: lower has 2 values, upper has 1"]),
    "region auto": ("[region]", "[region]\nauto = true", ["region: give either auto = true or lower and upper"]),
    "signals": (', {name = "velocity", unit = "m/s"}]', "]", ["signals.state has 1 name, the system has 2 states"]),
    "same name": ('"velocity", unit', '"position", unit', ["signals.state: the name position is already used"]),
    "reserved name": ('"force"', '"a/b"', ["signals.input[0].name: must start with a letter"]),
    "y size": ('y = ["pos", "vel"]', 'y = ["pos"]', ["table.y has 1 column, the system has 2 outputs"]),
    "u not there": ('y = ["pos"', 'u = ["pos"]\ny = ["pos"', ["table.u has 1 column, the system has no known inputs"]),
    "u region": ("[initial]", "[u_region]\nradius = [1.0]\n[initial]", ["u_region is given", "no known inputs"]),
    "file name": ('"boxes.csv"', '"../boxes.csv"', ["outputs.csv: must be a plain file name"]),
    "picture of no kind": ('"cart.png"', '"a.foo"', ["outputs.picture must end in", "say 'a.png'"]),
    "picture unnamed": ('"cart.png"', '"a"', ["outputs.picture must end in", ".pdf", "got 'a'"]),
    "same file": ('"boxes.csv"', '"cart.nc"', ["outputs: netcdf, csv, picture and report must be different files"]),
    "syntax": ("[noise]", "[noise", ["cart.toml: not valid TOML", "line 8"]),
    "conflict rule": ("[outputs]", "[estimate]\non_conflict = 'stop'\n[outputs]", ["estimate.on_conflict", "'stop'"]),
    "gains": ("sweeps = 1", "gains = 0", ['design.gains: must be a whole number, at least 1, or "auto"; got 0']),
    "window": ("sweeps = 1", 'window = "long"', ["design.window: must be a whole number, at least 1", "'long'"]),
    "clock": (
        'time = "t"',
        "time = 3",
        ['table.time: must be a column or a table such as {column = "t", unit = "ms"}'],
    ),
    "clock key": (
        'time = "t"',
        'time = {column = "t", unt = "ms"}',
        ["unknown key table.time.unt; did you mean unit?"],
    ),
    "clock unit": ('time = "t"', 'time = {column = "t", unit = "sec"}', ["table.time.unit must be 's', 'ms'", "'sec'"]),
    "clock both": (
        'time = "t"',
        'time = {column = "t", unit = "s", format = "%S"}',
        ["table.time: give either unit or"],
    ),
    "zone": ('time = "t"', 'time = {column = "t", zone = "Europe/Berln"}', ["did you mean Europe/Berlin?"]),
    "zone of numbers": (
        'time = "t"',
        'time = {column = "t", unit = "s", zone = "UTC"}',
        ["zone is for dates that lack"],
    ),
    "tolerance": (
        'time = "t"',
        'time = {column = "t", tolerance = 0.03}',
        ["table: time.tolerance = 0.03 s", "0.025 s"],
    ),
    "no clock": ('time = "t"\nsample_time = 0.1', 'sample_time = "auto"', ['table: sample_time = "auto" needs time']),
    "dt": (
        'time = "t"',
        'time = "t"\ndt = "as_input"',
        ['table: give either sample_time or dt = "as_input", not both'],
    ),
    "dt alone": ('time = "t"\nsample_time = 0.1', 'dt = "as_input"', ['table: dt = "as_input" needs time, the column']),
    "dt of no input": (
        "sample_time = 0.1",
        'dt = "as_input"',
        ['table.u has 0 columns and dt = "as_input" adds the time step as the last known input; the system has 0'],
    ),
    "unit": ("[design]", '[table.columns]\npos = {unit = "kmh"}\n[design]', ['unit "kmh"; did you mean km/h?', "mbar"]),
    "units": (
        "[design]",
        '[table.columns]\npos = {unit = "km", to = "deg"}\n[design]',
        ['table.columns.pos: "km" is of length, "deg" of angle; known for length: m, km'],
    ),
    "unit key": (
        "[design]",
        "[table.columns]\npos = {scal = 2}\n[design]",
        ["table.columns.pos.scal", "did you mean scale"],
    ),
    "scale": ("[design]", "[table.columns]\npos = {scale = 0}\n[design]", ["table.columns.pos: scale must not be 0"]),
    "column of nothing": ("[design]", "[table.columns]\nnote = {scale = 2}\n[design]", ["columns.note is not among y"]),
    "separator": (
        "[design]",
        '[table.dialect]\nseparator = "::"\n[design]',
        ["dialect.separator: must be one character"],
    ),
    "same marks": ("[design]", '[table.dialect]\nseparator = ","\ndecimal = ","\n[design]', ["must be different char"]),
    "encoding": ("[design]", '[table.dialect]\nencoding = "ansi8"\n[design]', ['unknown encoding "ansi8"; usual ones']),
    "draw": ("[outputs]", '[outputs]\ndraw = "cart_model:paint"', ["outputs.draw: cart_model has no attribute paint"]),
}


@pytest.mark.parametrize(("old", "new", "parts"), CASES.values(), ids=CASES.keys())
def test_a_mistake_is_one_line(project, old, new, parts):
    project.edit(old, new)
    project.refused(*parts)


def test_design_refuses_the_same_mistakes(project):
    project.edit("sample_time = 0.1", "")
    project.refused("cart.toml: table.sample_time is missing", command="design")


def test_files_that_are_no_configuration(project):
    for name, parts in {
        "nothing.toml": ["nothing.toml: no such file, and no built-in example of that name", "flight"],
        str(project.folder): ["this is a folder"],
    }.items():
        code, out, err = project.run_main("estimate", name, "--out", str(project.out))
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert all(part in err for part in parts)
    (project.folder / "latin.toml").write_bytes(b'title = "caf\xe9"')
    code, _, err = project.run_main("design", str(project.folder / "latin.toml"))
    assert (code, err) == (2, "gsisio: latin.toml: not valid TOML: the file is not UTF-8 text\n")


def test_debug_shows_the_traceback(project):
    project.edit("sample_time = 0.1", "")
    with pytest.raises(ValueError, match=r"table\.sample_time is missing"):
        project.run("--debug")


def test_the_help_of_estimate_names_every_key_of_a_configuration():
    def models(annotation):
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            yield annotation
        for part in get_args(annotation):
            yield from models(part)

    def keys(model):
        for name, field in model.model_fields.items():
            if model is Config and name in ("sweep", "monte_carlo"):  # they have a help of their own
                continue
            yield field.alias or name
            for inner in models(field.annotation):
                yield from keys(inner)

    missing = {key for key in keys(Config) if not re.search(rf"\b{key}\b", EXAMPLES)}
    assert missing == set()
