"""The table ``[table]`` of the configuration file: where the measurements are and how they are written."""

from __future__ import annotations

import difflib
import math
import zoneinfo
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo, field_validator, model_validator
from pydantic_core import PydanticCustomError

from ..fields import Number, Part, Reference
from .units import conversion

ClockUnit = Literal["s", "ms", "us", "ns", "min", "h", "d", "epoch", "iso8601"]


def _zone(name: str) -> str:
    try:
        zoneinfo.ZoneInfo(name)
    except (zoneinfo.ZoneInfoNotFoundError, ValueError, OSError):
        close = difflib.get_close_matches(name, sorted(zoneinfo.available_timezones()), n=1)
        hint = f"did you mean {close[0]}?" if close else 'a name reads "Europe/Berlin" or "UTC"'
        raise ValueError(f'unknown time zone "{name}"; {hint}') from None
    return name


def _one_character(value: str) -> str:
    value = {"tab": "\t", "space": " ", "comma": ",", "semicolon": ";"}.get(value, value)
    if len(value) != 1 or not value.isascii() or value.isalnum() or value in "\n\r.+-":
        raise ValueError(f'must be one character that is no part of a number, "tab" or "space"; got "{value}"')
    return value


def _clock_columns(value: Any) -> tuple[str, ...]:
    names = [value] if isinstance(value, str) else value
    if not isinstance(names, list | tuple) or not names or not all(isinstance(name, str) and name for name in names):
        raise ValueError(f'must be a column, or columns that are read as one such as ["Date", "Time"]; got {value!r}')
    return tuple(names)


def _encoding(name: str) -> str:
    try:
        "".encode(name)
    except LookupError:
        raise ValueError(f'unknown encoding "{name}"; usual ones: utf-8, utf-16, cp1252, latin-1, shift_jis') from None
    return name


class ClockPart(Part):
    """The column of the time and how it is written; ``time = "t"`` stands for ``time = {column = "t"}``.

    Without `unit` and `format`: numbers are seconds, dates are ISO 8601. A date and a time of day in two columns are
    read as one cell with a blank between them.
    """

    column: Annotated[tuple[str, ...], BeforeValidator(_clock_columns)]
    unit: ClockUnit | None = None
    format: Annotated[str, Field(min_length=1)] | None = None
    zone: Annotated[str, AfterValidator(_zone)] | None = None
    tolerance: Annotated[Number, Field(ge=0, lt=math.inf)] | None = None

    @model_validator(mode="after")
    def _check(self) -> ClockPart:
        if self.unit is not None and self.format is not None:
            raise ValueError("give either unit or format, not both")
        if self.zone is not None and self.unit not in (None, "iso8601"):
            raise ValueError(f'zone is for dates that lack one; unit = "{self.unit}" counts from a fixed instant')
        return self


class ColumnPart(Part):
    """What the numbers of a column mean: cell * scale + offset is in `unit`, and the plant takes it in `to`."""

    scale: Annotated[Number, Field(lt=math.inf, gt=-math.inf)] = 1.0
    offset: Annotated[Number, Field(lt=math.inf, gt=-math.inf)] = 0.0
    unit: str | None = None
    to: str | None = None

    @model_validator(mode="after")
    def _check(self) -> ColumnPart:
        if self.scale == 0:
            raise ValueError("scale must not be 0")
        if self.unit is not None:
            conversion(self.unit, self.to)
        elif self.to is not None:
            raise ValueError("to is given without unit")
        return self

    def apply(self, values: Any) -> Any:
        """Numbers of the file to numbers of the plant, elementwise."""
        if (self.scale, self.offset) != (1.0, 0.0):
            values = values * self.scale + self.offset
        if self.unit is None:
            return values
        factor, offset = conversion(self.unit, self.to)
        return values * factor + offset


