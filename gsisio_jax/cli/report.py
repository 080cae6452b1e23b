"""The closing summary: what happened, how wide the boxes are, what is promised, where the files are."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from ..observer.status import Status
from .logs import Table
from .problem import Problem
from .run import Outcome

SHOWN_TIMES = 8
SHOWN_ALARMS = 20

Row = tuple[str, ...]


@dataclass(frozen=True)
class Summary:
    """All text of the summary, before it is laid out."""

    title: str
    facts: list[Row]
    header: Row
    signals: list[Row]
    alarms: list[str]
    certificate: list[str]
    files: list[str]


def summarise(
    title: str, problem: Problem, table: Table, outcome: Outcome, dataset: Any, files: Sequence[Path]
) -> Summary:
    """Collect the numbers of a finished run."""
    status = np.asarray(outcome.estimate.status)
    steps = len(status)
    conflicts = np.flatnonzero(status & int(Status.CONFLICT))
    absent = np.isnan(table.y)
    whole, partly = int(absent.all(axis=1).sum()), int((absent.any(axis=1) & ~absent.all(axis=1)).sum())
    unbounded = int(np.count_nonzero(status & int(Status.UNBOUNDED)))
    facts = [
        ("steps", f"{steps}, from {seconds(table.time[0])} s to {seconds(table.time[-1])} s"),
        *table.notes,
        ("missing rows", f"{whole}" + (f", and {partly} with some entries missing" if partly else "")),
        ("conflicts", _conflicts(table.time[conflicts])),
        ("unbounded", f"{unbounded} steps with a state that is not bounded"),
        ("design", f"{outcome.design_seconds:.2f} s"),
        ("compile", f"{outcome.compile_seconds:.2f} s"),
        ("run", f"{outcome.run_seconds:.3g} s, {steps / max(outcome.run_seconds, 1e-9):,.0f} steps/s"),
    ]
    certificate = outcome.observer.certificate
    records = json.loads(dataset.attrs["alarms"])
    alarms = [alarm_line(record) for record in records[:SHOWN_ALARMS]]
    if len(records) > SHOWN_ALARMS:
        alarms.append(f"... and {len(records) - SHOWN_ALARMS} more, all in the attribute `alarms` of the NetCDF file")
    return Summary(
        title=title,
        facts=facts,
        header=("signal", "mean width", "last width", "unbounded steps", "certified width", "room in region"),
        signals=_signals(problem, certificate, dataset),
        alarms=alarms,
        certificate=certificate_lines(certificate, problem),
        files=[str(path) for path in files],
    )


def alarm_line(record: dict[str, Any]) -> str:
    """One alarm as ``time: sentence``."""
    return f"{seconds(record['time'])} s: {record['text']}"


def certificate_lines(certificate: Any, problem: Problem) -> list[str]:
    """The certificate in short: what is promised, or why nothing is."""
    if not certificate.certified:
        lines = ["none: no bound on the widths is promised (the boxes are guaranteed all the same)"]
    elif not certificate.self_consistent:
        short = [name for name, slack in zip(problem.state.names, certificate.slack, strict=True) if slack < 0]
        lines = [f"empty: the certified widths do not fit into the region for {', '.join(short)}"]
    elif not certificate.region_matters:
        lines = ["holds anywhere: while no measurement is missing, widths settle at or below the certified ones"]
    else:
        lines = ["holds: as long as the boxes stay in the region, widths settle at or below the certified ones"]
    if certificate.recoverable is False:
        lines.append("after a lost row the boxes may stay unbounded")
    return lines + [str(note) for note in certificate.notes]


def _conflicts(times: np.ndarray) -> str:
    if len(times) == 0:
        return "0"
    shown = ", ".join(map(seconds, times[:SHOWN_TIMES]))
    return f"{len(times)}, at {shown}{', ...' if len(times) > SHOWN_TIMES else ''} s"


def _signals(problem: Problem, certificate: Any, dataset: Any) -> list[Row]:
    rows = []
    groups = (
        (problem.state, np.asarray(certificate.steady_width), np.asarray(certificate.slack)),
        (problem.input, np.asarray(certificate.input_width), None),
    )
    for group, steady, slack in groups:
        for index, (name, unit) in enumerate(zip(group.names, group.units, strict=True)):
            width = dataset[f"{name}_upper"].values - dataset[f"{name}_lower"].values
            width = width[~np.isnan(width)]
            finite = width[np.isfinite(width)]
            promised = short(steady[index]) if certificate.certified else "none"
            rows.append(
                (
                    f"{name} [{unit}]" if unit else name,
                    short(finite.mean()) if len(finite) else "unbounded",
                    "" if len(width) == 0 else "unbounded" if np.isinf(width[-1]) else short(width[-1]),
                    str(len(width) - len(finite)),
                    promised,
                    short(slack[index]) if slack is not None and certificate.certified else "",
                )
            )
    return rows


def seconds(time: float) -> str:
    """A time with the digits that tell steps apart, also where it counts from 1970, and without those of its rounding.

    >>> seconds(0.1 + 0.2), seconds(1714557600.6)
    ('0.3', '1714557600.6')
    """
    return f"{time:.10g}" if abs(time) < 1e6 else f"{time:.15g}"


def short(value: float) -> str:
    """A width in few digits."""
    return f"{value:.0f}" if 1e4 <= abs(value) < 1e9 else f"{value:.4g}"


def show(summary: Summary, stream: IO[str]) -> None:
    """Print the summary: with rules and colours on a terminal, as plain aligned text elsewhere."""
    if stream.isatty():
        _show_rich(summary, stream)
    else:
        stream.write(plain(summary))


def plain(summary: Summary) -> str:
    """The summary as plain text."""
    lines = [summary.title, ""]
    lines += [f"  {label:<14}{value}" for label, value in summary.facts]
    lines += ["", *_aligned([summary.header, *summary.signals])]
    for heading, items in (("certificate", summary.certificate), ("alarms", summary.alarms), ("files", summary.files)):
        if items:
            lines += ["", f"  {heading}", *(f"    {item}" for item in items)]
    return "\n".join(lines) + "\n"


def _aligned(rows: Sequence[Row]) -> list[str]:
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = []
    for first, *others in rows:
        cells = [first.ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(others, widths[1:], strict=True))]
        lines.append("  " + "  ".join(cells))
    return lines


def _show_rich(summary: Summary, stream: IO[str]) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table as RichTable
    from rich.text import Text

    console = Console(file=stream)
    console.print(Text(summary.title, style="bold"))
    facts = RichTable(box=None, show_header=False, padding=(0, 2))
    for label, value in summary.facts:
        facts.add_row(Text(label, style="cyan"), Text(value))
    console.print(facts)
    signals = RichTable(box=box.SIMPLE_HEAD)
    for index, heading in enumerate(summary.header):
        signals.add_column(heading, justify="left" if index == 0 else "right")
    for row in summary.signals:
        signals.add_row(*map(Text, row))
    console.print(signals)
    for heading, items, style in (
        ("certificate", summary.certificate, ""),
        ("alarms", summary.alarms, "red"),
        ("files", summary.files, ""),
    ):
        if items:
            console.print(Text(heading, style="cyan"))
            for item in items:
                console.print(Text(f"  {item}", style=style), soft_wrap=True)
