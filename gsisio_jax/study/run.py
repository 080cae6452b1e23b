"""The run of a study: all its tiles, collected in memory or in a store, here or on a cluster."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from gsisio_jax._extras import need
from gsisio_jax._version import __version__
from gsisio_jax.observer.checks import AnyObserver
from gsisio_jax.study import cluster
from gsisio_jax.study.bar import bar
from gsisio_jax.study.certified_widths import beside, promised
from gsisio_jax.study.crew import Crew
from gsisio_jax.study.job import Job, Results, Running
from gsisio_jax.study.labels import Labels, coordinates_of, variables_of
from gsisio_jax.study.later import delay_of


def run(
    job: Job,
    observer: AnyObserver,
    labels: Labels,
    title: str,
    store: Any,
    resume: bool,
    progress: bool,
    client: Any = None,
    mesh: Any = None,
) -> Any:
    """All tiles of a study, as the labelled dataset.

    Args:
        job: the study.
        observer: as the user gave it (that of the job may be in single precision).
        labels: names and units.
        title: attribute of the dataset.
        store: path, or None for memory.
        resume: go on with a store that is there.
        progress: show a bar.
        client: of a Dask cluster that computes the tiles, or None for this process.
        mesh: local devices that share every tile, or None.

    Raises:
        ValueError: `client` and `mesh` together, or one of them cannot be used; or a tile fails.
    """
    xarray = need("xarray", extra="study", purpose="a study")
    if client is not None and mesh is not None:
        raise ValueError(
            f"{job.call}: `client` and `mesh` cannot be combined; give `client` for several machines (each worker uses "
            "the first device that it sees), or `mesh` for several devices of this one"
        )
    if client is not None:
        cluster.check(job.call, client)
    if mesh is not None:
        job = job.on(mesh)
    layout = job.layout
    variables = variables_of((*job.reductions, job.rows), job.shapes, labels)
    coordinates = coordinates_of(layout, job.reductions, labels, variables)
    attributes = {
        "title": title,
        "certificate": str(observer.certificate),
        "guaranteed": observer.guaranteed,
        "steps": labels.steps,
        **({"delay": delay} if (delay := delay_of(observer)) else {}),
        "tile": job.size,
        "library": f"gsisio_jax {__version__}, jax {jax.__version__}",
    }
    if store is None:
        values = {name: np.empty((layout.cases, *v[0]), v[1]) for name, v in variables.items()}

        def keep(tile: int, results: Results) -> None:
            for name, array in results.items():
                values[name][job.cases(tile)[0] : job.cases(tile)[-1] + 1] = array

        with bar(job, range(job.tiles), progress) as advance:
            if client is None:
                _compute(job, range(job.tiles), keep, advance)
            else:
                cluster.compute(client, job, range(job.tiles), advance, keep=keep)
        data = {
            name: ((*layout.names, *dims), values[name].reshape((*layout.sizes, *shape)), about)
            for name, (shape, _, dims, about) in variables.items()
        }
        result = xarray.Dataset(data, coords=coordinates, attrs=attributes)
    else:
        from gsisio_jax.study.store import Header, TileStore

        axes = dict(zip(layout.names, layout.sizes, strict=True))
        header = Header(layout.cases, job.size, variables, coordinates, attributes, job.fingerprint(), axes)
        tiles = TileStore.open(store, header, resume)
        missing = tiles.missing()
        with bar(job, missing, progress) as advance:
            if client is None:
                _compute(job, missing, tiles.write, advance)
            else:
                cluster.compute(client, job, missing, advance, store=tiles)
        result = tiles.dataset()
    return result.assign(beside(observer, layout, promised(observer.certificate, job.arguments["noise"]), labels))


def _compute(
    job: Job, tiles: Sequence[int], keep: Callable[[int, Results], None], advance: Callable[[int], None]
) -> None:
    """Tiles in order, two at a time: one is started before the last one is waited for, so that no core stands idle."""

    def finish(tile: int, running: Running) -> None:
        keep(tile, job.finish(tile, running))
        advance(tile)

    before: tuple[int, Running] | None = None
    with Crew() as crew:
        for tile in tiles:
            running = job.start(tile, crew)
            if before is not None:
                finish(*before)
            before = tile, running
        if before is not None:
            finish(*before)
