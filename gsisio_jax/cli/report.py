"""The closing summary: what happened, how wide the boxes are, what is promised, where the files are."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from ..observer.summary import Outside, units_hint
from .problem import Problem
from .run import Outcome
from .totals import Signal, Totals

SHOWN_TIMES = 8
SHOWN_ALARMS = 20

Row = tuple[str, ...]
Notes = Iterable[tuple[str, str]]


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
    title: str, problem: Problem, totals: Totals, outcome: Outcome, notes: Notes, files: Iterable[Path]
) -> Summary:
    """Collect the numbers of a finished run; `notes` are those of the table."""
    partly = f", and {totals.partly} with some entries missing" if totals.partly else ""
    estimated = totals.steps - outcome.resumed
    facts = [
        ("steps", f"{totals.steps}, from {span(totals)}"),
        *notes,
        ("missing rows", f"{totals.absent}{partly}"),
        ("conflicts", _conflicts(totals)),
        *([("units?", doubt(totals))] if doubt(totals) else []),
        ("unbounded", f"{totals.statuses['UNBOUNDED']} steps with a state that is not bounded"),
        *([("delay", _delay(outcome.boxes.delay))] if outcome.boxes.delay else []),
        ("outside", said_outside(totals, outcome)),
        *([("resumed", f"after step {outcome.resumed:,}")] if outcome.resumed else []),
        ("design", f"{outcome.design_seconds:.2f} s"),
        ("compile", f"{outcome.compile_seconds:.2f} s"),
        ("run", f"{outcome.run_seconds:.3g} s, {estimated / max(outcome.run_seconds, 1e-9):,.0f} steps/s"),
    ]
    certificate = outcome.observer.certificate
    alarms = [alarm_line(record, totals) for record in totals.alarms[:SHOWN_ALARMS]]
    if totals.alarm_count > SHOWN_ALARMS:
        alarms.append(f"... and {totals.alarm_count - SHOWN_ALARMS} more; every step with status 1 in the files is one")
    return Summary(
        title=title,
        facts=facts,
        header=("signal", "mean width", "last width", "unbounded steps", "certified width", "room in region"),
        signals=_signals(totals, certificate),
        alarms=alarms,
        certificate=certificate_lines(certificate, problem, outside(totals, outcome)),
        files=[str(path) for path in files],
    )


def _delay(steps: int) -> str:
    return f"boxes of a step are from measurements up to {steps} step{'s' if steps > 1 else ''} later"


def span(totals: Totals) -> str:
    """First and last time, and the zone of dates."""
    zone = f" ({totals.zone})" if totals.zone else ""
    return f"{totals.when(totals.first)} to {totals.when(totals.last)}{zone}"


def alarm_line(record: dict[str, Any], totals: Totals) -> str:
    """One alarm as ``time: sentence``."""
    return f"{totals.when(record['time'])}: {record['text']}"


def doubt(totals: Totals) -> str:
    """What is to be said of a run whose data contradict the bounds at nearly every step; "" of others."""
    return units_hint(totals.alarm_count, totals.steps - totals.absent)


def outside(totals: Totals, outcome: Outcome) -> Outside:
    """Steps for which no width is promised, and why."""
    return Outside(totals.steps, totals.outside, totals.beyond, outcome.u_outside, totals.unread)


def at_rates(outcome: Outcome) -> bool:
    """The promise is one for outputs of several rates."""
    rates = outcome.observer.certificate.rates
    return rates is not None and rates.period > 1


def said_outside(totals: Totals, outcome: Outcome) -> str:
    """The line of the summary on steps without a promised width."""
    rates = outcome.observer.certificate.rates
    if at_rates(outcome):
        return f"not counted: a width is promised while outputs come every {', '.join(map(str, rates.rates))} rows"
    return str(outside(totals, outcome))


def certificate_lines(certificate: Any, problem: Problem, found: Outside | None = None) -> list[str]:
    """The certificate in short: what is promised, or why nothing is, and where a run was outside of it."""
    if certificate.settles_by_rates:
        when = "outputs come at the stated rates" if certificate.rates.period > 1 else "no measurement is missing"
        lines = [f"holds anywhere: while {when}, widths settle at or below the certified ones"]
    elif not certificate.certified:
        lines = ["none: no bound on the widths is promised (the boxes are guaranteed all the same)"]
    elif not certificate.self_consistent:
        short = [name for name, slack in zip(problem.state.names, certificate.slack, strict=True) if slack < 0]
        lines = [f"empty: the certified widths do not fit into the region for {', '.join(short)}"]
    elif not certificate.region_matters:
        lines = ["holds anywhere: while no measurement is missing, widths settle at or below the certified ones"]
    else:
        lines = ["holds: as long as the boxes stay in the region, widths settle at or below the certified ones"]
    if found is not None and found.outside and certificate.self_consistent and certificate.rates is None:
        lines = [found.of_promise(), f"where it applies: {lines[0].partition(': ')[2]}"]
    if certificate.recoverable is False:
        lines.append("after a lost row the boxes may stay unbounded")
    return lines + [str(note) for note in certificate.notes]


def _conflicts(totals: Totals) -> str:
    times = totals.alarm_times
    if len(times) == 0:
        return "0"
    shown = ", ".join(totals.when(time, unit="") for time in times[:SHOWN_TIMES])
    return f"{len(times)}, at {shown}{', ...' if len(times) > SHOWN_TIMES else ''}{' s' if totals.zone is None else ''}"


def _signals(totals: Totals, certificate: Any) -> list[Row]:
    rows = []
    for signal, promise, room in promised(totals, certificate):
        rows.append(
            (
                f"{signal.name} [{signal.unit}]" if signal.unit else signal.name,
                "unbounded" if signal.mean is None else short(signal.mean),
                "" if signal.steps == 0 else "unbounded" if signal.last is None else short(signal.last),
                str(signal.unbounded),
                "none" if promise is None else short(promise),
                "" if room is None else short(room),
            )
        )
    return rows


def promised(totals: Totals, certificate: Any) -> Iterator[tuple[Signal, float | None, float | None]]:
    """Every signal with its certified width and its room in the region; None where nothing is promised."""
    # Where f and g are affine there is no region to leave.
    rooms = np.asarray(certificate.slack) if certificate.region_matters else [None] * len(certificate.steady_width)
    of_states, of_inputs = certificate.settled_widths
    states, inputs = zip(of_states, rooms, strict=True), ((width, None) for width in of_inputs)
    for signal, (width, room) in zip(totals.signals, (*states, *inputs), strict=True):
        there = certificate.certified if certificate.rates is None else np.isfinite(width)
        yield (signal, float(width), room) if there else (signal, None, None)


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
