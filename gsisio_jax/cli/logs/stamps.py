"""Cells of the clock to seconds: numbers in a unit, dates of ISO 8601 or of a pattern, with and without zone."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..._extras import need
from ..._moments import zone_name
from ..errors import UserError
from .cells import Block, Cells
from .config import ClockPart

PER_SECOND = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9, "min": 1 / 60, "h": 1 / 3600, "d": 1 / 86400}
NAMES = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
_ISO = re.compile(r"\d{4}-?\d\d-?\d\d([T ].*)?|\d{4}-\d\d-\d\d.*")
_OFFSET = re.compile(r":?\d\d(\.\d+)?\s*(Z|z|UTC|[+-]\d\d(:?\d\d)?)$")


@dataclass(frozen=True)
class Stamps:
    """Times of the rows of a block.

    Attributes:
        since: (R,) seconds since the first row that was read, as exact as the file; NaN where the cell is empty.
        time: (R,) seconds of the file's own clock; those of dates count from 1970-01-01 UTC.
        resolution: seconds between neighbouring numbers that the clock can hold; 0 where it is exact.
        show: text of one of them as the file has it.
        place: beginning of a message about one of them: file, row and column.
    """

    since: np.ndarray
    time: np.ndarray
    resolution: float
    show: Callable[[int], str]
    place: Callable[[int], str]

    def __len__(self) -> int:
        return len(self.since)

    def take(self, order: np.ndarray) -> Stamps:
        """Some of the rows, in another order."""
        return Stamps(
            self.since[order],
            self.time[order],
            self.resolution,
            lambda index: self.show(int(order[index])),
            lambda index: self.place(int(order[index])),
        )


@dataclass
class StampReader:
    """Reads the clock block by block; seconds count from the first row of the first block.

    Attributes:
        part: column, unit or format, zone.
        dates: whether the cells are dates and not numbers.
        unit: of numbers; for ``unit = "epoch"`` found by the size of the first one.
        zone: of the dates that the clock shows or stands for, "" where they have none; None where it counts from a
            beginning of its own.
        origin: the first stamp, in that unit or in nanoseconds since 1970, once there was one. With it a reader that is
            made anew goes on where another one was.
    """

    part: ClockPart
    missing: Sequence[float | str] = ()
    dates: bool = False
    unit: str = "s"
    zone: str | None = None
    origin: int | float | None = None

    def __post_init__(self) -> None:
        if self.part.unit in PER_SECOND:
            self.unit = self.part.unit

    def read(self, block: Block) -> Stamps:
        """Stamps of a block.

        Raises:
            UserError: a cell is no number or no date; a local time that its zone has twice or not at all.
        """
        column, name = self._column(block)

        def place(index: int) -> str:
            return f"{block.row(index)}, column '{name}'"

        if not self.dates:
            said = self.part.format is not None or self.part.unit == "iso8601"
            self.dates = said or (self.part.unit is None and is_date_column(column))
        if self.dates:
            values, empty = self._dates(column, place)
            scale = 1e9
        else:
            values, empty = self._numbers(block, column, name)
            if self.part.unit == "epoch" and self.origin is None and not empty.all():
                self.unit = _epoch_unit(float(values[~empty][0]), place(int(np.argmin(empty))))
            scale = PER_SECOND[self.unit]
            self.zone = "UTC" if self.part.unit == "epoch" else None
        if self.origin is None and not empty.all():
            self.origin = values[~empty][0].item()
        since = (values - (self.origin or 0)) / scale
        time = values / scale
        since[empty], time[empty] = np.nan, np.nan
        exact = values.dtype.kind == "i" or empty.all()
        resolution = 0.0 if exact else float(np.spacing(np.abs(values[~empty]).max())) / scale

        def show(index: int) -> str:
            return _text(column.iloc[index] if hasattr(column, "iloc") else column[index])

        return Stamps(since, time, resolution, show, place)

    def _column(self, block: Block) -> tuple[Any, str]:
        """The cells and the name of the clock; cells of several columns with blanks between them."""
        names = self.part.column
        columns = [block.columns[name] for name in names]
        if len(columns) == 1:
            return columns[0], names[0]
        rows = zip(*([str(cell).strip() for cell in column] for column in columns), strict=True)
        cells = ["" if "" in row or "nan" in row or "None" in row else " ".join(row) for row in rows]
        return np.array(cells, dtype=object), "', '".join(names)

    def _numbers(self, block: Block, column: Any, name: str) -> tuple[np.ndarray, np.ndarray]:
        if getattr(getattr(column, "dtype", None), "kind", "O") in "iu":
            # Whole numbers beyond 2^53 (nanoseconds since 1970) stay exact until the first one is taken off.
            values = np.asarray(column)
            signed = values.astype(np.int64)
            for word in self.missing:
                if isinstance(word, int | float) and (signed == word).any():
                    break
            else:
                return signed, np.zeros(len(signed), bool)
        values = Cells(self.missing).numbers(Block(block.name, {name: column}, block.rows, block.units), name)
        return values, np.isnan(values)

    def _dates(self, column: Any, place: Callable[[int], str]) -> tuple[np.ndarray, np.ndarray]:
        """Nanoseconds since 1970 in UTC, and where there is none."""
        pandas = need("pandas", extra="cli", purpose="the command line")
        series = pandas.Series(column).reset_index(drop=True)
        kind = getattr(series.dtype, "kind", "O")
        empty = series.isna().to_numpy(dtype=bool)
        if kind == "M":
            aware = getattr(series.dt, "tz", None) is not None
            found, own = series, zone_name(series.dt.tz) if aware else ""
        else:
            text = series.astype(object).where(~empty, "").map(lambda cell: str(cell).strip())
            words = {word for word in self.missing if isinstance(word, str)}
            empty = text.map(
                lambda cell: cell in words or cell.lower() in ("", "nan", "nat", "null", "na", "n/a")
            ).to_numpy(dtype=bool)
            found, aware = self._parsed(text, empty, place, pandas)
            own = _offset(text[~empty].iloc[0]) if aware and not empty.all() else ""
        if self.zone is None and _has_date(self.part.format):
            self.zone = self.part.zone or own
        if not aware:
            found = self._in_zone(found, empty, place)
        nanoseconds = (
            found.dt.tz_convert("UTC").dt.tz_localize(None).astype("datetime64[ns]").to_numpy().astype(np.int64)
        )
        return nanoseconds, empty

    def _parsed(self, text: Any, empty: np.ndarray, place: Callable[[int], str], pandas: Any) -> tuple[Any, bool]:
        pattern = self.part.format
        if pattern is None:
            with_zone = text.map(lambda cell: _OFFSET.search(cell) is not None).to_numpy(dtype=bool)[~empty]
            aware = bool(len(with_zone) and with_zone[0])
            if (with_zone != aware).any():
                bad = int(np.flatnonzero(~empty)[np.argmax(with_zone != aware)])
                what = "has no zone, the rows before have one" if aware else "has a zone, the rows before have none"
                raise UserError(f"{place(bad)}: the date '{text[bad]}' {what}")
        else:
            aware = "%z" in pattern
        cells = text.where(~empty, None)
        try:
            found = pandas.to_datetime(cells, format=pattern or "ISO8601", errors="coerce", utc=aware)
        except ValueError as error:
            raise UserError(f'time.format = "{pattern}" is no pattern of dates: {error}') from error
        wrong = found.isna().to_numpy(dtype=bool) & ~empty
        if wrong.any():
            bad = int(np.argmax(wrong))
            wanted = "a date of ISO 8601" if pattern is None else f'a date of the form "{pattern}"'
            hint = '; give time.format, such as "%d.%m.%Y %H:%M:%S"' if pattern is None else ""
            raise UserError(f"{place(bad)}: '{text[bad]}' is not {wanted}{hint}")
        return found, aware

    def _in_zone(self, found: Any, empty: np.ndarray, place: Callable[[int], str]) -> Any:
        zone = self.part.zone or "UTC"
        local = found.dt.tz_localize(zone, ambiguous="NaT", nonexistent="NaT")
        lost = local.isna().to_numpy(dtype=bool) & ~empty
        if lost.any():
            bad = int(np.argmax(lost))
            raise UserError(
                f"{place(bad)}: the local time {found[bad]} is there twice or not at all in {zone}, where clocks "
                "are set that night; log in UTC or with an offset such as +02:00"
            )
        return local


def _offset(cell: str) -> str:
    """The offset from UTC that a date ends with."""
    found = re.search(r"[+-]\d\d:?\d\d$|[+-]\d\d$", cell)
    return found[0] if found and _OFFSET.search(cell) else "UTC"


def _has_date(pattern: str | None) -> bool:
    """Whether a pattern has a day, not only a time of day."""
    return pattern is None or re.search("%[-#]?[djDFcxs]", pattern) is not None


def is_date_column(column: Any) -> bool:
    """Whether the cells of a clock are dates: by the type of the column, else by the first cell that is not empty."""
    kind = getattr(getattr(column, "dtype", None), "kind", "O")
    if kind in "iufb":
        return False
    if kind == "M":
        return True
    return is_date(next((cell for cell in column if isinstance(cell, str) and cell.strip()), ""))


def is_date(cell: str) -> bool:
    """Whether a cell begins as a date of ISO 8601 does; a number such as 20240131 is a number.

    >>> is_date("2024-01-31T10:00:00.5Z"), is_date("20240131T1000"), is_date("20240131"), is_date("12.5")
    (True, True, False, False)
    """
    cell = cell.strip()
    return _ISO.fullmatch(cell) is not None and not cell.isdigit()


def likely_unit(ratio: float, unit: str) -> str | None:
    """The unit that would make the steps of a clock `ratio` times shorter, if it is a usual one.

    >>> likely_unit(1000.4, "s"), likely_unit(1e-3, "ms"), likely_unit(7, "s")
    ('ms', 's', None)
    """
    wanted = PER_SECOND[unit] * ratio
    return next((name for name in NAMES if name != unit and abs(wanted / PER_SECOND[name] - 1) < 0.2), None)


def _epoch_unit(value: float, place: str) -> str:
    for unit in NAMES:
        # From 1989 to 2128: no two units share a number.
        if 6e8 <= abs(value) / PER_SECOND[unit] <= 5e9:
            return unit
    raise UserError(
        f"{place}: {value:.17g} is no time since 1970 in s, ms, us or ns; set time.unit to the clock's own unit"
    )


def _text(cell: Any) -> str:
    """A stamp as the file has it, with the digits that tell it from every other one."""
    if isinstance(cell, float | np.floating):
        return np.format_float_positional(cell, trim="-")
    return str(cell)
