"""The summary as JSON. Strict JSON has no infinity: a width or a bound that is not finite is null."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from .._version import __version__
from .problem import Names, Problem
from .report import Notes, at_rates, certificate_lines, doubt, outside, promised
from .run import Outcome
from .totals import Totals


def run_figures(
    title: str, problem: Problem, totals: Totals, outcome: Outcome, notes: Notes, files: dict[str, Path]
) -> dict[str, Any]:
    """The summary of ``gsisio estimate --format json``.

    Returns:
        ``title``, ``library``, ``steps``, ``time`` (first and last, seconds), ``missing`` (rows without any and with
        some entries missing), ``statuses`` (steps by bit), ``outside`` (``steps`` without a promised width, because the
        box of this or the last one is outside of the region at ``boxes`` of them, or u of `u_region` at ``inputs``, or
        measurements of this or the last one are missing or contradicted, at ``measurements``; null where outputs come
        at several `rates`, as entries that are missing for that are no gap),
        ``doubt`` (text where nearly every step contradicts the bounds, else null), ``resumed`` (steps taken from an
        interrupted run), ``delay`` (L: boxes are from measurements up to L steps later), ``seconds``, ``table`` (what
        was found in the file and is not plain), ``signals``, ``alarms`` (as in the NetCDF file, the first 10,000),
        ``alarm_count``, ``certificate`` (as of `certificate_figures`), ``files``.
    """
    found = outside(totals, outcome)
    signals = [
        {
            "name": signal.name,
            "unit": signal.unit,
            "kind": signal.kind,
            "mean_width": signal.mean,
            "last_width": signal.last,
            "unbounded_steps": signal.unbounded,
            "certified_width": promise,
            "room_in_region": room,
        }
        for signal, promise, room in promised(totals, outcome.observer.certificate)
    ]
    return {
        "title": title,
        "library": f"gsisio_jax {__version__}",
        "steps": totals.steps,
        "time": {"first": totals.first, "last": totals.last},
        "missing": {"rows": totals.absent, "partly": totals.partly},
        "statuses": totals.statuses,
        "outside": None
        if at_rates(outcome)
        else {
            "steps": found.outside,
            "boxes": found.boxes,
            "inputs": found.inputs,
            "measurements": found.unread,
        },
        "doubt": doubt(totals) or None,
        "resumed": outcome.resumed,
        "delay": outcome.boxes.delay,
        "seconds": {
            "design": outcome.design_seconds,
            "compile": outcome.compile_seconds,
            "run": outcome.run_seconds,
        },
        "table": dict(notes),
        "signals": signals,
        "alarms": totals.alarms,
        "alarm_count": totals.alarm_count,
        "certificate": certificate_figures(outcome.observer.certificate, problem),
        "files": {kind: str(path) for kind, path in files.items()},
    }


def certificate_figures(certificate: Any, problem: Problem) -> dict[str, Any]:
    """What a design promises, as ``gsisio design --format json`` prints it under ``certificate``.

    Returns:
        ``certified``, ``self_consistent``, ``region_matters``, ``recoverable`` (null: not examined), ``rate``,
        ``implicit_rate``, ``equality_residual``; ``states`` and ``inputs`` with ``name``, ``unit``, ``steady_width``,
        states also with ``region_width`` and ``slack``, and ``rate_width``, the widest of all rows, where rows over
        several steps or for ``rates`` promise widths; ``text``, the promise in words, and ``notes``.
    """

    def rows(group: Names, **columns: Any) -> list[dict[str, Any]]:
        return [
            {"name": name, "unit": unit, **{key: float(values[index]) for key, values in columns.items()}}
            for index, (name, unit) in enumerate(zip(group.names, group.units, strict=True))
        ]

    region = np.asarray(certificate.region.width)
    by_rates = {} if certificate.rates is None else {"rate_width": certificate.settled_widths[0]}
    words = certificate_lines(certificate, problem)
    notes = [str(note) for note in certificate.notes]
    return {
        "certified": bool(certificate.certified),
        "self_consistent": bool(certificate.self_consistent),
        "region_matters": bool(certificate.region_matters),
        "recoverable": certificate.recoverable,
        "rate": float(certificate.rate),
        "implicit_rate": float(certificate.implicit_rate),
        "equality_residual": float(certificate.equality_residual),
        "states": rows(
            problem.state,
            steady_width=certificate.steady_width,
            region_width=region,
            slack=certificate.slack,
            **by_rates,
        ),
        "inputs": rows(problem.input, steady_width=certificate.input_width),
        "text": words[: len(words) - len(notes)],
        "notes": notes,
    }


def line(figures: dict[str, Any], indent: int | None = None) -> str:
    """Strict JSON: numbers that are not finite become null."""
    return json.dumps(strict(figures), ensure_ascii=False, allow_nan=False, indent=indent)


def strict(value: Any) -> Any:
    """The same with None for every number that JSON does not have."""
    if isinstance(value, dict):
        return {key: strict(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [strict(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
