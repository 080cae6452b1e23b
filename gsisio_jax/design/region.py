"""region="auto": a region that fits the steady width designed for it, around a point, a box or a trajectory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsisio_jax.errors import NoDesignFound
from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.reading import read_array
from gsisio_jax.plant.system import System

_MARGIN = 1.05  # regions have this much more room than the steady width they were made from
_ROUNDS = 40

Around = Interval | Any
"""A state (n,), a box of states, or states or boxes over time (T, n)."""


@dataclass(frozen=True)
class Near:
    """What a region is looked for around: the hull of what was given, whether that was a whole trajectory, and whether
    boxes or states."""

    box: Interval
    along: bool
    boxes: bool


def find_region(system: System, steady_width: Callable[[Interval], np.ndarray], around: Near | None) -> Interval:
    """Grow a region until it has room for its own steady width.

    Around a point it is grown until it holds its steady width, and then enlarged as long as it does. Around a box it
    has the steady width as room on every side, so that boxes of any state in there fit; it is not made larger.

    Args:
        system: the plant.
        steady_width: of the best gain on a region, (n,), infinite where there is none.
        around: from `read_around`; None takes the centre of the state bounds (0 where there are none).

    Raises:
        NoDesignFound: no such region was met.

    Source: theory 6.
    """
    center = np.asarray(system.state_bounds.center, dtype=np.float64)
    core = Interval(center, center) if around is None else around.box
    point = not np.asarray(core.width).any()
    room = np.zeros(system.n)  # on both sides together around a point, on each side of a box
    for _ in range(_ROUNDS):
        steady = steady_width(_with_room(system, core, room, point))
        if not np.isfinite(steady).all():
            break
        if (steady <= room).all():
            return _enlarge(system, core, room, steady_width) if point else _with_room(system, core, room, point)
        room = np.maximum(room, _MARGIN * steady)
    where = str(np.asarray(core.lower).tolist())
    if not point:
        where += f" to {np.asarray(core.upper).tolist()}"
    hint = "Around a shorter part of the run there may be one. "
    if around is None:
        hint = "Where the plant runs elsewhere, give `around`: a state, a box or a trajectory (T, n). "
    elif not around.along:
        hint = f"Around {'another state' if point else 'a smaller or another box'} there may be one. "
    raise NoDesignFound(
        f"design_observer: region='auto' met no region around {where} that holds its own steady width (last room "
        f"tried: {room.tolist()}). {hint}Smaller noise bounds or more outputs may help too. Boxes are certain even "
        "where the certificate is empty: give a region by hand, or certify=False."
    )


def read_around(system: System, around: Around, auto: bool) -> Near | None:
    """What a region is looked for around: the hull of what was given, within the state bounds.

    Raises:
        ValueError: it has another shape, is not finite, has nothing in common with the state bounds, or a region was
            given as well.
    """
    if around is None:
        return None
    if not auto:
        raise ValueError(
            'design_observer: `around` says where region="auto" looks; leave it out where `region` is a box'
        )
    n, bounds = system.n, system.state_bounds
    box = isinstance(around, Interval)
    sides = [np.asarray(read_array("design_observer", "around", side, missing=not box), np.float64)
             for side in ((around.lower, around.upper) if box else (around, around))]  # fmt: skip
    shape = sides[0].shape
    if shape != (n,) and (len(shape) != 2 or shape[1] != n or not shape[0]):
        raise ValueError(
            f"design_observer: `around` must be a state ({n},), an Interval of shape ({n},), or states or boxes over "
            f"time (T, {n}), got shape {shape}"
        )
    rows = [side.reshape(-1, n) for side in sides]
    # Steps of which nothing is known (a NaN, the infinite box after a gap) say nothing of where the plant runs.
    lower, upper = np.maximum(rows[0], bounds.lower), np.minimum(rows[1], bounds.upper)
    known = np.isfinite(lower) & np.isfinite(upper) & (lower <= upper)
    for i in np.flatnonzero(~known.any(0)):
        raise ValueError(
            "design_observer: `around` must hold finite values of every state within the state bounds, but has none "
            f"of state {i + 1}: {rows[0][0, i]:g} to {rows[1][0, i]:g} first, and the bounds are {bounds.lower[i]:g} "
            f"to {bounds.upper[i]:g}"
        )
    hull = Interval(np.where(known, lower, np.inf).min(0), np.where(known, upper, -np.inf).max(0))
    return Near(hull, along=len(shape) == 2, boxes=box)


def grown_around(around: Near | None, region: Interval) -> str:
    """What a reader of the certificate should know of a region that was found without being told of the whole run; ""
    where all boxes of one were given."""
    if around is not None and around.along and around.boxes:
        return ""
    if around is not None and around.along:
        return (
            "the region has room for settled boxes along the states that were given; wider ones, as the first of a "
            "run, leave it: give the boxes of an earlier estimate as `around`, and look at est.summary()"
        )
    if around is not None:
        return (
            "the region was grown around one state or box; a run that goes on elsewhere leaves it: give the trajectory "
            "as `around`, and look at est.summary()"
        )
    center = ", ".join(f"{value:.4g}" for value in np.asarray(region.center))
    return (
        f"the region was grown around ({center}), the centre of the state bounds; a run elsewhere leaves it: give "
        "`around`, and look at est.summary()"
    )


def _enlarge(system: System, core: Interval, room: np.ndarray, steady_width: Callable) -> Interval:
    """The largest multiple of the region around a point, within a factor of 16, that still holds its steady width."""
    low, high = 1.0, 16.0
    for _ in range(8):
        middle = np.sqrt(low * high)
        steady = steady_width(_with_room(system, core, middle * room, True))
        low, high = (middle, high) if (steady <= middle * room).all() else (low, middle)
    return _with_room(system, core, low * room, True)


def _with_room(system: System, core: Interval, room: np.ndarray, point: bool) -> Interval:
    bounds, side = system.state_bounds, room / 2 if point else room
    return Interval(np.maximum(core.lower - side, bounds.lower), np.minimum(core.upper + side, bounds.upper))
