"""A study on the workers of a Dask cluster: tiles are tasks, and a worker that dies costs the tile that it had at hand.

The job travels once to every worker. With a store the workers write their tiles themselves and only say so; otherwise
the results come back as they are ready. A worker computes one tile at a time, on as many cores as Dask gave it threads,
and rounds as this process does: it takes over the configuration of JAX, and the flags of XLA where it has not started.
"""

from __future__ import annotations

import contextlib
import itertools
import time
import uuid
import warnings
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import CancelledError
from typing import TYPE_CHECKING, Any, NamedTuple

from gsisio_jax._extras import need
from gsisio_jax.study.worker import Parcel, compute_tile

if TYPE_CHECKING:
    from gsisio_jax.study.job import Job, Results
    from gsisio_jax.study.store import TileStore

PER_WORKER = 2  # tiles in flight: one that runs and one that is ready to
LOSSES = 3  # times that a tile may be lost
ALONE = 60.0  # seconds without any worker before it is said
SEEN = 90.0  # seconds that a file of another machine may take to be seen; NFS keeps its folders for 60


def check(call: str, client: Any) -> None:
    """Refuse what is no client of a cluster that runs.

    Raises:
        ValueError: and what to give.
        MissingExtra: distributed is not installed.
    """
    distributed = need("distributed", extra="cluster", purpose="`client`")
    if not isinstance(client, distributed.Client) or client.asynchronous:
        kind = f"asynchronous {type(client).__name__}" if hasattr(client, "asynchronous") else type(client).__name__
        raise ValueError(f"{call}: `client` must be a dask.distributed.Client that is not asynchronous, got {kind}")
    if client.status != "running":
        raise ValueError(f"{call}: `client` is not connected ({client.status}); make a new one: Client(cluster)")


def compute(
    client: Any,
    job: Job,
    tiles: Sequence[int],
    advance: Callable[[int], None],
    keep: Callable[[int, Results], None] | None = None,
    store: TileStore | None = None,
) -> None:
    """Compute tiles on the workers.

    Args:
        client: a ``dask.distributed.Client``.
        job: the study.
        tiles: their numbers.
        advance: called after every tile.
        keep: takes the results of a tile, where there is no store.
        store: takes them on the workers, to which its path must mean the same folder.

    Raises:
        ValueError: whatever a tile raises; a tile was lost with its worker again and again; the scheduler is gone; or
            the store is not in a folder that all share.
    """
    distributed = need("distributed", extra="cluster", purpose="`client`")
    kept = f"; finished tiles are kept in {store.path}, make the same call again to go on" if store else ""
    parcel = Parcel.of(job, store)
    waiting, lost = deque(tiles), Counter[int]()
    running: dict[Any, _Running] = {}
    sent = None
    try:
        while waiting or running:
            sent = _send(client, parcel) if sent is None else sent
            for worker in itertools.islice(_free(client, running), len(waiting)):
                tile = waiting.popleft()
                key = f"{job.call}-{uuid.uuid4().hex}-{tile}"
                # Should the worker die, any other will do.
                where = {} if worker is None else {"workers": [worker], "allow_other_workers": True}
                running[client.submit(compute_tile, sent, tile, key=key, pure=False, **where)] = _Running(tile, worker)
            for future in _ended(client, job.call, running):
                tile, _ = running.pop(future)
                try:
                    results = future.result()
                except CancelledError as error:  # the workers that had the parcel or the results died
                    _await_scheduler(client)
                    lost[tile] += 1
                    if lost[tile] > LOSSES:
                        raise ValueError(_given_up(job, tile) + kept) from error
                    waiting.append(tile)  # behind the others, should it be the one that kills
                    sent = None
                    continue
                except distributed.KilledWorker as error:
                    raise ValueError(_given_up(job, tile) + kept) from error
                if keep is not None:
                    keep(tile, results)
                advance(tile)
    except (OSError, RuntimeError) as error:
        if client.status == "running" and not isinstance(error, distributed.comm.CommClosedError):
            raise
        raise ValueError(f"{job.call}: the cluster is gone ({client.status}): {error}{kept}") from error
    finally:
        with contextlib.suppress(Exception):  # what is left to cancel, where there is still a scheduler to be told
            client.cancel(list(running))
    if store is not None:
        _await_files(job.call, store, tiles)


class _Running(NamedTuple):
    """A tile in flight, and the address of the worker that was asked for it."""

    tile: int
    worker: str | None


def _free(client: Any, running: dict[Any, _Running]) -> list[str | None]:
    """Workers that can take a tile, those with the fewest first, each as often as it can; None: any."""
    loads = Counter(worker for _, worker in running.values())
    free = [(n, worker) for worker in client.nthreads() for n in range(loads[worker], PER_WORKER)]
    return [worker for _, worker in sorted(free)] or ([] if running else [None])


def _send(client: Any, parcel: Parcel) -> Any:
    """The parcel on one worker; the others get it from there with their first tile."""
    for attempt in itertools.count(1):
        try:
            # A cluster that grows with its load starts no worker for data, but it does for a task.
            ready = client.submit(_ready, pure=False)
            _ended(client, parcel.rest.call, [ready])
            ready.result()
            return client.scatter(parcel, hash=False)
        except ModuleNotFoundError as error:
            raise ValueError(
                f"{parcel.rest.call}: the workers cannot import gsisio_jax ({error}); install it on them, the same "
                "version as here"
            ) from error
        except Exception as error:  # the worker died meanwhile, and Dask has many ways to say so
            _await_scheduler(client)
            if attempt == LOSSES:
                raise ValueError(
                    f"{parcel.rest.call}: the workers cannot be given the study: {error}; their logs say what ails them"
                ) from error


def _ready() -> None:
    pass


def _ended(client: Any, call: str, running: Iterable[Any]) -> list[Any]:
    """Wait until some futures have ended in any way; say so where there is no worker to end them."""
    distributed = need("distributed", extra="cluster", purpose="`client`")
    since = time.monotonic()
    told = False
    while not (ended := [future for future in running if future.done()]):
        # A cancelled one ends the wait as well.
        with contextlib.suppress(TimeoutError, CancelledError):
            distributed.wait(list(running), timeout=5, return_when="FIRST_COMPLETED")
        if client.nthreads():
            since = time.monotonic()
        elif not told and time.monotonic() - since > ALONE:
            warnings.warn(f"{call}: the cluster has no workers; waiting for some", RuntimeWarning, stacklevel=7)
            told = True
    return ended


def _await_scheduler(client: Any) -> None:
    """Give the client its time to find the scheduler again.

    Raises:
        ConnectionError: it did not.
    """
    while client.status == "connecting":
        time.sleep(0.1)
    if client.status != "running":
        raise ConnectionError("the connection to the scheduler was lost")


def _given_up(job: Job, tile: int) -> str:
    cases = job.cases(tile)
    return (
        f"{job.call}: tile {tile} (cases {cases[0]} to {cases[-1]}) is given up: the workers that had it died, again "
        f"and again. If they ran out of memory, give a smaller `batch` (now {job.size}) or workers with more; their "
        "logs say what ended them"
    )


def _await_files(call: str, store: TileStore, tiles: Sequence[int]) -> None:
    """The markers that other machines have written, as this one sees them."""
    deadline = time.monotonic() + SEEN
    while unseen := sorted(set(store.missing()) & set(tiles)):
        if time.monotonic() > deadline:
            raise ValueError(
                f"{call}: the workers have written {len(unseen)} tiles to {store.path} that are not there on this "
                "machine; give a `store` in a folder that all machines share"
            )
        time.sleep(0.5)
