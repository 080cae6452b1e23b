"""Design and run the observer over a table, in chunks of constant length so that progress can be shown."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from ..observer.estimation import OnConflict
from .logs import Table
from .problem import Problem
from .progress import DelayedProgress

CHUNK = 1024


@dataclass(frozen=True)
class Outcome:
    """The estimate and what it took, in seconds."""

    observer: Any
    estimate: Any
    design_seconds: float
    compile_seconds: float
    run_seconds: float


def design(problem: Problem) -> Any:
    """Design the observer of a problem."""
    import gsisio_jax as gx

    options = dict(problem.design)
    if problem.u_region is not None:
        options["u_region"] = problem.u_region
    return gx.design_observer(problem.system, problem.noise, problem.region, **options)


def run(
    problem: Problem, table: Table, on_conflict: OnConflict, progress: DelayedProgress, chunk: int = CHUNK
) -> Outcome:
    """Design the observer and estimate every step of the table.

    The numbers are those of `gsisio_jax.estimate` on the whole table. Every chunk has the same length, so there is one
    compilation: the last one is filled up with missing rows whose results are dropped.
    """
    import gsisio_jax as gx

    clock = time.perf_counter
    progress.stage("designing")
    began = clock()
    observer = design(problem)
    design_seconds = clock() - began

    steps = len(table.time)
    progress.stage("compiling")
    began = clock()
    u0 = None if table.u is None else table.u[0]
    carry, first = gx.start(observer, problem.initial, table.y[0], u0=u0, on_conflict=on_conflict)
    parts = [jax.device_get(first)]
    chunk = min(chunk, steps - 1)

    def advance(carry: Any, y: np.ndarray, u: np.ndarray | None) -> tuple[Any, Any]:
        carry, outs = gx.estimation.resume(observer, carry, y, u=u, on_conflict=on_conflict)
        return carry, jax.device_get(outs)

    if chunk > 0:
        # Once without looking at the result, so that compiling is not counted as running.
        advance(carry, *_rows(table, 1, 1, chunk))
    compile_seconds = clock() - began

    progress.stage("estimating", total=steps)
    progress.advance(1)
    began = clock()
    for begin in range(1, steps, max(chunk, 1)):
        end = min(begin + chunk, steps)
        carry, outs = advance(carry, *_rows(table, begin, end, chunk))
        parts.append(jax.tree.map(lambda values, rows=end - begin: values[:rows], outs))
        progress.advance(end - begin)
    run_seconds = clock() - began
    return Outcome(observer, gx.estimation.collect(observer, parts), design_seconds, compile_seconds, run_seconds)


def _rows(table: Table, begin: int, end: int, length: int) -> tuple[np.ndarray, np.ndarray | None]:
    """Rows ``begin`` to ``end``, filled up to `length` with missing rows."""
    spare = length - (end - begin)
    y = np.pad(table.y[begin:end], ((0, spare), (0, 0)), constant_values=np.nan)
    if table.u is None:
        return y, None
    # Known inputs must be finite also where their results are dropped.
    return y, np.concatenate([table.u[begin:end], np.repeat(table.u[begin - 1 : begin], spare, axis=0)])
