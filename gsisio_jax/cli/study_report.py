"""The closing summary of a study."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..observer.status import Status
from ..observer.summary import units_hint
from ..plot.scales import quantiles
from ..plot.study import with_entry
from .problem import Names, Problem
from .report import Summary, certificate_lines, short
from .study_arguments import NOISE

SHOWN = 5  # most elements of the axis of the noise
WIDTHS = ("final", "mean", "max", "rms")


@dataclass(frozen=True)
class Effort:
    """What a study took.

    Attributes:
        design_seconds: of the design.
        seconds: of all tiles, the compilation included.
        steps: of each case.
        measured: of them those with a measurement, on average over the cases.
        tiles: how many there are.
        kept: how many of them were there before.
        computed: cases that were computed now.
    """

    design_seconds: float
    seconds: float
    steps: int
    measured: float
    tiles: int
    kept: int
    computed: int


def summarise(
    title: str, problem: Problem, certificate: Any, dataset: Any, effort: Effort, files: Sequence[Path]
) -> Summary:
    """Collect the numbers of a finished study."""
    header, rows = _signals(problem, certificate, dataset)
    return Summary(
        title=title,
        facts=_facts(dataset, effort),
        header=header,
        signals=rows,
        alarms=[],
        certificate=certificate_lines(certificate, problem),
        files=[str(path) for path in files],
    )


def _facts(dataset: Any, effort: Effort) -> list[tuple[str, ...]]:
    status = dataset["status_any"]
    sizes = {str(dim): size for dim, size in status.sizes.items()}
    cases = int(np.prod(list(sizes.values())))
    product = " x ".join(f"{size} {dim.replace('_', ' ')}" + "s" * (size > 1) for dim, size in sizes.items())
    unbounded = int((status.values.astype(np.int64) & int(Status.UNBOUNDED) != 0).sum())
    conflicts = dataset["conflicts"].values
    outside = int((status.values.astype(np.int64) & int(Status.OUTSIDE_REGION) != 0).sum())
    rate = effort.computed * effort.steps / max(effort.seconds, 1e-9)
    kept = f", {effort.kept} of them from an earlier run" if effort.kept else ""
    speed = f", {rate:,.0f} box-steps/s, compiling included" if effort.computed else ""
    facts = [
        ("cases", f"{cases:,}" + (f" = {product}" if sizes else "")),
        ("steps", f"{effort.steps:,} each"),
        ("tiles", f"{effort.tiles}{kept}"),
        ("design", f"{effort.design_seconds:.2f} s"),
        ("run", f"{effort.seconds:.2f} s{speed}"),
        ("bounded", f"{_percent(1 - unbounded / cases)} of the cases at every step"),
        ("conflicts", f"{int(conflicts.sum()):,} steps in {int((conflicts > 0).sum()):,} cases"),
    ]
    if quiet := _quiet(dataset["conflicts"]):
        facts.append(("no conflict", quiet))
    if hint := _doubt(dataset["conflicts"], effort.measured):
        facts.append(("units?", hint))
    if outside:
        facts.append(("outside", f"{outside:,} cases leave the region at some step: no width is promised there"))
    if "missed" in dataset.attrs:
        facts.append(("misses", dataset.attrs["missed"]))
    return facts


def _doubt(conflicts: Any, measured: float) -> str:
    """What so many conflicts are a sign of: steps count, as of a single run, of the cases with the stated bounds or
    larger ones, for a study of the noise is meant to find out below which of them conflicts begin."""
    for noise in _noises(conflicts):
        conflicts = conflicts.isel({noise: np.flatnonzero(conflicts[noise].values >= 1)})
    return units_hint(int(conflicts.sum()), conflicts.size * measured)


def _quiet(conflicts: Any) -> str:
    """Where a study of the noise has conflicts at some scales: the smallest one without any."""
    for noise in _noises(conflicts):
        count = conflicts.sum([dim for dim in conflicts.dims if dim != noise])
        quiet = conflicts[noise].values[count.values == 0]
        if len(quiet) and count.values.any():
            return f"smallest {noise.replace('_', ' ')} without one: {quiet.min():g}"
    return ""


def _noises(variable: Any) -> list[str]:
    return [str(dim) for dim in variable.dims if dim in NOISE.values()]


def _percent(share: float) -> str:
    # Rounding must not turn some into none or nearly all into all.
    return f"{100 * share:.4g} %" if share in (0.0, 1.0) or 0.0001 < share < 0.9999 else f"{100 * share:.8g} %"


def _signals(problem: Problem, certificate: Any, dataset: Any) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """One line for each signal and each (shown) noise."""
    words, measured = _measured(dataset)
    if not measured:
        return (), []
    promised = {kind: dataset[f"predicted_{kind}_width"] for kind in ("state", "input")}
    noise = next((str(dim) for dim in promised["state"].dims if dim != "state"), None)
    count = 1 if noise is None else dataset.sizes[noise]
    shown = np.unique(np.linspace(0, count - 1, min(count, SHOWN)).round().astype(int))
    header = (
        "signal",
        *([noise.replace("_", " ")] if noise else []),
        f"median {words}",
        "worst",
        "unbounded",
        "certified",
        "room in region",
    )
    rows = []
    groups: dict[str, Names] = {"state": problem.state, "input": problem.input}
    region = np.asarray(certificate.region.width)
    for kind, group in groups.items():
        if kind not in measured:
            continue
        for index, (name, unit) in enumerate(zip(group.names, group.units, strict=True)):
            for element in shown:
                at = {kind: index} | ({noise: element} if noise else {})
                widths = measured[kind].isel(at).values.ravel()
                widths = widths[~np.isnan(widths)]
                width = float(promised[kind].isel({dim: i for dim, i in at.items() if dim in promised[kind].dims}))
                infinite = np.isinf(widths).mean() if len(widths) else 0.0
                room = (
                    short(region[index] - width)
                    if kind == "state" and certificate.region_matters and np.isfinite(width)
                    else ""
                )
                label = f"{name} [{unit}]" if unit else name
                rows.append(
                    (
                        label if element == shown[0] else "",
                        *(
                            [with_entry(dataset, noise, dataset[noise].values[element]).partition(" = ")[2]]
                            if noise
                            else []
                        ),
                        *(_width(w) for w in (quantiles(widths, (0.5, 1.0)) if len(widths) else ())),
                        *([] if len(widths) else ["", ""]),
                        _percent(infinite),
                        short(width) if np.isfinite(width) else "none",
                        room,
                    )
                )
    return header, rows


def _width(value: float) -> str:
    return short(value) if np.isfinite(value) else "unbounded"


def _measured(dataset: Any) -> tuple[str, dict[str, Any]]:
    """Which widths are told, in words, and their values by kind of signal."""
    for name in WIDTHS:
        if f"state_width_{name}" in dataset:
            words = {"final": "last width", "mean": "mean width", "max": "largest width", "rms": "rms width"}[name]
            return words, {kind: dataset[f"{kind}_width_{name}"] for kind in ("state", "input")}
    if "state_width_quantile" in dataset:
        share = float(dataset["quantile"][-1])
        return f"{share:g} quantile", {k: dataset[f"{k}_width_quantile"].isel(quantile=-1) for k in ("state", "input")}
    if "state_lower" in dataset:
        # The input box of the last step is not known.
        ends = {"state": -1, "input": max(-2, -dataset.sizes["time"])}
        return "last width", {
            kind: dataset[f"{kind}_upper"].isel(time=end) - dataset[f"{kind}_lower"].isel(time=end)
            for kind, end in ends.items()
        }
    return "", {}
