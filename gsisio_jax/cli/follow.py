"""``gsisio estimate --follow``: one line of JSON per step, as the rows of a growing file or of standard input come."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ..observer.estimation import OnConflict
from ..observer.status import Status
from .boxes import record_type, records
from .config import Config
from .errors import UserError
from .estimate import table_path
from .figures import line
from .logs import Table, TablePart, TableReader
from .logs.stream import on_grid
from .problem import Names, Problem, build_problem, importable
from .run import CHUNK, cut, design, to_the_end
from .stopping import exit_code, stoppable
from .tail import Tail
from .totals import alarms_of


def follow(options: argparse.Namespace, path: Path, config: Config, part: TablePart) -> int:
    """Follow the table of a configuration.

    Args:
        options: the command line.
        path, config: the configuration and its file.
        part: its table.

    Returns:
        The exit code: 0 at the end of standard input, 130 after Ctrl-C, 143 after SIGTERM.
    """
    _check(options, path, part)
    piped = (part.file if options.table is None else options.table) == "-"
    tail = Tail(None if piped else table_path(options, path, part), part)
    steps = 0
    try:
        with importable(path.parent), stoppable(lambda: "gsisio: interrupted"):
            problem = build_problem(config, path.name)
            stepper = Stepper(problem, config.estimate.on_conflict)
            print(f"gsisio: following {tail.name}", file=sys.stderr, flush=True)
            for rows in stepper.rows(on_grid(_rows(tail, part))):
                sys.stdout.writelines(f"{text}\n" for text in stepper.lines(rows, steps))
                sys.stdout.flush()
                steps += len(rows)
    except KeyboardInterrupt as stop:
        if options.debug:
            raise
        print(f"gsisio: stopped after {steps:,} steps", file=sys.stderr)
        return exit_code(stop)
    return 0


class Stepper:
    """The observer, one row at a time; long blocks of rows that were there before in chunks.

    Args:
        problem: what is observed.
        on_conflict: as in `gsisio_jax.estimate`.
    """

    def __init__(self, problem: Problem, on_conflict: OnConflict):
        self.problem = problem
        self.on_conflict: OnConflict = on_conflict
        self.observer = design(problem)
        system = problem.system
        self.kind = record_type(system.n, system.p, system.l)
        self.delay = getattr(self.observer, "delay", 0)
        self._carry: Any = None
        self._warm_up()

    def rows(self, tables: Iterator[Table]) -> Iterator[np.ndarray]:
        """Records of the rows, as they are finished: with a delay of L these are the rows of L steps before."""
        waiting = np.empty(0, self.kind)
        for table in to_the_end(tables, self.delay):
            for rows in self._feed(table):
                if not self.delay:
                    yield rows
                    continue
                told = np.concatenate([waiting, rows])
                finished, waiting = rows[max(self.delay - len(waiting), 0) :], told[-self.delay :]
                for name in ("time", "y"):
                    finished[name] = told[name][: len(finished)]
                yield finished

    def lines(self, rows: np.ndarray, begin: int) -> Iterator[str]:
        """Rows as lines of JSON; `begin` is the step of the first one."""
        alarms = {one["step"]: one for one in alarms_of(rows, self.problem, self.observer.output_rows, begin)}
        state, known = self.problem.state, self.problem.input
        for step, row in enumerate(rows, begin):
            status = Status(int(row["status"]))
            yield line(
                {
                    "step": step,
                    "time": float(row["time"]),
                    "state": _boxes(state, row["state_lower"], row["state_upper"]),
                    "previous_input": _boxes(known, row["input_lower"], row["input_upper"]) if step else None,
                    "status": int(status),
                    "flags": [str(member.name) for member in Status if member.value and member in status],
                    "margin": float(row["margin"]),
                    "alarm": alarms.get(step),
                }
            )

    def _feed(self, table: Table) -> Iterator[np.ndarray]:
        import gsisio_jax as gx

        begin = 0
        while begin < len(table.time):
            left = len(table.time) - begin
            if self._carry is None:
                rows = cut(table, begin, begin + 1)
                self._carry, out = self._start(rows.y[0], None if rows.u is None else rows.u[0])
            elif left >= CHUNK:
                rows = cut(table, begin, begin + CHUNK)
                self._carry, out = gx.estimation.resume(
                    self.observer, self._carry, rows.y, u=rows.u, on_conflict=self.on_conflict
                )
            else:
                rows = cut(table, begin, begin + 1)
                self._carry, out = self._step(self._carry, rows.y[0], None if rows.u is None else rows.u[0])
            begin += len(rows.time)
            yield records(self.kind, rows.time, rows.y, jax.device_get(out))

    def _start(self, y: np.ndarray, u: np.ndarray | None) -> Any:
        import gsisio_jax as gx

        return gx.start(self.observer, self.problem.initial, y, u0=u, on_conflict=self.on_conflict)

    def _step(self, carry: Any, y: np.ndarray, u: np.ndarray | None) -> Any:
        import gsisio_jax as gx

        return gx.estimation.step(self.observer, carry, y, u_k=u, on_conflict=self.on_conflict)

    def _warm_up(self) -> None:
        """Compile before the first row comes, on a row without measurements."""
        system = self.problem.system
        y, u = np.full(system.l, np.nan), None
        if system.m:
            region = self.observer.u_region
            u = np.clip(np.zeros(system.m), np.asarray(region.lower), np.asarray(region.upper))
        carry, _ = self._start(y, u)
        jax.block_until_ready(self._step(carry, y, u))


def _check(options: argparse.Namespace, path: Path, part: TablePart) -> None:
    if options.out is not None or options.resume:
        given = "--out" if options.out is not None else "--resume"
        raise UserError(f"--follow prints to standard output and writes no file; leave out {given}")
    if part.transform is not None:
        raise UserError(f"{path.name}: table.transform needs the whole table; it cannot be followed")
    if part.on_unsorted == "sort":
        raise UserError(f'{path.name}: table.on_unsorted = "sort" needs the whole table; it cannot be followed')


def _rows(tail: Tail, part: TablePart) -> Iterator[Any]:
    reader = TableReader(tail.name, part)
    for block in tail:
        yield from reader.feed_up_to_fault(block)
    yield reader.finish()


def _boxes(group: Names, lower: np.ndarray, upper: np.ndarray) -> dict[str, list[float]]:
    return {name: [float(low), float(high)] for name, low, high in zip(group.names, lower, upper, strict=True)}
