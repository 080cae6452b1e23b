"""The command ``gsisio estimate``: a table in, files and a summary out, in memory that does not grow with the table."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .._extras import need
from .checkpoint import Checkpoint
from .errors import Interrupted, UserError, reason
from .figures import line, run_figures
from .labelled import Labelled
from .logs import TableStream
from .output import check_writable, write_all
from .page import write_page
from .problem import Problem, build_problem, importable, resolve
from .progress import DelayedProgress
from .report import Summary, doubt, show, summarise
from .totals import Totals, gather

if TYPE_CHECKING:
    from .config import Config, OutputsPart, TablePart
    from .run import Outcome

DOUBTFUL = 3  # exit code


def estimate(options: argparse.Namespace, path: Path, config: Config, wanted: TablePart) -> int:
    """Run the observer over the table of a configuration.

    Args:
        options: the command line.
        path, config: the configuration and its file.
        wanted: its table.

    Returns:
        The exit code: 0, or 3 where the files are written, but nearly every step contradicts the stated bounds.
    """
    from .run import run

    out = options.out or Path("results") / path.stem
    names = _file_names(config.outputs, path.stem)
    check_writable(out, list(names.values()))
    source = table_path(options, path, wanted)
    _check_apart(out, names, (source, path))
    title = config.title or path.stem
    checkpoint = Checkpoint(out / f".{path.stem}.part")
    with importable(path.parent), DelayedProgress(options.progress) as progress:
        transform = wanted.transform and resolve(wanted.transform, f"{path.name}: table.transform")
        draw = _draw(config.outputs, path.name)
        problem = build_problem(config, path.name)
        table = TableStream(source, wanted, transform or None)
        try:
            outcome = run(
                problem,
                table,
                config.estimate.on_conflict,
                progress,
                checkpoint=checkpoint,
                resume=options.resume,
                total=table.total,
            )
            progress.stage("writing the files")
            files = _write(outcome, problem, path, title, table, out, names, draw, checkpoint)
        except (KeyboardInterrupt, UserError) as error:
            checkpoint.leave()
            if checkpoint.rows == 0:
                raise
            if isinstance(error, UserError):
                if str(error).startswith("--resume"):
                    raise
                raise UserError(f"{error} (what comes before is kept: mend it and add --resume)") from error
            raise Interrupted(
                "interrupted, no file was written; the same command with --resume goes on after step "
                f"{checkpoint.rows:,}"
            ) from error
        except OSError as error:
            checkpoint.leave()
            raise UserError(f"cannot write to {out}: {reason(error)}") from error
        except BaseException:
            checkpoint.leave()
            raise
        checkpoint.remove()
    totals, summary, paths = files
    if options.format == "json":
        print(line(run_figures(title, problem, totals, outcome, table.notes, paths), indent=2))
    else:
        show(summary, sys.stdout)
    return DOUBTFUL if doubt(totals) else 0


def table_path(options: argparse.Namespace, path: Path, wanted: TablePart) -> Path:
    """The table named on the command line, else that of the configuration, beside it."""
    return path.parent / wanted.file if options.table is None else Path(options.table)


def _write(
    outcome: Outcome,
    problem: Problem,
    path: Path,
    title: str,
    table: TableStream,
    out: Path,
    names: dict[str, str],
    draw: Callable[[Labelled, Path], None],
    checkpoint: Checkpoint,
) -> tuple[Totals, Summary, dict[str, Path]]:
    """All files, or none; and what is said of them."""
    from .output import write_csv, write_netcdf

    observer = outcome.observer
    totals = gather(outcome.boxes.parts(), problem, observer)
    totals.zone = table.zone
    labelled = Labelled(problem, outcome.boxes, totals, title, observer.certificate)
    paths = {kind: out / name for kind, name in names.items()}
    summary = summarise(title, problem, totals, outcome, table.notes, paths.values())
    writers: dict[str, Callable[[Path], None]] = {
        names["netcdf"]: lambda target: write_netcdf(labelled.parts(), target),
        names["csv"]: lambda target: write_csv(labelled.parts(), target),
        names["picture"]: lambda target: draw(labelled, target),
        names["report"]: lambda target: write_page(
            target,
            summary,
            totals,
            picture=target.parent / names["picture"],
            certificate=str(observer.certificate),
            configuration=path.read_text("utf-8"),
        ),
    }
    write_all(out, writers, checkpoint.folder if outcome.boxes.on_disk else None)
    outcome.boxes.close()
    return totals, summary, paths


def _file_names(outputs: OutputsPart, stem: str) -> dict[str, str]:
    endings = {"netcdf": ".nc", "csv": ".csv", "picture": ".png", "report": ".html"}
    return {kind: getattr(outputs, kind) or stem + ending for kind, ending in endings.items()}


def _check_apart(out: Path, names: dict[str, str], read: Iterable[Path]) -> None:
    """The files that are read must not be written over: `pump.csv` may be the log and the boxes of `pump.toml`."""
    for kind, name in names.items():
        if any(one.exists() and (out / name).resolve() == one.resolve() for one in read):
            raise UserError(
                f"cannot write {out / name}: it is a file that is read; give another --out, or name another file in "
                f"outputs.{kind}"
            )


def _draw(outputs: OutputsPart, file: str) -> Callable[[Labelled, Path], None]:
    """What draws the picture: the user's own function, which is given all rows, or the library's."""
    need("matplotlib", extra="plot", purpose="drawing the picture")
    if outputs.draw is None:
        from ..plot.style import check_picture

        try:
            check_picture(f"{file}: outputs.picture", outputs.picture or "boxes.png")
        except ValueError as error:
            raise UserError(str(error)) from error
        return _draw_plainly
    own = resolve(outputs.draw, f"{file}: outputs.draw")

    def draw(labelled: Labelled, target: Path) -> None:
        whole = labelled.whole()
        try:
            own(whole, target)
        except Exception as error:
            raise UserError(f"outputs.draw: {outputs.draw} raised {type(error).__name__}: {reason(error)}") from error

    return draw


def _draw_plainly(labelled: Labelled, target: Path) -> Any:
    from ..plot import save
    from ..plot.record import read_record

    dataset = labelled.picture()
    record = read_record(dataset)
    # Every measurement is shown: on the panel of its signal, or on one of its own.
    save(dataset, target, [*record.series, *record.outputs])
