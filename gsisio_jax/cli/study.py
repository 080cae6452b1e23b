"""``gsisio sweep`` and ``gsisio monte-carlo``: studies whose finished part is never lost."""

from __future__ import annotations

import sys
import time
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .._extras import need
from ..errors import ContainmentLost
from .config import Config
from .errors import UserError
from .labelled import date_attributes
from .output import check_writable, write_all
from .problem import Problem, build_problem, importable
from .progress import DelayedProgress
from .report import show
from .run import design
from .stopping import exit_code, stoppable
from .study_arguments import initial_of, noise_of, read_records, simulated
from .study_config import MonteCarloPart, SweepPart
from .study_files import (
    begun_anew,
    check_store,
    finished,
    netcdf_writer,
    picture_names,
    picture_writers,
    stopped,
)
from .study_report import Effort, summarise

EXTRA = ("xarray", "zarr", "netCDF4", "tqdm")

# Calls `sweep` or `monte_carlo` with an observer and the arguments that both have.
Call = Callable[..., Any]


def sweep(options: Namespace, path: Path, config: Config) -> int:
    """Run ``gsisio sweep``; returns the exit code."""

    def plan(problem: Problem, folder: Path, file: str) -> tuple[SweepPart, int, float, Call]:
        part = config.sweep
        if part is None:
            raise UserError(f"{file}: sweep is missing; gsisio sweep --help shows a [sweep] table")
        if config.table is None:
            raise UserError(f"{file}: table is missing; a sweep needs measurements")
        if part.records is None and part.axes.noise is None and part.axes.initial is None:
            raise UserError(
                f"{file}: sweep: nothing varies; give sweep.axes.noise, sweep.axes.initial or sweep.records"
            )
        records = read_records(config.table, part.records, folder, file)
        initial = initial_of(problem, part.axes, f"{file}: sweep")
        if records.length is None and part.axes.noise is None and part.axes.initial is None:
            raise UserError(
                f"{file}: sweep: nothing varies; give sweep.axes.noise, sweep.axes.initial or several sweep.records"
            )

        def call(observer: Any, **shared: Any) -> Any:
            import gsisio_jax as gx

            wanted = {"initial": initial, "y": records.y, "u": records.u, "length": records.length}
            dataset = gx.sweep(observer, **wanted, time=records.time, **shared)
            if records.zone is not None and "time" in dataset.coords:
                dataset["time"].attrs |= date_attributes(records.zone)
            return dataset

        return part, records.steps, records.measured, call

    return _study(options, path, config, "sweep", plan)


def monte_carlo(options: Namespace, path: Path, config: Config) -> int:
    """Run ``gsisio monte-carlo``; returns the exit code."""

    def plan(problem: Problem, folder: Path, file: str) -> tuple[MonteCarloPart, int, float, Call]:
        part = config.monte_carlo
        if part is None:
            raise UserError(f"{file}: monte_carlo is missing; gsisio monte-carlo --help shows a [monte_carlo] table")
        wanted = simulated(config, part, problem, file)

        def call(observer: Any, **shared: Any) -> Any:
            import gsisio_jax as gx

            try:
                return gx.monte_carlo(observer, part.seed, part.runs, part.steps, **wanted, **shared)
            except ContainmentLost as error:
                raise ContainmentLost(f"{error} (here monte_carlo.seed is {part.seed})") from error

        return part, part.steps, part.steps, call

    return _study(options, path, config, "monte_carlo", plan)


def _study(options: Namespace, path: Path, config: Config, kind: str, plan: Callable[..., Any]) -> int:
    for package in EXTRA:
        need(package, extra="study", purpose="a study")
    for package in ("pandas", "rich"):
        need(package, extra="cli", purpose="the command line")
    need("matplotlib", extra="plot", purpose="drawing the pictures")
    stem = f"{path.stem}_{kind}"
    out = options.out or Path("results") / path.stem
    store = out / f"{stem}.zarr"
    check_writable(out, [f"{stem}.nc", *picture_names(stem)])
    check_store(store, options.fresh)
    title = config.title or path.stem
    try:
        with importable(path.parent), stoppable(lambda: stopped(store, options.fresh)):
            with DelayedProgress(options.progress) as progress:
                problem = build_problem(config, path.name)
                progress.stage("reading the tables" if kind == "sweep" else "checking")
                part, steps, measured, call = plan(problem, path.parent, path.name)
                shared = _shared(config, part, problem, title, f"{path.name}: {kind}")
                progress.stage("designing")
                began = time.perf_counter()
                observer = design(problem, progress=False)
                design_seconds = time.perf_counter() - began
            with begun_anew(store, options.fresh):
                before = finished(store)
                began = time.perf_counter()
                dataset = _call(call, observer, **shared, store=store, progress=options.progress != "never")
                seconds = time.perf_counter() - began
            kept, _, known = before or (0, 0, 0)
            done = finished(store) or (0, 0, 0)
            effort = Effort(design_seconds, seconds, steps, measured, done[1], kept, done[2] - known)
            writers = {f"{stem}.nc": netcdf_writer(dataset, store)} | picture_writers(dataset, stem, part.picture)
            files = write_all(out, writers)
            summary = summarise(title, problem, observer.certificate, dataset, effort, [store, *files])
    except KeyboardInterrupt as error:
        if options.debug:
            raise
        print(stopped(store, options.fresh), file=sys.stderr)
        return exit_code(error)
    except ContainmentLost as error:
        if options.debug:
            raise
        print(f"gsisio: {error}", file=sys.stderr)
        return 1
    show(summary, sys.stdout)
    return 0


def _shared(config: Config, part: Any, problem: Problem, title: str, key: str) -> dict[str, Any]:
    """Arguments that `sweep` and `monte_carlo` have in common."""
    # The summary tells of conflicts and of boxes that are not bounded.
    reduce = part.reduce if "status" in part.reduce else [*part.reduce, "status"]
    units = {kind: list(group.units) for kind, group in (("state", problem.state), ("input", problem.input))}
    return {
        "noise": noise_of(problem, part.axes, key),
        "reduce": tuple(reduce),
        "batch": part.batch,
        "on_conflict": config.estimate.on_conflict,
        "state_names": list(problem.state.names),
        "input_names": list(problem.input.names),
        "state_units": units["state"] if any(units["state"]) else None,
        "input_units": units["input"] if any(units["input"]) else None,
        "title": title,
    }


def _call(call: Call, observer: Any, **arguments: Any) -> Any:
    try:
        return call(observer, **arguments)
    except ValueError as error:
        if "belongs to another study" in str(error):
            raise UserError(f"{error}, as --fresh does") from error
        raise
