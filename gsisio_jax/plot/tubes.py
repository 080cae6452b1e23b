"""Boxes over time of one or many cases, for `widths` and `funnel`, from an estimate, a labelled dataset or a study."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gsisio_jax.observer.status import Status
from gsisio_jax.plot.record import read_record, sides_over_time, told_delay
from gsisio_jax.plot.study import (
    KINDS,
    axes_of,
    check_signals,
    kept_kinds,
    predicted,
    prepared,
    time_of,
    title_of,
    variable_signals,
    with_entry,
)  # fmt: skip


@dataclass(frozen=True)
class Tube:
    """Boxes of one signal: sides of shape (*sizes, T), one size for each axis of the cases.

    `predicted` is the steady width that the certificate promises, with as many axes, of size 1 where it does not vary;
    None where there is no certificate.
    """

    name: str
    unit: str
    kind: str
    lower: np.ndarray
    upper: np.ndarray
    predicted: np.ndarray | None = None


@dataclass(frozen=True)
class Group:
    """Cases that are drawn together: sides (N, T), their label, and the width promised for them (None: unknown)."""

    label: str
    lower: np.ndarray
    upper: np.ndarray
    predicted: float | None
    truth: np.ndarray | None = None
    conflicts: np.ndarray | None = None  # (N, T)


@dataclass(frozen=True)
class Tubes:
    """All signals of a source.

    Attributes:
        axes: names of the axes of the cases.
        level: index of the axis along which the promised widths vary (the noise), or None.
        entries: elements of that axis in words.
        ranked: the elements of that axis by increasing coordinate.
        conflicts: steps whose data contradict the bounds, (*sizes, T); None where it is not known.
    """

    title: str
    time: np.ndarray
    time_label: str
    series: dict[str, Tube]
    axes: tuple[str, ...] = ()
    level: int | None = None
    entries: Sequence[str] = ()
    ranked: Sequence[int] = ()
    conflicts: np.ndarray | None = None

    def chosen(self, call: str, signals: str | Sequence[str] | None) -> list[Tube]:
        """The signals to draw: those named, or all.

        Raises:
            ValueError: a name that is not there.
        """
        names = list(self.series) if signals is None else [signals] if isinstance(signals, str) else list(signals)
        check_signals(call, names, list(self.series))
        return [self.series[name] for name in names]

    def groups(self, tube: Tube, most: int, truth: np.ndarray | None = None) -> list[Group]:
        """The cases of a signal, by their noise: `most` levels from the lowest to the highest, one is the middle one.

        Args:
            truth: of the signal, (T,), or with the axes of the cases.
        """
        if self.level is None:
            return [self._group(tube, None, truth, "")]
        count = len(self.ranked)
        places = [count // 2] if most == 1 else sorted(set(np.linspace(0, count - 1, most).round().astype(int)))
        return [self._group(tube, self.ranked[i], truth, self.entries[self.ranked[i]]) for i in places]

    def _group(self, tube: Tube, at: int | None, truth: np.ndarray | None, label: str) -> Group:
        def cut(values: np.ndarray) -> np.ndarray:
            if at is None or self.level is None:
                return values
            return np.take(values, 0 if values.shape[self.level] == 1 else at, axis=self.level)

        lower, upper = cut(tube.lower), cut(tube.upper)
        promise = None if tube.predicted is None else float(np.max(cut(tube.predicted)))
        if truth is not None:
            truth = np.broadcast_to(truth, (*tube.lower.shape[:-1], truth.shape[-1]))
            truth = cut(truth).reshape(-1, truth.shape[-1])
        rows = (-1, lower.shape[-1])
        bad = None
        if self.conflicts is not None:
            bad = cut(np.broadcast_to(self.conflicts, tube.lower.shape)).reshape(rows)
        return Group(label, lower.reshape(rows), upper.reshape(rows), promise, truth, bad)


def read_tubes(call: str, source: Any, certificate: Any = None) -> Tubes:
    """Boxes over time with what the certificate promises.

    Args:
        source: an estimate, also of a batch; a dataset of `to_dataset`; one of a study with reduce=None.
        certificate: its steady widths count in the place of those in the dataset.

    Raises:
        ValueError: there are no boxes over time, or the certificate is that of another system.
    """
    if not hasattr(source, "data_vars"):
        tubes = _of_estimate(call, source)
    elif kept_kinds(source):
        tubes = _of_study(prepared(call, source))
    else:
        record = read_record(source, call)
        series = {n: Tube(n, one.unit, one.kind, one.lower, one.upper) for n, one in record.series.items()}
        bad = np.isin(record.time, record.alarms)
        tubes = Tubes(record.title, record.time, record.time_label, series, conflicts=bad)
    return tubes if certificate is None else replace(tubes, series=_promised(call, tubes.series, certificate))


def _of_estimate(call: str, est: Any) -> Tubes:
    if not hasattr(est, "state") or np.ndim(est.state.lower) < 2:
        raise ValueError(
            f"{call}: expected an estimate, the dataset of `to_dataset`, or that of a study with reduce=None; got "
            f"{type(est).__name__}"
        )
    series = {}
    for kind, letter in KINDS.items():
        lower, upper = sides_over_time(est, kind)
        for i in range(lower.shape[-1]):
            name = f"{letter}{i + 1}"
            series[name] = Tube(name, "", kind, lower[..., i], upper[..., i])
    lead = tuple(f"axis {i}" for i in range(np.ndim(est.state.lower) - 2))
    bad = (np.asarray(est.status) & int(Status.CONFLICT)) != 0
    steps = np.arange(np.shape(est.state.lower)[-2], dtype=np.float64)
    return Tubes(told_delay(est), steps, "step", series, lead, conflicts=bad)


def _of_study(dataset: Any) -> Tubes:
    axes = axes_of(dataset)
    series, level = {}, None
    for kind in kept_kinds(dataset):
        sides = (variable_signals(dataset, f"{kind}_{side}") for side in ("lower", "upper"))
        for low, high in zip(*sides, strict=True):
            mine = tuple(axis for axis in axes if axis in low.values.dims)
            lower, upper = (
                np.asarray(one.values.transpose(*mine, "time").values, dtype=np.float64) for one in (low, high)
            )
            promise = predicted(dataset, kind, low.signal)
            if promise is not None:
                level = next((mine.index(axis) for axis in mine if axis in promise.dims), level)
                shape = [promise.sizes.get(axis, 1) for axis in mine]
                promise = np.asarray(promise.values, dtype=np.float64).reshape(shape)
            series[low.signal] = Tube(low.signal, low.unit, kind, lower, upper, promise)
    bad = None
    if "status" in dataset.data_vars:
        status = dataset["status"].transpose(*(a for a in axes if a in dataset["status"].dims), "time").values
        bad = (np.nan_to_num(status).astype(int) & int(Status.CONFLICT)) != 0
    found = Tubes(title_of(dataset), *time_of(dataset), series, axes, conflicts=bad)
    if level is None:
        return found
    values = dataset[axes[level]].values
    entries = [with_entry(dataset, axes[level], value) for value in values]
    ranked = [int(i) for i in (np.argsort(values) if values.dtype.kind in "iuf" else np.arange(len(values)))]
    return replace(found, level=level, entries=entries, ranked=ranked)


def _promised(call: str, series: dict[str, Tube], certificate: Any) -> dict[str, Tube]:
    """The same with the widths at which boxes settle by a certificate."""
    if not hasattr(certificate, "settled_widths"):
        raise ValueError(
            f"{call}: `certificate` must be that of an observer (observer.certificate), got "
            f"{type(certificate).__name__}"
        )
    promised = dict(series)
    for kind, steady in zip(("state", "input"), certificate.settled_widths, strict=True):
        mine = [one for one in series.values() if one.kind == kind]
        if mine and len(mine) != len(steady):
            raise ValueError(
                f"{call}: the certificate is of a system with {len(steady)} {kind}s, here are {len(mine)}: "
                f"{', '.join(one.name for one in mine)}; give all of them, and choose by `signals`"
            )
        for one, width in zip(mine, np.asarray(steady, dtype=np.float64), strict=False):
            promised[one.name] = replace(one, predicted=np.full((1,) * (one.lower.ndim - 1), width))
    return promised
