"""``cells="auto"``: whether a step bounds bent outputs part by part, decided by a run of both."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np

from gsisio_jax.design.problem import GainProblem
from gsisio_jax.design.recovery import Trial
from gsisio_jax.design.row_solver import RowSolver
from gsisio_jax.interval.box import Interval
from gsisio_jax.observer.cells import counts
from gsisio_jax.observer.enclosures import Slopes
from gsisio_jax.observer.types import Observer

_TRIED = 64
_WIDE = 0.1  # share of the state bounds: a box that stays as wide is not found by what a step does otherwise
_LOOSE = 2.0  # times the width that y[k] alone leaves where outputs are as straight as at one point: so neither
_WORTH = 0.5  # share of the width that cells must leave, as they cost some hundred bounds of the outputs a step
_SETTLED = 5  # last steps of a run that are looked at


def with_cells(
    observer: Observer, problem: GainProblem, cells: int | str, everywhere: Slopes, u_region: Interval
) -> Observer:
    """The observer with cells.

    Args:
        observer: a finished one without cells.
        problem: of the design.
        cells: about how many, of the box of x[k] and of the last one; "auto" takes 64 of the first where boxes of
            states that outputs are bent in would else stay wide, in a noise-free run from a narrow box, and cells halve
            them. Wide is a tenth of their bounds, or twice what straight outputs would leave.
        everywhere: bounds of the maps of the plant.
        u_region: of the design.
    """
    bent = everywhere.bent_outputs
    if cells != "auto":
        last = counts(int(cells), everywhere.bent_states)
        return replace(observer, cells=counts(int(cells), bent), past_cells=last)
    bounds = np.asarray(observer.system.state_bounds.width)
    found_anew = bent & _moved_freely(problem) & np.isfinite(bounds)
    if not found_anew.any():
        return observer
    whole = _widths(observer, u_region)
    if whole is None:
        return observer
    wide = np.minimum(_WIDE * bounds, _LOOSE * _straight(observer, u_region))
    if not (whole > wide)[found_anew].any():
        return observer
    cut = replace(observer, cells=counts(_TRIED, bent))
    parts = _widths(cut, u_region)
    if parts is None or not (parts < _WORTH * whole)[found_anew].any():
        return observer
    state = int(np.argmax(np.where(found_anew, whole / np.maximum(parts, 1e-300), 0.0)))
    note = (
        f"cells={_TRIED}, chosen as outputs are bent: the box of state {state + 1} would stay {whole[state]:.3g} wide "
        f"in a run without noise, and is {parts[state]:.3g} wide with cells"
    )
    return replace(cut, certificate=cut.certificate.with_notes(note))


def _moved_freely(problem: GainProblem) -> np.ndarray:
    """(n,): which states an unknown input moves that neither has bounds nor shows at once, so that only y[k] says where
    they are."""
    G, H = problem.G[:, problem.free], problem.H[:, problem.free]
    left = G - G @ np.linalg.pinv(H) @ H if H.size else G
    return (np.abs(left) > 1e-9 * np.abs(problem.G).max(initial=0.0)).any(1)


def _straight(observer: Observer, u_region: Interval) -> np.ndarray:
    """Widths (n,) of the set of states that agree with the free outputs of one step at the centre of the region, if
    these were as straight as they are there; ``inf`` along a state that they do not bound."""
    system, T2 = observer.system, np.asarray(observer.T2)
    with jax.enable_x64(True):
        x, u = (np.nan_to_num(np.asarray(b.center, np.float64)) for b in (observer.certificate.region, u_region))
        slope = T2 @ np.asarray(jax.jacfwd(system.measurement)(x, u))
    room = np.abs(T2) @ np.asarray(observer.noise.v.width) / 2
    if not np.isfinite(slope).all():
        return np.full(system.n, np.inf)
    q, solver = len(slope), RowSolver(np.eye(len(slope)), slope.T)
    goals = np.hstack([np.zeros((system.n, q)), -np.eye(system.n)])
    found = [solver.multipliers(goal, room, np.zeros(q)) for goal in goals]
    return np.array([np.inf if best is None else 2 * best[1] for best in found])


def _widths(observer: Observer, u_region: Interval) -> np.ndarray | None:
    """Median widths (n,) of the last boxes of a run without noise that begins with a narrow box: half as wide as is
    promised, or as the region."""
    trial = Trial.of(observer, u_region)
    if trial is None:
        return None
    certificate, bounds = observer.certificate, observer.system.state_bounds
    reach = np.minimum(certificate.region.width, certificate.steady_width) / 4
    lower, upper = np.maximum(trial.start - reach, bounds.lower), np.minimum(trial.start + reach, bounds.upper)
    return np.median(trial.widths(Interval(lower, upper), trial.rows)[-_SETTLED:], axis=0)
