"""The gains that a design begins with, and why there are none, where there are none.

Boxes are certain with any gains (theory 3.1), so what can fail here is the promise of a width, or that boxes become
finite at all. Where only the promise is lost, the design goes on without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.design.assemble import Plan
from gsisio_jax.design.existence import check_rank
from gsisio_jax.design.gain_selection import main_gain
from gsisio_jax.design.guidance import starts, what_helps
from gsisio_jax.design.problem import GainProblem
from gsisio_jax.errors import NoDesignFound
from gsisio_jax.inclusion.culprits import Culprit, culprits
from gsisio_jax.interval.box import Interval
from gsisio_jax.observer.enclosures import Enclosures, Slopes

_HALVINGS, _BISECTIONS = 10, 5  # of the region, in search of a scale at which a design exists


@dataclass(frozen=True)
class FirstGain:
    """What the rest of a design builds upon.

    Attributes:
        problem: the gain problem on the region; where slopes are infinite there, at its centre.
        slopes: enclosures of the derivatives on the region.
        gain: N (n, columns), the first of the bank.
        uncertified: why no width can be promised; empty where one may be.
    """

    problem: GainProblem
    slopes: Slopes
    gain: np.ndarray
    uncertified: str


def first_gain(plan: Plan, on: Enclosures, region: Interval, certify: bool) -> FirstGain:
    """The certified gain of the region, or one without a certificate.

    Args:
        plan: plant, noise, feedthrough and known inputs.
        on: its enclosures.
        region: of the design.
        certify: refuse where a certificate cannot be had on this region, but might on another one. Jumps of f and g
            rule it out on every region that holds them, so they are no reason to refuse.

    Raises:
        NoDesignFound: says which operation, or which direction of the input, is the reason, and what may help.
    """
    slopes, uncertified = on.slopes(region), ""
    problem = plan.problem(slopes) if slopes.finite else plan.problem(_at_center(plan, region, slopes))
    if not slopes.finite:
        found = _culprits(plan, region)
        reason = "; ".join(map(str, found)) + _wraps(found)
        uncertified = f"no width is promised: {reason}"
        if certify and not (found and all(c.fault == "may jump" for c in found)):
            raise NoDesignFound(
                f"design_observer: the derivatives of f or g are not bounded on the region {region}: "
                f"{reason}. Give a region (or `state_bounds`) that keeps away from such points, or "
                f"design without a certificate: certify=False.{_scaled(plan, on, region)}"
            )
    try:
        check_rank(problem)
        gain = main_gain(problem, region)
    except NoDesignFound as error:
        if certify:
            hint = " certify=False gives an observer without a certificate."
            hint += _scaled(plan, on, region) + what_helps(plan, on, region)
            raise NoDesignFound(f"{error}{hint}") from None
        gain, uncertified = _any_gain(problem), f"no width is promised: {error}"
    return FirstGain(problem, slopes, gain, uncertified)


def _culprits(plan: Plan, region: Interval) -> list[Culprit]:
    system, u = plan.system, plan.u_region
    with jax.enable_x64(True):
        box, known = (Interval(*(np.asarray(s, np.float64) for s in (b.lower, b.upper))) for b in (region, u))
        return [c for function in (system.dynamics, system.measurement) for c in culprits(function, box, known)]


def _wraps(found: Sequence[Culprit]) -> str:
    """A hint for angles that g wraps."""
    if not any(c.operation in ("atan2", "remainder", "rem", "floor") for c in found):
        return ""
    return (
        ". An angle that g wraps (a remainder, or the arctangent of sine and cosine) jumps: let g return the angle "
        "itself, and name that output in System(periodic=...)"
    )


def _at_center(plan: Plan, region: Interval, slopes: Slopes) -> Slopes:
    """Slopes for the choice of gains only: those that are infinite become those at the centre of the region."""
    system = plan.system
    with jax.enable_x64(True):
        x, u = (jnp.asarray(np.nan_to_num(np.asarray(box.center)), float) for box in (region, plan.u_region))
        F, E = jax.jacfwd(system.dynamics)(x, u), jax.jacfwd(system.measurement)(x, u)
    F, E = (np.nan_to_num(np.asarray(J, np.float64), posinf=0.0, neginf=0.0) for J in (F, E))
    parts: list[Any] = []
    for center, radius, there in (
        (slopes.F, slopes.F_radius, F),
        (slopes.E, slopes.E_radius, E),
        (slopes.Z, slopes.Z_radius, np.asarray(plan.feedthrough.T2) @ E),
    ):
        known = np.isfinite(radius)
        parts += [np.where(known, center, there), np.where(known, radius, 0.0)]
    return Slopes(*parts)


def _any_gain(problem: GainProblem) -> np.ndarray:
    """Rows that cancel the unknown input with the smallest weights, zero where none does: what such a row says is
    bounded with the box of the input, which may be infinite."""
    seen, target = problem.seen[:, problem.free], problem.G[:, problem.free]
    rows = target @ np.linalg.pinv(seen) if seen.shape[1] else np.zeros((problem.n, problem.columns))
    left = np.abs(target - rows @ seen).max(axis=1, initial=0.0)
    return np.where((left <= 1e-12 * np.abs(target).max(initial=1.0))[:, None], rows, 0.0)


def _scaled(plan: Plan, on: Enclosures, region: Interval) -> str:
    """The largest multiple of the region about its centre for which a gain exists, as a hint, or that there
    is none; "" where the region is unbounded or a point."""
    lower, upper = (np.asarray(side, np.float64) for side in (region.lower, region.upper))
    if not (np.isfinite(lower) & np.isfinite(upper)).all() or not (upper > lower).any():
        return ""
    center, radius = 0.5 * lower + 0.5 * upper, 0.5 * upper - 0.5 * lower

    def of(scale: float) -> Interval:
        return Interval(center - scale * radius, center + scale * radius)

    def works(scale: float, contracts: bool) -> bool:
        slopes = on.slopes(of(scale))
        if not slopes.finite:
            return False
        problem = plan.problem(slopes)
        try:
            check_rank(problem)
            gain = main_gain(problem, of(scale))
        except NoDesignFound:
            return False
        if not starts(plan, problem, gain, slopes, on):
            return False
        return not contracts or bool(np.isfinite(problem.steady_width(gain)).all())

    for contracts in (True, False):
        low = next((2.0**-i for i in range(1, _HALVINGS) if works(2.0**-i, contracts)), None)
        if low is None:
            continue
        high = 2 * low
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if works(middle, contracts) else (low, middle)
        sides = " to ".join(np.array2string(np.asarray(side), precision=4) for side in (of(low).lower, of(low).upper))
        return (
            f" Scaled by {low:.3g} about its centre ({sides}), the region has a gain"
            f"{', and widths settle' if contracts else ', though no widths that settle'}."
        )
    return " A smaller region about the same centre alone does not help."
