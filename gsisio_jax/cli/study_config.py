"""The tables ``[sweep]`` and ``[monte_carlo]`` of the configuration file."""

from __future__ import annotations

import difflib
import math
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from ..study import REDUCTIONS, Reduction, quantiles, settle
from .fields import Bounds, Number, Part, reference

MADE = {"quantiles": quantiles, "settle": settle}  # reductions with numbers of their own: {quantiles = [0.5, 0.95]}
WIDTHS = ("final", "max", "mean", "rms")  # reductions that a picture can show


def _reductions(values: list[Any]) -> list[Any]:
    """Names, or reductions made from a table such as ``{settle = 3}``."""
    if not values:
        raise ValueError(f"must name at least one of {', '.join(REDUCTIONS)}")
    found = [_reduction(value) for value in values]
    names = [one.name if isinstance(one, Reduction) else one for one in found]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{name} is there {names.count(name)} times")
    return found


def _reduction(value: Any) -> Any:
    if isinstance(value, dict) and len(value) == 1 and next(iter(value)) in MADE:
        name, numbers = next(iter(value.items()))
        numbers = numbers if isinstance(numbers, list) else [numbers]
        if not all(isinstance(n, int | float) and not isinstance(n, bool) for n in numbers):
            raise ValueError(f"{name} takes numbers, got {value[name]!r}")
        if name == "settle" and len(numbers) != 1:
            raise ValueError(f"settle takes one factor, got {value[name]!r}")
        return MADE[name](*numbers)
    if isinstance(value, str):
        if value in REDUCTIONS:
            return value
        close = difflib.get_close_matches(value, [*REDUCTIONS, *MADE], n=1)
        hint = f"; did you mean {close[0]}?" if close and close[0] not in MADE else ""
        raise ValueError(f'unknown reduction "{value}"{hint or _known_reductions()}')
    raise ValueError(f"{value!r} is no reduction{_known_reductions()}")


def _known_reductions() -> str:
    return f"; known are {', '.join(REDUCTIONS)}, {{quantiles = [0.5, 0.95]}} and {{settle = 3}}"


def _runs(value: Any) -> int | list[int]:
    several = isinstance(value, list)
    numbers = value if several else [value]
    whole = numbers and all(isinstance(n, int) and not isinstance(n, bool) for n in numbers)
    if not whole or min(numbers) < (0 if several else 1):
        raise ValueError(
            f"must be a number of runs, at least 1, or a list of their numbers such as [17]; got {value!r}"
        )
    return value


def _records(value: Any) -> str | list[str]:
    names = [value] if isinstance(value, str) else value
    if not isinstance(names, list) or not names or not all(isinstance(name, str) and name for name in names):
        raise ValueError(f'must be a file, a pattern such as "logs/*.csv", or a list of these; got {value!r}')
    return value


def _drawn_input(value: Any) -> str | list[float]:
    """A reference, or the amplitudes of ``{amplitude = [...]}``."""
    if isinstance(value, str):
        return reference(value)
    wanted = 'must read "module:attribute" or {amplitude = [...]}'
    if not isinstance(value, dict) or list(value) != ["amplitude"] or not isinstance(value["amplitude"], list):
        raise ValueError(f"{wanted}, got {value!r}")
    for number in value["amplitude"]:
        if isinstance(number, bool) or not isinstance(number, int | float) or not 0 <= number < math.inf:
            raise ValueError(f"amplitude must hold finite numbers, 0 or larger; got {number!r}")
    return [float(number) for number in value["amplitude"]]


def _noise_draw(value: str) -> str:
    if value not in ("uniform", "vertices") and ":" not in value:
        raise ValueError(f'must be "uniform", "vertices" or "module:attribute", got "{value}"')
    return value if value in ("uniform", "vertices") else reference(value)


def _known_input(value: Any) -> str | list[float]:
    if isinstance(value, str):
        return reference(value)
    if not isinstance(value, list) or not all(
        isinstance(n, int | float) and not isinstance(n, bool) and math.isfinite(n) for n in value
    ):
        raise ValueError(f'must be a list of numbers (constant inputs) or "module:attribute", got {value!r}')
    return [float(number) for number in value]


class ScaleAxis(Part):
    """Factors: ``scale = [0.5, 1, 2]``, or ``from``, ``to`` and ``count``."""

    scale: list[Number] | None = None
    from_: Number | None = Field(default=None, alias="from")
    to: Number | None = None
    count: Annotated[int, Field(ge=2)] | None = None
    spacing: Literal["linear", "log"] = "linear"

    @model_validator(mode="after")
    def _check(self) -> ScaleAxis:
        ends = (self.from_, self.to, self.count)
        if self.scale is None and None in ends:
            raise ValueError("needs scale = [...], or from, to and count")
        if self.scale is not None and (any(end is not None for end in ends) or self.spacing != "linear"):
            raise ValueError("give either scale or from, to and count, not both")
        if self.spacing == "log" and min(self.from_ or 0, self.to or 0) <= 0:
            raise ValueError('spacing = "log" needs from and to above 0')
        scales = self.scales()
        if not len(scales):
            raise ValueError("scale has no entry")
        if not (np.isfinite(scales) & (scales >= 0)).all():
            raise ValueError("every scale must be a finite number, 0 or larger")
        if len(np.unique(scales)) < len(scales):
            raise ValueError("a scale is there twice")
        return self

    def scales(self) -> np.ndarray:
        """(S,) factors, in the order of the file."""
        if self.scale is not None:
            return np.asarray(self.scale, dtype=np.float64)
        if self.from_ is None or self.to is None or self.count is None:
            return np.zeros(0)  # refused by the check
        spread = np.geomspace if self.spacing == "log" else np.linspace
        return spread(self.from_, self.to, self.count)


class NoiseAxis(ScaleAxis):
    """Factors by which the stated noise bounds are multiplied."""

    of: Literal["w", "v", "both"] = "both"


class AxesPart(Part):
    """What varies, besides records and runs."""

    noise: NoiseAxis | None = None
    initial: ScaleAxis | None = None


class _StudyPart(Part):
    reduce: Annotated[list[Any], AfterValidator(_reductions)] = Field(default_factory=lambda: ["final", "max", "mean"])
    batch: Annotated[int, Field(ge=1)] | None = None
    picture: Literal["final", "max", "mean", "rms"] | None = None
    axes: AxesPart = AxesPart()

    @model_validator(mode="after")
    def _check(self) -> Any:
        if self.picture is not None and self.picture not in self.reduce:
            raise ValueError(f'picture = "{self.picture}" must be one of those in reduce')
        return self


class SweepPart(_StudyPart):
    """One record or several, over noise bounds and initial boxes."""

    records: Annotated[Any, AfterValidator(_records)] = None

    @model_validator(mode="after")
    def _check_truth(self) -> SweepPart:
        for name in ("coverage", "error"):
            if name in self.reduce:
                raise ValueError(f'reduce: "{name}" needs the truth, which a table does not hold; use monte-carlo')
        return self


class MonteCarloPart(_StudyPart):
    """Simulated runs."""

    runs: Annotated[Any, AfterValidator(_runs)]
    steps: Annotated[int, Field(ge=1)]
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    draw: Annotated[str, AfterValidator(_noise_draw)] = "uniform"
    x0: Bounds | None = None
    d: Annotated[Any, AfterValidator(_drawn_input)] = None
    u: Annotated[Any, AfterValidator(_known_input)] = None
