"""What `test_cluster.py` does to workers; they import it, so it imports nothing that they lack."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import gsisio_jax as gx
from gsisio_jax.errors import ContainmentLost
from gsisio_jax.observer import fixed
from gsisio_jax.study import kernel
from gsisio_jax.study import store as store_module
from gsisio_jax.study.job import Job


def plant(log: Path) -> gx.System:
    """Two states; f is a closure, as users have them, and says in a file when and where it is traced."""

    def f(x: Any) -> Any:
        with open(log, "a") as stream:
            stream.write(f"{os.getpid()}\n")
        return jnp.stack([x[0] + 0.1 * x[1], 0.9 * x[1]])

    return gx.System(f, lambda x: x, G=[[0.0], [0.1]], H=np.zeros((2, 1)))


def study(log: Path) -> dict[str, Any]:
    """A sweep of 22 boxes along one record."""
    ball = gx.Interval.symmetric
    noise = gx.Noise(ball(np.full(2, 1e-3)), ball(np.array([0.1, 0.2])))
    observer = gx.design_observer(plant(log), noise, gx.Interval.entire(2), missing=False, sweeps=1)
    observer = observer.with_rounding("nearest")  # less to compile
    initial = ball(np.linspace(0.5, 5, 22)[:, None] * np.ones(2))
    y = [np.array([0.1, -0.2])]
    for k in range(8):
        y.append(np.array([y[k][0] + 0.1 * y[k][1], 0.9 * y[k][1] + 0.1 * np.sin(k)]))
    return {
        "observer": observer,
        "initial": gx.grid("box", initial),
        "y": np.array(y),
        "reduce": ("final", "max"),
    }


def die_computing() -> None:
    """At the second tile from now on, while XLA is at it."""
    start, left = Job.start, [1]

    def deadly(self: Job, tile: int, crew: Any) -> Any:
        running = start(self, tile, crew)
        if left[0] == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        left[0] -= 1
        return running

    Job.start = deadly


def die_writing() -> None:
    """In the second tile from now on, when one of its files is there and the next is half written."""
    files = [0]
    write, put = store_module.TileStore.write, store_module.put

    def counted(self: Any, tile: int, values: Any) -> None:
        files[0] += 100
        write(self, tile, values)

    def half(path: Path, data: bytes) -> None:
        files[0] += 1
        if files[0] == 202:
            path.with_name(f".{path.name}.half{store_module.PART}").write_bytes(data[: len(data) // 2])
            os.kill(os.getpid(), signal.SIGKILL)
        put(path, data)

    store_module.TileStore.write, store_module.put = counted, half


def fail(error: bool) -> None:
    """Every tile from now on: with an error, or with the death of the worker."""

    def failing(self: Job, tile: int, crew: Any) -> Any:
        if error:
            raise ContainmentLost(f"sweep: run 17 of tile {tile} is lost")
        os.kill(os.getpid(), signal.SIGKILL)

    Job.start = failing


def state() -> dict[str, Any]:
    """Of a worker: its process, its precision, the threads with which XLA computes, and programs for tiles."""
    names = [task.read_text().strip() for task in Path("/proc/self/task").glob("*/comm")]
    return {
        "pid": os.getpid(),
        "x64": jax.config.jax_enable_x64,
        "pool": names.count("tf_XLAEigen"),
        "programs": sum(kernel.compiled(observer)._cache_size() for observer in list(fixed._known)),
    }


def slow() -> None:
    """Tiles take a while from now on."""
    start = Job.start

    def slowly(self: Job, tile: int, crew: Any) -> Any:
        time.sleep(0.1)
        return start(self, tile, crew)

    Job.start = slowly
