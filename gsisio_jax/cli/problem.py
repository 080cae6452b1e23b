"""From the configuration to the library's objects, with every size checked against the system."""

from __future__ import annotations

import contextlib
import importlib
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..interval import Interval
from ..plant.system import Noise, System
from .config import Config, Signal
from .errors import UserError, reason
from .fields import Bounds


@dataclass(frozen=True)
class Names:
    """Names and units of one group of signals, in order."""

    names: tuple[str, ...]
    units: tuple[str, ...]


@dataclass(frozen=True)
class Problem:
    """All that the observer needs, apart from the measurements; `arguments` are those that the system was made with,
    `around` is where region = "auto" looks."""

    system: Any
    noise: Any
    region: Any
    u_region: Any
    initial: Any
    design: dict[str, Any]
    state: Names
    input: Names
    output: Names
    known_input: Names
    arguments: dict[str, Any] = field(default_factory=dict)
    around: Any = None


@contextlib.contextmanager
def importable(folder: Path) -> Iterator[None]:
    """Let modules that lie beside the configuration file be imported, as ``python script.py`` does."""
    sys.path.insert(0, str(folder))
    importlib.invalidate_caches()
    try:
        yield
    finally:
        with contextlib.suppress(ValueError):
            sys.path.remove(str(folder))


def resolve(reference: str, key: str) -> Any:
    """Import what ``module:attribute`` names.

    Raises:
        UserError: the module cannot be imported, or has no such attribute.
    """
    module_name, _, attribute = reference.partition(":")
    try:
        found = importlib.import_module(module_name)
    except Exception as error:
        raise UserError(f"{key}: cannot import {module_name}: {type(error).__name__}: {reason(error)}") from error
    for part in attribute.split("."):
        if not hasattr(found, part):
            raise UserError(f"{key}: {module_name} has no attribute {attribute}")
        found = getattr(found, part)
    return found


def used_box(reference: str, key: str, size: int, of: str) -> Interval:
    """The box that ``module:attribute`` names: of a plant that is discretised the bound of what that leaves out, say.

    Raises:
        UserError: it is no box, or one of another size.
    """
    found = resolve(reference, key)
    if not isinstance(found, Interval):
        raise UserError(f"{key}: {reference} must be a gsisio_jax.Interval, got {type(found).__name__}")
    if found.shape != (size,):
        raise UserError(
            f"{key}: {reference} has the shape {found.shape}, and ({size},) is needed: one for each of the {of}"
        )
    return found


def build_problem(config: Config, file: str) -> Problem:
    """Build system, noise and boxes, and check every list of the file against the size of the system.

    Args:
        config: the configuration, read and checked by itself.
        file: its name, for messages.

    Raises:
        UserError: the system cannot be made, or a list has the wrong length.
    """
    system = _system(config, file)
    sizes = {"states": system.n, "inputs": system.p, "outputs": system.l, "known inputs": system.m}

    def check(key: str, values: list, what: str, unit: str = "value") -> None:
        if len(values) != sizes[what]:
            plural = "" if len(values) == 1 else "s"
            singular = what.removesuffix("s") if sizes[what] == 1 else what
            raise UserError(
                f"{file}: {key} has {len(values)} {unit}{plural}, the system has {sizes[what] or 'no'} {singular}"
            )

    def box(key: str, bounds: Bounds, what: str) -> Any:
        if bounds.use is not None:
            return used_box(bounds.use, f"{file}: {key}.use", sizes[what], what)
        if bounds.radius is not None:
            check(f"{key}.radius", bounds.radius, what)
            return Interval.symmetric(bounds.radius)
        check(f"{key}.lower", bounds.lower or [], what)
        return Interval(bounds.lower, bounds.upper)

    def names(key: str, signals: list[Signal] | None, what: str, letter: str) -> Names:
        if signals is None:
            signals = [Signal(name=f"{letter}{index + 1}") for index in range(sizes[what])]
        check(f"signals.{key}", signals, what, "name")
        return Names(tuple(signal.name for signal in signals), tuple(signal.unit for signal in signals))

    if config.table is not None:
        check("table.y", config.table.y, "outputs", "column")
        if config.table.dt is None:
            check("table.u", config.table.u, "known inputs", "column")
        elif len(config.table.u) + 1 != system.m:
            raise UserError(
                f"{file}: table.u has {len(config.table.u)} column{'' if len(config.table.u) == 1 else 's'} and dt = "
                f'"as_input" adds the time step as the last known input; the system has {system.m}'
            )
    if config.u_region is not None and system.m == 0:
        raise UserError(f"{file}: u_region is given, the system has no known inputs")
    if config.region.auto:
        region: Any = "auto"
    else:
        whole = config.region
        region = box("region", Bounds(use=whole.use, lower=whole.lower, upper=whole.upper), "states")
    around = config.region.around
    if around == "initial":
        around = box("initial", config.initial, "states")
    elif isinstance(around, Bounds):
        around = box("region.around", around, "states")
    elif around is not None:
        check("region.around", around, "states")
    groups = {
        "state": names("state", config.signals.state, "states", "x"),
        "input": names("input", config.signals.input, "inputs", "d"),
        "output": names("output", config.signals.output, "outputs", "y"),
        "known_input": names("known_input", config.signals.known_input, "known inputs", "u"),
    }
    _check_unique(groups, file)
    return Problem(
        system=_with_more(system, config, groups, file),
        noise=Noise(w=box("noise.w", config.noise.w, "states"), v=box("noise.v", config.noise.v, "outputs")),
        region=region,
        u_region=None if config.u_region is None else box("u_region", config.u_region, "known inputs"),
        initial=box("initial", config.initial, "states"),
        design=config.design.model_dump(exclude_none=True),
        around=around,
        arguments=config.system.arguments,
        **groups,
    )


