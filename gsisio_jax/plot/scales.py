"""Axes of studies as they are drawn, and the numbers that many cases are drawn as."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsisio_jax.plot.style import label, log_ticks, short, with_unit

LABELS = 12  # most tick labels of categories


@dataclass(frozen=True)
class Scale:
    """One axis of a study.

    Attributes:
        name: of the axis.
        text: its label.
        at: (S,) where the elements lie: their coordinates, or 0..S-1 for categories.
        order: (S,) elements by increasing place.
        log: the axis is logarithmic.
        words: names of categories, None for numbers.
        whole: the numbers are integers.
    """

    name: str
    text: str
    at: np.ndarray
    order: np.ndarray
    log: bool
    words: list[str] | None
    whole: bool

    @classmethod
    def of(cls, dataset: Any, name: str) -> Scale:
        values = np.asarray(dataset[name].values)
        about = dataset[name].attrs
        text = with_unit(about.get("long_name", name.replace("_", " ")), about.get("units", ""))
        numbers = values.astype(np.float64) if values.dtype.kind in "iuf" else np.zeros(0)
        if values.dtype.kind in "iuf" and np.isfinite(numbers).all() and len(np.unique(numbers)) == len(numbers):
            order = np.argsort(numbers)
            whole = values.dtype.kind != "f" or (name == "time" and not about.get("units"))
            return cls(name, text, numbers[order], order, _is_log(numbers[order]), None, whole)
        words = [short(float(v)) if isinstance(v, float | np.floating) else str(v) for v in values]
        count = np.arange(len(values))
        return cls(name, text, count.astype(np.float64), count, False, words, False)

    def edges(self) -> np.ndarray:
        """(S+1,) borders between the elements, half way (on a logarithmic axis by the factor)."""
        at = np.log(self.at) if self.log else self.at
        if len(at) == 1:
            return self.at[0] + np.array([-0.5, 0.5])
        middle = 0.5 * (at[1:] + at[:-1])
        edges = np.concatenate([[at[0] - (middle[0] - at[0])], middle, [at[-1] + (at[-1] - middle[-1])]])
        return np.exp(edges) if self.log else edges

    def decorate(self, axis: Any, which: str, labelled: bool = True) -> None:
        """Scale, ticks and label of the x or y axis of a panel."""
        from matplotlib.ticker import MaxNLocator

        side = axis.xaxis if which == "x" else axis.yaxis
        if self.log:
            (axis.set_xscale if which == "x" else axis.set_yscale)("log")
            log_ticks(side, self.at[0], self.at[-1])
        elif self.words is not None:
            step = -(-len(self.words) // LABELS)
            shown = [word if len(word) <= 24 else word[:23] + "…" for word in self.words[::step]]
            long = which == "x" and max(map(len, shown)) * len(shown) > 40
            side.set_ticks(self.at[::step], shown, **({"rotation": 35, "ha": "right"} if long else {}))
        elif self.whole:
            side.set_major_locator(MaxNLocator(integer=True))
        if labelled:
            (axis.set_xlabel if which == "x" else axis.set_ylabel)(
                self.text if which == "x" or len(self.text) < 30 else label(self.text, "")
            )


def _is_log(at: np.ndarray) -> bool:
    """Do these increasing numbers lie much more evenly by their factors than by their differences?"""
    if len(at) < 3 or at[0] <= 0 or at[-1] < 5 * at[0]:
        return False
    steps, factors = np.diff(at), np.diff(np.log(at))
    return bool(2 * factors.max() / factors.min() < steps.max() / steps.min())


def quantiles(values: np.ndarray, shares: Sequence[float]) -> np.ndarray:
    """Quantiles over the first axis, (len(shares), ...), linear between the sorted values.

    Infinite values stay infinite; what is not a number counts as larger than any, so that nothing looks better than it
    was.
    """
    ordered = np.sort(values, axis=0)  # NaN comes last
    place = np.asarray(shares, dtype=np.float64) * (len(ordered) - 1)
    low = np.floor(place).astype(int)
    a, b = ordered[low], ordered[np.ceil(place).astype(int)]
    share = (place - low).reshape(-1, *[1] * (ordered.ndim - 1))
    with np.errstate(invalid="ignore"):
        between = np.where(np.isinf(b), b, a + share * (b - a))
    return np.where((a == b) | (share == 0), a, between)


@dataclass(frozen=True)
class Merge:
    """How the cases of axes that are not drawn become one number.

    Attributes:
        word: "median", "smallest", ...
        of: over the first axis.
        pair: of two numbers; joins neighbours of which there are too many to be drawn one by one.
        worst: quantile that is the worst case: 1 for widths, 0 for a coverage.
    """

    word: str
    of: Callable[[np.ndarray], np.ndarray]
    pair: np.ufunc
    worst: int = 1


def merge_of(variable: str, flags: Any) -> Merge:
    """Widths by their median; what tells of failures by its worst case, which a median would hide."""
    if flags is not None:
        return Merge("all bits", lambda v: np.bitwise_or.reduce(_bits(v), axis=0), np.bitwise_or)
    if "coverage" in variable:
        return Merge("smallest", lambda v: v.min(axis=0), np.minimum, 0)
    if variable.startswith("first_") or variable == "broken_at":
        return Merge("first", lambda v: np.fmin.reduce(v, axis=0), np.fmin, 0)
    if variable.endswith(("_miss", "_max")) or variable == "conflicts":
        return Merge("largest", lambda v: v.max(axis=0), np.maximum)
    return Merge("median", lambda v: quantiles(v, (0.5,))[0], np.maximum)


def _bits(values: np.ndarray) -> np.ndarray:
    """A bit mask as integers; rows of an unfinished study are not a number."""
    return np.nan_to_num(values).astype(np.int64)
