"""The store never loses work: kills, a full disk, other studies, several writers, and the dataset read back."""

from __future__ import annotations

import builtins
import errno
import json
import os
import pickle
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from study import killed_run

from gsisio_jax import _extras
from gsisio_jax.study import store as store_module
from gsisio_jax.study.disk import StoreError
from gsisio_jax.study.store import TileStore

xarray = pytest.importorskip("xarray")
zarr = pytest.importorskip("zarr")


def header(rows: int = 4, **changes: Any) -> store_module.Header:
    return killed_run.header(store_module, rows, **changes)


def whole(path: Path, rows: int = 4) -> TileStore:
    """An undisturbed study."""
    killed_run.finish(store_module, path, rows)
    return TileStore.load(path)


def files(path: Path) -> dict[str, bytes]:
    """Every file of a store but the remains of killed runs."""
    found = {str(file.relative_to(path)): file.read_bytes() for file in path.rglob("*") if file.is_file()}
    return {name: data for name, data in found.items() if not name.endswith(".part")}


def same(one: Any, other: Any) -> None:
    """Two datasets agree bit for bit."""
    xarray.testing.assert_identical(one, other)
    for name in one.variables:
        assert one[name].dtype == other[name].dtype
        if one[name].dtype.kind != "U":
            assert one[name].values.tobytes() == other[name].values.tobytes()


def run(mode: str, folder: Path, *numbers: int) -> dict[str, Any]:
    command = [sys.executable, killed_run.__file__, mode, str(folder), *map(str, numbers)]
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, env=environment)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def check_folder(folder: Path, rows: int, tmp_path: Path) -> int:
    """Every store in the folder equals the undisturbed one, file by file; returns how many there are."""
    undisturbed = whole(tmp_path / "undisturbed", rows)
    expected = files(undisturbed.path)
    found = [path for path in folder.iterdir() if not path.name.endswith(".part")]
    for path in found:
        assert files(path) == expected, path
    same(TileStore.load(found[0]).dataset(), undisturbed.dataset())
    return len(found)


def test_fifty_kills(tmp_path: Path) -> None:
    (tmp_path / "runs").mkdir()
    report = run("random", tmp_path / "runs", 50, 13)
    assert report["kills"] == 50
    assert sum(progress >= 0 for progress in report["progress"]) >= 30  # killed among the tiles
    assert check_folder(tmp_path / "runs", 13, tmp_path) == report["studies"]


def test_killed_at_every_call_that_touches_the_disk(tmp_path: Path) -> None:
    (tmp_path / "runs").mkdir()
    report = run("points", tmp_path / "runs", 2)
    assert report["points"] > 40
    assert check_folder(tmp_path / "runs", 2, tmp_path) == report["points"] + 1


def test_concurrent_writers(tmp_path: Path) -> None:
    (tmp_path / "runs").mkdir()
    run("concurrent", tmp_path / "runs", 3, 17)
    assert check_folder(tmp_path / "runs", 17, tmp_path) == 2


