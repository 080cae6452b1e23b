"""Tables too long for memory, runs that are interrupted: the same files in the end, bit for bit."""

from __future__ import annotations

import json

import numpy as np
import pytest
import xarray

from gsisio_jax.cli import boxes, checkpoint, run
from gsisio_jax.cli.boxes import Boxes, record_type
from gsisio_jax.cli.labelled import _hulls
from gsisio_jax.cli.logs import Table, TablePart, TableStream, parser, read_table
from gsisio_jax.cli.run import chunks

FILES = ("boxes.csv", "cart.nc", "cart.png", "cart.html")


@pytest.fixture
def short_memory(monkeypatch):
    """What is long for ten million rows is long here for forty: chunks of 8, rows on the disk after the first, a
    checkpoint after every chunk, files written 16 rows at a time."""
    monkeypatch.setattr(run.run, "__defaults__", (8, *run.run.__defaults__[1:]))
    monkeypatch.setattr(boxes, "IN_MEMORY", 1)
    monkeypatch.setattr(Boxes.parts, "__defaults__", (16,))
    monkeypatch.setattr(checkpoint, "EVERY", 0.0)


def stop_after(monkeypatch, count, error=KeyboardInterrupt):
    """A run that ends at its n-th checkpoint, once that is written."""
    save, left = checkpoint.Checkpoint.save, [count]

    def saving(self, *args):
        save(self, *args)
        left[0] -= 1
        if left[0] == 0:
            raise error

    monkeypatch.setattr(checkpoint.Checkpoint, "save", saving)


def test_parts_make_the_files_of_the_whole(project, short_memory, monkeypatch):
    """Interrupted twice and resumed twice, against one run in memory."""
    with monkeypatch.context() as patch:
        patch.setattr(boxes, "IN_MEMORY", 1000)
        assert project.run("--out", str(project.folder / "whole"))[0] == 0
    part = project.out / ".cart.part"
    for count, step in ((2, 17), (1, 25)):
        with monkeypatch.context() as patch:
            stop_after(patch, count)
            code, out, err = project.run("--resume")
        assert (code, out) == (130, "")
        assert err == (
            f"gsisio: interrupted, no file was written; the same command with --resume goes on after step {step}\n"
        )
        assert [path.name for path in project.out.iterdir()] == [".cart.part"]
        # A kill while rows were written leaves more of them than the checkpoint knows, the last one torn.
        with open(part / "rows.bin", "ab") as stream:
            stream.write(b"torn" * 50)
    code, out, err = project.run("--resume", "--format", "json")
    assert (code, err) == (0, "")
    assert json.loads(out)["resumed"] == 25
    assert sorted(path.name for path in project.out.iterdir()) == sorted(FILES)
    assert (project.out / "boxes.csv").read_bytes() == (project.folder / "whole" / "boxes.csv").read_bytes()
    with (
        xarray.open_dataset(project.out / "cart.nc") as ours,
        xarray.open_dataset(project.folder / "whole/cart.nc") as all,
    ):
        xarray.testing.assert_identical(ours.load(), all.load())


def test_resume_refuses_another_run(project, short_memory, monkeypatch):
    with monkeypatch.context() as patch:
        stop_after(patch, 2)
        assert project.run()[0] == 130
    kept = {path.name: path.read_bytes() for path in (project.out / ".cart.part").iterdir()}
    table = (project.folder / "cart.csv").read_text()
    lines = table.splitlines()
    time, position, rest = lines[4].split(",", 2)
    for changed in ([*lines[:4], f"{time},{position}1,{rest}", *lines[5:]], lines[:12]):
        project.write_table(changed)
        words = "the first 17 steps of the table are not those of the interrupted run; begin anew without --resume"
        assert project.run("--resume") == (2, "", f"gsisio: --resume: {words}\n")
    (project.folder / "cart.csv").write_text(table)
    project.edit("v = {radius = [0.1, 0.1]}", "v = {radius = [0.1, 0.2]}")
    code, _, err = project.run("--resume")
    assert (code, "had another plant, noise, initial box" in err) == (2, True)
    # Without --resume a run that ends before it has rows of its own leaves the old ones alone.
    (project.folder / "cart.csv").write_text("t,pos,vel\n0,1,1\n0.1,oops,1\n")
    assert project.run()[0] == 2
    assert {path.name: path.read_bytes() for path in (project.out / ".cart.part").iterdir()} == kept


def test_a_bad_cell_is_told_before_the_design(project, monkeypatch):
    """Without any observer; but for one beyond the rows that are read before."""

    def designed(*_, **__):
        raise ValueError("designed")

    monkeypatch.setattr("gsisio_jax.cli.run.design", designed)
    monkeypatch.setattr(parser.text_blocks, "__defaults__", ((), 300))
    lines = (project.folder / "cart.csv").read_text().splitlines()
    lines[35] = lines[35].replace(",fine", "x,fine")
    project.write_table(lines)
    project.refused("cart.csv: row 36, column 'vel': ")
    monkeypatch.setattr(boxes, "IN_MEMORY", 1)
    project.refused("designed")


