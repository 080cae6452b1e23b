"""Rows over a window of steps: what y[k-N..k] and the boxes of x[k-N..k-1] say of x[k] jointly (theory 5.7).

A row adds the plant's equations of N steps, each with a multiplier, so that inputs and the states in between cancel.
The bounds of f and g on the boxes of these steps are kept in the carry: a window costs no new evaluation of either.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.atoms import States, wider
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, magnitude
from gsisio_jax.interval.image import loose_matvec_upper, plain_image, widened_for_sums
from gsisio_jax.interval.primitives import matmul, scale
from gsisio_jax.observer import past
from gsisio_jax.observer.contractors import Affine
from gsisio_jax.observer.domain import Domain
from gsisio_jax.observer.lost import Lost, plainly_wider
from gsisio_jax.observer.measurement import everything_unless, output_box
from gsisio_jax.observer.status import Source
from gsisio_jax.plant.system import Noise


class Window(eqx.Module):
    """R rows for single states over the last N steps; lag t stands for step k-1-t.

        x_i = sum over t of {multipliers [f + B u + w; g + D u + v - y] - (those of x) x}[k-1-t]
              + output (y - D u - v)[k] - remainder psi(x[k]) + sum over t of known (bounded inputs)[k-1-t]

    What multiplies x[k-1-t] is the part of lag t+1 that acts on f: the equation of one step less.

    Attributes:
        multipliers: (N, R, n + l).
        output: (R, l); remainder: (R, q).
        known: (N, R, b).
        left_x: (R, n), what the rows leave of x[k] by rounding; left_d: (N, R, p), of the inputs.
        targets: the state i of every row.
        counts: how many rows, the first ones, look back to lag 0, 1, ...
    """

    multipliers: Any
    output: Any
    remainder: Any
    known: Any
    left_x: Any
    left_d: Any
    targets: tuple[int, ...] = eqx.field(static=True)
    counts: tuple[int, ...] = eqx.field(static=True)

    @property
    def length(self) -> int:
        """N, in steps."""
        return self.multipliers.shape[0]

    def states(self, lag: int, n: int) -> Any:
        """What multiplies x[k-1-lag], (R, n)."""
        if lag + 1 < self.length:
            return self.multipliers[lag + 1][:, :n]
        return np.zeros((len(self.targets), n))

    @property
    def terms(self) -> int:
        """What is added up of all lags, for rounding."""
        return 2 * self.length + 4


@jax.named_scope("window")
def contract(
    maps: Any, domain: Domain, carry: Any, states: States, psi: Affine, y: Any, u: Any, noise: Noise, lost: Lost
) -> Domain:
    """Contract the box of x[k] with every row.

    Args:
        maps: of the observer.
        domain: of x[k] so far.
        carry: the step before, and older ones.
        states: the box of x[k] so far.
        psi: affine bounds of psi on a box that holds it.
        y, u, noise: of step k.
        lost: bounds the inputs of the last step.
    """
    window, system = maps.observer.window, maps.observer.system
    n = system.n
    pasts = (past.last(carry, lost.magnitudes(domain.box)[1]), *carry.older[: window.length - 1])
    total = plain_image(window.output, widened_for_sums(output_box(system, y, u, noise.v), system.l + window.terms))
    holds = jnp.ones(len(window.targets), bool)
    # Constants are widened for the sum of one row; here they go on through those of all lags.
    constants: Any = jnp.zeros(len(window.targets), y.dtype)
    for lag, (before, count) in enumerate(zip(pasts, window.counts, strict=True)):
        multipliers = window.multipliers[lag][:count]
        # f and g jointly on the box of that step, slopes combined first; then what is known of it.
        rows = maps.rows(multipliers, window.states(lag, n)[:count])
        found = rows.joint_box(maps.states(before.state), before.h)
        weights = jnp.concatenate([multipliers, window.known[lag][:count]], -1)
        known = plain_image(weights, past.known(maps.observer, before, weights.shape[-1] + window.terms))
        part = Interval.unchecked(found.lower + known.lower, found.upper + known.upper)
        total = Interval.unchecked(added(total.lower, part.lower), added(total.upper, part.upper))
        constants = added(constants, abs(rows.constant))
        measured = (multipliers[:, n:] != 0).any(-1)
        holds = jnp.concatenate([holds[:count] & before.trusted & (~measured | before.believed), holds[count:]])
    # The part of x[k] itself, psi, on the box so far.
    slope = matmul(window.remainder, psi.slope)
    middle = matmul(slope, states.center) + matmul(window.remainder, psi.center)
    loose = scale(abs(slope), states.radius).sum(-1) + scale(abs(window.remainder), psi.radius).sum(-1)
    # Slopes that were combined are off by what they are made of.
    loose = loose + scale(abs(window.remainder), scale(abs(psi.slope), states.error).sum(-1)).sum(-1)
    constants = constants + scale(abs(window.remainder), abs(psi.center) + psi.radius).sum(-1)
    loose = loose + wider(constants, system.l + window.terms)
    box = Interval.unchecked(total.lower - (middle + loose), total.upper - (middle - loose))
    if rounding.outward():
        left = jnp.concatenate([window.left_x, *window.left_d], -1)
        sizes = jnp.concatenate([magnitude(domain.box), *(before.input for before in pasts)])
        box = plainly_wider(box, loose_matvec_upper(left, sizes))
    return domain.intersect(by_state(everything_unless(holds, box), window.targets, n), Source.STATE)


def added(total: Any, part: Any) -> Any:
    """The part added to as many rows as it has."""
    return jnp.concatenate([total[: part.shape[0]] + part, total[part.shape[0] :]])


def by_state(box: Interval, targets: tuple[int, ...], n: int) -> Interval:
    """Rows as boxes of all states, (K, n): a state with fewer rows repeats its last one, one without has no bound."""
    rows = [[r for r, i in enumerate(targets) if i == state] for state in range(n)]
    lower, upper = [], []
    for k in range(max(map(len, rows))):
        for side, out, none in ((box.lower, lower, -jnp.inf), (box.upper, upper, jnp.inf)):
            entries = [side[of[min(k, len(of) - 1)]] if of else jnp.asarray(none, side.dtype) for of in rows]
            out.append(jnp.stack(entries))
    return Interval.unchecked(jnp.stack(lower), jnp.stack(upper))
