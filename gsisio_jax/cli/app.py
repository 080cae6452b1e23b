"""The command line itself: arguments, order of the work, and one line for every error a user can cause."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .._extras import MissingExtra, need
from ..scalar.options import use_flags
from .errors import UserError, reason
from .help import EXAMPLES, MONTE_CARLO, SWEEP

if TYPE_CHECKING:
    from .config import Config
    from .problem import Problem


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: words after ``gsisio``; those of the process where left out.

    Returns:
        The exit code.
    """
    options = _parser().parse_args(arguments)
    use_flags()
    try:
        code = options.command(options)
        sys.stdout.flush()
        return code
    except BrokenPipeError:
        # The reader of a pipe went away (`gsisio design x | head`); nothing is left to say, also not at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt:
        if options.debug:
            raise
        print("gsisio: interrupted, no file was written", file=sys.stderr)
        return 130
    except (ValueError, MissingExtra) as error:
        if options.debug:
            raise
        print(f"gsisio: {reason(error)}", file=sys.stderr)
        return 2


def _parser() -> argparse.ArgumentParser:
    form = argparse.RawDescriptionHelpFormatter
    layout = {"epilog": EXAMPLES, "formatter_class": form}
    parser = argparse.ArgumentParser(
        prog="gsisio", description="Guaranteed boxes for the states and the unknown inputs of a system.", **layout
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("config", metavar="CONFIG", help="a TOML file, or the name of a built-in example")
    common.add_argument("--debug", action="store_true", help="show the full traceback of every error")

    estimate = commands.add_parser(
        "estimate", parents=[common], help="run the observer over a table of measurements", **layout
    )
    estimate.add_argument("--out", metavar="DIR", type=Path, help="folder of the files (default: results/NAME)")
    estimate.add_argument(
        "--progress",
        choices=("auto", "always", "never"),
        default="auto",
        help="progress bar after two seconds; auto: only on a terminal",
    )
    estimate.set_defaults(command=_estimate)

    design = commands.add_parser("design", parents=[common], help="print the certificate alone", **layout)
    design.set_defaults(command=_design)

    for name, epilog, text, command in (
        ("sweep", SWEEP, "widths over noise bounds, initial boxes and records, in a study that can be resumed", _sweep),
        ("monte-carlo", MONTE_CARLO, "simulated runs, every box checked against the truth", _monte_carlo),
    ):
        study = commands.add_parser(name, parents=[common], help=text, epilog=epilog, formatter_class=form)
        study.add_argument("--out", metavar="DIR", type=Path, help="folder of the files (default: results/NAME)")
        study.add_argument("--fresh", action="store_true", help="begin anew: delete the stored study of an earlier run")
        study.add_argument(
            "--progress", choices=("auto", "never"), default="auto", help="progress bars; auto: only on a terminal"
        )
        study.set_defaults(command=command)

    reproduce = commands.add_parser(
        "reproduce", help="the paper's example: every printed number beside the computed one, figures 2 and 3", **layout
    )
    reproduce.add_argument("--out", metavar="DIR", type=Path, help="folder of the files (default: results/paper)")
    reproduce.add_argument("--progress", choices=("auto", "always", "never"), default="auto", help="progress bar")
    reproduce.add_argument("--debug", action="store_true", help="show the full traceback of every error")
    reproduce.set_defaults(command=_reproduce)
    return parser


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from .._version import __version__

        print(f"gsisio {__version__}")
        parser.exit()


def _estimate(options: argparse.Namespace) -> int:
    for package in ("pandas", "xarray", "netCDF4", "rich"):
        need(package, extra="cli", purpose="the command line")
    need("matplotlib", extra="plot", purpose="drawing the picture")
    path, config = _configuration(options.config)
    wanted = config.table
    if wanted is None:
        raise UserError(f"{path.name}: table is missing; estimate needs measurements")

    from .logs import read_table
    from .output import check_writable, write_all, write_csv, write_netcdf
    from .problem import build_problem, importable, resolve
    from .progress import DelayedProgress
    from .report import show, summarise
    from .run import run

    out = options.out or Path("results") / path.stem
    names = config.outputs
    netcdf, csv, picture = (
        given or path.stem + ending
        for given, ending in ((names.netcdf, ".nc"), (names.csv, ".csv"), (names.picture, ".png"))
    )
    check_writable(out, [netcdf, csv, picture])
    _use_float64()
    title = config.title or path.stem
    with importable(path.parent), DelayedProgress(options.progress) as progress:
        transform = wanted.transform and resolve(wanted.transform, f"{path.name}: table.transform")
        draw = resolve(names.draw, f"{path.name}: outputs.draw") if names.draw else _draw
        problem = build_problem(config, path.name)
        progress.stage("reading the table")
        table = read_table(path.parent / wanted.file, wanted, transform or None)
        outcome = run(problem, table, config.estimate.on_conflict, progress)
        progress.stage("writing the files")
        dataset = _dataset(outcome, problem, table, title)
        writers = {
            netcdf: lambda target: write_netcdf(dataset, target),
            csv: lambda target: write_csv(dataset, target),
            picture: lambda target: _call_draw(draw, names.draw, dataset, target),
        }
        files = write_all(out, writers)
    show(summarise(title, problem, table, outcome, dataset, files), sys.stdout)
    return 0


def _design(options: argparse.Namespace) -> int:
    path, config = _configuration(options.config)

    from .problem import build_problem, importable
    from .run import design

    _use_float64()
    with importable(path.parent):
        problem = build_problem(config, path.name)
        certificate = design(problem).certificate
    print(config.title or path.stem)
    for kind, group in (("state", problem.state), ("input", problem.input)):
        for index, (name, unit) in enumerate(zip(group.names, group.units, strict=True)):
            print(f"  {kind} {index + 1} is {name}{f' [{unit}]' if unit else ''}")
    print(certificate)
    return 0


def _sweep(options: argparse.Namespace) -> int:
    path, config = _configuration(options.config)
    from .study import sweep

    _use_float64()
    return sweep(options, path, config)


def _monte_carlo(options: argparse.Namespace) -> int:
    path, config = _configuration(options.config)
    from .study import monte_carlo

    _use_float64()
    return monte_carlo(options, path, config)


def _reproduce(options: argparse.Namespace) -> int:
    from .reproduce import reproduce

    _use_float64()
    return reproduce(options.out, options.progress)


def _configuration(name: str) -> tuple[Path, Config]:
    """Find the file, or the built-in example of that name, and read it."""
    need("pydantic", extra="cli", purpose="the command line")
    from .config import read_config

    path = Path(name)
    if not path.is_file():
        from .. import examples

        if name in examples.names():
            path = Path(examples.config_path(name))
        elif path.is_dir():
            raise UserError(f"{name}: this is a folder; give the TOML file in it")
        else:
            known = ", ".join(examples.names())
            raise UserError(f"{name}: no such file, and no built-in example of that name (there are: {known})")
    path = path.resolve()
    return path, read_config(path)


def _use_float64() -> None:
    import jax

    jax.config.update("jax_enable_x64", True)


def _dataset(outcome: Any, problem: Problem, table: Any, title: str) -> Any:
    from ..dataset import to_dataset

    return to_dataset(
        outcome.estimate,
        time=table.time,
        state_names=problem.state.names,
        state_units=problem.state.units,
        input_names=problem.input.names,
        input_units=problem.input.units,
        output_names=problem.output.names,
        output_units=problem.output.units,
        y=table.y,
        title=title,
        certificate=outcome.observer.certificate,
    )


def _draw(dataset: Any, path: Path) -> None:
    from ..plot import save

    save(dataset, path)


def _call_draw(draw: Any, reference: str | None, dataset: Any, path: Path) -> None:
    if reference is None:
        return draw(dataset, path)
    try:
        draw(dataset, path)
    except Exception as error:
        raise UserError(f"outputs.draw: {reference} raised {type(error).__name__}: {reason(error)}") from error
