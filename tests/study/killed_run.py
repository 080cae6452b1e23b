"""Studies that are killed on purpose: started by `test_store.py`, prints one line of JSON.

Children are forked from a parent that has everything imported and has started no thread, so a kill costs milliseconds.
The package itself is not imported (it would load JAX, whose threads do not survive a fork): only its `store` is.
"""

from __future__ import annotations

import builtins
import importlib
import json
import os
import random
import signal
import sys
import time
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np


def store_module() -> Any:
    """`gsisio_jax.study.store` under package names that run no `__init__`."""
    root = Path(__file__).resolve().parents[2] / "gsisio_jax"
    for name, folder in (("gsisio_jax", root), ("gsisio_jax.study", root / "study")):
        package = types.ModuleType(name)
        package.__path__ = [str(folder)]
        sys.modules[name] = package
    module = importlib.import_module("gsisio_jax.study.store")
    assert "jax" not in sys.modules
    return module


def header(store: Any, rows: int, tile: int = 4, **changes: Any) -> Any:
    """A study of rows x 3 cases, the last tile partly filled where 3 rows do not divide."""
    values = {
        "cases": 3 * rows,
        "tile": tile,
        "variables": {
            "width": ((2,), "float64", ("state",), {"units": "m", "long_name": "last width"}),
            "status": ((), "int32", (), {"flag_masks": np.array([1, 2], np.int32), "flag_meanings": "A B"}),
            "kept": ((0, 5), "float32", ("input", "time"), {}),
        },
        "coords": {
            "noise": (("noise",), np.geomspace(0.01, 1, rows), {"units": "m"}),
            "run": (("run",), np.arange(3), {}),
            "state": (("state",), ["east", "north"], {}),
        },
        "attrs": {"title": "killed", "predicted": [0.5, np.float64(1.5)]},
        "fingerprint": "5f" * 32,
    }
    return store.Header(**(values | changes))


def tile_values(opened: Any, tile: int) -> dict[str, np.ndarray]:
    """Values that are the same in every run, with the numbers that a careless encoding loses."""
    cases = opened.cases(tile)
    random_state = np.random.default_rng(tile)
    width = random_state.normal(size=(cases.stop - cases.start, 2))
    width[0] = -0.0, [np.nan, np.inf, 0.0][tile % 3]
    status = random_state.integers(0, 3, size=len(width), dtype=np.int32) * (tile % 2)
    return {"width": width, "status": status.astype(np.int32), "kept": np.zeros((len(width), 0, 5), np.float32)}


def finish(
    store: Any,
    path: Path,
    rows: int,
    pause: float = 0.0,
    mine: Callable[[int], bool] = lambda tile: True,
    ready: Callable[[], Any] = lambda: None,
) -> None:
    """Open or create the study, say so, and write every tile that is missing."""
    opened = store.TileStore.open(path, header(store, rows))
    ready()
    for tile in opened.missing():
        if mine(tile):
            time.sleep(pause)
            opened.write(tile, tile_values(opened, tile))


def fork(work: Callable[[], None]) -> int:
    """Run `work` in a child; its exit code is 0 where it came to its end."""
    child = os.fork()
    if child:
        return child
    code = 1
    try:
        work()
        code = 0
    finally:
        os._exit(code)


def ended(child: int) -> int:
    """Wait for a child; its exit code, minus the signal where it was killed."""
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def random_kills(store: Any, folder: Path, count: int, rows: int) -> dict[str, Any]:
    """Kill runs until `count` were hit, each resumed by the next; finish every study that was begun.

    Every third run is killed 1 to 80 ms after its start, often before its store is laid out; the others 1 to 80 ms
    after their store is open, so that a slow disk does not leave the tiles undisturbed.
    """
    rng = random.Random(count)
    kills, studies, progress = 0, 0, []
    while kills < count:
        path = folder / f"killed-{studies}"
        while kills < count:
            told, tell = os.pipe()
            child = fork(
                lambda path=path, tell=tell: finish(store, path, rows, 0.003, ready=lambda: os.write(tell, b"!"))
            )
            os.close(tell)
            if kills % 3:
                os.read(told, 1)
            time.sleep(rng.uniform(0.001, 0.08))
            os.kill(child, signal.SIGKILL)
            code = ended(child)
            os.close(told)
            if code == 0:
                break
            assert code == -signal.SIGKILL, code
            kills += 1
            done = path / "tile_done"
            progress.append(sum(name.startswith("c.") for name in os.listdir(done)) if done.is_dir() else -1)
        assert ended(fork(lambda path=path: finish(store, path, rows))) == 0
        studies += 1
    return {"kills": kills, "studies": studies, "progress": progress}


def kill_points(store: Any, folder: Path, rows: int) -> dict[str, Any]:
    """Kill a run at its first, second, ... call that touches the disk, and resume it, until no call is left."""
    os.fsync = lambda handle: None  # a kill, unlike a power cut, loses nothing that was written
    point = 0
    while True:
        path = folder / f"point-{point}"
        code = ended(fork(lambda path=path, point=point: (_die_at(store, point), finish(store, path, rows))))
        assert code in (0, -signal.SIGKILL), (point, code)
        assert ended(fork(lambda path=path: finish(store, path, rows))) == 0, point
        if code == 0:
            return {"points": point}
        point += 1


def _die_at(store: Any, point: int) -> None:
    left = [point]

    def tick() -> None:
        if left[0] == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        left[0] -= 1

    def counted(call: Callable[..., Any]) -> Callable[..., Any]:
        def wrapped(*arguments: Any, **options: Any) -> Any:
            tick()
            return call(*arguments, **options)

        return wrapped

    class Half:
        """A file whose write can be cut in the middle."""

        def __init__(self, stream: Any) -> None:
            self.stream = stream

        def __getattr__(self, name: str) -> Any:
            return getattr(self.stream, name)

        def __enter__(self) -> Half:
            return self

        def __exit__(self, *_: Any) -> None:
            self.stream.close()

        def write(self, data: bytes) -> None:
            self.stream.write(data[: len(data) // 2])
            self.stream.flush()
            tick()
            self.stream.write(data[len(data) // 2 :])

    for name in ("replace", "rename", "fsync"):
        setattr(os, name, counted(getattr(os, name)))

    def halved(path: Path, mode: str) -> Any:
        stream = builtins.open(path, mode)  # noqa: SIM115
        return Half(stream) if mode == "xb" else stream

    store.open = halved


def concurrent(store: Any, folder: Path, workers: int, rows: int) -> dict[str, Any]:
    """Several processes at once: first each its own tiles of one new store, then all of them the same tiles."""
    own, same = folder / "own", folder / "same"
    for children in (
        [fork(lambda i=i: finish(store, own, rows, 0.001, lambda tile: tile % workers == i)) for i in range(workers)],
        [fork(lambda: finish(store, same, rows)) for _ in range(workers)],
    ):
        assert [ended(child) for child in children] == [0] * workers
    return {"workers": workers}


def main() -> None:
    mode, folder, *numbers = sys.argv[1:]
    store = store_module()
    importlib.import_module("zarr.codecs")
    work = {"random": random_kills, "points": kill_points, "concurrent": concurrent}[mode]
    print(json.dumps(work(store, Path(folder), *map(int, numbers))))


if __name__ == "__main__":
    main()