def test_a_bad_cell_far_down_keeps_what_comes_before(project, short_memory, monkeypatch):
    monkeypatch.setattr(parser.text_blocks, "__defaults__", ((), 300))
    lines = (project.folder / "cart.csv").read_text().splitlines()
    good = lines[35]
    lines[35] = lines[35].replace(",", ",oops", 1)
    project.write_table(lines)
    code, _, err = project.run()
    assert code == 2
    assert "row 36, column 'pos'" in err
    assert err.endswith("(what comes before is kept: mend it and add --resume)\n")
    lines[35] = good
    project.write_table(lines)
    assert project.run("--resume")[0] == 0
    assert sorted(path.name for path in project.out.iterdir()) == sorted(FILES)


def test_the_log_is_not_written_over(project):
    project.edit('csv = "boxes.csv"\n', "")
    before = (project.folder / "cart.csv").read_bytes()
    code, _, err = project.run("--out", str(project.folder))
    assert (code, "it is a file that is read" in err) == (2, True)
    assert (project.folder / "cart.csv").read_bytes() == before


def test_two_runs_do_not_share_a_folder(tmp_path):
    first = checkpoint.Checkpoint(tmp_path / "a" / ".x.part")
    first.begin()
    with pytest.raises(ValueError, match="another run is at work there"):
        checkpoint.Checkpoint(tmp_path / "a" / ".x.part").begin()
    first.leave()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("sizes", [[1], [3, 1, 1, 12, 5], [40], [2, 0, 9]])
def test_chunks_are_whole_however_the_table_is_cut(sizes):
    rows = np.arange(sum(sizes), dtype=float)
    ends = np.cumsum(sizes)
    blocks = [
        Table(rows[end - size : end], rows[end - size : end, None], None) for size, end in zip(sizes, ends, strict=True)
    ]
    found = list(chunks(blocks, 4))
    np.testing.assert_array_equal(np.concatenate([part.time for part in found]), rows)
    assert len(found[0].time) == 1
    assert all(len(part.time) == 4 for part in found[1:-1])


def test_hulls_hold_every_box(tmp_path, monkeypatch):
    """Groups of neighbours against the same by plain loops."""
    rng = np.random.default_rng(3)
    kind = record_type(2, 1, 1)
    rows = np.zeros(101, kind)
    for name in ("state_lower", "input_lower"):
        rows[name] = rng.normal(size=rows[name].shape) - 3
    for name in ("state_upper", "input_upper"):
        rows[name] = rng.normal(size=rows[name].shape) + 3
    rows["time"], rows["y"] = np.arange(101.0), rng.normal(size=(101, 1))
    rows["y"][40:60] = np.nan
    rows["state_upper"][7] = np.inf
    monkeypatch.setattr("gsisio_jax.cli.labelled.MAXIMUM_POINTS", 10)
    monkeypatch.setattr(Boxes.parts, "__defaults__", (13,))
    stored = Boxes(kind, lambda: tmp_path / "rows.bin", limit=1)
    monkeypatch.setattr(boxes, "records", lambda *args: rows)
    stored.append(rows["time"], rows["y"], None)
    assert stored.on_disk
    found = _hulls(stored)
    stored.close()
    starts = [int(start) for start in np.linspace(0, 101, 10, endpoint=False)]
    for group, (begin, end) in enumerate(zip(starts, [*starts[1:], 101], strict=True)):
        mine, pair = rows[begin:end], found[2 * group : 2 * group + 2]
        np.testing.assert_array_equal(pair["time"], [begin, end - 1])
        np.testing.assert_array_equal(pair["state_lower"], np.tile(mine["state_lower"].min(axis=0), (2, 1)))
        np.testing.assert_array_equal(pair["state_upper"], np.tile(mine["state_upper"].max(axis=0), (2, 1)))
        seen = mine["y"][~np.isnan(mine["y"])]
        expected = [seen.min(), seen.max()] if len(seen) else [np.nan, np.nan]
        np.testing.assert_array_equal(pair["y"][:, 0], expected)


@pytest.mark.parametrize("size", [15, 40, 10_000])
@pytest.mark.parametrize("extra", [{}, {"on_duplicate": "mean"}, {"on_unsorted": "sort", "on_duplicate": "last"}])
def test_pieces_of_a_file_are_the_whole_file(tmp_path, monkeypatch, size, extra):
    """Gaps, doubles and disorder across the borders of blocks."""
    stamps = ["0", "0.1", "0.2", "0.5", "0.6", "1.1", "1.2"]
    if "on_duplicate" in extra:
        stamps[3:3] = ["0.2", "0.2"]
    if "on_unsorted" in extra:
        stamps[0], stamps[-2] = stamps[-2], stamps[0]
    path = tmp_path / "log.csv"
    path.write_text("t,a\n" + "".join(f"{stamp},{value}\n" for value, stamp in enumerate(stamps)))
    part = TablePart.model_validate({"file": "log.csv", "time": "t", "sample_time": 0.1, "y": ["a"], **extra})
    whole = read_table(path, part)
    monkeypatch.setattr(parser.text_blocks, "__defaults__", ((), size))
    stream = TableStream(path, part)
    found = run.joined(list(stream))
    np.testing.assert_array_equal(found.time, whole.time)
    np.testing.assert_array_equal(found.y, whole.y)
    assert stream.notes == whole.notes
    assert stream.total == len(stamps) + 1  # lines, the header included
