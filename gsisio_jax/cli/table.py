"""The logged table on the grid of the sample time: measurements, known inputs and missing rows."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .._extras import need
from .cells import Source, check_columns, convert, numbers, read_csv, read_parquet
from .errors import UserError, reason

MAXIMUM_STEPS = 50_000_000


@dataclass(frozen=True)
class Table:
    """Measurements on an evenly spaced grid.

    Attributes:
        time: shape (T,), seconds; the file's own value where the row is in the file.
        y: shape (T, l); NaN is missing.
        u: shape (T, m) of known inputs, or None where the system has none.
    """

    time: np.ndarray
    y: np.ndarray
    u: np.ndarray | None


def read_table(
    path: Path,
    *,
    time: str,
    sample_time: float,
    y: Sequence[str],
    u: Sequence[str] = (),
    missing: Iterable[float | str] = (),
    transform: Callable[[Any], Any] | None = None,
) -> Table:
    """Read a CSV or Parquet file of measurements.

    Args:
        path: ``.csv`` (comma separated, one header line, UTF-8) or ``.parquet``.
        time: column of the time, seconds, strictly increasing, on the grid of `sample_time`.
        sample_time: seconds between two steps. Rows of the grid that are not in the file become missing rows.
        y: columns of the outputs, in order.
        u: columns of the known inputs, in order; finite in every row, and no row may be absent.
        missing: values that mean missing, besides empty cells and NaN.
        transform: DataFrame to DataFrame, applied before the columns are taken. Columns of numbers reach it as
            floats with NaN where missing, other columns as text.

    Returns:
        The table on its grid.

    Raises:
        UserError: anything in the file that cannot be used; one line that names file, row and column. Rows of a CSV
            file are its lines (the header is line 1), rows of Parquet or of a transformed table count from 1.
    """
    pandas = need("pandas", extra="cli", purpose="the command line")
    missing = tuple(missing)
    parquet = path.suffix.lower() in (".parquet", ".pq")
    source = read_parquet(path, pandas) if parquet else read_csv(path, pandas)
    if len(source.frame) == 0:
        raise UserError(f"{path.name}: the file has a header but no rows")
    if transform is not None:
        source = _transformed(source, transform, missing, pandas)
    wanted = [time, *y, *u]
    check_columns(source, wanted)
    columns = {name: numbers(source, name, missing) for name in dict.fromkeys(wanted)}
    index = _grid_index(source, time, columns[time], sample_time)
    steps = int(index[-1]) + 1
    grid = columns[time][0] + sample_time * np.arange(steps)
    grid[index] = columns[time]
    outputs = np.full((steps, len(y)), np.nan)
    outputs[index] = np.stack([columns[name] for name in y], axis=1)
    return Table(grid, outputs, _known_inputs(source, u, columns, index) if u else None)


def _transformed(source: Source, transform: Callable, missing: tuple, pandas: Any) -> Source:
    """Hand the user's function a frame with numbers where there are numbers; take back its frame."""
    frame = source.frame.copy()
    if frame.columns.is_unique:
        for name in frame.columns:
            values, bad = convert(frame[name], missing)
            if bad is None:
                frame[name] = values
    label = getattr(transform, "__name__", repr(transform))
    try:
        frame = transform(frame)
    except Exception as error:
        raise UserError(
            f"{source.name}: table.transform: {label} raised {type(error).__name__}: {reason(error)}"
        ) from error
    if not isinstance(frame, pandas.DataFrame):
        raise UserError(f"table.transform: {label} must return a DataFrame, got {type(frame).__name__}")
    if len(frame) == 0:
        raise UserError(f"{source.name}: table.transform: {label} returned no rows")
    return Source(f"{source.name} after {label}", frame, None)


def _grid_index(source: Source, name: str, time: np.ndarray, sample_time: float) -> np.ndarray:
    """Index of every row on the grid that starts at the first row."""
    if np.isnan(time).any():
        bad = int(np.argmax(np.isnan(time)))
        raise UserError(f"{source.row(bad)}, column '{name}': the time is missing; every row needs one")
    step = np.diff(time)
    if (step <= 0).any():
        bad = int(np.argmax(step <= 0)) + 1
        before, now = time[bad - 1], time[bad]
        what = "is there twice" if before == now else f"comes after {before:.12g}"
        raise UserError(
            f"{source.row(bad)}, column '{name}': the time {now:.12g} {what}; times must increase from row to row"
        )
    since = time - time[0]
    if since[-1] / sample_time > MAXIMUM_STEPS:
        raise UserError(
            f"{source.name}: column '{name}' spans {since[-1]:.6g} s, more than {MAXIMUM_STEPS} steps of "
            f"{sample_time:g} s; check the unit of the time and sample_time"
        )
    index = np.rint(since / sample_time).astype(np.int64)
    # A large clock value (seconds since 1970) is itself only known to a few units in its last place.
    tolerance = max(1e-6 * sample_time, 4 * float(np.spacing(np.abs(time).max())))
    off = np.abs(since - sample_time * index) > tolerance
    off[1:] |= np.diff(index) == 0
    if off.any():
        bad = int(np.argmax(off))
        raise UserError(
            f"{source.row(bad)}, column '{name}': the time {time[bad]:.12g} is not on the grid of sample_time = "
            f"{sample_time:g} s that starts at {time[0]:.12g}"
        )
    return index


def _known_inputs(source: Source, u: Sequence[str], columns: dict[str, np.ndarray], index: np.ndarray) -> np.ndarray:
    for name in u:
        if np.isnan(columns[name]).any():
            bad = int(np.argmax(np.isnan(columns[name])))
            raise UserError(f"{source.row(bad)}, column '{name}': a known input is missing; every step needs one")
    if len(index) <= index[-1]:
        bad = int(np.argmax(np.diff(index) > 1)) + 1
        raise UserError(
            f"{source.row(bad)}: {index[bad] - index[bad - 1] - 1} rows of the grid are absent before it, so the known "
            f"inputs ({', '.join(u)}) are not known there; every step needs them"
        )
    return np.stack([columns[name] for name in u], axis=1)
