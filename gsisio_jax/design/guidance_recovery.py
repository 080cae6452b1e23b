"""What would bring boxes back after a lost row of measurements: one more sensor or bound, each tried on the plant.

By the rules that the recovery of a design follows (theory 5.8), and not by a run of a whole design for each of them,
which would take longer than the design itself.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsisio_jax.design.anchored import rows_until_finite
from gsisio_jax.design.assemble import Plan
from gsisio_jax.design.dead_beat import NOTHING, affine_problem, unseen_after
from gsisio_jax.design.gain_selection import typical_width
from gsisio_jax.design.guidance import Changed, first_form, one_of
from gsisio_jax.design.problem import GainProblem
from gsisio_jax.interval.box import Interval
from gsisio_jax.observer.enclosures import Enclosures
from gsisio_jax.observer.recovery_constants import AffineMaps

_RANK = 1e-9


def what_recovers(plan: Plan, on: Enclosures, region: Interval, maps: AffineMaps | None) -> str:
    """Which further sensor or bound makes boxes finite again after a lost row, or that none was found.

    Args:
        plan, on, region: of the design.
        maps: affine bounds of the plant on its state bounds; None where there are none.
    """
    found = one_of(
        "after a lost row boxes would become finite again", plan, on, region, lambda one: recovers(one, region, maps)
    )
    return found or "no single further sensor or bound was found that makes boxes finite again after a lost row"


def recovers(one: Changed, region: Interval, maps: AffineMaps | None) -> bool:
    """Do boxes become finite again after a lost row, whatever the unknown input does?

    Sure are a measurement that determines every state at once, and inputs that move none without bound in the gap; else
    it takes affine bounds of the plant.
    """
    bounded = np.isfinite(np.asarray(one.plan.system.state_bounds.width))
    n = len(bounded)
    slope, finite = first_form(one)
    if _rank(np.vstack([slope[finite], np.eye(n)[bounded]])) == n:
        return True
    problem = one.plan.problem(one.region)
    unit = typical_width(problem, region)
    alone = _bounds_alone(problem.scaled(unit), bounded)
    lost = _infinite(unseen_after(alone, np.zeros((n, 0)), True, True), bounded)
    if not lost.any():
        return True
    if maps is None:
        return False
    nothing = np.zeros(problem.l, bool)
    affine = affine_problem(problem, _with_sensors(maps, one), nothing, nothing).scaled(unit)
    # Rows that lean on the box before the gap; and boxes from row to row. No row of an observer uses the bound of a
    # state to find where another one was, so here they serve the states that they are of.
    late = np.where(bounded, 0.0, rows_until_finite(affine, 1))
    for row in range(n + 4):
        before = np.eye(n)[:, lost]
        after = _infinite(unseen_after(affine, before, row > 0, True), bounded)
        lost = after & (late > row)
        if not lost.any():
            return True
    return False


def _infinite(unseen: np.ndarray, bounded: np.ndarray) -> np.ndarray:
    """Which states a basis of states that nothing tells from 0 moves."""
    return (np.abs(unseen).max(1, initial=0.0) >= NOTHING) & ~bounded


def _bounds_alone(problem: GainProblem, bounded: np.ndarray) -> GainProblem:
    """The bounds of states as all that is known of x[k]."""
    rows = np.eye(problem.n)[bounded]
    return replace(problem, T2=np.zeros((len(rows), problem.l)), C=rows)


def _with_sensors(maps: AffineMaps, one: Changed) -> AffineMaps:
    """The affine bounds of the plant with its further sensors: rows of the identity, exact."""
    n, more = one.plan.system.n, len(one.sensors)
    if not more:
        return maps
    rows = np.eye(n)[one.sensors]
    l = len(one.plan.system.H) - more

    def joined(parts: np.ndarray, new: np.ndarray) -> np.ndarray:
        f, g, z = np.split(parts, [n, n + l])
        return np.concatenate([f, g, new, z, new])

    none = np.zeros(more)
    return AffineMaps(
        joined(maps.slope, rows), joined(maps.slack, 0 * rows), joined(maps.center, none), joined(maps.radius, none)
    )


def _rank(matrix: np.ndarray) -> int:
    norms = np.linalg.norm(matrix, axis=1, keepdims=True)
    singular = np.linalg.svd(matrix / np.where(norms > 0, norms, 1.0), compute_uv=False)
    return int((singular > _RANK * singular.max(initial=0.0)).sum()) if len(singular) else 0
