"""What travels to a worker of a cluster, and what the worker does with it."""

from __future__ import annotations

import contextlib
import os
import platform
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import jax

from gsisio_jax._extras import need
from gsisio_jax._version import __version__
from gsisio_jax.scalar.options import fuses, loop_bytes, use_flags
from gsisio_jax.study.crew import Crew, configuration, configured

if TYPE_CHECKING:
    from gsisio_jax.study.job import Job, Results
    from gsisio_jax.study.store import TileStore

POOL = ("PJRT_NPROC", "NPROC")  # what XLA takes the number of its threads from, where one of them is set

_one_tile = threading.Lock()


class Setting(NamedTuple):
    """What the numbers depend on besides the job: versions, and configuration of JAX that is not part of any array."""

    python: str
    jax: str
    gsisio_jax: str
    x64: bool
    threefry_partitionable: bool
    matmul_precision: str | None
    fuses: bool
    loop_bytes: int

    @classmethod
    def here(cls) -> Setting:
        """That of this process and thread."""
        return cls(
            ".".join(platform.python_version_tuple()[:2]),
            jax.__version__,
            __version__,
            *configuration(),
            fuses(),
            loop_bytes(),
        )

    @contextlib.contextmanager
    def applied(self, call: str) -> Iterator[None]:
        """Compute as the process does that made this; the configuration of this process is left alone.

        Raises:
            ValueError: the versions differ.
        """
        here = Setting.here()
        differ = [f"{name} {there} ({now} here)" for name, now, there in zip(self._fields, self, here, strict=True)]
        differ = [text for text, now, there in zip(differ[:3], self, here, strict=False) if now != there]
        if differ:
            raise ValueError(
                f"{call}: a worker on {platform.node()} has {', '.join(differ)}, so its numbers could differ; install "
                "the same versions on the workers"
            )
        with configured(self.x64, self.threefry_partitionable, self.matmul_precision):
            yield


@dataclass(eq=False)
class Parcel:
    """What a worker is sent, once.

    Attributes:
        rest: the job without what is in `program`.
        program: observer, rows and reductions, pickled: they hold the user's functions, and arrays of JAX, which must
            be unpacked in the precision of the sender.
        setting: of the sender.
        store: where finished tiles go; None: back.
    """

    rest: Job
    program: bytes
    setting: Setting
    store: TileStore | None

    @classmethod
    def of(cls, job: Job, store: TileStore | None) -> Parcel:
        """Pack a job.

        Raises:
            ValueError: a function of the user cannot be sent.
        """
        pickle = need("cloudpickle", extra="cluster", purpose="`client`")
        try:
            program = pickle.dumps((job.observer, job.rows, job.reductions))
        except Exception as error:
            raise ValueError(
                f"{job.call}: the observer cannot be sent to workers: {error}; f, g and functions of the study must "
                "not hold on to open files, locks and the like"
            ) from error
        rest: Any = {"observer": None, "rows": None, "reductions": ()}
        return cls(replace(job, **rest), program, Setting.here(), store)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "job"}

    @cached_property
    def job(self) -> Job:
        """The job, unpacked once in every process."""
        try:
            observer, rows, reductions = _unpacked(self.program, self.setting.x64)
        except (ImportError, AttributeError) as error:
            raise ValueError(
                f"{self.rest.call}: a worker cannot load the functions of the study: {error}; send their module with "
                "client.upload_file('plant.py') or install it on the workers, or define f and g in the script itself"
            ) from error
        return replace(self.rest, observer=observer, rows=rows, reductions=reductions)


@lru_cache(maxsize=8)
def _unpacked(program: bytes, x64: bool) -> Any:
    """f and g of equal bytes are the same objects, so that later studies of an observer find it compiled."""
    return need("cloudpickle", extra="cluster", purpose="a worker").loads(program)


def compute_tile(parcel: Parcel, tile: int) -> Results | None:
    """The task: one tile, on a worker."""
    with _one_tile:
        threads = _prepare(parcel.setting.fuses)
        with parcel.setting.applied(parcel.rest.call), Crew(threads) as crew:
            job = parcel.job
            results = job.finish(tile, job.start(tile, crew))
    if parcel.store is None:
        return results
    parcel.store.write(tile, results)
    return None


@cache
def _prepare(flags: bool) -> int:
    """Before JAX starts: let XLA make as many threads as Dask gave this worker, otherwise every worker would take all
    cores of the machine; and give it the flags of the sender, otherwise it would round in other places.

    Nothing happens where JAX has started already. Threads are left alone where the environment says how many.

    Returns:
        Threads for a tile.
    """
    distributed = need("distributed", extra="cluster", purpose="a worker")
    system = need("dask.system", extra="cluster", purpose="a worker")
    if flags:
        use_flags()
    threads = min(distributed.get_worker().state.nthreads, system.CPU_COUNT)
    if any(name in os.environ for name in POOL):
        return threads
    os.environ.update(dict.fromkeys(POOL, str(threads)))
    try:
        jax.devices()
    finally:
        for name in POOL:
            del os.environ[name]
    return threads
