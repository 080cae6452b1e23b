"""A study as tiles that any process can compute, and the run that collects them."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import numpy as np

import gsisio_jax
from gsisio_jax._extras import need
from gsisio_jax.estimation import AnyObserver
from gsisio_jax.study.axes import Layout
from gsisio_jax.study.kernel import fingerprint, outline, run_cases, tile_size
from gsisio_jax.study.labels import Labels, coordinates_of, variables_of
from gsisio_jax.study.promises import along, beside, promised
from gsisio_jax.study.reduce import Reduction
from gsisio_jax.study.rows import Rows

PATIENCE = 2.0  # seconds before a bar appears

Results = dict[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Job:
    """All that a tile of a study takes; can be sent to other processes.

    Attributes:
        call: what messages name.
        observer: in the type of the data.
        arguments: of all cases, bare or on an axis.
        layout: the axes.
        rows: what the observer is given at every step.
        reductions: what is kept of every run.
        hold: as in `estimate`, ``on_conflict="hold"``.
        size: cases per tile.
        shapes: of the results of one case.
    """

    call: str
    observer: AnyObserver
    arguments: dict[str, Any]
    layout: Layout
    rows: Rows
    reductions: tuple[Reduction, ...]
    hold: bool
    size: int
    shapes: dict[str, jax.ShapeDtypeStruct]

    @classmethod
    def plan(
        cls,
        call: str,
        observer: AnyObserver,
        arguments: dict[str, Any],
        dtype: Any,
        ranks: dict[str, tuple[int, ...]] | None,
        rows: Rows,
        reductions: tuple[Reduction, ...],
        hold: bool,
        batch: int | None,
    ) -> Job:
        """Lay out the cases and choose the size of a tile.

        Raises:
            ValueError: the axes do not agree, or `batch` is not a number of cases.
        """
        noise = arguments["noise"]
        steady = along(noise, promised(observer.certificate, noise)[0].astype(dtype))
        # In the order of the arguments, so that the axes are those that the user sees.
        layout = Layout.build(call, arguments | {"steady": steady}, ranks)
        arguments = arguments | {"steady": steady}
        if dtype != np.float64:
            observer = observer.astype(dtype)
        one, shared = layout.take(arguments, np.zeros(1, int)), layout.shared(arguments)
        shapes, cost = outline(observer, one, shared, rows, reductions, hold)
        return cls(
            call, observer, arguments, layout, rows, reductions, hold, _batch(call, batch, cost, layout.cases), shapes
        )

    @cached_property
    def _shared(self) -> Any:
        return jax.device_put(self.layout.shared(self.arguments))

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "_shared"}

    @property
    def tiles(self) -> int:
        """Number of tiles."""
        return -(-self.layout.cases // self.size)

    def cases(self, tile: int) -> np.ndarray:
        """Numbers of the cases of a tile."""
        return np.arange(tile * self.size, min((tile + 1) * self.size, self.layout.cases))

    def start(self, tile: int) -> dict[str, Any]:
        """Results of a tile, started but not waited for; the last one is filled up with its last case."""
        cases = np.minimum(np.arange(tile * self.size, (tile + 1) * self.size), self.layout.cases - 1)
        varying = self.layout.take(self.arguments, cases)
        return run_cases(self.observer, varying, self._shared, self.rows, self.reductions, self.hold)

    def finish(self, tile: int, running: dict[str, Any]) -> Results:
        """Wait for a tile that was started, and check it.

        Raises:
            ValueError: the results cannot be (see `Rows.check`).
        """
        cases = self.cases(tile)
        results = {name: np.asarray(array)[: len(cases)] for name, array in running.items()}
        self.rows.check(self, cases, results)
        return results

    def fingerprint(self) -> str:
        """Identifies the study by all that its numbers depend on."""
        axes = dict(zip(self.layout.names, self.layout.sizes, strict=True))
        rest = axes, self.layout.placed, self.size, self.hold
        return fingerprint(self.observer, self.arguments, self.rows, self.reductions, *rest)


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
    """
    xarray = need("xarray", extra="study", purpose="a study")
    layout = job.layout
    variables = variables_of((*job.reductions, job.rows), job.shapes, labels)
    coordinates = coordinates_of(layout, job.reductions, labels, variables)
    attributes = {
        "title": title,
        "certificate": str(observer.certificate),
        "steps": labels.steps,
        "tile": job.size,
        "library": f"gsisio_jax {gsisio_jax.__version__}, jax {jax.__version__}",
    }
    if store is None:
        values = {name: np.empty((layout.cases, *v[0]), v[1]) for name, v in variables.items()}

        def keep(tile: int, results: Results) -> None:
            for name, array in results.items():
                values[name][job.cases(tile)[0] : job.cases(tile)[-1] + 1] = array

        _compute(job, range(job.tiles), keep, progress)
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
        _compute(job, tiles.missing(), tiles.write, progress)
        result = tiles.dataset()
    return result.assign(beside(observer, layout, promised(observer.certificate, job.arguments["noise"]), labels))


def _compute(job: Job, tiles: Sequence[int], keep: Callable[[int, Results], None], progress: bool) -> None:
    """Tiles in order, two at a time: one is started before the last one is waited for, so that no core stands idle."""
    bar = None
    if progress and tiles and sys.stderr.isatty():
        tqdm = need("tqdm", extra="study", purpose="a progress bar (progress=False does without)")
        bar = tqdm.tqdm(total=job.layout.cases, unit="case", unit_scale=True, delay=PATIENCE, leave=False)
        bar.update(job.layout.cases - sum(len(job.cases(tile)) for tile in tiles))

    def finish(tile: int, running: dict[str, Any]) -> None:
        keep(tile, job.finish(tile, running))
        if bar is not None:
            bar.update(len(job.cases(tile)))

    try:
        before: tuple[int, dict[str, Any]] | None = None
        for tile in tiles:
            running = job.start(tile)
            if before is not None:
                finish(*before)
            before = tile, running
        if before is not None:
            finish(*before)
    finally:
        if bar is not None:
            bar.close()


def _batch(call: str, batch: int | None, cost: float, cases: int) -> int:
    if batch is None:
        return tile_size(cost, cases)
    if not isinstance(batch, int | np.integer) or batch < 1:
        raise ValueError(f"{call}: `batch` must be a number of cases per tile, at least 1, or None; got {batch!r}")
    return min(int(batch), cases)
