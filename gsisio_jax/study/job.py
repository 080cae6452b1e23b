"""A study as tiles that any process can compute."""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh

from gsisio_jax.observer.checks import AnyObserver
from gsisio_jax.observer.fixed import Fixed
from gsisio_jax.scalar import most_numbers
from gsisio_jax.study import devices
from gsisio_jax.study.axes import Layout
from gsisio_jax.study.certified_widths import along, promised
from gsisio_jax.study.crew import Crew
from gsisio_jax.study.kernel import fingerprint, outline, run_cases, tile_size
from gsisio_jax.study.reduction_base import Reduction
from gsisio_jax.study.row_source import Rows

Results = dict[str, np.ndarray]


class Running(NamedTuple):
    """A tile that was started: its results, on a CPU as far as its chunks are done."""

    results: dict[str, Any]
    chunks: list[Future[None]]


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
        chunk: cases that a CPU takes at once, the same for all tiles.
        most: numbers that a step may compute; the same for all tiles.
        shapes: of the results of one case.
        cost: bytes of working set of a case, where the size of a tile was chosen by it.
        mesh: devices that share a tile, from `devices.flat`.
    """

    call: str
    observer: AnyObserver
    arguments: dict[str, Any]
    layout: Layout
    rows: Rows
    reductions: tuple[Reduction, ...]
    hold: bool
    size: int
    chunk: int
    most: int
    shapes: dict[str, jax.ShapeDtypeStruct]
    cost: float | None = None
    mesh: Mesh | None = None

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
        planned = outline(observer, one, shared, rows, reductions, hold)
        size, chosen = _batch(call, batch, planned.cost, layout.cases), planned.cost if batch is None else None
        chunk, shapes = min(planned.chunk(layout.cases), size), planned.shapes
        most = most_numbers(float(planned.turns) * layout.cases)
        return cls(call, observer, arguments, layout, rows, reductions, hold, size, chunk, most, shapes, chosen)

    def on(self, mesh: Any) -> Job:
        """The same study with every tile spread over devices; a chosen tile grows with their number.

        Raises:
            ValueError: not a mesh of local devices.
        """
        mesh = devices.flat(self.call, mesh)
        size = self.size if self.cost is None else tile_size(self.cost / mesh.size, self.layout.cases)
        return replace(self, size=size, mesh=mesh)

    @cached_property
    def _common(self) -> tuple[Fixed, Any]:
        """What all tiles share: the observer, and arguments on the devices."""
        shared = self.layout.shared(self.arguments)
        return Fixed.of(self.observer), jax.device_put(shared) if self.mesh is None else devices.copied(
            shared, self.mesh
        )

    @property
    def tiles(self) -> int:
        """Number of tiles."""
        return -(-self.layout.cases // self.size)

    def cases(self, tile: int) -> np.ndarray:
        """Numbers of the cases of a tile."""
        return np.arange(tile * self.size, min((tile + 1) * self.size, self.layout.cases))

    def start(self, tile: int, crew: Crew) -> Running:
        """Start a tile, and do not wait for it.

        On a CPU the crew computes it in chunks, the last one filled up with the last case of the tile. A GPU takes all
        at once, and so does a mesh; there the last tile is filled up with its last case.
        """
        cases = self.cases(tile)
        if self.mesh is None and jax.default_backend() == "cpu":
            results = {name: np.empty((len(cases), *s.shape), s.dtype) for name, s in self.shapes.items()}

            def work(first: int) -> None:
                part = cases[np.minimum(first + np.arange(self.chunk), len(cases) - 1)]
                for name, array in self._call(part).items():
                    results[name][first : first + self.chunk] = np.asarray(array)[: len(cases) - first]

            return Running(results, crew.start(work, range(0, len(cases), self.chunk)))
        count = self.size if self.mesh is None else devices.padded(self.size, self.mesh)
        return Running(self._call(np.minimum(tile * self.size + np.arange(count), self.layout.cases - 1)), [])

    def _call(self, cases: np.ndarray) -> dict[str, Any]:
        varying = self.layout.take(self.arguments, cases)
        if self.mesh is not None:
            varying = devices.spread(varying, self.mesh)
        observer, shared = self._common
        return run_cases(observer, varying, shared, self.rows, self.reductions, self.hold, self.most)

    def finish(self, tile: int, running: Running) -> Results:
        """Wait for a tile that was started, and check it.

        Raises:
            ValueError: the results cannot be (see `Rows.check`).
            Exception: what a chunk raised.
        """
        for chunk in running.chunks:
            chunk.result()
        cases = self.cases(tile)
        results = {name: np.asarray(array)[: len(cases)] for name, array in running.results.items()}
        self.rows.check(self, cases, results)
        return results

    def fingerprint(self) -> str:
        """Identifies the study by all that its numbers depend on."""
        axes = dict(zip(self.layout.names, self.layout.sizes, strict=True))
        rest = [axes, self.layout.placed, self.size, self.hold]
        if self.mesh is not None and self.mesh.size > 1:
            rest.append(f"{self.mesh.size} devices")  # each runs a smaller tile, which may round in other places
        return fingerprint(self.observer, self.arguments, self.rows, self.reductions, *rest)


def _batch(call: str, batch: int | None, cost: float, cases: int) -> int:
    if batch is None:
        return tile_size(cost, cases)
    if not isinstance(batch, int | np.integer) or batch < 1:
        raise ValueError(f"{call}: `batch` must be a number of cases per tile, at least 1, or None; got {batch!r}")
    return min(int(batch), cases)
