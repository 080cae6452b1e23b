"""The two files that ``gsisio init`` writes."""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from .init_columns import Column
from .logs.units import conversion

_LONGEST = 200  # rows of a pattern that `rates` can have
DEGREES = {"deg": "rad", "°": "rad", "deg/s": "rad/s", "°/s": "rad/s"}


@dataclass(frozen=True)
class Clocked:
    """The clock that was found.

    Attributes:
        column, unit: as in ``time = {column, unit}``; no unit for dates and for seconds.
        dates: whether its cells are dates.
        sample_time: seconds; None where it could not be found, for the reason in `trouble`.
        tolerance: seconds that stamps are off the grid, where that is more than usual.
        description: rows on the grid, gaps, jitter.
        blank, falls, doubles: cells are empty; times fall; times are there twice.
    """

    column: str
    unit: str | None
    dates: bool
    sample_time: float | None = None
    tolerance: float | None = None
    description: str = ""
    trouble: str = ""
    blank: bool = False
    falls: bool = False
    doubles: bool = False


def configuration(file: str, name: str, dialect: str, rows: int, clock: Clocked | None, columns: list[Column]) -> str:
    """Text of the TOML file.

    Args:
        file: the table, from the folder of the configuration.
        name: of the table.
        dialect: what is not plain about it.
        rows: how many were looked at.
        clock: the clock, if one was found.
        columns: the others.
    """
    used = measured(columns)
    units = [(unit, DEGREES.get(unit, unit)) for _, unit in _labels(used)]
    outputs = ", ".join(
        f"{{name = {_quoted(label)}{unit and f', unit = {_quoted(unit)}'}}}"
        for (label, _), (_, unit) in zip(_labels(used), units, strict=True)
    )
    radius = ", ".join(
        _not_below((column.resolution or 0.0) / 2 * (conversion(unit, to)[0] if unit != to else 1.0))
        for column, (unit, to) in zip(used, units, strict=True)
    )
    return f"""\
# Written by gsisio init from the first {rows:,} rows of {name}.
# Fill in what says FILL_IN, here and in plant.py, and take out of y, output and noise.v what you do not measure with.
title = {_quoted(name)}

[system]
# The function plant() of plant.py, beside this file.
use = "plant:plant"

[signals]
# Names and units in the order of the components; without them states are x1, x2, ... and unknown inputs d1, d2, ...
# state = [{{name = "position", unit = "m"}}, {{name = "velocity", unit = "m/s"}}]
# input = [{{name = "force", unit = "N"}}]
output = [{outputs}]

[noise]
# What f leaves out in one step, at most, by state: {{radius = [0.01, 0.02]}}, or {{lower = [...], upper = [...]}}.
w = "FILL_IN"
# A SUGGESTION, and the least that is possible: half of the resolution of each column (its last digit, or a coarser step
# that all values lie on), as rounding costs that much. The sensor itself errs by more: its data sheet says by how much.
# Bounds that are too small make false alarms.
v = {{radius = [{radius}]}}

[region]
# Where the certificate shall hold: found by itself, or lower = [...] and upper = [...], by state.
auto = true

[initial]
# Where the states can be before the first row, by state; -inf and inf where nothing is known.
lower = "FILL_IN"
upper = "FILL_IN"

{_rates(used)}[table]
file = {_quoted(file)}
{_found(dialect)}{_clock(clock)}
# Columns of numbers, in the order of y in plant.py. Known inputs go to u = [...]; then it is f(x, u) and
# gx.System(..., m=1), and a table [u_region] with lower and upper holds the values that they can take.
y = [{", ".join(_quoted(column.name) for column in used)}]
{_conversions(used, units)}
{_missing(columns)}
# What was found in the columns:
{_columns(columns, used)}

# [outputs]                        # files of gsisio estimate; by default named after this file
# netcdf = "boxes.nc"
# csv = "boxes.csv"
# picture = "boxes.png"
# report = "report.html"
"""


def measured(columns: list[Column]) -> list[Column]:
    """Columns that may be measurements: numbers that are not all the same, or all numbers where there is none."""
    numbers = [column for column in columns if column.numeric]
    return [column for column in numbers if not column.constant] or numbers


def plant(name: str, clock: Clocked | None, outputs: int) -> str:
    """Text of the module."""
    step = "FILL_IN" if clock is None or clock.sample_time is None else repr(clock.sample_time)
    return f'''\
"""The plant behind {name}, in steps of the sample time:

x[k+1] = f(x) + G d + w     x states, d unknown inputs (any value at any time), w process noise
y[k]   = g(x) + H d + v     y measurements, v measurement noise

Fill in what says FILL_IN. The comments show a cart on a line that is pushed by an unknown force, with position and
velocity as states, both measured.
"""

import jax.numpy as jnp

import gsisio_jax as gx

STEP = {step}  # seconds between two rows


def f(x):
    """States one step later, (n,), without unknown input and noise."""
    return FILL_IN  # jnp.stack([x[0] + STEP * x[1], x[1]])


def g(x):
    """Measurements, ({outputs},) for all columns in y, without unknown input and noise."""
    return FILL_IN  # jnp.stack([x[0], x[1]])


# How the unknown inputs enter the states, n rows, and the measurements, one row each; one column per input.
G = FILL_IN  # [[STEP**2 / 2], [STEP]]
H = FILL_IN  # [[0.0], [0.0]]


def plant():
    return gx.System(f=f, g=g, G=G, H=H)
'''


