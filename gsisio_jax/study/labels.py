"""How the results of a study are labelled: names and units of signals, dimensions, coordinates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from gsisio_jax._moments import EPOCH, zone_name
from gsisio_jax.dataset import zone_of_dates
from gsisio_jax.interval.reading import read_array
from gsisio_jax.observer.status import flag_attributes
from gsisio_jax.plant.system import System
from gsisio_jax.study.axes import Layout
from gsisio_jax.study.reduction_base import Reduction, Variable
from gsisio_jax.study.row_source import Rows


class Labels(NamedTuple):
    """Names and units of signals and rows."""

    names: dict[str, list[str]]
    units: dict[str, list[str] | None]
    time: np.ndarray | None
    steps: int
    clock: dict[str, str]  # attributes of the time

    @classmethod
    def of(
        cls,
        call: str,
        system: System,
        state_names: Sequence[str] | None,
        input_names: Sequence[str] | None,
        state_units: Sequence[str] | None,
        input_units: Sequence[str] | None,
        time: Any,
        steps: int,
    ) -> Labels:
        """The names and units as given, or filled in.

        Raises:
            ValueError: not one for each signal (row).
        """
        names: dict[str, list[str]] = {}
        units: dict[str, list[str] | None] = {}
        of_state, of_input = (system.n, "x", state_names, state_units), (
            system.p, "d", input_names, input_units,
        )  # fmt: skip
        for kind, (count, letter, given, their_units) in (("state", of_state), ("input", of_input)):
            names[kind] = [f"{letter}{i + 1}" for i in range(count)] if given is None else list(given)
            units[kind] = None if their_units is None else list(their_units)
            for what, values in (("names", names[kind]), ("units", units[kind])):
                if values is not None and len(values) != count:
                    raise ValueError(
                        f"{call}: `{kind}_{what}` has {len(values)} entries, the system has {count}; give one for each"
                    )
        clock = {"long_name": "time", "units": "s"}
        if time is not None:
            if getattr(getattr(time, "dtype", None), "kind", "") == "M":
                # A store holds numbers; pictures show what they stand for.
                zone = zone_of_dates(time)
                clock |= {"epoch": EPOCH} | ({} if zone is None else {"zone": zone_name(zone)})
                dates = np.asarray(time, dtype="datetime64[ns]")  # of a zone: in UTC
                time = np.where(np.isnat(dates), np.nan, dates.astype(np.int64) / 1e9)
                if np.isnan(time).any():
                    raise ValueError(f"{call}: `time` has no date in row {int(np.argmax(np.isnan(time)))}")
            time = np.asarray(read_array(call, "time", time), dtype=np.float64)
            if time.shape != (steps,):
                raise ValueError(f"{call}: `time` must have shape ({steps},), one per step; got {time.shape}")
        return cls(names, units, time, steps, clock)

    def unit(self, of: str) -> dict[str, Any]:
        """Attributes that say the unit; signals of different units have it as the coordinate ``<signal>_unit``."""
        units = self.units.get(of)
        if of in self.units:
            return {"units": units[0]} if units and len(set(units)) == 1 else {}
        return {"units": of} if of else {}


def variables_of(
    sources: Sequence[Reduction | Rows], shapes: Mapping[str, jax.ShapeDtypeStruct], labels: Labels
) -> dict[str, tuple[tuple[int, ...], str, tuple[str, ...], dict[str, Any]]]:
    """Shape of one case, type, dimensions and attributes by name of the result."""
    described: dict[str, Variable] = {}
    for source in sources:
        described |= source.describe()
    variables = {}
    for name in sorted(shapes, key=lambda name: list(described).index(name) if name in described else len(described)):
        shape = shapes[name]
        own = tuple(f"{name}_dim{i}" for i in range(len(shape.shape)))
        dims, text, unit = described.get(name, Variable(own, name))
        about: dict[str, Any] = {"long_name": text, **(flag_attributes() if unit == "status" else labels.unit(unit))}
        variables[name] = tuple(shape.shape), np.dtype(shape.dtype).name, tuple(dims), about
    return variables


def coordinates_of(
    layout: Layout, reductions: tuple[Reduction, ...], labels: Labels, variables: Mapping[str, Any]
) -> dict[str, Any]:
    coordinates: dict[str, Any] = {}
    for name, (values, unit) in layout.coordinates.items():
        coordinates[name] = (name, values, {"units": unit} if unit else {})
    for kind, names in labels.names.items():
        coordinates[kind] = (kind, names, {})
        if labels.units[kind] is not None:
            coordinates[f"{kind}_unit"] = (kind, labels.units[kind], {})
    for reduction in reductions:
        coordinates |= {name: (name, values, {}) for name, values in reduction.coordinates().items()}
    if any("time" in dims for _, _, dims, _ in variables.values()):
        step = np.arange(labels.steps, dtype=np.float64)
        coordinates["time"] = (
            ("time", step, {"long_name": "step"}) if labels.time is None else ("time", labels.time, labels.clock)
        )
    return coordinates
