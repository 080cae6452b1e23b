"""Rows that need no box to begin with: what y[k-N..k] alone say of x[k] (theory 5.8).

After a conflict, a gap or from an unknown start the boxes are infinite, and a row whose slopes on them were cancelled
up to rounding says nothing: 1e-17 times infinity. What rounding leaves is bounded here by the measurements themselves.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, magnitude
from gsisio_jax.interval.image import plain_image, widened_for_sums
from gsisio_jax.interval.primitives import scale
from gsisio_jax.observer import past
from gsisio_jax.observer.domain import Domain
from gsisio_jax.observer.known_inputs import input_matrix, moved
from gsisio_jax.observer.lost import plainly_wider
from gsisio_jax.observer.measurement import everything_unless, output_box
from gsisio_jax.observer.status import Source
from gsisio_jax.observer.window import by_state
from gsisio_jax.plant.system import Noise


class Recovery(eqx.Module):
    """R rows for single states from measurements, known inputs and noise of N steps and of now; lag t is step k-1-t.
    Those with an anchor also lean on the box of the oldest step, and bridge measurements that were lost since.

        x_i in sum over t of {multipliers [B u + w; D u + v - y]}[k-1-t] + output (y - D u - v)[k] + constant
               + sum over t of known (bounded inputs)[k-1-t] + anchor x[k-N]  +-  slack size

    where `size` is the largest number that enters, in units of its own. Where f and g take u, B and D are those of
    ``[f; g](x, u) = [f; g](x, 0) + M u`` as well (`known_inputs`).

    Attributes:
        multipliers: (N, R, n + l).
        output: (R, l); remainder: (R, q), the same on T2 y.
        known: (N, R, b).
        constant: boxes (R,) of what f and g have at 0.
        slack: (R,), what the rows leave of the states and inputs of all steps, by rounding.
        scales: (N + 1, n + l), one over the units in which equations of the plant and outputs count for `size`, lag by
            lag, those of y[k] last; 0 for those that no row uses.
        floor: (), least size: constants and bounded inputs.
        width: (R,), of boxes from these rows alone, at the noise of the design.
        targets: the state i of every row.
        anchor: (R, n); None for rows that need no box.
        anchor_scales: (n,), as `scales` for the states of that box.
    """

    multipliers: Any
    output: Any
    remainder: Any
    known: Any
    constant: Interval
    slack: Any
    scales: Any
    floor: Any
    width: Any
    targets: tuple[int, ...] = eqx.field(static=True)
    anchor: Any = None
    anchor_scales: Any = None

    @property
    def length(self) -> int:
        """N, in steps."""
        return self.multipliers.shape[0]


@jax.named_scope("recovery")
def contract(observer: Any, domain: Domain, carry: Any, y: Any, u: Any, noise: Noise) -> Domain:
    """Contract the box of x[k] with all rows; they hold as long as all measurements that they use are believed."""
    inputs = input_matrix(observer.system, y.dtype) if observer.system.takes_u else None
    if observer.system.takes_u and inputs is None:  # f has traced numbers (`with_model`): what u does is not known
        return domain
    for rows in observer.recovery:
        domain = domain.intersect(_boxes(observer, rows, carry, y, u, noise, inputs), Source.STATE)
    return domain


def covers_all(observer: Any) -> bool:
    """Is there a row for every state that needs no box?"""
    alone = [rows for rows in observer.recovery or () if rows.anchor is None]
    return len({i for rows in alone for i in rows.targets}) == observer.system.n


def _boxes(observer: Any, rows: Recovery, carry: Any, y: Any, u: Any, noise: Noise, inputs: Any) -> Interval:
    """What rows of one length say of x[k], (1, n); `inputs` as for `past.known`."""
    system = observer.system
    steps = (past.last(carry, None), *carry.older)[: rows.length]
    terms = rows.length * rows.multipliers.shape[-1] + system.l + rows.known.shape[-1] * rows.length + 4
    terms += 0 if rows.anchor is None else system.n + 1
    now = output_box(system, y, u, noise.v)
    if inputs is not None:
        now = moved(-inputs[system.n :], u, now)
    total = plain_image(rows.output, widened_for_sums(now, terms))
    total = Interval.unchecked(total.lower + rows.constant.lower, total.upper + rows.constant.upper)
    size = jnp.maximum(scale(rows.scales[-1, system.n :], magnitude(now)).max(initial=0.0), rows.floor)
    holds = jnp.asarray(True)
    for lag, step in enumerate(steps):
        weights = jnp.concatenate([rows.multipliers[lag], rows.known[lag]], -1)
        seen = past.known(observer, step, terms, inputs)
        part = plain_image(weights, seen)
        total = Interval.unchecked(total.lower + part.lower, total.upper + part.upper)
        size = jnp.maximum(size, scale(rows.scales[lag], magnitude(seen)[: system.n + system.l]).max(initial=0.0))
        believed = step.believed
        if rows.anchor is not None:  # in a gap nothing is used that could be wrong
            believed = believed | ~(rows.scales[lag, system.n :] != 0).any()
        holds = holds & step.trusted & believed
    if rows.anchor is not None:
        box: Any = steps[-1].state
        part = plain_image(rows.anchor, widened_for_sums(box, terms))
        total = Interval.unchecked(total.lower + part.lower, total.upper + part.upper)
        size = jnp.maximum(size, scale(rows.anchor_scales, magnitude(box)).max(initial=0.0))
    if rounding.outward():
        total = plainly_wider(total, rounding.generous(scale(rows.slack, size)))
    # A missing measurement or an infinite box that counts makes the size infinite, and then nothing is known.
    holds = holds & (size < jnp.inf)
    return by_state(everything_unless(holds, total), rows.targets, system.n)