def _quoted(text: str) -> str:
    """A string as TOML has it."""
    return json.dumps(text, ensure_ascii=False)


def _labels(columns: list[Column]) -> list[tuple[str, str]]:
    """Signal names (letters, digits and _ . + - only, each once) and units, from names such as ``Level 1 [m]``."""
    labels: dict[str, str] = {}
    for column in columns:
        bare, unit = re.fullmatch(r"(.*?)\s*(?:[\[(]([^\[\]()]*)[\])])?", column.name, re.DOTALL).groups()  # type: ignore[union-attr]
        label = re.sub(r"[^\w .+-]+", "_", bare).strip(" _") or "y"
        label = label if re.match(r"[^\W\d]", label) else f"y_{label}"
        while label in labels:
            label += "_"
        labels[label] = unit or ""
    return list(labels.items())


def _found(dialect: str) -> str:
    return f"# Found by looking: {dialect}.\n# Keys of [table.dialect] override that.\n" if dialect else ""


def _clock(clock: Clocked | None) -> str:
    if clock is None:
        return (
            "# No clock was found, so rows are one sample time apart. Where a column is one, say which and how:\n"
            '# time = "a", or {column = "a", unit = "ms"}, or {column = ["a", "b"], format = "%d.%m.%Y %H:%M:%S"}\n'
            'sample_time = "FILL_IN"           # seconds'
        )
    unit = "" if clock.unit is None else f", unit = {_quoted(clock.unit)}"
    unit += "" if clock.tolerance is None else f", tolerance = {clock.tolerance!r}"
    kind = "dates" if clock.dates else "seconds, as no unit is known" if clock.unit is None else f"unit: {clock.unit}"
    lines = [f"# Clock: {clock.column} ({kind}).", f"time = {{column = {_quoted(clock.column)}{unit}}}"]
    if clock.sample_time is None:
        lines += [
            f"# No sample time was found: {clock.trouble}",
            'sample_time = "FILL_IN"           # seconds; or dt = "as_input" in its place, where rows lie on no grid',
        ]
    else:
        lines += [f"# {clock.description}", f"sample_time = {clock.sample_time!r}"]
    if clock.blank:
        lines.append('on_blank_time = "drop"            # some rows have no time')
    if clock.falls:
        lines.append('on_unsorted = "sort"              # some times fall from row to row')
    if clock.doubles:
        lines.append('on_duplicate = "first"            # some times are there twice; or "last", "mean"')
    return "\n".join(lines)


def _not_below(value: float) -> str:
    """Four digits, rounded up.

    >>> _not_below(0.0005), _not_below(0.00872664), _not_below(0.0)
    ('0.0005', '0.008727', '0')
    """
    text = f"{value:.4g}"
    return text if float(text) >= value else f"{value + 10 ** (math.floor(math.log10(value)) - 3) / 2:.4g}"


def _conversions(used: list[Column], units: list[tuple[str, str]]) -> str:
    angles = [
        f"{_quoted(column.name)} = {{unit = {_quoted(unit)}, to = {_quoted(to)}}}"
        for column, (unit, to) in zip(used, units, strict=True)
        if unit != to
    ]
    if not angles:
        return f'# columns = {{{_quoted(used[0].name)} = {{unit = "mV"}}}}  # cells in mV, km/h, ... become V, m/s'
    return (
        "# Degrees become radians, which sin and cos take; noise.v and the units of output are in radians.\n"
        f"columns = {{{', '.join(angles)}}}"
    )


def _missing(columns: list[Column]) -> str:
    found: dict[Any, None] = {}
    for column in columns:
        if column.numeric:
            found |= dict.fromkeys(int(value) for value in column.sentinels)
            found |= dict.fromkeys(word for word, _ in column.words)
    if not found:
        return '# missing = [-9999, "---"]         # cells that mean missing, besides empty ones, NaN and NA'
    listed = ", ".join(str(one) if isinstance(one, int) else _quoted(one) for one in found)
    return f"# These cells look as if they meant missing; take out what does not.\nmissing = [{listed}]"


def _rates(used: list[Column]) -> str:
    """The part [design] where some columns come in every m-th row alone, and all of them together in some row."""
    there = [np.isfinite(column.values) & ~np.isin(column.values, column.sentinels) for column in used]
    strides = [np.unique(np.diff(np.flatnonzero(rows))) for rows in there]
    if not all(len(stride) == 1 for stride in strides) or not np.all(there, axis=0).any():
        return ""
    rates = [int(stride[0]) for stride in strides]
    if max(rates) == 1 or np.lcm.reduce(rates) > _LONGEST:
        return ""
    slow = ", ".join(re.sub(r"\s+", " ", c.name) for c, rate in zip(used, rates, strict=True) if rate > 1)
    return f"[design]\n# Every how many rows each of y comes, as not every row has {slow}.\nrates = {rates}\n\n"


def _columns(columns: list[Column], used: list[Column]) -> str:
    lines = []
    for column in columns:
        name = re.sub(r"\s+", " ", column.name)
        if not column.numeric:
            lines.append(f"#   {name}: text")
            continue
        facts = [f"{column.low:.6g} to {column.high:.6g}"]
        facts.append("constant" if column.constant else f"resolution {column.resolution:.4g}")
        absent = column.empty + column.stand_ins + sum(count for _, count in column.words)
        facts += [f"{absent:,} cells missing"] if absent else []
        facts += ["not in y"] if column not in used else []
        lines.append(f"#   {name}: {', '.join(facts)}")
    return "\n".join(lines)
