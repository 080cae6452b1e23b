"""The TOML file: its keys, their types, and one line of error that names file and key."""

from __future__ import annotations

import difflib
import math
import re
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from .._extras import need
from .errors import UserError, reason

pydantic = need("pydantic", extra="cli", purpose="the command line")

from pydantic import (  # noqa: E402  (after the check above, so that a missing package gives one line)
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)


def _not_nan(value: float) -> float:
    if math.isnan(value):
        raise ValueError("must be a number, not nan; use -inf or inf for an unknown bound")
    return value


def _reference(value: str) -> str:
    if not re.fullmatch(r"[A-Za-z_][\w.]*:[A-Za-z_][\w.]*", value):
        raise ValueError(f'must read "module:attribute", got "{value}"')
    return value


def _signal_name(value: str) -> str:
    if not re.fullmatch(r"[^\W\d][\w .+-]*(?<! )", value):
        raise ValueError(f'must start with a letter and use letters, digits and _ . + - only, got "{value}"')
    return value


def _file_name(value: str) -> str:
    if Path(value).name != value or value in ("", ".", ".."):
        raise ValueError(f'must be a plain file name inside the --out folder, got "{value}"')
    return value


Number = Annotated[float, AfterValidator(_not_nan)]
Reference = Annotated[str, AfterValidator(_reference)]
FileName = Annotated[str, AfterValidator(_file_name)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class SystemPart(_Part):
    """Where the System comes from."""

    use: Reference
    arguments: dict[str, Any] = {}


class Signal(_Part):
    """Name and unit of one component."""

    name: Annotated[str, AfterValidator(_signal_name)]
    unit: str = ""


class SignalsPart(_Part):
    """Names in the order of the components; a list left out is filled with x1, x2, ... ."""

    state: list[Signal] | None = None
    input: list[Signal] | None = None
    output: list[Signal] | None = None
    known_input: list[Signal] | None = None


class Bounds(_Part):
    """A box: either ``radius`` (symmetric) or ``lower`` and ``upper``."""

    radius: list[Number] | None = None
    lower: list[Number] | None = None
    upper: list[Number] | None = None

    @model_validator(mode="after")
    def _check(self) -> Bounds:
        if self.radius is None:
            _check_box(self.lower, self.upper, "needs radius, or both lower and upper")
        elif self.lower is not None or self.upper is not None:
            raise ValueError("give either radius or lower and upper, not both")
        elif min(self.radius, default=0.0) < 0:
            raise ValueError(f"radius has the negative value {min(self.radius):g}")
        return self


class RegionPart(_Part):
    """The box the gain is designed for, or ``auto = true``."""

    auto: bool = False
    lower: list[Number] | None = None
    upper: list[Number] | None = None

    @model_validator(mode="after")
    def _check(self) -> RegionPart:
        if not self.auto:
            _check_box(self.lower, self.upper, "needs both lower and upper, or auto = true")
        elif self.lower is not None or self.upper is not None:
            raise ValueError("give either auto = true or lower and upper, not both")
        return self


def _check_box(lower: list[float] | None, upper: list[float] | None, needs: str) -> None:
    if lower is None or upper is None:
        raise ValueError(needs)
    if len(lower) != len(upper):
        raise ValueError(f"lower has {len(lower)} values, upper has {len(upper)}")
    for index, (low, high) in enumerate(zip(lower, upper, strict=True)):
        if low > high or low == math.inf or high == -math.inf:
            raise ValueError(f"bounds cross at index {index}: lower = {low:g}, upper = {high:g}")


class NoisePart(_Part):
    """Bounds of the process noise w and of the measurement noise v."""

    w: Bounds
    v: Bounds


class DesignPart(_Part):
    """Options of ``design_observer``; what is left out keeps the library's default."""

    gains: Annotated[int, Field(ge=1)] | None = None
    missing: bool | None = None
    sweeps: Annotated[int, Field(ge=1)] | None = None
    bounds: Annotated[list[str], Field(min_length=1)] | None = None
    form: Literal["current", "prediction"] | None = None
    left_inverse: Literal["pseudo", "feedthrough", "smallest"] | None = None
    allow_uncertified: bool | None = None


class TablePart(_Part):
    """The logged measurements."""

    file: str
    time: str
    sample_time: Annotated[Number, Field(gt=0, lt=math.inf)]
    y: Annotated[list[str], Field(min_length=1)]
    u: list[str] = []
    missing: list[float | int | str] = []
    transform: Reference | None = None


class EstimatePart(_Part):
    """Options of ``estimate``."""

    on_conflict: Literal["restart", "hold"] = "restart"


class OutputsPart(_Part):
    """File names inside the ``--out`` folder; by default named after the configuration file."""

    netcdf: FileName | None = None
    csv: FileName | None = None
    picture: FileName | None = None
    draw: Reference | None = None


class Config(_Part):
    """The whole file."""

    title: str = ""
    system: SystemPart
    signals: SignalsPart = SignalsPart()
    noise: NoisePart
    region: RegionPart
    u_region: Bounds | None = None
    initial: Bounds
    design: DesignPart = DesignPart()
    table: TablePart
    estimate: EstimatePart = EstimatePart()
    outputs: OutputsPart = OutputsPart()


def read_config(path: Path) -> Config:
    """Read and check a configuration file.

    Raises:
        UserError: the file cannot be read, is not TOML, or a key is missing, unknown or of the wrong kind.
    """
    try:
        with open(path, "rb") as stream:
            raw = tomllib.load(stream)
    except OSError as error:
        raise UserError(f"{path}: cannot read the configuration: {reason(error)}") from error
    except tomllib.TOMLDecodeError as error:
        raise UserError(f"{path.name}: not valid TOML: {reason(error)}") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{path.name}: not valid TOML: the file is not UTF-8 text") from error
    try:
        config = Config.model_validate(raw)
    except ValidationError as error:
        raise UserError(f"{path.name}: {_one_line(error)}") from error
    names = config.outputs.model_dump(include={"netcdf", "csv", "picture"}, exclude_none=True)
    if len(set(names.values())) < len(names):
        raise UserError(f"{path.name}: outputs: netcdf, csv and picture must be different files")
    return config


def _one_line(error: ValidationError) -> str:
    """The first problem as ``key: what is wrong``, and how many more there are."""
    problems = error.errors()
    first = problems[0]
    key, kind = _dotted(first["loc"]), first["type"]
    if kind == "missing":
        text = f"{key} is missing"
    elif kind == "extra_forbidden":
        text = f"unknown key {key}{_did_you_mean(first['loc'])}"
    elif kind == "value_error":
        text = f"{key}: {first.get('ctx', {}).get('error', first['msg'])}"
    else:
        message = first["msg"].removeprefix("Input should be ")
        got = repr(first["input"])
        text = f"{key} must be {message}, got {got if len(got) <= 60 else got[:57] + '...'}"
    more = len(problems) - 1
    return text + (f" (and {more} more problem{'s' if more > 1 else ''})" if more else "")


def _dotted(location: tuple[int | str, ...]) -> str:
    # A union adds the name of the type it tried ("float"); only what stands in the file is shown.
    parts = [part for part in location if isinstance(part, int) or part not in ("float", "int", "str")]
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in parts).removeprefix(".")


def _did_you_mean(location: tuple[int | str, ...]) -> str:
    model: type[BaseModel] | None = Config
    for part in location[:-1]:
        if isinstance(part, str) and model is not None:
            field = model.model_fields.get(part)
            model = None if field is None else _model_in(field.annotation)
    known = [] if model is None else list(model.model_fields)
    close = difflib.get_close_matches(str(location[-1]), known, n=1)
    if close:
        return f"; did you mean {close[0]}?"
    return f"; the keys here are: {', '.join(known)}" if known else ""


def _model_in(annotation: Any) -> type[BaseModel] | None:
    """The model inside an annotation such as ``list[Signal] | None``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next(filter(None, map(_model_in, get_args(annotation))), None)
