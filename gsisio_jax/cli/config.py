"""The TOML file: its keys, their types, and one line of error that names file and key."""

from __future__ import annotations

import difflib
import re
import tomllib
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

from pydantic import BaseModel, BeforeValidator, Field, ValidationError, model_validator

from .errors import UserError, reason
from .fields import Bounds, FileName, Number, Part, Reference, SignalName, check_box
from .fill_in import check_filled_in
from .logs.config import TablePart
from .study_config import MonteCarloPart, SweepPart


class SystemPart(Part):
    """Where the System comes from; by name the periods of outputs and states that are angles, and rates of inputs."""

    use: Reference
    arguments: dict[str, Any] = Field(default_factory=dict)
    periodic: dict[str, Number] = Field(default_factory=dict)
    periodic_states: dict[str, Number] = Field(default_factory=dict)
    input_rate: dict[str, Number] = Field(default_factory=dict)
    input_constant: Annotated[int, Field(ge=1)] | None = None


class Signal(Part):
    """Name and unit of one component."""

    name: SignalName
    unit: str = ""


class SignalsPart(Part):
    """Names in the order of the components; a list left out is filled with x1, x2, ... ."""

    state: list[Signal] | None = None
    input: list[Signal] | None = None
    output: list[Signal] | None = None
    known_input: list[Signal] | None = None


class RegionPart(Part):
    """The box the gain is designed for, or ``auto = true``, around a state, a box, or the initial one."""

    use: Reference | None = None
    auto: bool = False
    around: list[Number] | Bounds | Literal["initial"] | None = None
    lower: list[Number] | None = None
    upper: list[Number] | None = None

    @model_validator(mode="after")
    def _check(self) -> RegionPart:
        if self.around is not None and not self.auto:
            raise ValueError("around says where auto = true looks; leave it out, or lower and upper")
        if self.use is not None:
            if self.auto or (self.lower, self.upper) != (None, None):
                raise ValueError("give either use, or auto = true, or lower and upper, not several of them")
        elif not self.auto:
            check_box(self.lower, self.upper, "needs both lower and upper, or auto = true")
        elif self.lower is not None or self.upper is not None:
            raise ValueError("give either auto = true or lower and upper, not both")
        return self


class NoisePart(Part):
    """Bounds of the process noise w and of the measurement noise v."""

    w: Bounds
    v: Bounds


def _count(value: Any, least: int) -> Any:
    if value not in (None, "auto") and (isinstance(value, bool) or not isinstance(value, int) or value < least):
        raise ValueError(f'must be a whole number, at least {least}, or "auto"; got {value!r}')
    return value


# A union of types would report every one of them that does not fit.
Count = Annotated[Any, BeforeValidator(partial(_count, least=1))]
Delay = Annotated[Any, BeforeValidator(partial(_count, least=0))]


class DesignPart(Part):
    """Options of ``design_observer``; what is left out keeps the library's default."""

    gains: Count = None
    missing: bool | None = None
    certify: bool | None = None
    sweeps: Annotated[int, Field(ge=1)] | None = None
    window: Count = None
    split: Count = None
    cells: Count = None
    delay: Delay = None
    rates: Annotated[list[Annotated[int, Field(ge=1)]], Field(min_length=1)] | None = None
    bounds: Annotated[list[str], Field(min_length=1)] | None = None
    form: Literal["current", "prediction"] | None = None
    left_inverse: Literal["pseudo", "feedthrough", "smallest"] | None = None
    allow_uncertified: bool | None = None


class EstimatePart(Part):
    """Options of ``estimate``."""

    on_conflict: Literal["restart", "hold"] = "restart"


class OutputsPart(Part):
    """File names inside the ``--out`` folder; by default named after the configuration file."""

    netcdf: FileName | None = None
    csv: FileName | None = None
    picture: FileName | None = None
    report: FileName | None = None
    draw: Reference | None = None


class Config(Part):
    """The whole file."""

    title: str = ""
    system: SystemPart
    signals: SignalsPart = SignalsPart()
    noise: NoisePart
    region: RegionPart
    u_region: Bounds | None = None
    initial: Bounds
    design: DesignPart = DesignPart()
    table: TablePart | None = None
    estimate: EstimatePart = EstimatePart()
    outputs: OutputsPart = OutputsPart()
    sweep: SweepPart | None = None
    monte_carlo: MonteCarloPart | None = None


def _bare_point(path: Path) -> str:
    """Of a file that is no TOML: a number such as ``50.`` or ``.5``, which Python knows and TOML does not."""
    for number, line in enumerate(path.read_text("utf-8", "replace").splitlines(), start=1):
        bare = re.search(r"[=\[,\s][+-]?(\d+\.(?![\d.])|\.\d+)", re.sub(r"\"[^\"]*\"|'[^']*'|#.*", "", line))
        if bare is not None:
            return f"; line {number} has {bare[0][1:]}, and a number needs digits on both sides of the point: 50.0, 0.5"
    return ""


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
        raise UserError(f"{path.name}: not valid TOML: {reason(error)}{_bare_point(path)}") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{path.name}: not valid TOML: the file is not UTF-8 text") from error
    check_filled_in(raw, path)
    try:
        config = Config.model_validate(raw)
    except ValidationError as error:
        raise UserError(f"{path.name}: {_one_line(error)}") from error
    names = config.outputs.model_dump(include={"netcdf", "csv", "picture", "report"}, exclude_none=True)
    if len(set(names.values())) < len(names):
        raise UserError(f"{path.name}: outputs: netcdf, csv, picture and report must be different files")
    return config


def _one_line(error: ValidationError) -> str:
    """The first problem as ``key: what is wrong``, and how many more there are."""
    problems = error.errors()
    # What is misspelled is why something else is missing.
    first = next((one for one in problems if one["type"] == "extra_forbidden"), problems[0])
    key, kind = _dotted(first["loc"]), first["type"]
    if kind == "missing":
        text = f"{key} is missing"
    elif kind == "extra_forbidden":
        kind = "section" if isinstance(first["input"], dict) else "key"
        text = f"unknown {kind} {key}{_did_you_mean(first['loc'])}"
    elif kind == "value_error":
        text = f"{key}: {first.get('ctx', {}).get('error', first['msg'])}"
    elif kind in ("too_short", "string_too_short"):
        text = f"{key} must have at least one entry, got {first['input']!r}"
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
    named = False
    for part in location[:-1]:
        if isinstance(part, str) and model is not None and not named:
            field = model.model_fields.get(part)
            model = None if field is None else _model_in(field.annotation)
            # The next part of a table of tables is a name that the user gave.
            named = field is not None and get_origin(field.annotation) is dict
        else:
            named = False
    known = [] if model is None else [field.alias or name for name, field in model.model_fields.items()]
    close = difflib.get_close_matches(str(location[-1]), known, n=1, cutoff=0.65)  # "rates" is no misspelt "tolerate"
    if close:
        return f"; did you mean {close[0]}?"
    return f"; the keys here are: {', '.join(known)}" if known else ""


def _model_in(annotation: Any) -> type[BaseModel] | None:
    """The model inside an annotation such as ``list[Signal] | None``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next(filter(None, map(_model_in, get_args(annotation))), None)
