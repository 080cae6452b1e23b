"""Kinds of values that a configuration file is made of."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, model_validator


def _not_nan(value: float) -> float:
    if math.isnan(value):
        raise ValueError("must be a number, not nan; use -inf or inf for an unknown bound")
    return value


def reference(value: str) -> str:
    """Check the form of ``module:attribute``."""
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
Reference = Annotated[str, AfterValidator(reference)]
SignalName = Annotated[str, AfterValidator(_signal_name)]
FileName = Annotated[str, AfterValidator(_file_name)]


class Part(BaseModel):
    """A table of the file: no other keys, no silent conversions."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


def check_box(lower: list[float] | None, upper: list[float] | None, needs: str) -> None:
    if lower is None or upper is None:
        raise ValueError(needs)
    if len(lower) != len(upper):
        raise ValueError(f"lower has {len(lower)} values, upper has {len(upper)}")
    for index, (low, high) in enumerate(zip(lower, upper, strict=True)):
        if low > high or low == math.inf or high == -math.inf:
            raise ValueError(f"bounds cross at index {index}: lower = {low:g}, upper = {high:g}")


class Bounds(Part):
    """A box: either ``radius`` (symmetric) or ``lower`` and ``upper``, or one that a module holds (``use``)."""

    use: Reference | None = None
    radius: list[Number] | None = None
    lower: list[Number] | None = None
    upper: list[Number] | None = None

    @model_validator(mode="before")
    @classmethod
    def _is_table(cls, value: Any) -> Any:
        if isinstance(value, int | float | str | list):
            radius = ", ".join(f"{part:g}" for part in (value if isinstance(value, list) else [value])
                               if isinstance(part, int | float))  # fmt: skip
            raise ValueError(
                f"must be a box, got {value!r}; write {{ radius = [{radius or '...'}] }}, one number for each "
                "component, or { lower = [...], upper = [...] }"
            )
        return value

    @model_validator(mode="after")
    def _check(self) -> Bounds:
        if self.use is not None:
            if (self.radius, self.lower, self.upper) != (None, None, None):
                raise ValueError("give either use, or radius, or lower and upper, not several of them")
        elif self.radius is None:
            check_box(self.lower, self.upper, "needs radius, or both lower and upper")
        elif self.lower is not None or self.upper is not None:
            raise ValueError("give either radius or lower and upper, not both")
        elif min(self.radius, default=0.0) < 0:
            raise ValueError(f"radius has the negative value {min(self.radius):g}")
        return self
