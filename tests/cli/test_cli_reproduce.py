"""``gsisio reproduce``: the table, the files, and what goes wrong. The computation itself is tested elsewhere."""

from __future__ import annotations

import io

import numpy as np
import pytest

from gsisio_jax import Interval
from gsisio_jax.cli import main
from gsisio_jax.cli.reproduce import WIDTH, show
from gsisio_jax.paper import example, reproduce
from gsisio_jax.paper.figures import Boxes

STEPS = 4


@pytest.fixture(scope="module")
def rows():
    return example.numbers()


@pytest.fixture
def computed(monkeypatch, rows):
    """A small outcome in the place of the computed one."""
    run = example.record(STEPS)
    around = np.arange(STEPS + 1.0)[:, None] * [1, -1]
    crossed = Interval.unchecked(run.x - around - 0.5, run.x + around + 0.5)
    ones = np.ones(STEPS + 1)
    printed = Boxes("printed", run.x, run.d, crossed, Interval(run.d - 1, run.d + 1), ones, ones[1:], "b", ones < 0)
    fine = Interval(run.x[:-1] - 1, run.x[:-1] + 1)
    inputs = Interval(run.d[:-1] - 1, run.d[:-1] + 1)
    now = 9 * ones[1:]
    current = Boxes("current", run.x[:-1], run.d[:-1], fine, inputs, now, now[1:], "b", now < 0)
    outcome = reproduce.Reproduction(rows, run, printed, current, None)  # pyright: ignore[reportArgumentType]
    monkeypatch.setattr(reproduce, "reproduce", lambda: outcome)
    return outcome


def test_table_and_files(computed, tmp_path, capsys):
    out = tmp_path / "new" / "paper"
    assert main(["reproduce", "--out", str(out), "--progress", "never"]) == 0
    text, error = capsys.readouterr()
    assert error == ""
    assert sorted(path.name for path in out.iterdir()) == sorted(reproduce.FILES)
    lines = text.splitlines()
    assert all(len(line) <= WIDTH for line in lines if str(out) not in line)
    by_name = {line.split("  ")[1].strip(): " ".join(line.split()) for line in lines if line.startswith("  ")}
    assert by_name["K, row 2"] == "K, row 2 0.4177 2.1203 1.0817 2.0209 0.1768 1.3988 0.11 0.3143 no P5"
    assert by_name["L, row 1"] == "L, row 1 0 0.1017 0 0 0 0.2279 0.0629 0 2 of 4 P5"
    assert by_name["b^f"] == "b^f 0.82 0.21 -0.2 -0.14 0.82 0.21 -0.2 -0.14 yes"
    assert by_name["rk(I-K1+L1)"] == "rk(I-K1+L1) 2 1 no P1"
    assert by_name["calligraphic L"] == "calligraphic L 0.643 3.952 no P8"
    joined = " ".join(text.split())
    for row in computed.rows:
        assert row.reason in joined
        assert row.agrees or example.FINDINGS[row.finding] in joined
    assert "20 of 48 printed numbers" in joined
    assert f"{STEPS} of {STEPS} state boxes crossed, the first at k = 1" in joined
    for name in reproduce.FILES:
        assert str(out / name) in text


def test_default_folder(computed, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["reproduce"]) == 0
    assert {path.name for path in (tmp_path / "results" / "paper").iterdir()} == set(reproduce.FILES)
    assert "results/paper/figure_2.png" in capsys.readouterr().out


def test_on_a_terminal(computed):
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    stream = Terminal()
    show(computed, [], stream)
    for part in ("calligraphic L", "P12", "why not", "outcome"):
        assert part in stream.getvalue()


def test_unwritable_folder_is_found_before_the_work(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(reproduce, "reproduce", lambda: pytest.fail("computed all the same"))
    blocked = tmp_path / "file"
    blocked.write_text("kept")
    assert main(["reproduce", "--out", str(blocked / "below")]) == 2
    out, error = capsys.readouterr()
    assert out == ""
    assert error.startswith("gsisio: cannot write to ")
    assert error.count("\n") == 1
    assert blocked.read_text() == "kept"


def test_all_files_or_none(computed, tmp_path, capsys, monkeypatch):
    def full(boxes):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(reproduce, "figure_3", full)
    out = tmp_path / "out"
    assert main(["reproduce", "--out", str(out)]) == 2
    assert capsys.readouterr().err == f"gsisio: cannot write {out / 'figure_3.png'}: No space left on device\n"
    assert not out.exists()


def test_interrupted(tmp_path, capsys, monkeypatch):
    def stop():
        raise KeyboardInterrupt

    monkeypatch.setattr(reproduce, "reproduce", stop)
    assert main(["reproduce", "--out", str(tmp_path / "out")]) == 130
    assert capsys.readouterr().err == "gsisio: interrupted, no file was written\n"
    assert not (tmp_path / "out").exists()


def test_help_names_the_command(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    assert "gsisio reproduce" in capsys.readouterr().out