def _system(config: Config, file: str) -> Any:
    reference, arguments = config.system.use, config.system.arguments
    found = resolve(reference, f"{file}: system.use")
    if not isinstance(found, System):
        if not callable(found):
            raise UserError(
                f"{file}: system.use: {reference} must be a System or a function that returns one, "
                f"got {type(found).__name__}"
            )
        try:
            found = found(**arguments)
        except Exception as error:
            text = reason(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {reason(error)}"
            raise UserError(f"{file}: system: {reference} failed: {text}") from error
        if not isinstance(found, System):
            raise UserError(f"{file}: system.use: {reference} returned {type(found).__name__}, not a System")
    elif arguments:
        raise UserError(f"{file}: system.arguments are given, but {reference} is a System and takes none")
    return found


def _with_more(system: Any, config: Config, groups: dict[str, Names], file: str) -> Any:
    """The system with what the file says of it: periodic outputs and states, and how the unknown input moves."""

    def by_index(key: str, group: str, given: dict[str, float], own: Any) -> dict[int, float]:
        names = groups[group].names
        for name in given:
            if name not in names:
                raise UserError(f"{file}: system.{key}: there is no {group} {name}; they are: {', '.join(names)}")
        return {names.index(name): period for name, period in given.items()} or dict(own)

    part = config.system
    if not (part.periodic or part.periodic_states or part.input_rate or part.input_constant):
        return system
    outputs = by_index("periodic", "output", part.periodic, system.periodic)
    states = by_index("periodic_states", "state", part.periodic_states, system.periodic_states)
    rate: Any = system.input_rate
    if part.input_rate:
        given = by_index("input_rate", "input", part.input_rate, {})
        rate = [given.get(j, np.inf) for j in range(system.p)]
    try:
        return System(
            system.f, system.g, system.G, system.H, system.B, system.D, system.state_bounds, system.input_bounds,
            system.m, periodic=outputs, periodic_states=states, input_rate=rate,
            input_constant=part.input_constant or system.input_constant,
        )  # fmt: skip
    except ValueError as error:
        raise UserError(f"{file}: system: {reason(error)}") from error


def _check_unique(groups: dict[str, Names], file: str) -> None:
    """Names become columns and variables, so no two may give the same one."""
    taken: dict[str, str] = {name: "a column of every output" for name in ("time", "status", "margin")}
    for group in ("state", "input", "output"):
        for name in groups[group].names:
            made = [f"measured_{name}"] if group == "output" else [f"{name}_lower", f"{name}_upper"]
            for column in made:
                if column in taken:
                    raise UserError(f"{file}: signals.{group}: the name {name} is already used ({taken[column]})")
                taken[column] = f"by {group} {name}"
