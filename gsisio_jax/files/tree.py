"""Pytrees of this library as JSON and plain arrays, and back. Only the classes listed here can be in a file."""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import Any

import numpy as np

from gsisio_jax.plant.lift import lifted

Node = Any
"""What JSON has of a value."""

_GIVEN = {"System": ("f", "g", "captured", "turns")}
"""Fields that are no data: they come from the system that is given when a file is read."""


_MORE = "more"
"""What a file has of a `DelayedObserver` besides its fields: the combinations of `gsisio_jax.plant.lift.lifted`."""


class Unknown(Exception):
    """A part of a file that this version does not know; the message says which."""


@cache
def _classes() -> dict[str, type]:
    from gsisio_jax.inclusion import AffineForm
    from gsisio_jax.inclusion.atoms import AtomBounds
    from gsisio_jax.inclusion.planes import Abstraction
    from gsisio_jax.interval.box import Interval
    from gsisio_jax.observer import bank, input_memory, past, recovery, slices, types, window, window_widths
    from gsisio_jax.observer.certificate import Certificate
    from gsisio_jax.observer.delayed import DelayedObserver, Waiting
    from gsisio_jax.observer.prediction_step import PredictionObserver
    from gsisio_jax.observer.rate_widths import RateWidths
    from gsisio_jax.observer.tolerant import Guesses, TolerantObserver
    from gsisio_jax.plant.system import Noise, System

    found = (
        Abstraction, AffineForm, AtomBounds, Certificate, DelayedObserver, Interval, Noise, PredictionObserver, System,
        Guesses, TolerantObserver, Waiting,
        bank.CancellationResidual, bank.LinearBounds, types.Carry, types.ExactInputs, types.InitialContraction,
        types.Observer, types.RoundingConstants, past.Past, recovery.Recovery, slices.Slices, window.Window,
        window_widths.WindowWidths, RateWidths,
        input_memory.InputMemory, input_memory.InputRows,
    )  # fmt: skip
    return {kind.__name__: kind for kind in found}


def layout() -> dict[str, list[str]]:
    """The fields of every class that can be in a file: what a version of the layout stands for."""
    return {name: _stored(kind) for name, kind in sorted(_classes().items())}


def encode(value: Any, name: str, arrays: dict[str, np.ndarray]) -> Node:
    """The structure of a value as JSON.

    Args:
        value: of the classes above, arrays, numbers, text, None, and tuples and lists of these.
        name: of the value, which its arrays are named after.
        arrays: takes the arrays.

    Raises:
        TypeError: another class; a new part of an observer that was not added here.
    """
    if value is None or isinstance(value, bool | str):
        return value
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float) and not isinstance(value, np.floating):
        return {"float": value.hex()}
    if isinstance(value, tuple | list):
        parts = [encode(part, f"{name}.{index}", arrays) for index, part in enumerate(value)]
        return {"tuple" if isinstance(value, tuple) else "list": parts}
    kind = type(value).__name__
    if _classes().get(kind) is type(value):
        fields = {field: encode(getattr(value, field), f"{name}.{field}", arrays) for field in _stored(type(value))}
        if kind == "DelayedObserver":
            observer: Any = value
            fields[_MORE] = encode(observer.lift.more, f"{name}.{_MORE}", arrays)
        return {"kind": kind, "fields": fields}
    if not hasattr(value, "dtype"):
        raise TypeError(f"{name} is of the class {kind}, which has no form in a file")
    arrays[name] = np.asarray(value)
    return {"array": name}


def decode(node: Node, arrays: dict[str, np.ndarray], system: Any) -> Any:
    """The value of a node; takes its arrays out of `arrays`.

    Args:
        node: what `encode` returned.
        arrays: by name.
        system: the one that f and g are taken from.

    Raises:
        Unknown: it is none of what `encode` writes.
    """
    if node is None or isinstance(node, bool | int | str):
        return node
    match node:
        case {"float": str(text)}:
            return float.fromhex(text)
        case {"tuple": list(parts)}:
            return tuple(decode(part, arrays, system) for part in parts)
        case {"list": list(parts)}:
            return [decode(part, arrays, system) for part in parts]
        case {"array": str(name)} if name in arrays:
            return arrays.pop(name)[()]
        case {"kind": str(kind), "fields": dict(fields)}:
            return _rebuilt(kind, fields, arrays, system)
    raise Unknown(f"the entry {str(node)[:60]}")


def _stored(kind: type) -> list[str]:
    return [field.name for field in dataclasses.fields(kind) if field.name not in _GIVEN.get(kind.__name__, ())]


def _rebuilt(name: str, fields: dict[str, Node], arrays: dict[str, np.ndarray], system: Any) -> Any:
    """An object as it was: nothing is checked or computed anew, so that not a bit changes."""
    kind = _classes().get(name)
    if kind is None:
        raise Unknown(f"the part {name}")
    stored = _stored(kind)
    expected = [*stored, _MORE] if name == "DelayedObserver" else stored
    for found, wanted, what in ((fields, expected, "unknown"), (expected, fields, "missing")):
        if strange := [field for field in found if field not in wanted]:
            raise Unknown(f"{what} {'fields' if len(strange) > 1 else 'field'} of {name}: {', '.join(strange)}")
    made, within = object.__new__(kind), {}
    if name == "DelayedObserver":
        # Its inner observer is that of the lifted plant, whose outputs follow from the plant and a few weights.
        more, delay = (decode(fields[field], arrays, system) for field in (_MORE, "delay"))
        within["inner"] = lifted(system, delay, more)
    for field in stored:
        object.__setattr__(made, field, decode(fields[field], arrays, within.get(field, system)))
    for field in _GIVEN.get(name, ()):
        object.__setattr__(made, field, getattr(system, field))
    return made
