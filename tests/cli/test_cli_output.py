"""All files or none: unwritable folders, failures half-way, interruptions."""

from __future__ import annotations

from pathlib import Path

import pytest

from gsisio_jax.cli.errors import UserError
from gsisio_jax.cli.output import check_writable, write_all


def put(text: str):
    return lambda path: path.write_text(text)


def fail(path: Path):
    path.write_text("half")
    raise OSError(28, "No space left on device")


def test_files_replace_older_ones(tmp_path):
    out = tmp_path / "a" / "b"
    write_all(out, {"x.txt": put("1")})
    assert write_all(out, {"x.txt": put("2"), "y.txt": put("3")}) == [out / "x.txt", out / "y.txt"]
    assert {path.name: path.read_text() for path in out.iterdir()} == {"x.txt": "2", "y.txt": "3"}


def test_a_failure_leaves_the_older_files(tmp_path):
    write_all(tmp_path, {"x.txt": put("old")})
    with pytest.raises(UserError, match=r"cannot write .*y\.txt: No space left on device"):
        write_all(tmp_path, {"x.txt": put("new"), "y.txt": fail})
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"x.txt": "old"}


@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError])
def test_a_new_folder_is_removed_again(tmp_path, error):
    def stop(path):
        raise error

    with pytest.raises(error):
        write_all(tmp_path / "a" / "b", {"x.txt": put("1"), "y.txt": stop})
    assert list(tmp_path.iterdir()) == []


def test_a_writer_that_writes_nothing_is_noticed(tmp_path):
    with pytest.raises(UserError, match="made no such file"):
        write_all(tmp_path / "out", {"x.png": lambda path: None})
    assert list(tmp_path.iterdir()) == []


def test_the_check_leaves_nothing_behind(tmp_path):
    check_writable(tmp_path / "a" / "b", ["x.txt"])
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").write_text("")
    for out in ("file", "file/below"):
        with pytest.raises(UserError, match="file is not a folder"):
            check_writable(tmp_path / out, ["x.txt"])
    (tmp_path / "x.txt").mkdir()
    with pytest.raises(UserError, match="it is a folder"):
        check_writable(tmp_path, ["x.txt"])


def test_a_read_only_folder(tmp_path, monkeypatch):
    def refuse(*args, **kwargs):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("tempfile.mkdtemp", refuse)  # a test that runs as root may write anywhere
    with pytest.raises(UserError, match=r"^cannot write to .*: Permission denied$"):
        check_writable(tmp_path, ["x.txt"])


def test_unwritable_out_through_the_command_line(project):
    project.out.write_text("a file, no folder")
    project.refused("cannot write to", "out is not a folder")
    assert project.out.read_text() == "a file, no folder"


def test_unwritable_is_found_before_the_table_is_read(project):
    project.out.write_text("")
    (project.folder / "cart.csv").unlink()
    project.refused("is not a folder")


def test_a_picture_that_fails_leaves_no_file(project):
    project.edit("[outputs]", '[outputs]\ndraw = "cart_model:draw_fails"')
    project.refused("outputs.draw: cart_model:draw_fails raised RuntimeError: no paint")


@pytest.mark.parametrize("where", ["gsisio_jax.cli.run.run", "gsisio_jax.cli.output.write_csv"])
def test_interrupted(project, monkeypatch, where):
    def stop(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(where, stop)
    assert project.run() == (130, "", "gsisio: interrupted, no file was written\n")
    assert not project.out.exists()
