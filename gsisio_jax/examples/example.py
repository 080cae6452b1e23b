"""What an example is: a plant with sourced numbers, a record to run it on, and one picture."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import jax
import numpy as np

from gsisio_jax.interval import Interval
from gsisio_jax.observer.estimation import Estimate, estimate
from gsisio_jax.observer.types import Observer
from gsisio_jax.plant import Noise, System, simulate
from gsisio_jax.plant.periodic import nearest

if TYPE_CHECKING:
    import xarray as xr

Signals = tuple[tuple[str, str], ...]
"""Name and unit of every component, in order."""


@dataclass(frozen=True)
class Record:
    """What the observer sees, and what it does not.

    Attributes:
        time: (T,) seconds.
        y: (T, l) measurements, NaN where missing.
        u: (T, m) known inputs, or None.
        x: (T, n) true states, or None where nobody knows them.
        d: (T, p) true unknown inputs, or None.
    """

    time: np.ndarray
    y: np.ndarray
    u: np.ndarray | None = None
    x: np.ndarray | None = None
    d: np.ndarray | None = None


@dataclass(frozen=True)
class Example:
    """A built-in example; `gsisio_jax.examples.load` makes it.

    Attributes:
        name: what ``gsisio estimate NAME`` calls it.
        title: of its picture.
        teaches: one sentence.
        source: where model and numbers come from.
        system, noise, initial: as `gsisio_jax.estimate` takes them.
        region: of the design, and `u_region`.
        states, inputs, outputs, known_inputs: names and units.
        sample_time: seconds from one step to the next.
        make_record: takes a seed and gives the record; a real one does not depend on it.
        design: options of `design_observer`.
        shown: names of the signals in the picture; all where empty.
        time_unit: of the picture, and how many seconds it has.
        config: the configuration file of an example that is shipped as one, else None.
    """

    name: str
    title: str
    teaches: str
    source: str
    system: System
    noise: Noise
    initial: Interval
    region: Interval | Literal["auto"]
    states: Signals
    inputs: Signals
    outputs: Signals
    make_record: Callable[[int], Record]
    known_inputs: Signals = ()
    u_region: Interval | None = None
    sample_time: float = 1.0
    design: Mapping[str, Any] = field(default_factory=dict)
    shown: tuple[str, ...] = ()
    time_unit: tuple[str, float] = ("s", 1.0)
    config: Path | None = None

    def observer(self) -> Observer:
        """Design the observer; ``print(example.observer().certificate)`` says what it promises."""
        from gsisio_jax.design import design_observer

        return design_observer(self.system, self.noise, self.region, u_region=self.u_region, **self.design)

    def record(self, seed: int = 0) -> Record:
        """The record: simulated from that seed, with its truth, or a real one."""
        return self.make_record(seed)

    def estimate(self, record: Record | None = None, observer: Observer | None = None) -> Estimate:
        """The boxes of a record; of ``record()`` and ``observer()`` where left out."""
        record = self.record() if record is None else record
        return estimate(observer or self.observer(), self.initial, record.y, record.u)

    def dataset(self, record: Record, boxes: Estimate) -> xr.Dataset:
        """Record and boxes under the names and units of the example (`gsisio_jax.dataset.to_dataset`)."""
        labels: dict[str, Any] = {}
        for kind, signals in (("state", self.states), ("input", self.inputs), ("output", self.outputs)):
            labels[f"{kind}_names"] = [name for name, _ in signals]
            labels[f"{kind}_units"] = [unit for _, unit in signals]
        found = boxes.to_xarray(time=record.time, y=record.y, title=self.title, **labels)
        unit, seconds = self.time_unit
        found["time"] = ("time", record.time / seconds, {**found["time"].attrs, "units": unit})
        return found

    def picture(self, path: str | Path, record: Record | None = None, boxes: Estimate | None = None) -> None:
        """Draw boxes, measurements and truth into a file, whose ending names the format.

        Args:
            path: the file.
            record: what is drawn; ``record()`` where left out.
            boxes: of that record; computed where left out.
        """
        from gsisio_jax.plot import save

        record = self.record() if record is None else record
        boxes = self.estimate(record) if boxes is None else boxes
        truth: dict[str, np.ndarray] = {}
        # Of a periodic state boxes hold the truth up to a multiple of its period.
        x = nearest(self.system, record.x, boxes.state)
        for signals, values in ((self.states, x), (self.inputs, record.d)):
            if values is not None:
                truth |= {name: values[:, index] for index, (name, _) in enumerate(signals)}
        save(self.dataset(record, boxes), path, self.shown or None, truth)


def simulated(
    system: System,
    noise: Noise,
    x0: Any,
    d: Any,
    u: Any = None,
    *,
    sample_time: float,
    seed: int,
    missing: float = 0.0,
) -> Record:
    """A record of a plant with a known truth, its noise anywhere in its bounds.

    Args:
        system, noise: of the plant.
        x0: (n,) true first state.
        d: (T, p) true unknown input.
        u: (T, m) known input.
        sample_time: seconds.
        seed: of the noise.
        missing: share of measurements that are lost, entry by entry.
    """
    run = simulate(system, jax.random.key(seed), x0, d, noise, u)
    y = np.array(run.y, dtype=float)
    y[np.random.default_rng(seed).uniform(size=y.shape) < missing] = np.nan
    x, d = np.asarray(run.x, dtype=float)[:-1], np.asarray(d, dtype=float)
    return Record(sample_time * np.arange(len(y)), y, None if u is None else np.asarray(u, dtype=float), x, d)
