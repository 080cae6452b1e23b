"""The command line itself: arguments, order of the work, and one line for every error a user can cause."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .._collector import rare_collection
from .._extras import MissingExtra, need
from .._quiet import hear_interrupts
from ..scalar.options import use_flags
from .errors import Interrupted, UserError, reason
from .help import EXAMPLES, INIT, MONTE_CARLO, SWEEP
from .stopping import exit_code

if TYPE_CHECKING:
    from .config import Config


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
        with rare_collection():
            code = options.command(options)
        sys.stdout.flush()
        return code
    except BrokenPipeError:
        # The reader of a pipe went away (`gsisio design x | head`); nothing is left to say, also not at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt as stop:
        if options.debug:
            raise
        print(
            f"gsisio: {stop if isinstance(stop, Interrupted) else 'interrupted, no file was written'}", file=sys.stderr
        )
        return exit_code(stop)
    except (ValueError, MissingExtra) as error:
        if options.debug:
            raise
        print(f"gsisio: {reason(error)}", file=sys.stderr)
        return 2


def _folder(name: str) -> Path:
    """Of ``--out``. An empty one, as of a variable that is not set, would be the folder at hand."""
    if not name:
        raise argparse.ArgumentTypeError('must be the name of a folder, got ""; the one at hand is "."')
    return Path(name)


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
    estimate.add_argument(
        "table", metavar="TABLE", nargs="?", help="a table in the place of that of CONFIG; - is standard input"
    )
    estimate.add_argument("--out", metavar="DIR", type=_folder, help="folder of the files (default: results/NAME)")
    estimate.add_argument(
        "--follow", action="store_true", help="read a growing file or standard input, print a line of JSON per step"
    )
    estimate.add_argument("--resume", action="store_true", help="go on where a long run was interrupted or killed")
    estimate.add_argument("--format", choices=("text", "json"), default="text", help="of the summary")
    estimate.add_argument(
        "--progress",
        choices=("auto", "always", "never"),
        default="auto",
        help="progress bar after two seconds; auto: only on a terminal",
    )
    estimate.set_defaults(command=_estimate)

    design = commands.add_parser("design", parents=[common], help="print the certificate alone", **layout)
    design.add_argument("--format", choices=("text", "json"), default="text", help="of the certificate")
    design.set_defaults(command=_design)

    examples = commands.add_parser(
        "examples", help="list the built-in examples, or write one out to start from", **layout
    )
    examples.add_argument("name", metavar="NAME", nargs="?", help="the example to write; left out: list all of them")
    examples.add_argument("--out", metavar="DIR", type=_folder, help="folder of its files (default: here)")
    examples.add_argument("--debug", action="store_true", help="show the full traceback of every error")
    examples.set_defaults(command=_examples)

    init = commands.add_parser(
        "init", help="write a configuration and a plant to fill in, for a table", epilog=INIT, formatter_class=form
    )
    init.add_argument("table", metavar="LOG", help="a CSV or Parquet file of measurements")
    init.add_argument("--out", metavar="DIR", type=_folder, default=Path(), help="folder of the files (default: here)")
    init.add_argument("--debug", action="store_true", help="show the full traceback of every error")
    init.set_defaults(command=_init)

    for name, epilog, text, command in (
        ("sweep", SWEEP, "widths over noise bounds, initial boxes and records, in a study that can be resumed", _sweep),
        ("monte-carlo", MONTE_CARLO, "simulated runs, every box checked against the truth", _monte_carlo),
    ):
        study = commands.add_parser(name, parents=[common], help=text, epilog=epilog, formatter_class=form)
        study.add_argument("--out", metavar="DIR", type=_folder, help="folder of the files (default: results/NAME)")
        study.add_argument("--fresh", action="store_true", help="begin anew: delete the stored study of an earlier run")
        study.add_argument(
            "--progress", choices=("auto", "never"), default="auto", help="progress bars; auto: only on a terminal"
        )
        study.set_defaults(command=command)

    reproduce = commands.add_parser(
        "reproduce", help="the paper's example: every printed number beside the computed one, figures 2 and 3", **layout
    )
    reproduce.add_argument("--out", metavar="DIR", type=_folder, help="folder of the files (default: results/paper)")
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
    path, config = _configuration(options.config)
    if config.table is None:
        raise UserError(f"{path.name}: table is missing; estimate needs measurements")
    _use_float64()

    if options.follow:
        from .follow import follow

        hear_interrupts()
        return follow(options, path, config, config.table)
    if options.table == "-":
        raise UserError("standard input (-) is read as it comes: add --follow")
    from .estimate import estimate

    hear_interrupts()
    return estimate(options, path, config, config.table)


def _design(options: argparse.Namespace) -> int:
    path, config = _configuration(options.config)

    from .problem import build_problem, importable
    from .run import design

    _use_float64()
    hear_interrupts()
    with importable(path.parent):
        problem = build_problem(config, path.name)
        certificate = design(problem).certificate
    if options.format == "json":
        from .figures import certificate_figures, line

        figures = {"title": config.title or path.stem, "certificate": certificate_figures(certificate, problem)}
        print(line(figures, indent=2))
        return 0
    print(config.title or path.stem)
    for kind, group in (("state", problem.state), ("input", problem.input)):
        for index, (name, unit) in enumerate(zip(group.names, group.units, strict=True)):
            print(f"  {kind} {index + 1} is {name}{f' [{unit}]' if unit else ''}")
    print(certificate)
    return 0


def _init(options: argparse.Namespace) -> int:
    need("pandas", extra="cli", purpose="the command line")
    need("pydantic", extra="cli", purpose="the command line")
    from .init import init

    hear_interrupts()
    return init(Path(options.table), options.out)


def _examples(options: argparse.Namespace) -> int:
    from .example_files import list_examples, write_example

    hear_interrupts()
    if options.name is None:
        if options.out is not None:
            raise UserError("examples: --out needs the NAME of the example to write")
        return list_examples()
    _use_float64()
    return write_example(options.name, options.out or Path())


def _sweep(options: argparse.Namespace) -> int:
    path, config = _configuration(options.config)
    from .study import sweep

    _use_float64()
    hear_interrupts()
    return sweep(options, path, config)


def _monte_carlo(options: argparse.Namespace) -> int:
    path, config = _configuration(options.config)
    from .study import monte_carlo

    _use_float64()
    hear_interrupts()
    return monte_carlo(options, path, config)


def _reproduce(options: argparse.Namespace) -> int:
    from .reproduce import reproduce

    _use_float64()
    hear_interrupts()
    return reproduce(options.out, options.progress)


def _configuration(name: str) -> tuple[Path, Config]:
    """Find the file, or the built-in example of that name, and read it."""
    need("pydantic", extra="cli", purpose="the command line")
    from .config import read_config

    path = Path(name)
    if not path.is_file():
        from .. import examples

        if name in examples.names():
            _use_float64()  # some records are simulated now
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
