"""What would help where a design fails: one more sensor or bound, or two of them, each tried on the changed plant.

Slopes of the changed plant are those of the plant: a sensor adds a row of the identity, a bound of an input changes
none, and with a bound of a state they are enclosed anew. So the tests that the design begins with (existence, rank, a
gain, a first box) cost a small linear program for each of them.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from types import SimpleNamespace
from typing import Any

import numpy as np

from gsisio_jax.design.assemble import Plan
from gsisio_jax.design.existence import check_existence, check_rank
from gsisio_jax.design.gain_selection import main_gain
from gsisio_jax.design.problem import GainProblem
from gsisio_jax.errors import NoDesignFound, ObserverDoesNotExist
from gsisio_jax.interval.box import Interval
from gsisio_jax.observer.certificate import spectral_radius
from gsisio_jax.observer.enclosures import Enclosures, Slopes
from gsisio_jax.plant.system import Noise

_MOST = 12  # candidates of a kind: plants with more states are told of the first ones
_MOST_PAIRS = 66  # that are tried
_SHOWN_PAIRS = 6
_SINGULAR = 1e-6  # determinants below this are not divided by, as in the design


@dataclass(frozen=True)
class Changed:
    """A plant with some things more known, as far as gain problems read it.

    Attributes:
        plan: of the changed plant.
        region, everywhere: enclosures of its slopes on the region and on the state bounds.
        outputs: affine bounds of T2 g of the plant as it is, on a box (`Enclosures`).
        changes: what is more known: "sensor", "input_bounds" or "state_bounds", and the state or the input.
    """

    plan: Plan
    region: Slopes
    everywhere: Slopes
    outputs: Callable[[Interval], Any]
    changes: tuple[tuple[str, int], ...] = ()

    @property
    def sensors(self) -> list[int]:
        return [index for kind, index in self.changes if kind == "sensor"]


def what_helps(plan: Plan, on: Enclosures, region: Interval | None) -> str:
    """Lines that say which further sensor or bound makes a design possible; each was tried.

    Args:
        plan: of the plant that has none.
        on: its enclosures.
        region: of the design; None where it was to be found.
    """
    region = _place(plan, region)
    if not on.slopes(region).finite:
        return ""
    found: dict[tuple[str, bool], list[int]] = {}
    for one in _changes(plan, on, region):
        verdict = _verdict(one)
        if verdict is not None:
            ((kind, index),) = one.changes
            found.setdefault((kind, verdict), []).append(index)
    if not found:
        alone = "neither one more state measured nor one more bound of a state or an input is enough by itself"
        return f"\nTried: {alone}{_two_that_help(plan, on, region)}."
    lines = [
        f"  {_words(kind, members)}: {_promise(settles)}"
        for (kind, settles), members in sorted(found.items(), key=lambda item: not item[0][1])
    ]
    return "\nTried one by one (no two of them together), each of these is enough:\n" + ";\n".join(lines) + "."


def _two_that_help(plan: Plan, on: Enclosures, region: Interval) -> str:
    """Which two things together make a design possible, those of one kind first."""
    nothing = _as_it_is(plan, on, region)
    pairs = sorted(combinations(_candidates(nothing), 2), key=lambda pair: pair[0][0] != pair[1][0])
    found = []
    for pair in pairs[:_MOST_PAIRS]:
        verdict = _verdict(_with(_with(nothing, pair[0], on, region), pair[1], on, region))
        if verdict is not None:
            found.append((not verdict, _together(*pair)))
    if not found:
        return ", nor are two of them together"
    found.sort(key=lambda way: way[0])
    lines = [f"  {text}: {_promise(not less)}" for less, text in found[:_SHOWN_PAIRS]]
    more = f";\n  and {len(found) - _SHOWN_PAIRS} more pairs" if len(found) > _SHOWN_PAIRS else ""
    return "; two together are:\n" + ";\n".join(lines) + more


def what_settles(plan: Plan, on: Enclosures, region: Interval) -> str:
    """Which further sensor or bound makes widths settle where they do not; "" where none of them alone does."""
    return one_of("widths would settle", plan, on, region, lambda one: _verdict(one) is True)


def one_of(
    what: str,
    plan: Plan,
    on: Enclosures,
    region: Interval,
    works: Callable[[Changed], bool],
) -> str:
    found: dict[str, list[int]] = {}
    for one in _changes(plan, on, region):
        if works(one):
            ((kind, index),) = one.changes
            found.setdefault(kind, []).append(index)
    ways = "; or ".join(_words(kind, members) for kind, members in found.items())
    return f"{what} with one of these (tried): {ways}" if ways else ""


def _together(first: tuple[str, int], second: tuple[str, int]) -> str:
    (kind, i), (other, j) = first, second
    if kind != other:
        return f"{_words(kind, [i])}, and {_words(other, [j])}"
    if kind == "sensor":
        return f"measure states {i + 1} and {j + 1} as well"
    return f"`{kind}` with two finite sides for {kind.removesuffix('_bounds')}s {i + 1} and {j + 1}"


def _promise(settles: bool) -> str:
    return "widths settle" if settles else "finite boxes, but no width settles"


def _words(kind: str, members: list[int]) -> str:
    names = [str(index + 1) for index in members]
    which = f"{', '.join(names[:-1])} or {names[-1]}" if len(names) > 1 else names[0]
    if kind == "sensor":
        return f"measure state {which} as well"
    return f"`{kind}` with two finite sides for {kind.removesuffix('_bounds')} {which}"


def starts(plan: Plan, problem: GainProblem, gain: np.ndarray, here: Slopes, on: Enclosures) -> bool:
    """Would the first box of a step be finite with this gain of the plant as it is?"""
    everywhere = on.slopes(plan.system.state_bounds)
    return _starts(Changed(plan, here, everywhere, on.outputs), problem, gain)


def _place(plan: Plan, region: Interval | None) -> Interval:
    center = np.asarray(plan.system.state_bounds.center, np.float64)
    return Interval(center, center) if region is None else region


def _as_it_is(plan: Plan, on: Enclosures, region: Interval) -> Changed:
    return Changed(plan, on.slopes(region), on.slopes(plan.system.state_bounds), on.outputs)


def _changes(plan: Plan, on: Enclosures, region: Interval) -> Iterator[Changed]:
    """The plant with each one thing more known."""
    nothing = _as_it_is(plan, on, region)
    if nothing.region.finite:
        for change in _candidates(nothing):
            yield _with(nothing, change, on, region)


def _candidates(one: Changed) -> Iterable[tuple[str, int]]:
    """What may be known besides."""
    system = one.plan.system
    unmeasured = [i for i in range(system.n) if not _measured(one.everywhere, i)]
    unbounded = [np.flatnonzero(~np.isfinite(np.asarray(b.width))) for b in (system.input_bounds, system.state_bounds)]
    for kind, members in zip(("sensor", "input_bounds", "state_bounds"), (unmeasured, *unbounded), strict=True):
        yield from ((kind, int(index)) for index in members[:_MOST])


def _with(one: Changed, change: tuple[str, int], on: Enclosures, region: Interval) -> Changed:
    """The plant with one thing more known."""
    (kind, i), plan, system = change, one.plan, one.plan.system
    changes = (*one.changes, change)
    if kind == "sensor":
        T2 = np.pad(plan.feedthrough.T2, ((0, 1), (0, 1)))
        T2[-1, -1] = 1.0
        v = plan.noise.v
        changed = Plan(
            _like(plan, H=np.vstack([system.H, np.zeros((1, system.p))])),
            Noise(plan.noise.w, Interval(np.append(v.lower, -1.0), np.append(v.upper, 1.0))),
            replace(plan.feedthrough, T2=T2),
            plan.u_region,
        )
        return Changed(changed, _with_row(one.region, i), _with_row(one.everywhere, i), on.outputs, changes)
    if kind == "input_bounds":
        changed = replace(plan, system=_like(plan, input_bounds=_bounded(system.input_bounds, i, -1.0, 1.0)))
        return replace(one, plan=changed, changes=changes)
    low, high = float(region.lower[i]), float(region.upper[i])
    if not (np.isfinite([low, high]).all() and low < high):
        low, high = low - 1.0 if np.isfinite(low) else -1.0, high + 1.0 if np.isfinite(high) else 1.0
    box = _bounded(system.state_bounds, i, low, high)
    everywhere = on.slopes(box)
    for sensor in one.sensors:
        everywhere = _with_row(everywhere, sensor)
    changed = replace(plan, system=_like(plan, state_bounds=box))
    return Changed(changed, one.region, everywhere, on.outputs, changes)


def _like(plan: Plan, **changes: Any) -> Any:
    """What gain problems read of a system, changed."""
    system = plan.system
    parts = {"G": system.G, "H": system.H, "state_bounds": system.state_bounds, "input_bounds": system.input_bounds}
    return SimpleNamespace(**{**parts, **changes}, n=system.n, p=system.p, measurement=system.measurement)


def _measured(slopes: Slopes, i: int) -> bool:
    """Is there an output that is this state alone, but for a factor and the unknown input?"""
    rows = (slopes.Z != 0) | (slopes.Z_radius != 0)
    return bool((rows[:, i] & (rows.sum(1) == 1) & (slopes.Z_radius[:, i] < np.abs(slopes.Z[:, i]))).any())


def _with_row(slopes: Slopes, i: int) -> Slopes:
    row = np.eye(slopes.F.shape[0])[i : i + 1]
    E, Z = np.vstack([slopes.E, row]), np.vstack([slopes.Z, row])
    radii = (np.vstack([radius, 0 * row]) for radius in (slopes.E_radius, slopes.Z_radius))
    E_radius, Z_radius = radii
    return Slopes(slopes.F, slopes.F_radius, E, E_radius, Z, Z_radius)


def _bounded(box: Interval, i: int, low: float, high: float) -> Interval:
    lower, upper = np.array(box.lower, np.float64), np.array(box.upper, np.float64)
    lower[i] = lower[i] if np.isfinite(lower[i]) else min(low, upper[i] - 1.0)
    upper[i] = upper[i] if np.isfinite(upper[i]) else max(high, lower[i] + 1.0)
    return Interval(lower, upper)


def _verdict(one: Changed) -> bool | None:
    """Do widths settle? None where there is no observer with finite boxes all the same."""
    problem = one.plan.problem(one.region)
    with contextlib.suppress(ObserverDoesNotExist, NoDesignFound):
        check_existence(one.plan.system, one.plan.feedthrough, one.everywhere)
        check_rank(problem)
        gain = main_gain(problem, Interval.entire(problem.n))
        if _starts(one, problem, gain):
            return bool(np.isfinite(problem.steady_width(gain)).all())
    return None


def _starts(one: Changed, problem: GainProblem, gain: np.ndarray) -> bool:
    """Is the first contraction of a step finite (`check_initial_contraction`)?"""
    reached = (problem.G[:, problem.free] != 0).any(axis=1)
    if np.isfinite(np.asarray(one.plan.system.state_bounds.width))[reached].all():
        return True
    N_z, C = problem.split(gain)[1], problem.C[: problem.q]
    used = (N_z != 0).any(axis=0)
    R = (np.abs(one.everywhere.Z - C) + one.everywhere.Z_radius)[used]
    if np.isfinite(R).all() and spectral_radius(np.abs(N_z[:, used]) @ R) < 1:
        return True
    slope, finite = first_form(one)
    matrix = np.eye(problem.n) + N_z[:, used] @ (slope - C)[used]
    return bool(finite[used].all()) and abs(np.linalg.det(matrix)) > _SINGULAR


def first_form(one: Changed) -> tuple[np.ndarray, np.ndarray]:
    """Slopes (q, n) of the affine bounds of T2 g on the state bounds, and which of them have a finite remainder."""
    if one.everywhere.near_affine(one.everywhere.Z_radius):
        return one.everywhere.Z, np.full(len(one.everywhere.Z), True)
    form, _ = one.outputs(one.plan.system.state_bounds)
    slope = np.asarray(form.slope, np.float64)
    finite = np.isfinite(form.offset.lower) & np.isfinite(form.offset.upper)
    measured = np.eye(slope.shape[1])[one.sensors]
    return np.vstack([slope, measured]), np.append(finite, np.full(len(measured), True))
