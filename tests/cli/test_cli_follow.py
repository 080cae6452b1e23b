"""`gsisio estimate --follow`: the boxes of the whole table as lines of JSON, from a pipe or a growing file."""

from __future__ import annotations

import csv
import json
import math
from types import SimpleNamespace

import pytest

from gsisio_jax.cli import follow, tail

COMPILED = True


def pipe(monkeypatch, text, *pieces):
    """Standard input that hands out the pieces one after the other, then ends."""

    left = [text, *pieces]
    stream = SimpleNamespace(read1=lambda size: left.pop(0).encode() if left else b"")
    monkeypatch.setattr("sys.stdin", SimpleNamespace(buffer=stream))


def boxes(project):
    """Rows of the CSV file of a run over the whole table, infinite sides as None."""
    with open(project.out / "boxes.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))

    def number(cell):
        value = float(cell or "nan")
        return value if math.isfinite(value) else None

    return [{name: number(cell) for name, cell in row.items()} for row in rows]


def check(lines, rows):
    assert [line["step"] for line in lines] == list(range(len(lines)))
    for step, (line, row) in enumerate(zip(lines, rows, strict=True)):
        assert line["time"] == row["time"]
        assert line["status"] == row["status"]
        for name in ("position", "velocity"):
            assert line["state"][name] == [row[f"{name}_lower"], row[f"{name}_upper"]]
        before = rows[step - 1]
        expected = {"force": [before["force_lower"], before["force_upper"]]} if step else None
        assert line["previous_input"] == expected


def test_lines_are_the_boxes_of_the_table(project, monkeypatch):
    """From a pipe that is cut anywhere, with a gap, missing cells, an alarm and no line end at the end."""
    assert project.run()[0] == 0
    rows = boxes(project)
    text = (project.folder / "cart.csv").read_text().rstrip("\n")
    places = [3, 9, 30, 31, 32, 200, 600]
    pieces = [text[a:b] for a, b in zip([0, *places], [*places, len(text)], strict=True)]
    pipe(monkeypatch, *pieces)
    config = str(project.folder / "cart.toml")
    code, out, err = project.run_main("estimate", config, "-", "--follow")
    assert (code, err) == (0, "gsisio: following standard input\n")
    lines = [json.loads(line, parse_constant=pytest.fail) for line in out.splitlines()]
    check(lines, rows)
    assert lines[10]["flags"] == ["MISSING", "UNBOUNDED"]
    assert lines[0]["alarm"] is None
    alarm = lines[project.jump]["alarm"]
    assert alarm["gap"] == -lines[project.jump]["margin"] > 0
    assert alarm["step"] == project.jump
    assert alarm["text"]

    # The same from a file that grows, and is then cut off, replaced or left by Ctrl-C.
    log = project.folder / "log.csv"
    for end, code, words in (
        (lambda: (_ for _ in ()).throw(KeyboardInterrupt), 130, "gsisio: stopped after 39 steps\n"),
        (lambda: log.write_text("t,pos\n"), 2, "gsisio: log.csv: the file became shorter while it was followed\n"),
        (lambda: log.rename(project.folder / "old.csv"), 2, "the file was removed or replaced while it was followed\n"),
    ):
        log.write_text(pieces[0])
        left = [*pieces[1:]]

        def grow(_, left=left, end=end):
            if not left:
                return end()
            with open(log, "a") as stream:
                stream.write(left.pop(0))

        monkeypatch.setattr(tail.time, "sleep", grow)
        found, out, err = project.run_main("estimate", config, str(log), "--follow")
        assert (found, err.endswith(words)) == (code, True), err
        # Its last line has no end yet, so it may be half a row.
        check([json.loads(line) for line in out.splitlines()], rows[:-1])


GOOD = "t,pos,vel\n" + "".join(f"{k / 10},1,1\n" for k in range(20))


@pytest.mark.parametrize("burst", [False, True])
@pytest.mark.parametrize(
    ("text", "words", "steps"),
    [
        ("t,pos,vel\n0,1,1\n0.1,1,oops\n", "standard input: row 3, column 'vel': 'oops' is not a number", 1),
        ("t,pos,vel\n0,1,1\n0,1,1\n", "standard input: row 3, column 't': the time 0 is there twice", 1),
        ("t,pos\n0,1\n0.1,1\n0.2,1\n", "standard input: there is no column 'vel'; the columns are: t, pos", 0),
        ("t,pos,vel\n", "standard input: the file has a header but no rows", 0),
        ("", "standard input: the file is empty", 0),
        (f"{GOOD}2,oops,1\n2.1,1,1\n", "row 22, column 'pos': 'oops' is not a number", 20),
        (f"{GOOD}2,1\n2.1,1,1\n", "row 22 has 2 cells, the header has 3", 20),
        (f"{GOOD}2.5,1,\n2.53,1,1\n2.6,1,1\n", "row 23, column 't': the time 2.53 is not on the grid", 26),
        ('t,pos,vel\n0,1,"1"\n0.1,1,1\n0.2,1,"oops"\n', "row 4, column 'vel': 'oops' is not a number", 2),
    ],
)
def test_faults_come_after_the_lines_before_them(project, monkeypatch, text, words, steps, burst):
    """What is read and when, without an observer; whether the lines come one by one or all at once."""
    follow_without_observer(project, monkeypatch, [text] if burst else text.splitlines(keepends=True), words, steps)


@pytest.mark.parametrize("burst", [False, True])
def test_a_gap_in_known_inputs_comes_after_the_lines_before_it(project, monkeypatch, burst):
    project.edit('y = ["pos", "vel"]', 'y = ["pos"]\nu = ["vel"]')
    text = GOOD + "2.2,1,1\n"
    words = "row 22: 2 rows of the grid are absent before it, so the known inputs (vel) are not known"
    follow_without_observer(project, monkeypatch, [text] if burst else text.splitlines(keepends=True), words, 20)


def test_known_inputs_are_held_while_following(project, monkeypatch):
    project.edit('y = ["pos", "vel"]', 'y = ["pos"]\nu = ["vel"]\non_gap_u = "hold"')
    follow_without_observer(project, monkeypatch, [f"{GOOD}2.2,1,1\n2.3,1,\noops\n"], "row 24 has 1 cell", 24)


def follow_without_observer(project, monkeypatch, pieces, words, steps):
    blind = SimpleNamespace(
        rows=lambda tables: (table.time for table in tables), lines=lambda rows, begin: map(str, rows)
    )
    monkeypatch.setattr(follow, "Stepper", lambda *args: blind)
    monkeypatch.setattr(follow, "build_problem", lambda *args: None)
    (project.folder / "cart.toml").write_text(project.config)
    pipe(monkeypatch, *pieces or [""])
    code, out, err = project.run_main("estimate", str(project.folder / "cart.toml"), "-", "--follow")
    assert code == 2
    assert words in err.splitlines()[-1]
    assert len(out.splitlines()) == steps


@pytest.mark.parametrize(
    ("arguments", "config", "words"),
    [
        (["-"], "", "standard input (-) is read as it comes: add --follow"),
        (["-", "--follow", "--resume"], "", "writes no file; leave out --resume"),
        (["-", "--follow", "--out", "x"], "", "writes no file; leave out --out"),
        (["--follow"], 'transform = "cart_model:in_seconds"', "table.transform needs the whole table"),
        (["--follow"], 'on_unsorted = "sort"', 'table.on_unsorted = "sort" needs the whole table'),
    ],
)
def test_what_cannot_be_followed(project, arguments, config, words):
    path = project.folder / "cart.toml"
    path.write_text(project.config.replace("sample_time = 0.1", f"sample_time = 0.1\n{config}"))
    code, out, err = project.run_main("estimate", str(path), *arguments)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert words in err
