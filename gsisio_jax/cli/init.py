"""The command ``gsisio init``: a configuration and a plant to fill in, from a look at a table."""

from __future__ import annotations

import contextlib
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from .errors import UserError
from .init_columns import Column, look_at
from .init_text import Clocked, configuration, measured, plant
from .logs.cells import Block
from .logs.clock import TOLERANCE, Clock, find_sample_time, tolerance_needed
from .logs.config import ClockPart, DialectPart
from .logs.dialect import sniff_file
from .logs.parquet import parquet_blocks, parquet_columns
from .logs.parser import Parser
from .logs.stamps import StampReader, Stamps, is_date_column
from .logs.text import blocks_of_lines, is_parquet, opened
from .output import check_writable, write_all

LOOKED_AT = 1 << 22  # characters of a text file
_CLOCKS = re.compile(r"(?i)^(t|ts|zeit|epoch|uhr\w*|(.*[^a-z])?(time|date|clock|stamp|timestamp|datetime)([^a-z].*)?)$")
_UNITS = (
    ("ns", re.compile(r"(?i)([_ (\[/]|nano)(ns|nsec|nanoseconds?|seconds?)[)\]]?$|nanos")),
    ("us", re.compile(r"(?i)[_ (\[/](us|µs|usec|microseconds?)[)\]]?$|micros")),
    ("ms", re.compile(r"(?i)[_ (\[/](ms|msec|milliseconds?)[)\]]?$|millis")),
)


def init(path: Path, out: Path) -> int:
    """Write ``NAME.toml`` and ``plant.py`` for a table.

    Args:
        path: the table.
        out: folder of the two files.

    Raises:
        UserError: the table cannot be read, or one of the files is there already.
    """
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    stem = re.sub(r"(\.(csv|tsv|txt|dat|log|parquet|pq|gz|bz2|xz|zst|zip))+$", "", path.name, flags=re.IGNORECASE)
    names = [f"{stem or path.stem}.toml", "plant.py"]
    for name in names:
        if (out / name).exists():
            raise UserError(f"{out / name} is there already; init overwrites nothing: move it, or give another --out")
    check_writable(out, names)
    block, found, marks = _head(path)
    columns = [look_at(name, cells, *marks) for name, cells in block.columns.items()]
    clock = _clock(columns, block)
    columns = [column for column in columns if clock is None or column.name != clock.column]
    used = measured(columns)
    if not used:
        raise UserError(f"{path.name}: no column of numbers was found; the columns are: {', '.join(block.columns)}")
    try:
        file = str(path.resolve().relative_to(out.resolve()))
    except ValueError:
        file = str(path.resolve())
    texts = configuration(file, path.name, found, len(block), clock, columns), plant(path.name, clock, len(used))
    for written in write_all(
        out, {name: lambda target, text=text: _put(target, text) for name, text in zip(names, texts, strict=True)}
    ):
        print(f"wrote {written}", file=sys.stdout)
    print(f"fill in what says FILL_IN in both, then run: gsisio estimate {out / names[0]}")
    return 0


def _put(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")


def _head(path: Path) -> tuple[Block, str, tuple[str, str]]:
    """The first rows as they are in the file, what the dialect is, and its marks of decimals and thousands."""
    if is_parquet(path):
        names = list(dict.fromkeys(parquet_columns(path)))
        return next(iter(parquet_blocks(path, names, (), as_text=names))), "", (".", "")
    dialect = sniff_file(path, DialectPart())
    parser = Parser(path.name, dialect, (), ())
    with opened(path, dialect.compression) as stream:
        line, text = next(blocks_of_lines(stream, dialect.encoding, dialect.quote, path.name, LOOKED_AT))
    frame, rows = parser.text(line, text)
    if not len(rows):
        raise UserError(f"{path.name}: the file has a header but no rows")
    # A name that is there twice cannot be used; its first column stands for it.
    columns = {name: frame[index].to_numpy() for index, name in reversed(list(enumerate(dialect.columns)))}
    ordered = {name: columns[name] for name in dict.fromkeys(dialect.columns)}
    return Block(path.name, ordered, rows), dialect.found, (dialect.decimal, dialect.thousands)


def _clock(columns: list[Column], block: Block) -> Clocked | None:
    """The column that looks most like a clock: dates or rising numbers, with the name of one where several do."""
    likely = [
        (bool(_CLOCKS.match(column.name)), is_date_column(block.columns[column.name]), -place, column)
        for place, column in enumerate(columns)
    ]
    likely = [one for one in likely if one[1] or (one[3].rises and (one[0] or one[2] == 0))]
    if not likely:
        return None
    column = max(likely, key=lambda one: one[:3])[3]
    unit = _unit(column)
    cells = block.columns[column.name]
    if unit is not None or not is_date_column(cells):
        cells = column.values
    return _measured(
        Clocked(column.name, unit, cells is not column.values), Block(block.name, {column.name: cells}, block.rows)
    )


def _unit(column: Column) -> str | None:
    if not column.numeric or not np.isfinite(column.values).any():
        return None
    for unit, pattern in _UNITS:
        if pattern.search(column.name):
            return unit
    # From 2001 to 2128, in s, ms, us or ns: none of them is taken for another.
    first = abs(float(column.values[np.isfinite(column.values)][0]))
    return "epoch" if any(1e9 <= first / scale <= 5e9 for scale in (1.0, 1e3, 1e6, 1e9)) else None


def _measured(clocked: Clocked, block: Block) -> Clocked:
    """The same with sample time, gaps, doubles and disorder, as far as they can be told."""
    try:
        stamps = StampReader(ClockPart.model_validate({"column": clocked.column, "unit": clocked.unit})).read(block)
    except UserError as error:
        return replace(clocked, trouble=str(error))
    empty = np.isnan(stamps.since)
    step = np.diff(stamps.since[~empty])
    clocked = replace(clocked, blank=bool(empty.any()), falls=bool((step < 0).any()), doubles=bool((step == 0).any()))
    order = np.flatnonzero(~empty)[np.argsort(stamps.since[~empty], kind="stable")]
    stamps = stamps.take(order)
    try:
        return _on_grid(clocked, stamps, None)
    except UserError as error:
        with contextlib.suppress(UserError):
            if tolerance := tolerance_needed(stamps):
                return _on_grid(clocked, stamps, tolerance)
        return replace(clocked, trouble=str(error))


def _on_grid(clocked: Clocked, stamps: Stamps, tolerance: float | None) -> Clocked:
    sample_time = find_sample_time(stamps, tolerance)
    clock = Clock(sample_time, TOLERANCE * sample_time if tolerance is None else tolerance, "s", found=True)
    clock.place(stamps, duplicates=True)
    return replace(clocked, sample_time=sample_time, tolerance=tolerance, description=clock.describe())
