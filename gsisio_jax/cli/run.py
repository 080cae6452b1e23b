"""Design and run the observer over blocks of rows, in chunks of constant length so that memory and programs are few."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from ..observer.estimation import OnConflict
from ..observer.summary import beyond
from . import boxes as storage
from .boxes import Boxes, record_type
from .checkpoint import Checkpoint, Digest, identity, refused
from .logs import Table
from .problem import Problem
from .progress import DelayedProgress

CHUNK = 1024


@dataclass(frozen=True)
class Outcome:
    """The boxes and what they took, in seconds; `resumed` steps were there from an interrupted run, and at `u_outside`
    steps the known input was not inside of `u_region`."""

    observer: Any
    boxes: Boxes
    design_seconds: float
    compile_seconds: float
    run_seconds: float
    resumed: int = 0
    u_outside: int = 0


def design(problem: Problem, progress: bool | None = None) -> Any:
    """Design the observer of a problem; `progress` as in `design_observer`, False where a bar is shown already."""
    import gsisio_jax as gx

    options = {**problem.design, "progress": progress}
    if problem.u_region is not None:
        options["u_region"] = problem.u_region
    if problem.around is not None:
        options["around"] = problem.around
    return gx.design_observer(problem.system, problem.noise, problem.region, **options)


def run(
    problem: Problem,
    blocks: Iterable[Table],
    on_conflict: OnConflict,
    progress: DelayedProgress,
    chunk: int = CHUNK,
    checkpoint: Checkpoint | None = None,
    resume: bool = False,
    total: int | None = None,
) -> Outcome:
    """Read the beginning of a table, design the observer and estimate every step.

    The numbers are those of `gsisio_jax.estimate` on the whole table. Every chunk has the same length, so there is one
    compilation: one that is not full is filled up with missing rows whose results are dropped.

    Args:
        problem: what is observed.
        blocks: the table, some rows at a time, at least one row in all.
        on_conflict: as in `gsisio_jax.estimate`.
        progress: told of every chunk.
        chunk: rows of a chunk.
        checkpoint: where the rows of a long run are kept; without it they stay in memory.
        resume: go on from the checkpoint, if there is one.
        total: number of steps for the progress bar, where it is known.

    Raises:
        UserError: the checkpoint is that of another run, or whatever reading the blocks raises.
    """
    clock = time.perf_counter
    progress.stage("reading the table")
    began = clock()
    blocks = read_ahead(blocks, storage.IN_MEMORY)
    reading_seconds = clock() - began
    progress.stage("designing")
    began = clock()
    observer = design(problem, progress=False)
    design_seconds = clock() - began
    system = problem.system
    delay = getattr(observer, "delay", 0)
    boxes = Boxes(record_type(system.n, system.p, system.l), checkpoint and checkpoint.begin, delay=delay)
    runner = _Runner(problem, observer, on_conflict, chunk, boxes, checkpoint)
    progress.stage("compiling")
    began = clock()
    try:
        rows = chunks(to_the_end(blocks, delay), chunk)
        runner.begin(next(rows), resume)
        progress.stage("estimating", total=total)
        progress.advance(1)
        for part in rows:
            runner.feed(part)
            progress.advance(len(part.time))
        runner.end()
    except BaseException:
        boxes.close()
        raise
    seconds = reading_seconds + clock() - began - runner.compile_seconds
    return Outcome(observer, boxes, design_seconds, runner.compile_seconds, seconds, runner.resumed, runner.u_outside)


class _Runner:
    """The carry of a run, and what has been read so far."""

    def __init__(
        self,
        problem: Problem,
        observer: Any,
        on_conflict: OnConflict,
        chunk: int,
        boxes: Boxes,
        checkpoint: Checkpoint | None,
    ):
        self.problem, self.observer, self.chunk = problem, observer, chunk
        self.on_conflict: OnConflict = on_conflict
        self.boxes, self.checkpoint, self.digest = boxes, checkpoint, Digest()
        self.carry: Any = None
        self.compile_seconds = 0.0
        self.resumed, self._stored, self._read, self._full, self.u_outside = 0, "", 0, False, 0
        self.identity = identity(observer, problem, on_conflict, chunk) if checkpoint is not None else ""

    def begin(self, row: Table, resume: bool) -> None:
        """The first row; from a checkpoint, all is taken from there that it has."""
        import gsisio_jax as gx

        began = time.perf_counter()
        u0 = None if row.u is None else row.u[0]
        carry, out = gx.start(self.observer, self.problem.initial, row.y[0], u0=u0, on_conflict=self.on_conflict)
        self.carry = carry
        found = self.checkpoint.load(self.identity, self.observer) if self.checkpoint is not None and resume else None
        if found is not None and self.checkpoint is not None:
            self.carry, self.resumed, self._stored = found
            self.boxes.reopen(self.checkpoint.boxes, self.resumed)
            self._count(row)
        else:
            self._keep(row, jax.tree.map(lambda values: np.asarray(values)[None], out))
        self.compile_seconds = time.perf_counter() - began

    def feed(self, part: Table) -> None:
        """The rows of a chunk; those that the checkpoint has are read only to hold them against it."""
        steps = len(part.time)
        if self._read < self.resumed:
            self._count(part)
            return
        # All chunks have one length; filling one up with missing rows is harmless because none comes after it.
        length = self.chunk if self._full else steps
        if not self._full:
            # Once without looking at the result, so that compiling is not counted as running.
            began = time.perf_counter()
            self._advance(part, length)
            self.compile_seconds += time.perf_counter() - began
        self._full = True
        self.carry, out = self._advance(part, length)
        self._keep(part, jax.tree.map(lambda values: values[:steps], out))

    def end(self) -> None:
        """Complain if the table is shorter than the checkpoint. A kill while files are written shall cost nothing."""
        if self._read < self.resumed:
            raise refused(self.resumed)
        if self.checkpoint is not None and self.boxes.on_disk:
            self._save(self.checkpoint)

    def _advance(self, part: Table, length: int) -> tuple[Any, Any]:
        import gsisio_jax as gx

        y, u = filled_up(part, length)
        carry, out = gx.estimation.resume(self.observer, self.carry, y, u=u, on_conflict=self.on_conflict)
        return carry, jax.device_get(out)

    def _count(self, part: Table) -> None:
        self.digest.add(part.time, part.y, part.u)
        self._seen(part)
        if self._read >= self.resumed and (self._read > self.resumed or str(self.digest) != self._stored):
            raise refused(self.resumed)

    def _keep(self, part: Table, out: Any) -> None:
        self.boxes.append(part.time, part.y, out)
        self._seen(part)
        if self.checkpoint is not None:
            self.digest.add(part.time, part.y, part.u)
            if self.checkpoint.due(self.boxes):
                self._save(self.checkpoint)

    def _seen(self, part: Table) -> None:
        self._read += len(part.time)
        if part.u is not None:
            self.u_outside += int(np.count_nonzero(beyond(part.u, part.u, self.observer.u_region)))

    def _save(self, checkpoint: Checkpoint) -> None:
        checkpoint.save(self.boxes, self.carry, self.identity, self.digest)


def read_ahead(blocks: Iterable[Table], limit: int) -> Iterator[Table]:
    """The same blocks; as many of the first ones as have more than `limit` rows are read at once.

    So what is wrong with a table that is not long is said before the observer is designed.
    """
    rest = iter(blocks)
    first: deque[Table] = deque()
    rows = 0
    for block in rest:
        first.append(block)
        rows += len(block.time)
        if rows > limit:
            break

    def every() -> Iterator[Table]:
        while first:
            yield first.popleft()
        yield from rest

    return every()


def chunks(blocks: Iterable[Table], size: int) -> Iterator[Table]:
    """The first row, then chunks of `size` rows; only the last may be shorter.

    Args:
        blocks: rows, any number at a time.
        size: rows of a chunk.
    """
    wanted, waiting = 1, []
    for block in blocks:
        waiting.append(block)
        if sum(len(one.time) for one in waiting) < wanted:
            continue
        whole, begin = joined(waiting), 0
        while len(whole.time) - begin >= wanted:
            yield cut(whole, begin, begin + wanted)
            begin, wanted = begin + wanted, size
        waiting = [cut(whole, begin, len(whole.time))]
    rest = joined(waiting)
    if len(rest.time):
        yield rest


def to_the_end(blocks: Iterable[Table], delay: int) -> Iterator[Table]:
    """The rows, and as many missing ones as an observer with a delay needs to finish the last of them."""
    last: Table | None = None
    for block in blocks:
        last = block if len(block.time) else last
        yield block
    if delay and last is not None:
        u = None if last.u is None else np.repeat(last.u[-1:], delay, axis=0)
        yield Table(np.full(delay, np.nan), np.full((delay, last.y.shape[1]), np.nan), u)


def joined(tables: list[Table]) -> Table:
    """Several tables as one."""
    if len(tables) == 1:
        return tables[0]
    u = None if tables[0].u is None else np.concatenate([one.u for one in tables if one.u is not None])
    return Table(np.concatenate([one.time for one in tables]), np.concatenate([one.y for one in tables]), u)


def cut(table: Table, begin: int, end: int) -> Table:
    """Rows `begin` to `end`."""
    return Table(table.time[begin:end], table.y[begin:end], None if table.u is None else table.u[begin:end])


def filled_up(table: Table, length: int) -> tuple[np.ndarray, np.ndarray | None]:
    """Measurements and known inputs, filled up to `length` with missing rows."""
    spare = length - len(table.time)
    y = np.pad(table.y, ((0, spare), (0, 0)), constant_values=np.nan)
    # Known inputs must be finite also where their results are dropped.
    return y, None if table.u is None else np.pad(table.u, ((0, spare), (0, 0)), mode="edge")