class DialectPart(Part):
    """How the text file is written; what is left out is found by looking at its beginning."""

    separator: Annotated[str, AfterValidator(_one_character)] | None = None
    decimal: Literal[".", ","] | None = None
    thousands: Literal[",", ".", " ", "'", "_"] | None = None
    comment: Annotated[str, Field(min_length=1)] | None = None
    quote: Annotated[str, AfterValidator(_one_character)] | None = None
    skip: Annotated[int, Field(ge=0)] | None = None
    skip_after: Annotated[int, Field(ge=0)] | None = None
    header: bool | None = None
    encoding: Annotated[str, AfterValidator(_encoding)] | None = None
    compression: Literal["none", "gz", "zip", "bz2", "xz", "zst"] | None = None

    @model_validator(mode="after")
    def _check(self) -> DialectPart:
        given = [mark for mark in (self.separator, self.decimal, self.thousands, self.quote) if mark is not None]
        if len(set(given)) < len(given):
            raise ValueError("separator, decimal, thousands and quote must be different characters")
        return self


def _clock(value: Any) -> Any:
    if isinstance(value, str):
        return {"column": value}
    if value is not None and not isinstance(value, dict | ClockPart):
        raise ValueError(f'must be a column or a table such as {{column = "t", unit = "ms"}}, got {value!r}')
    return value


def _sample_time(value: Any) -> Any:
    if value is None or value == "auto":
        return value
    if not isinstance(value, int | float) or isinstance(value, bool) or not 0 < value < math.inf:
        raise ValueError(f'must be a number of seconds greater than 0, or "auto"; got {value!r}')
    return float(value)


class TablePart(Part):
    """The logged measurements."""

    file: str
    time: Annotated[ClockPart | None, BeforeValidator(_clock)] = None
    dt: Literal["as_input"] | None = None
    sample_time: Annotated[Any, BeforeValidator(_sample_time), Field(validate_default=True)] = None
    y: Annotated[list[str], Field(min_length=1)]
    u: list[str] = Field(default_factory=list)
    missing: list[float | int | str] = Field(default_factory=list)
    transform: Reference | None = None
    columns: dict[str, ColumnPart] = Field(default_factory=dict)
    dialect: DialectPart = DialectPart()
    on_duplicate: Literal["error", "first", "last", "mean"] = "error"
    on_unsorted: Literal["error", "sort"] = "error"
    on_blank_time: Literal["error", "drop"] = "error"
    on_gap_u: Literal["error", "hold"] = "error"
    sparse: bool = False

    @field_validator("sample_time", mode="after")
    @classmethod
    def _needed(cls, value: Any, info: ValidationInfo) -> Any:
        if value is None and info.data.get("dt") is None:
            raise PydanticCustomError("missing", "is missing")
        return value

    @model_validator(mode="after")
    def _check(self) -> TablePart:
        if self.time is None and self.dt is not None:
            raise ValueError('dt = "as_input" needs time, the column that the time steps are taken from')
        if self.time is None and self.sample_time == "auto":
            raise ValueError('sample_time = "auto" needs time, the column that it is found in; give a number instead')
        if self.dt is not None and self.sample_time is not None:
            raise ValueError('give either sample_time or dt = "as_input", not both: its rows lie on no grid')
        if self.on_gap_u == "hold" and not self.u:
            raise ValueError('on_gap_u = "hold" is for known inputs, and u is empty')
        tolerance = None if self.time is None else self.time.tolerance
        if tolerance is not None and self.dt is not None:
            raise ValueError('time.tolerance has no meaning with dt = "as_input": its rows lie on no grid')
        if tolerance is not None and isinstance(self.sample_time, float) and tolerance > self.sample_time / 4:
            raise ValueError(
                f"time.tolerance = {tolerance:g} s must not exceed a quarter of sample_time "
                f"({self.sample_time / 4:g} s): beyond that a row could belong to either neighbour"
            )
        for name in self.columns:
            if name not in (*self.y, *self.u):
                raise ValueError(f"columns.{name} is not among y and u, so nothing would use it")
        return self

    @property
    def wanted(self) -> list[str]:
        """Columns that are read: the clock, y and u, without repetition."""
        clock = () if self.time is None else self.time.column
        return list(dict.fromkeys([*clock, *self.y, *self.u]))
