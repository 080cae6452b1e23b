"""Rows that bridge a gap: from the box before it, without the measurements that were lost since (theory 5.8).

An input that drives several states at once leaves, after a lost row, no box of a state finite, but combinations of
states are. Boxes do not hold these; a row over all steps since the gap does.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsisio_jax.design.dead_beat import (
    NOTHING,
    affine_problem,
    as_recovery,
    dead_beat_rows,
    sizes_without_boxes,
    unseen_after,
)
from gsisio_jax.design.problem import GainProblem
from gsisio_jax.design.recovery import with_recovery
from gsisio_jax.design.window_program import WindowProgram
from gsisio_jax.design.window_runs import Rows
from gsisio_jax.interval.box import Interval
from gsisio_jax.observer.certificate import Certificate
from gsisio_jax.observer.recovery import Recovery
from gsisio_jax.observer.recovery_constants import AffineMaps
from gsisio_jax.observer.residuals import nearest_feedthrough
from gsisio_jax.observer.rounding_constants import stored_recovery
from gsisio_jax.observer.types import Observer

_LONGEST = 12  # states beyond which these windows, and how many there are of them, take seconds
_BOX = 0.5  # half the width of the box before a gap, in units of typical widths


def with_anchored_rows(
    observer: Observer,
    certificate: Certificate,
    problem: GainProblem,
    maps: AffineMaps,
    width: np.ndarray,
    u_region: Interval,
) -> tuple[Observer, Certificate]:
    """The observer with rows for every gap after which its boxes are finite later than they could be, if any, and the
    certificate with what they prove.

    Args:
        observer: finished, in float64.
        certificate: its own, which says after how many rows boxes are finite without these rows.
        problem: of the design.
        maps: affine bounds of f, g and T2 g on the state bounds.
        width: (n,) typical widths of boxes.
        u_region: known inputs of the design.
    """
    n, system = problem.n, observer.system
    if n > _LONGEST or not certificate.recovery_steps or not certificate.lost_row_steps:
        return observer, certificate
    H_slack = nearest_feedthrough(np.asarray(observer.T2, np.float64), system.H)
    if not observer.recovery and any(certificate.recovery_steps):
        # y[k] may determine all states, and no gain say so, as slopes on infinite boxes cancel up to rounding only.
        rows = [
            stored_recovery(rows, observer, system, maps, H_slack, np.float64)
            for rows in dead_beat_rows(problem, maps, width, always=True)
        ]
        if alone := tuple(found for found in rows if found is not None):
            observer = replace(observer, recovery=alone)
            certificate = with_recovery(observer, width, u_region)
    unknown, said = np.array(certificate.recovery_steps), certificate.lost_row_steps
    nothing = np.zeros(problem.l, bool)
    affine = affine_problem(problem, maps, nothing, nothing)
    scaled = affine.scaled(width)
    added: list[Recovery] = []
    steps: list[tuple[float, ...]] = []
    widths: list[np.ndarray] = []
    tried = False  # some states would stay infinite for good without these rows; whether they do not is tried
    for lost in range(1, n + 1):
        now, width_now = certificate.rows_until_finite(lost), certificate.recovered_width(lost)
        first = np.minimum(now, rows_until_finite(scaled, lost))
        # Once all boxes are finite that can be, the step keeps them so.
        until = np.where(np.isfinite(now), now, 1 + np.max(first, where=np.isfinite(first), initial=0))
        for after in range(int(np.max(until, where=first < now, initial=0))):
            states = np.flatnonzero((first <= after) & (after < until))
            if not states.size:
                continue
            rows = _rows(affine, scaled, maps, width, lost, after, states)
            if rows is not None:
                rows = stored_recovery(rows, observer, system, maps, H_slack, np.float64)
            if rows is None:  # what cancels has no bound; it may have one a row later
                first[states] = after + 1
            else:
                added.append(rows)
                begin = np.array([first[i] == after for i in rows.targets])
                width_now[np.array(rows.targets)[begin]] = rows.width[begin]
                tried |= bool(np.isinf(now[states]).any())
        steps.append(tuple(map(float, first)))
        widths.append(width_now)
        if (first == unknown).all() and lost >= len(said):
            break  # nor after more rows
    if not added:
        return observer, certificate
    longer = replace(observer, recovery=(*observer.recovery, *added))
    if tried:
        found = with_recovery(longer, width, u_region)
        return (observer, certificate) if found.lost_row_steps == said else (longer, found)
    if steps[-1] != said[-1]:  # gaps too long for these rows
        steps.append(said[-1])
        widths.append(certificate.recovered_width(len(steps)))
    recoverable = bool(np.isfinite(steps[0]).all())
    return longer, replace(
        certificate, lost_row_steps=tuple(steps), lost_row_width=np.array(widths), recoverable=recoverable
    )


def rows_until_finite(problem: GainProblem, lost: int) -> np.ndarray:
    """For every state the row of measurements, counted from 0, from which on it has bounds if so many rows were lost
    behind a box, whatever the free inputs were, (n,); ``inf``: not within n + 1 rows. Slopes are taken as constant."""
    unseen, hidden = np.zeros((problem.n, 0)), []
    for row in range(lost):
        unseen = unseen_after(problem, unseen, row == 0, False)
    for row in range(problem.n + 1):
        unseen = unseen_after(problem, unseen, row > 0, True)
        hidden.append(np.abs(unseen).max(1, initial=0.0) >= NOTHING)
    late = np.array(hidden)
    found = np.where(late.any(0), len(late) - np.argmax(late[::-1], 0), 0)
    return np.where(late[-1], np.inf, found)


def _rows(
    affine: GainProblem,
    scaled: GainProblem,
    maps: AffineMaps,
    width: np.ndarray,
    lost: int,
    after: int,
    states: np.ndarray,
) -> Recovery | None:
    """The row of least noise for each of these states, from the box in front of so many lost rows, the measurement of
    that step, and those `after` the gap besides y[k]; None where there is none for one of them."""
    n, l, N = affine.n, affine.l, lost + after + 1
    gap, seen = slice(1, lost + 1), np.ones(N, bool)
    seen[gap] = False
    whole = WindowProgram.of(scaled, N, N)
    # No weight on the boxes since, nor on what was lost.
    vanish = np.zeros(len(whole.parts), bool)
    vanish[n : N * n] = True
    vanish[2 * N * n :][: N * l] = np.repeat(~seen, l)
    program = replace(
        whole,
        parts=whole.parts[~vanish],
        offset=whole.offset[~vanish],
        equal=np.vstack([whole.parts[vanish], whole.equal]),
        equal_offset=np.vstack([whole.offset[vanish], whole.equal_offset]),
    )
    size = np.concatenate([np.full(N * n, _BOX), sizes_without_boxes(affine, scaled, maps, width, N)])[~vanish]
    rows, radius = Rows([], []), {}
    for state in states:
        row = program.best(state, size, np.zeros_like(size))
        if row is None:
            return None
        parts = np.zeros(len(whole.parts))
        parts[~vanish] = row[0]
        rows.parts.append(parts)
        rows.states.append(int(state))
        radius[int(state)] = row[1]
    scales = np.tile(1 / np.concatenate([width, affine.output_units]), (N + 1, 1))
    scales[:N, n:][~seen[::-1]] = 0
    found = as_recovery(affine, N, rows, radius, width, scales)
    # On the box: what the equations of its step leave, but for what the program made 0.
    anchor = found.multipliers[-1] @ np.vstack([affine.F, affine.E])
    used = {state: parts[:n] != 0 for state, parts in zip(rows.states, rows.parts, strict=True)}
    anchor = np.where([used[state] for state in found.targets], anchor, 0.0)
    return replace(found, anchor=anchor, anchor_scales=1 / width)
