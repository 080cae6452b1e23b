"""Certified alarms: the steps whose data contradict the stated bounds, in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsisio_jax.observer.status import SOURCE_STRIDE, Source, Status


@dataclass(frozen=True)
class Alarm:
    """One contradiction between data and bounds.

    Attributes:
        step: index k.
        kind: which intersection was empty: "initial" (initial box and state bounds), "output" (a measurement and the
            box), "state" (the box carried from the past and the box so far), "dynamics", "input", "certificate",
            "balance" (a combination of dynamics and outputs that no unknown input can explain), or "periodic" (no
            multiple of its period brings a periodic output to where the box is).
        index: the component: a state, a row of T2, an input, a circuit of [G; H], or an output (kind "periodic").
        outputs: the outputs that enter that row, for kinds "output" and "periodic".
        gap: by how much the two pieces miss each other, in the unit of the component.

    Source: theory 8.
    """

    step: int
    kind: str
    index: int
    outputs: tuple[int, ...]
    gap: float

    def describe(
        self,
        state_names: Sequence[str] | None = None,
        output_names: Sequence[str] | None = None,
        input_names: Sequence[str] | None = None,
        state_units: Sequence[str] | None = None,
        output_units: Sequence[str] | None = None,
        input_units: Sequence[str] | None = None,
    ) -> str:
        """One sentence: what emptied, and by how much.

        >>> Alarm(4, "state", 0, (), 21950.0).describe(["east"], state_units=["m"])
        'east: no value agrees with both the past and the measurements now, they are 21950 m apart'
        """
        if self.kind == "output":
            names = [_pick(output_names, j, "output") for j in self.outputs]
            gap = f"{_plain(self.gap)}{_unit(output_units, self.outputs[0]) if len(self.outputs) == 1 else ''}"
            subject = names[0] if len(names) == 1 else "the combination of " + " and ".join(names)
            return f"{subject}: the measurement lies {gap} outside of what the box of the state allows"
        if self.kind == "periodic":
            name, gap = _pick(output_names, self.index, "output"), _plain(self.gap) + _unit(output_units, self.index)
            return f"{name}: with any number of whole periods, {gap} outside of what the box of the state allows"
        if self.kind == "input":
            gap = f"{_plain(self.gap)}{_unit(input_units, self.index)}"
            return (
                f"{_pick(input_names, self.index, 'input')}: the bounds of the unknown input miss each other by {gap}"
            )
        if self.kind == "balance":
            return (
                "no unknown input explains both the change of the states and the measurements before it, combination "
                f"{self.index + 1} of the two misses by {_plain(self.gap)}"
            )
        name, gap = _pick(state_names, self.index, "state"), f"{_plain(self.gap)}{_unit(state_units, self.index)}"
        if self.kind == "initial":
            return f"{name}: the initial box lies {gap} outside of the state bounds"
        return f"{name}: no value agrees with both the past and the measurements now, they are {gap} apart"


def read_alarms(status: Any, margin: Any, source: Any, output_rows: Sequence[tuple[int, ...]]) -> list[Alarm]:
    """Decode the CONFLICT steps of one record (arrays of shape (T,))."""
    status, margin, source = np.asarray(status), np.asarray(margin), np.asarray(source)
    if status.ndim != 1:
        raise ValueError(
            f"alarms: one record is needed, this estimate is batched with shape {status.shape}; select a record with "
            "jax.tree.map(lambda a: a[i], estimate)"
        )
    alarms = []
    for k in np.flatnonzero(status & Status.CONFLICT):
        kind, index = Source(int(source[k]) // SOURCE_STRIDE), int(source[k]) % SOURCE_STRIDE
        outputs = tuple(output_rows[index]) if kind is Source.OUTPUT else (index,) if kind is Source.PERIODIC else ()
        alarms.append(Alarm(int(k), kind.name.lower(), index, outputs, float(-margin[k])))
    return alarms


def _pick(names: Sequence[str] | None, index: int, what: str) -> str:
    return names[index] if names is not None else f"{what} {index + 1}"


def _unit(units: Sequence[str] | None, index: int) -> str:
    return f" {units[index]}" if units is not None and units[index] else ""


def _plain(value: float) -> str:
    """Five digits, without an exponent where a person would not write one: 224387, 21955, 0.0123."""
    return f"{value:.0f}" if 1e4 <= value < 1e9 else f"{value:.5g}"
