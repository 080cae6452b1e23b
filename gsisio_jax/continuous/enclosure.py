"""Where a plant is within a step: a box that holds every solution that starts in a box of states (theory 15.1)."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from gsisio_jax.continuous import sides
from gsisio_jax.continuous.arguments import cells_of
from gsisio_jax.continuous.sides import Sides

_ROUNDS, _TIGHTER, _TIGHTER_IN_PARTS = 40, 3, 10
_INFLATION = 0.1
_PARTS = 32  # of a box on which F is bounded part by part, at most
_SHRINKS = 0.99  # a round more is worth it
_PAYS = 0.9  # of the width of F on the box as a whole


def _by_width(found: Sides, x: Sides) -> Sides:
    more = _INFLATION * (found[1] - found[0]) + 1e-300
    return more, more


def _by_way(found: Sides, x: Sides) -> Sides:
    """A part of the way that the plant moves beyond x, on either side."""
    with np.errstate(invalid="ignore"):
        below, above = x[0] - found[0], found[1] - x[1]
    below, above = (np.where(np.isfinite(way), way, 0) for way in (below, above))  # of infinite sides of x it is NaN
    return _INFLATION * below + 1e-300, _INFLATION * above + 1e-300


@dataclass
class Around:
    """Boxes around solutions.

    Attributes:
        field: bounds of ``F(x) = f(x, u) + c + G d`` on a box of x, for all u and d.
        h: length of a step.
        spread: radius of the disturbance, (n,).
        never: box that the plant never leaves, (n,); infinite sides where nothing is known.
    """

    field: Callable[[Sides], Sides]
    h: float
    spread: np.ndarray
    never: Sides
    parts_pay: bool | None = None  # are there parts on which F is much narrower? None: not asked yet

    def of(self, x: Sides) -> Sides:
        """A box that holds every solution over a step that starts in x."""
        # A tenth of a wide region may be far beyond what a short step can reach: where f has no bound, perhaps.
        for more in (_by_width, _by_way):
            with contextlib.suppress(ValueError):
                return self._enclosure(x, more, self.field)
        return self._enclosure(x, _by_way, self.rate)

    def _enclosure(self, x: Sides, more: Callable[[Sides, Sides], Sides], rate_on: Callable[[Sides], Sides]) -> Sides:
        """That box, looked for in boxes that grow by `more` each time. Any one that passes the test is right."""
        wide, around = sides.symmetric(self.spread), x
        length = np.zeros(()), np.asarray(self.h)

        def moved(around: Sides, rate_on: Callable[[Sides], Sides] = rate_on) -> Sides:
            rate = sides.add(rate_on(around), wide)
            if not np.isfinite(rate).all():
                row = int(np.argwhere(~np.isfinite(rate).all(0))[0, 0])
                raise ValueError(
                    f"discretize: within a step of dt = {self.h:g} the plant may reach {box_text(around)}, where "
                    f"f[{row}] has no finite bound; give a region on which f is defined, `state_bounds` that the plant "
                    "never leaves (a concentration is not negative), more cells, or a shorter dt"
                )
            return sides.meet(sides.add(x, sides.times(length, rate)), self.never)

        for _ in range(_ROUNDS):
            found = moved(around)
            if sides.inside(found, around):
                for _ in range(_TIGHTER):  # only to boxes that pass the same test
                    image = moved(found)
                    if not sides.inside(image, found):
                        break
                    around, found = found, image
                return self._tighter(around, lambda around: moved(around, self.rate))
            found = sides.hull([found, around])
            below, above = more(found, x)
            around = sides.meet((found[0] - below, found[1] + above), self.never)
        raise ValueError(
            f"discretize: a step of dt = {self.h:g} is too long to enclose the plant on {box_text(x)} (boxes "
            "kept growing); give a shorter dt, a smaller region, more cells, or `state_bounds` that it never leaves"
        )

    def _tighter(self, around: Sides, moved: Callable[[Sides], Sides]) -> Sides:
        """A smaller box that passes the same test, with F bounded part by part, where that is worth it."""
        if not self._in_parts(around):
            return around
        for _ in range(_TIGHTER_IN_PARTS):
            image = moved(around)
            if not (sides.inside(image, around) and sides.inside(moved(image), image)):
                break
            before, around = around, image
            if not (around[1] - around[0] < _SHRINKS * (before[1] - before[0])).any():
                break
        return around

    def rate(self, around: Sides) -> Sides:
        """F on a box, as the hull over parts of it: where states stand in denominators that says much more."""
        if not self._in_parts(around):
            return self.field(around)
        return sides.hull([self.field(part) for part in _parts(around)])

    def _in_parts(self, around: Sides) -> bool:
        """Is F on parts of the first box that was asked for so much narrower that parts are worth their time?"""
        if self.parts_pay is None:
            parts = list(_parts(around))
            whole, found = self.field(around), sides.hull([self.field(part) for part in parts])
            with np.errstate(invalid="ignore"):
                self.parts_pay = len(parts) > 1 and bool((found[1] - found[0] < _PAYS * (whole[1] - whole[0])).any())
        return self.parts_pay


def _parts(around: Sides) -> Iterator[Sides]:
    """Of a box: so many along every state that the limit is kept."""
    low, high = around
    cut = np.isfinite(low) & np.isfinite(high) & (low < high)
    count = int(_PARTS ** (1 / max(int(cut.sum()), 1)) + 1e-9)
    return cells_of(around, [min(count, 8) if yes else 1 for yes in cut])


def box_text(pair: Sides) -> str:
    """A box, in few digits."""
    return f"[{', '.join(f'{v:.4g}' for v in pair[0])}] to [{', '.join(f'{v:.4g}' for v in pair[1])}]"
