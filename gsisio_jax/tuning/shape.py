"""Which numbers are fitted: from a few factors to noise bounds.

Every bound is that of a template, stretched away from its anchor, the point of the template nearest to 0. So bounds
grow with every factor, and boxes of larger factors contain those of smaller ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.reading import check_type
from gsisio_jax.plant.system import Noise

Parameters = str | Mapping[str, Any]


@dataclass(frozen=True)
class Shape:
    """A template of noise bounds and the factors that stretch it: bounds = anchor -+ factor[index] reach, w then v.

    Attributes:
        template: the bounds for factors 1.
        names: of the k factors.
        anchor: (n + l,).
        reach: below and above the anchor, two arrays (n + l,).
        index: of the factor of each side, two arrays (n + l,); k, for factor 1, where a side is not fitted.
    """

    template: Noise
    names: tuple[str, ...]
    anchor: np.ndarray
    reach: tuple[np.ndarray, np.ndarray]
    index: tuple[np.ndarray, np.ndarray]

    def noise(self, factors: np.ndarray) -> Noise:
        """Noise bounds for factors (..., k), as NumPy arrays (..., n) and (..., l)."""
        factors = np.concatenate([factors, np.ones((*np.shape(factors)[:-1], 1))], axis=-1)
        lower = self.anchor - factors[..., self.index[0]] * self.reach[0]
        upper = self.anchor + factors[..., self.index[1]] * self.reach[1]
        n = self.template.w.shape[0]
        return Noise(Interval(lower[..., :n], upper[..., :n]), Interval(lower[..., n:], upper[..., n:]))

    def pull(self, slope: Noise) -> np.ndarray:
        """From derivatives by the bounds (R, .) to derivatives by the factors, (R, k)."""
        total = np.zeros((np.shape(slope.w.lower)[0], len(self.names) + 1))
        for side, name, sign in ((0, "lower", -1.0), (1, "upper", 1.0)):
            by_side = np.concatenate([np.asarray(getattr(box, name)) for box in (slope.w, slope.v)], axis=1)
            np.add.at(total.T, self.index[side], sign * (by_side * self.reach[side]).T)
        return total[:, :-1]

    def cost(self, weights: np.ndarray) -> tuple[np.ndarray, float]:
        """The weighted sum of widths as ``vector @ factors + constant``; weights (n + l,)."""
        total = np.zeros(len(self.names) + 1)
        for index, reach in zip(self.index, self.reach, strict=True):
            np.add.at(total, index, weights * reach)
        return total[:-1], float(total[-1])

    def factors(self, noise: Noise) -> np.ndarray:
        """The smallest factors whose bounds contain the given ones; sides that are not fitted do not count."""
        found = np.zeros(len(self.names) + 1)
        sides = [np.concatenate([np.asarray(getattr(b, s), float) for b in (noise.w, noise.v)]) for s in _SIDES]
        needed = self.anchor - sides[0], sides[1] - self.anchor
        for index, reach, side in zip(self.index, self.reach, needed, strict=True):
            np.maximum.at(found, index, np.where(reach > 0, side / np.where(reach > 0, reach, 1), 0))
        return found[:-1]


_SIDES = ("lower", "upper")


def read_shape(call: str, template: Noise, parameters: Parameters) -> Shape:
    """Name the factors of a template.

    Args:
        call: for error messages.
        template: constant noise bounds; components of width 0 stay as they are.
        parameters: "scale" (one factor for all bounds), "each" (one per component), "sides" (one per lower and one per
            upper bound), or a mapping with keys "w" and "v": a name for all components, or a name or None (not fitted)
            per component; components of one name share a factor.

    Raises:
        ValueError: the template changes with time, the words are unknown, or nothing is left to fit.
    """
    check_type(call, "noise", template, Noise, "gx.Noise(w, v)")
    sizes = [box.shape[-1] for box in (template.w, template.v)]
    if any(len(box.shape) != 1 for box in (template.w, template.v)):
        raise ValueError(f"{call}: the noise to fit must be constant, of shapes (n,) and (l,); it changes with time")
    lower, upper = (
        np.concatenate([np.asarray(getattr(b, s), float) for b in (template.w, template.v)]) for s in _SIDES
    )
    anchor = np.clip(0.0, lower, upper)
    reach = anchor - lower, upper - anchor
    labels = _labels(call, sizes, parameters)
    names: list[str] = []
    index = []
    for side, sign in zip(reach, "-+", strict=True):
        chosen = np.full(len(side), -1)
        for i, label in enumerate(labels):
            if label is None or side[i] == 0:
                continue
            name = label + sign if parameters == "sides" else label
            if name not in names:
                names.append(name)
            chosen[i] = names.index(name)
        index.append(chosen)
    if not names:
        raise ValueError(f"{call}: nothing is left to fit; name components of `noise` that are not zero wide")
    order = sorted(range(len(names)), key=lambda j: _first_use(j, index))
    rank = np.argsort(order)
    fixed = len(names)
    index = [np.where(chosen < 0, fixed, rank[np.maximum(chosen, 0)]) for chosen in index]
    return Shape(template, tuple(names[j] for j in order), anchor, reach, (index[0], index[1]))


def _labels(call: str, sizes: list[int], parameters: Parameters) -> list[str | None]:
    own = [f"{letter}{i + 1}" for letter, size in zip("wv", sizes, strict=True) for i in range(size)]
    if parameters == "scale":
        return ["scale"] * len(own)
    if parameters in ("each", "sides"):
        return list(own)
    if isinstance(parameters, str) or not isinstance(parameters, Mapping) or not set(parameters) <= {"w", "v"}:
        raise ValueError(
            f'{call}: `parameters` must be "scale", "each", "sides" or a mapping of "w" and "v" to names, got '
            f"{parameters!r}"
        )
    labels: list[str | None] = []
    for letter, size in zip("wv", sizes, strict=True):
        given = parameters.get(letter)
        part = [given] * size if given is None or isinstance(given, str) else list(given)
        if len(part) != size or not all(name is None or isinstance(name, str) for name in part):
            raise ValueError(
                f'{call}: `parameters["{letter}"]` must be one name, None, or {size} of them, got {given!r}'
            )
        labels += part
    return labels


def _first_use(name: int, index: Sequence[np.ndarray]) -> tuple[int, int]:
    """Where a factor appears first: by component, then by side."""
    return min((int(i), side) for side, chosen in enumerate(index) for i in np.flatnonzero(chosen == name))
