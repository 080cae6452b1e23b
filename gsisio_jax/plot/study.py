"""Reads datasets of `sweep` and `monte_carlo`: which axes they have, which signals, and what is drawn by default."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from gsisio_jax.observer.status import Status
from gsisio_jax.plot.dates import DateLabel, days, zone_of
from gsisio_jax.plot.style import short

KINDS = {"state": "x", "input": "d"}
OWN = ("state", "input", "time", "quantile", "statistic")  # dimensions that are no axes of the study
BESIDE = ("steady_width", "predicted_state_width", "predicted_input_width")
# What is drawn where nobody says; the first one that is there.
PREFERRED = (
    "width_final", "width_mean", "width_max", "width_rms", "width_quantile", "error_rms", "error_max",
    "width_final_summary", "width_mean_summary", "width_max_summary", "coverage",
)  # fmt: skip


class Part(NamedTuple):
    """A variable of one signal; the signal is "" and the kind None where the variable has none."""

    signal: str
    kind: str | None
    unit: str
    values: Any


@dataclass(frozen=True)
class Quantity:
    """What one panel of a heat map or of curves shows.

    Attributes:
        variable: name in the dataset.
        signal: "" where the variable has none.
        text: in words, without unit.
        values: DataArray over the axes of the study; ``statistic`` may be left.
        predicted: DataArray, the steady width that the certificate promises, over some of these axes; None for what is
            no width.
        flags: names by bit, for a bit mask.
    """

    variable: str
    signal: str
    text: str
    unit: str
    values: Any
    predicted: Any = None
    flags: dict[int, str] | None = None

    def mean(self) -> Quantity:
        """The mean (or else the first) of the statistics in the place of all of them."""
        if "statistic" not in self.values.dims:
            return self
        names = [str(name) for name in np.atleast_1d(self.values["statistic"].values)]
        chosen = names.index("mean") if "mean" in names else 0
        return replace(self, values=self.values.isel(statistic=chosen), text=f"{names[chosen]} of {self.text}")


def prepared(call: str, dataset: Any) -> Any:
    """The dataset with axes of one element turned into labels.

    Raises:
        ValueError: it is none.
    """
    if not hasattr(dataset, "data_vars"):
        raise ValueError(
            f"{call}: expected the dataset of gx.sweep or gx.monte_carlo, got {type(dataset).__name__}; for an "
            "estimate use gx.plot.framers or gx.plot.widths"
        )
    return dataset.squeeze([axis for axis in axes_of(dataset) if dataset.sizes[axis] == 1])


def axes_of(dataset: Any) -> tuple[str, ...]:
    """Axes that the study varied, in their order."""
    every = (str(dim) for name, one in dataset.data_vars.items() if name not in BESIDE for dim in one.dims)
    return tuple(dim for dim in dict.fromkeys(every) if dim not in OWN and not re.search(r"_dim\d+$", dim))


def kept_kinds(dataset: Any) -> list[str]:
    """Kinds of signals ("state", "input") whose boxes over time the dataset holds."""
    return [
        kind for kind in KINDS
        if f"{kind}_lower" in dataset.data_vars and "signal" not in dataset[f"{kind}_lower"].attrs
        and "time" in dataset[f"{kind}_lower"].dims
    ]  # fmt: skip


def time_of(dataset: Any) -> tuple[np.ndarray, str]:
    """Time of the rows and the label of its axis; a `DateLabel` where they are dates."""
    if (zone := zone_of(dataset)) is not None:
        return days(dataset["time"].values), DateLabel(zone)
    unit = dataset["time"].attrs.get("units")
    return np.asarray(dataset["time"].values), f"time [{unit}]" if unit else "step"


def fixed(dataset: Any) -> str:
    """The elements of axes that are not there any more: ``level = 0.2 m``."""
    known = (*OWN, *(f"{kind}_unit" for kind in KINDS))
    return ", ".join(
        with_entry(dataset, str(name), one.values[()])
        for name, one in dataset.coords.items()
        if one.ndim == 0 and name not in known
    )


def title_of(dataset: Any) -> str:
    return ", ".join(part for part in (dataset.attrs.get("title", ""), fixed(dataset)) if part)


def with_entry(dataset: Any, axis: str, entry: Any) -> str:
    """One element of an axis in words, with its unit."""
    unit = dataset[axis].attrs.get("units", "") if axis in dataset.coords else ""
    value = short(float(entry)) if isinstance(entry, float | np.floating) else str(entry)
    return f"{axis.replace('_', ' ')} = {value}{' ' if unit else ''}{unit}"


def variable_signals(dataset: Any, name: str) -> list[Part]:
    """The parts of a variable, one for each signal."""
    values = dataset[name]
    kind = next((kind for kind in KINDS if kind in values.dims), None)
    if kind is None:
        # One signal was selected before: it is a label now.
        words = str(name).removeprefix("predicted_")
        kind = next((k for k in KINDS if words.startswith(f"{k}_") and k in dataset.coords), None)
        if kind is None:
            unit = values.attrs.get("units", "")
            return [Part("", None, "" if unit == "1" else unit, values)]
        parts = [values]
    else:
        parts = [values.isel({kind: index}) for index in range(values.sizes[kind])]
    units = dataset.coords.get(f"{kind}_unit")
    each = [""] * len(parts) if units is None else [str(unit) for unit in np.atleast_1d(units.values)]
    if "units" in values.attrs:
        each = ["" if values.attrs["units"] == "1" else str(values.attrs["units"])] * len(parts)
    names = signals_of(dataset, kind)
    return [Part(names[i], kind, each[i], part) for i, part in enumerate(parts)]


def signals_of(dataset: Any, kind: str) -> list[str]:
    """Names of the signals of a kind, none where the dataset has no such dimension."""
    if kind in dataset.coords:
        return [str(name) for name in np.atleast_1d(dataset[kind].values)]
    return [f"{KINDS[kind]}{i + 1}" for i in range(dataset.sizes.get(kind, 0))]


def check_signals(call: str, names: Sequence[str], known: Sequence[str]) -> None:
    """
    Raises:
        ValueError: a name that is not there.
    """
    for name in names:
        if name not in known:
            raise ValueError(f"{call}: there is no signal '{name}'; the signals are: {', '.join(known) or 'none'}")


def predicted(dataset: Any, kind: str | None, signal: str) -> Any:
    """The steady width that the certificate promises for a signal, as a DataArray, or None."""
    for name in (f"predicted_{kind}_width", *(["steady_width"] if kind == "state" else [])):
        if name in dataset.data_vars:
            found = [part for part in variable_signals(dataset, name) if part.signal in (signal, "")]
            return found[0].values if found else None
    return None


def conflicts_of(dataset: Any, like: Any) -> Any:
    """Which elements of a DataArray hold steps whose data contradict the bounds, over its dimensions without those of
    its signals; None where the study did not keep it."""
    if "conflicts" in dataset.data_vars:
        found = dataset["conflicts"] > 0
    elif "status" in dataset.data_vars:
        found = (dataset["status"].fillna(0).astype(int) & int(Status.CONFLICT)) != 0
    elif "status_any" in dataset.data_vars:
        found = (dataset["status_any"].fillna(0).astype(int) & int(Status.CONFLICT)) != 0
    else:
        return None
    found = found.any([dim for dim in found.dims if dim not in like.dims])
    like = like.isel({dim: 0 for dim in like.dims if dim in ("statistic", *KINDS)}, drop=True)
    return found.broadcast_like(like).transpose(*like.dims)


def quantities(
    call: str, dataset: Any, variable: str | None, signals: str | Sequence[str] | None, least: int, over: Sequence[Any]
) -> list[Quantity]:
    """What to draw, one for each signal.

    Args:
        variable: its name, or ``state_width`` and ``input_width`` where the boxes were kept; None takes the first of
            `PREFERRED` that is there.
        signals: names; None takes all that the variable has.
        least: axes that the variable needs for this picture.
        over: names of axes asked for; where "time" is among them, the rows are not reduced to the last.

    Raises:
        ValueError: there is nothing to draw, or a name is not there.
    """
    names = None if signals is None else [signals] if isinstance(signals, str) else list(signals)
    if names is not None:
        check_signals(call, names, [name for kind in KINDS for name in signals_of(dataset, kind)])
    drawable = _drawable(dataset, least)
    if not drawable:
        has = ", ".join(f"{axis}: {dataset.sizes[axis]}" for axis in axes_of(dataset)) or "none"
        raise ValueError(
            f"{call}: {least} swept {'axis is' if least == 1 else 'axes are'} needed, the dataset has {has}; vary more "
            "by gx.grid, or draw one case over time by gx.plot.framers or gx.plot.widths"
        )
    if variable is not None and variable not in drawable:
        raise ValueError(f"{call}: there is no variable {variable!r} to draw; there are: {', '.join(drawable)}")
    if names is None:
        chosen = variable or _preferred(drawable, "state")
        return [_quantity(dataset, chosen, part, over) for part in _parts(dataset, chosen)]
    found = []
    for name in names:
        kind = next(kind for kind in KINDS if name in signals_of(dataset, kind))
        chosen = variable or _preferred(drawable, kind)
        parts = {part.signal: part for part in _parts(dataset, chosen)}
        if name not in parts:
            own = ", ".join(filter(None, parts)) or "none"
            raise ValueError(f"{call}: the variable {chosen!r} has no signal {name!r}; its signals are: {own}")
        found.append(_quantity(dataset, chosen, parts[name], over))
    return found


def _drawable(dataset: Any, least: int) -> list[str]:
    axes = set(axes_of(dataset))
    found = []
    for name, values in dataset.data_vars.items():
        dims = set(values.dims) - set(OWN)
        if name not in BESIDE and values.dtype.kind in "biuf" and dims <= axes and "signal" not in values.attrs:
            plain = len(dims) + ("time" in values.dims and least > 1)
            if plain >= least and not re.fullmatch(r"(state|input)_(lower|upper)", str(name)):
                found.append(str(name))
    for kind in kept_kinds(dataset):
        if len(set(dataset[f"{kind}_lower"].dims) & axes) + (least > 1) >= least:
            found.append(f"{kind}_width")
    return found


def _preferred(drawable: Sequence[str], kind: str) -> str:
    ranked = [f"{kind}_{name}" for name in (*PREFERRED, "width")]
    return next(name for name in (*ranked, *(n for n in drawable if n.startswith(kind)), drawable[0])
                 if name in drawable)  # fmt: skip


def _parts(dataset: Any, name: str) -> list[Part]:
    if name in dataset.data_vars:
        return variable_signals(dataset, name)
    kind = name.removesuffix("_width")
    sides = (variable_signals(dataset, f"{kind}_{side}") for side in ("lower", "upper"))
    return [low._replace(values=high.values - low.values) for low, high in zip(*sides, strict=True)]


def _quantity(dataset: Any, name: str, part: Part, over: Sequence[Any]) -> Quantity:
    values = part.values
    about = dataset[name].attrs if name in dataset.data_vars else {"long_name": "width"}
    text = str(about.get("long_name", name.replace("_", " ")))
    text = re.sub(r" of the (state|input) box", "", re.sub(r", over the axis \w+$", "", text))
    if "quantile" in values.dims:
        values = values.isel(quantile=int(np.argmax(dataset["quantile"].values)))
        text = text.replace("quantile", f"{float(dataset['quantile'].max()):g} quantile", 1)
    if "time" in values.dims and "time" not in over and len(values.dims) > 1:
        # The input box of the last row is not known yet.
        last = -2 if part.kind == "input" and name not in dataset.data_vars and values.sizes["time"] > 1 else -1
        values, text = values.isel(time=last), f"last {text}"
    promise = predicted(dataset, part.kind, part.signal) if "width" in name else None
    flags = None
    if "flag_masks" in about:
        masks = [int(mask) for mask in np.atleast_1d(about["flag_masks"])]
        flags = dict(zip(masks, str(about["flag_meanings"]).split(), strict=True))
    return Quantity(name, part.signal, text, part.unit, values, promise, flags)