def test_dataset(tmp_path: Path) -> None:
    opened = whole(tmp_path / "a", 5)  # 15 cases, the last of four tiles holds three
    dataset = opened.dataset()
    expected = np.concatenate([killed_run.tile_values(opened, tile)["width"] for tile in range(4)]).reshape(5, 3, 2)
    assert dataset.sizes == {"noise": 5, "run": 3, "state": 2, "input": 0, "time": 5}
    assert dataset["width"].dims == ("noise", "run", "state")
    assert dataset["width"].values.tobytes() == expected.tobytes()
    assert dataset["status"].dtype == np.int32
    assert dataset["status"].attrs["flag_masks"].dtype == np.int32
    assert dataset["kept"].shape == (5, 3, 0, 5)
    assert list(dataset["state"].values) == ["east", "north"]
    assert dataset["noise"].attrs == {"units": "m"}
    assert dataset.attrs["complete"] is True
    assert dataset.attrs["predicted"] == [0.5, 1.5]
    lazy = opened.dataset(cache=False)["width"]
    for key in (np.s_[2, 1], np.s_[::-1, 2], np.s_[1:4, [2, 0], 1], np.s_[[], :], np.s_[3:1]):
        np.testing.assert_array_equal(lazy[key].values, xarray.DataArray(expected)[key].values)
    points = xarray.DataArray([4, 0, 4], dims="point")
    np.testing.assert_array_equal(lazy.isel(noise=points, run=points // 2).values, expected[[4, 0, 4], [2, 0, 2]])
    same(pickle.loads(pickle.dumps(opened)).dataset(), dataset)


def test_any_zarr_reader_opens_it(tmp_path: Path) -> None:
    opened = whole(tmp_path / "a")
    dataset = xarray.open_zarr(opened.path, consolidated=False)
    assert dataset["width"].dims == ("case", "state")
    np.testing.assert_array_equal(dataset["width"].values, opened.dataset()["width"].values.reshape(12, 2))
    assert dataset["tile_done"].values.tolist() == [1, 1, 1]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="names of open files are read from /proc")
def test_a_tile_is_on_the_disk_before_its_marker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a power cut needs and no kill can show: contents are flushed before their name is given, the marker last."""
    opened = TileStore.open(tmp_path / "a", header())
    done = []
    flush, rename = os.fsync, os.replace

    def fsync(handle: int) -> None:
        flush(handle)
        done.append("flush " + Path(os.readlink(f"/proc/self/fd/{handle}")).name.removeprefix(".").split(".x")[0])

    def replace(source: Path, target: Path) -> None:
        rename(source, target)
        done.append(f"name {target.parent.name}/{target.name}")

    monkeypatch.setattr(store_module.uuid, "uuid4", lambda: type("Token", (), {"hex": "x"}))
    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(os, "replace", replace)
    opened.write(2, killed_run.tile_values(opened, 2))
    expected = []
    for folder, key in (("width", "c.2.0"), ("status", "c.2"), ("tile_done", "c.2")):
        expected += [f"flush {key}", f"name {folder}/{key}", f"flush {folder}"]
    assert done == expected


def test_unfinished_tiles_are_nan(tmp_path: Path) -> None:
    opened = TileStore.open(tmp_path / "a", header())
    assert opened.missing() == [0, 1, 2]
    opened.write(1, killed_run.tile_values(opened, 1))
    assert opened.missing() == [0, 2]
    dataset = opened.dataset()
    assert dataset.attrs["complete"] is False
    assert dataset.attrs["tiles"] == "1 of 3 finished"
    status = dataset["status"].values.ravel()
    assert status.dtype == np.float64
    assert np.array_equal(np.isfinite(status), np.arange(12) // 4 == 1)
    np.testing.assert_array_equal(status[4:8], killed_run.tile_values(opened, 1)["status"])
    same(TileStore.open(tmp_path / "a", header()).dataset(), dataset)


def test_a_chunk_without_its_marker_is_hidden_and_redone(tmp_path: Path) -> None:
    opened = whole(tmp_path / "a")
    expected = files(opened.path)
    (opened.path / "tile_done" / "c.1").unlink()
    (opened.path / "width" / "c.1.0").write_bytes(b"torn")
    (opened.path / "status" / "c.1").write_bytes(files(opened.path)["status/c.2"])
    assert opened.missing() == [1]
    assert np.isnan(opened.dataset()["status"].values.ravel()[4:8]).all()
    killed_run.finish(store_module, opened.path, 4)
    assert files(opened.path) == expected


def test_a_finished_tile_is_never_written_again(tmp_path: Path) -> None:
    opened = whole(tmp_path / "a")
    expected = files(opened.path)
    values = killed_run.tile_values(opened, 0)
    opened.write(0, values | {"width": values["width"] + 1})
    assert files(opened.path) == expected


def test_remains_of_killed_runs_are_removed(tmp_path: Path) -> None:
    opened = whole(tmp_path / "a")
    young, old = opened.path / "width" / ".c.0.0.x.part", tmp_path / ".a.y.part"
    young.touch()
    old.mkdir()
    os.utime(old, (0, 0))
    TileStore.open(opened.path, header())
    assert young.exists()  # its writer may be alive
    assert not old.exists()
    opened.dataset()
    assert not young.exists()


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"fingerprint": "00" * 32}, "fingerprint"),
        ({"tile": 6}, "tile size 4, now 6"),
        ({"fingerprint": "0", "coords": {"noise": ("noise", np.ones(4)), "run": ("run", np.arange(3))}}, "`noise`"),
        ({"fingerprint": "0", "attrs": {"title": "other"}}, "`predicted`; `title`"),
        ({"variables": {"width": ((2,), "float32", ("state",), {})}, "axes": {"noise": 4, "run": 3}}, "shape or dtype"),
        ({"cases": 6, "axes": {"noise": 2, "run": 3}}, "cases 12, now 6"),
    ],
)
def test_another_study_is_refused(tmp_path: Path, changes: dict[str, Any], named: str) -> None:
    opened = whole(tmp_path / "a")
    expected = files(opened.path)
    with pytest.raises(
        ValueError, match=r"belongs to another study \(differs in .*give another path or delete it"
    ) as caught:
        TileStore.open(opened.path, header(**changes))
    assert named in str(caught.value)
    assert files(opened.path) == expected


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    opened = TileStore.open(tmp_path / "empty", header(), resume=False)
    with pytest.raises(ValueError, match=r"is there already.*resume=True"):
        TileStore.open(opened.path, header(), resume=False)
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "thesis.tex").touch()
    (tmp_path / "file").touch()
    zarr.create_group(tmp_path / "group")
    for name in ("folder", "file", "group"):
        with pytest.raises(ValueError, match=r"holds no stored study; give another path"):
            TileStore.open(tmp_path / name, header())
    with pytest.raises(ValueError, match="holds no stored study"):
        TileStore.load(tmp_path / "none")


def test_unwritable_path(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(
        StoreError, match=r"^store: cannot create .*file/a: .*; nothing was written; check the path"
    ) as caught:
        TileStore.open(tmp_path / "file" / "a", header())
    assert isinstance(caught.value, ValueError)
    assert "\n" not in str(caught.value)


def full_disk(monkeypatch: pytest.MonkeyPatch, after: int) -> None:
    """The disk has room for `after` more flushes."""
    flush, left = os.fsync, [after]

    def fsync(handle: int) -> None:
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        flush(handle)

    monkeypatch.setattr(os, "fsync", fsync)


def test_disk_full_at_creation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for after in (0, 5, 11):
        with monkeypatch.context() as patch:
            full_disk(patch, after)
            with pytest.raises(StoreError, match=r"No space left on device; nothing was written; free some space"):
                TileStore.open(tmp_path / "a", header())
        assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("after", [0, 1, 2, 3, 4, 5])
def test_disk_full_in_a_tile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, after: int) -> None:
    opened = TileStore.open(tmp_path / "a", header())
    opened.write(0, killed_run.tile_values(opened, 0))
    with monkeypatch.context() as patch:
        full_disk(patch, after)
        if after < 5:
            told = (
                r"cannot write tile 1 to .*: No space left.*; 1 of 3 tiles are finished and kept; free some space, then"
            )
            with pytest.raises(StoreError, match=told) as caught:
                opened.write(1, killed_run.tile_values(opened, 1))
            assert caught.value.errno == errno.ENOSPC
            assert opened.missing() == [1, 2]
        else:  # only the flush of the marker's folder failed: the tile is there
            opened.write(1, killed_run.tile_values(opened, 1))
    assert not list(opened.path.rglob("*.part"))
    killed_run.finish(store_module, opened.path, 4)
    assert files(opened.path) == files(whole(tmp_path / "b").path)


def test_a_limit_of_the_system_itself(tmp_path: Path) -> None:
    """A real refusal in the middle of a write, not a patched one."""
    opened = TileStore.open(tmp_path / "a", header())
    values = {name: killed_run.tile_values(opened, 0)[name] for name in ("width", "status", "kept")}
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (16, hard))
    try:
        with pytest.raises(StoreError, match=r"File too large; 0 of 3 tiles .*free some space"):
            opened.write(0, values)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not list(opened.path.rglob("*.part"))
    killed_run.finish(store_module, opened.path, 4)
    assert files(opened.path) == files(whole(tmp_path / "b").path)


def test_deleted_while_it_is_written(tmp_path: Path) -> None:
    opened = TileStore.open(tmp_path / "a", header())
    os.rename(opened.path, tmp_path / "gone")
    with pytest.raises(StoreError, match=r"cannot write tile 0 .*check the path"):
        opened.write(0, killed_run.tile_values(opened, 0))
    with pytest.raises(StoreError, match="cannot read"):
        opened.missing()


def test_netcdf(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("netCDF4")
    opened = whole(tmp_path / "a")
    target = opened.export_netcdf(tmp_path / "study.nc")
    with xarray.open_dataset(target, engine="netcdf4") as read:
        expected = opened.dataset()
        for name in expected.variables:
            np.testing.assert_array_equal(read[name].values, expected[name].values)
            assert read[name].dtype.kind in (expected[name].dtype.kind, "O")
        assert read["width"].values.tobytes() == expected["width"].values.tobytes()
        assert read.attrs["complete"] == 1
        assert read["width"].attrs == expected["width"].attrs
    before = target.read_bytes()
    with monkeypatch.context() as patch:
        full_disk(patch, 0)
        with pytest.raises(StoreError, match=r"cannot write .*study.nc: No space left"):
            opened.export_netcdf(target)
    assert target.read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "study.nc"]
    with pytest.raises(StoreError, match="cannot write"):
        opened.export_netcdf(tmp_path / "none" / "study.nc")


def test_wrong_tiles(tmp_path: Path) -> None:
    opened = TileStore.open(tmp_path / "a", header(5))
    values = killed_run.tile_values(opened, 0)
    with pytest.raises(ValueError, match="has tiles 0 to 3"):
        opened.write(4, values)
    with pytest.raises(ValueError, match="keeps the variables"):
        opened.write(0, {"width": values["width"]})
    with pytest.raises(
        ValueError, match=r"`width` of tile must be float64 of shape \(3, 2\), got float64 of shape \(4, 2\)"
    ):
        opened.write(3, values)
    with pytest.raises(ValueError, match="`status` of tile must be int32"):
        opened.write(0, values | {"status": values["status"].astype(float)})
    assert opened.missing() == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"axes": {"noise": 5, "run": 3}}, "name them in Header.axes"),
        ({"tile": 0}, "tiles of 0"),
        (
            {"variables": {"big": ((2**28,), "f8", ("time",), {})}, "axes": {"noise": 4, "run": 3}},
            "give a smaller batch",
        ),
        ({"variables": {"a": ((2,), "float64", (), {})}, "coords": {}, "axes": {"run": 12}}, "does not fit"),
        ({"variables": {"a/b": ((), "float64", (), {})}, "coords": {}, "axes": {"run": 12}}, "rename it"),
        ({"coords": {"noise": ("noise", np.ones((4, 2)))}}, "must be numbers or text"),
    ],
)
def test_wrong_headers(tmp_path: Path, changes: dict[str, Any], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        TileStore.open(tmp_path / "a", header(**changes))
    assert list(tmp_path.iterdir()) == []


def test_one_case_and_coordinates_of_any_rank(tmp_path: Path) -> None:
    coords = {"bound": ((), 0.5), "box": (("side", "state"), np.eye(2)), "none": ("none", np.zeros(0))}
    one = header(cases=1, tile=1, axes={}, coords=coords)
    opened = TileStore.open(tmp_path / "a", one)
    opened.write(0, {"width": np.ones((1, 2)), "status": np.ones(1, np.int32), "kept": np.zeros((1, 0, 5), np.float32)})
    dataset = TileStore.open(tmp_path / "a", one).dataset()
    assert dataset["width"].values.tolist() == [1.0, 1.0]
    assert dataset["status"].item() == 1
    assert dataset["box"].values.tolist() == [[1.0, 0.0], [0.0, 1.0]]


def test_missing_zarr_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> Any:
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)

    monkeypatch.setattr(_extras.importlib, "import_module", absent)
    with pytest.raises(_extras.MissingExtra, match=r"storing a study needs zarr; .*gsisio_jax\[study\]"):
        TileStore.open(tmp_path / "a", header())


def test_the_store_is_imported_without_jax_and_zarr() -> None:
    code = "import sys; sys.path.insert(0, sys.argv[1]); import killed_run; killed_run.store_module(); "
    code += "assert not {'jax', 'zarr', 'xarray'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code, str(Path(killed_run.__file__).parent)], check=True, timeout=60)
    assert builtins.open is open
