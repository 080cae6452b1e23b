"""``gsisio reproduce``: the numbers and figures of the paper's example, printed beside computed."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import IO, TYPE_CHECKING

from .._extras import need

if TYPE_CHECKING:
    from ..paper.example import Row
    from ..paper.reproduce import Reproduction
    from .progress import When

DEFAULT_OUT = Path("results/paper")
WIDTH = 100
_HEADER = ("number", "printed", "computed", "agree", "why not")


def reproduce(out: Path | None, progress: When = "auto") -> int:
    """Compute, write the files and print the table.

    Args:
        out: folder of the files; None is `DEFAULT_OUT`.
        progress: when to show the progress bar, as for the other commands.

    Returns:
        The exit code, 0.

    Raises:
        UserError: a file cannot be written.
        MissingExtra: rich or matplotlib is not installed.
    """
    need("rich", extra="cli", purpose="the command line")
    need("matplotlib", extra="plot", purpose="drawing the pictures")
    from ..paper.reproduce import FILES
    from ..paper.reproduce import reproduce as compute
    from .output import check_writable, write_all
    from .progress import DelayedProgress

    out = DEFAULT_OUT if out is None else out
    check_writable(out, list(FILES))
    with DelayedProgress(progress) as bar:
        bar.stage("computing")
        found = compute()
        bar.stage("writing the files")
        files = write_all(out, found.writers())
    show(found, files, sys.stdout)
    return 0


def show(found: Reproduction, files: Sequence[Path], stream: IO[str]) -> None:
    """Print the outcome: with rules and colours on a terminal, as plain aligned text elsewhere."""
    if stream.isatty():
        _show_rich(found, files, stream)
    else:
        stream.write(plain(found, files))


def plain(found: Reproduction, files: Sequence[Path]) -> str:
    """All text of the command, at most `WIDTH` columns wide where no path is longer."""
    table = [_HEADER, *_lines(found.rows)]
    widths = [max(len(line[column]) for line in table) for column in range(4)]
    lines = [_title(), ""]
    for name, *others in table:
        cells = [name.ljust(widths[0]), *(c.rjust(w) for c, w in zip(others[:3], widths[1:], strict=True)), others[3]]
        lines.append(("  " + "  ".join(cells)).rstrip())
    lines += ["", "  why not", *_wrapped(_reasons(found.rows), 6)]
    lines += ["", "  outcome", *_wrapped(found.facts(), 14)]
    lines += ["", "  files", *(f"    {path}" for path in files)]
    return "\n".join(lines) + "\n"


def _title() -> str:
    return "The paper's example: printed numbers beside those that follow from the printed system"


def _lines(rows: Sequence[Row]) -> list[tuple[str, str, str, str, str]]:
    """One line per number, or per row of a matrix: name, printed, computed, agree, findings."""
    out = []
    for group, members in groupby(rows, key=lambda row: row.group):
        block = list(members)
        agree = sum(row.agrees for row in block)
        word = {len(block): "yes", 0: "no"}.get(agree, f"{agree} of {len(block)}")
        computed = [_short(row.computed, row.digits) for row in block]
        size = [max(len(row.printed), len(value)) for row, value in zip(block, computed, strict=True)]
        cells = (
            "  ".join(text.rjust(width) for text, width in zip(texts, size, strict=True))
            for texts in ([row.printed for row in block], computed)
        )
        out.append((group, *cells, word, " ".join(dict.fromkeys(row.finding for row in block if row.finding))))
    return out


def _short(value: float, digits: int) -> str:
    """As many decimals as are printed in the paper, without trailing zeros."""
    text = f"{value:.{digits}f}"
    return text.rstrip("0").rstrip(".") if digits else text


def _reasons(rows: Sequence[Row]) -> list[tuple[str, str]]:
    """Every finding that a row names, and what its numbers say in particular."""
    from ..paper.example import FINDINGS

    out = []
    for finding in dict.fromkeys(row.finding for row in rows if row.finding):
        out.append((finding, FINDINGS[finding]))
        said: dict[str, list[str]] = {}
        for row in rows:
            if row.finding == finding:
                said.setdefault(row.reason, []).append(row.group.partition(",")[0])
        for reason, groups in said.items():
            out.append(("", f"{', '.join(dict.fromkeys(groups))}: {reason}."))
    return out


def _wrapped(items: Sequence[tuple[str, str]], label: int) -> list[str]:
    out = []
    for name, text in items:
        start, indent = f"    {name.ljust(label)}", " " * (4 + label)
        out += textwrap.wrap(text, WIDTH, initial_indent=start, subsequent_indent=indent, break_long_words=False)
    return out


def _show_rich(found: Reproduction, files: Sequence[Path], stream: IO[str]) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console(file=stream)
    console.print(Text(_title(), style="bold"))
    table = Table(box=box.SIMPLE_HEAD)
    for heading, side in zip(_HEADER, ("left", "right", "right", "right", "left"), strict=True):
        table.add_column(heading, justify=side, no_wrap=heading in ("number", "agree"))
    for line in _lines(found.rows):
        table.add_row(*map(Text, line), style="" if line[3] == "yes" else "red")
    console.print(table)
    for heading, items in (("why not", _reasons(found.rows)), ("outcome", found.facts())):
        console.print(Text(heading, style="cyan"))
        grid = Table(box=None, show_header=False, padding=(0, 2))
        for item in items:
            grid.add_row(*map(Text, item))
        console.print(grid)
    console.print(Text("files", style="cyan"))
    for path in files:
        console.print(Text(f"  {path}"), soft_wrap=True)
