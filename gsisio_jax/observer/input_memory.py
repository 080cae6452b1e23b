"""What earlier steps say of the unknown input, where it is known how it moves with time (theory 7.5).

A box of d[k-2] and a bound of ``d[k-1] - d[k-2]`` give a box of d[k-1], for every plant. Rows over several steps add
the plant's equations, each with a multiplier, so that all they leave of the inputs is d[k-1], bounded moves of it, and
the box that was found for it some steps ago: the noise of one difference is spread over many.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.atoms import wider
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, add, choose, entire_like, is_concrete, magnitude
from gsisio_jax.interval.image import loose_matvec_upper, plain_image, widened_for_sums
from gsisio_jax.observer import past
from gsisio_jax.observer.domain import Domain
from gsisio_jax.observer.lost import plainly_wider
from gsisio_jax.observer.measurement import everything_unless, output_box, shift_box, typed
from gsisio_jax.observer.status import Source
from gsisio_jax.observer.window import added, by_state
from gsisio_jax.plant.system import Noise


class InputRows(eqx.Module):
    """R rows for single inputs over the last N steps; lag t stands for step k-1-t.

        sum of d_j[k-1-t] over t < over =
            now x[k] - output (g + D u + v - y)[k] - ahead (d[k] - d[k-1])
            - sum over t of {multipliers [f + B u + w; g + D u + v - y] - (those of x) x}[k-1-t]
            - sum over t of boxes d[k-1-t] - sum over t of moves (d[k-1-t] - d[k-2-t])

    What multiplies x[k-1-t] is the part of lag t+1 that acts on f, and `now` is that of lag 0.

    Attributes:
        multipliers: (N, R, n + l).
        output, ahead: (R, l) and (R, p), what the rows use of y[k], where d[k] shows in it.
        boxes, moves: (N, R, p).
        left: (N, R, p), what the rows leave of the inputs by rounding; left_now: (R, p), of d[k].
        targets: the input j of every row.
        counts: how many rows, the first ones, look back to lag 0, 1, ...
        over: 1 for d[k-1] itself.
    """

    multipliers: Any
    output: Any
    ahead: Any
    boxes: Any
    moves: Any
    left: Any
    left_now: Any
    targets: tuple[int, ...] = eqx.field(static=True)
    counts: tuple[int, ...] = eqx.field(static=True)
    over: int = eqx.field(static=True, default=1)

    @property
    def length(self) -> int:
        """N, in steps."""
        return self.multipliers.shape[0]

    @property
    def terms(self) -> int:
        """What is added up of all lags, for rounding."""
        return (self.length + 1) * (2 + 2 * self.boxes.shape[-1]) + self.multipliers.shape[-1] + 4

    @property
    def looks_ahead(self) -> bool:
        """Some row uses y[k] by itself, beyond what the box of x[k] says."""
        return not is_concrete(self.output) or bool(np.any(self.output))


class InputMemory(eqx.Module):
    """What is carried of the unknown input; it stands in `Carry.memory`.

    Attributes:
        boxes: of d[k-2], d[k-3], ... as step k begins, (N, p).
        phase: number of d[k-1] within its block of `input_constant` steps, in the floating type of the boxes.
    """

    boxes: Interval
    phase: Any


def blank(observer: Any, dtype: Any) -> InputMemory | None:
    """What a first step has of it; None where nothing is known of how the input moves."""
    system = observer.system
    if system.input_rate is None and system.input_constant is None:
        return None
    rows = observer.input_rows
    limits, count = typed(system.input_bounds, dtype), 1 if rows is None else max(1, rows.length - 1)
    boxes = Interval.unchecked(*(jnp.tile(side, (count, 1)) for side in (limits.lower, limits.upper)))
    return InputMemory(boxes, jnp.asarray((system.input_constant or 1) - 1, dtype))


def after(observer: Any, carry: Any, d: Interval, conflict: Any, hold: bool) -> InputMemory | None:
    """The memory of the next step, given the box of d[k-1].

    After a conflict the past counts for nothing, or where it is believed (`hold`) no more than before.
    """
    memory: InputMemory | None = carry.memory
    if memory is None:
        return None
    system, older = observer.system, memory.boxes
    limits = typed(system.input_bounds, d.dtype)
    if hold:
        kept, _ = _met(limits, _moved(observer, memory), Source.INPUT)
        d = choose(conflict, kept, d)
    else:
        nothing = Interval.unchecked(*(jnp.broadcast_to(side, older.shape) for side in _sides(limits)))
        older = choose(conflict, nothing, older)
    joined = (jnp.concatenate([new[None], old])[: len(old)] for new, old in zip(_sides(d), _sides(older), strict=True))
    following = memory.phase + 1
    return InputMemory(Interval.unchecked(*joined), jnp.where(following >= (system.input_constant or 1), 0, following))


@jax.named_scope("input memory")
def contract(
    maps: Any, domain: Domain, carry: Any, d: Interval, y: Any, u: Any, noise: Noise
) -> tuple[Interval, Domain]:
    """Contract the box of d[k-1] with the memory and with every row, given the box of x[k] and what was measured."""
    memory: InputMemory | None = carry.memory
    if memory is None:
        return d, domain
    d, met = _met(d, _moved(maps.observer, memory), Source.INPUT)
    domain = domain.taken(met)
    if maps.observer.input_rows is None:
        return d, domain
    rows = maps.observer.input_rows
    pasts = (past.last(carry, None), *carry.older[: rows.length - 1])
    inputs = [d, *(memory.boxes[t] for t in range(rows.length - 1))]
    moves = [_moves(maps.observer, memory, lag, d.dtype) for lag in range(-1, rows.length)]
    yes, h = jnp.asarray(True), None
    if rows.looks_ahead:
        h = maps.output_bounds(maps.states(domain.box), domain.box, u)
    now = past.Past(y, u, noise, yes, yes, domain.box, h)
    found = by_state(from_rows(maps, rows, (now, *pasts), inputs, moves), rows.targets, d.shape[0])
    met = Domain.of(d, 0.0).intersect(found, Source.INPUT)
    return met.box, domain.taken(met)


def from_rows(maps: Any, rows: InputRows, steps: Any, inputs: Any, moves: Any) -> Interval:
    """Boxes (R,) from every row.

    Args:
        maps: of the observer.
        rows: to be evaluated.
        steps: step k, whose h need bound g alone, and those of lag 0, 1, ...
        inputs: boxes of d[k-1-t], t = 0, 1, ...
        moves: boxes of d[k] - d[k-1], and of d[k-1-t] - d[k-2-t].
    """
    (now, *pasts), (ahead, *moves) = steps, moves
    system, terms, n = maps.observer.system, rows.terms, maps.observer.system.n
    total, constants = _of_now(maps, rows, now, ahead, inputs[0])
    holds = jnp.ones(len(rows.targets), bool)
    for lag, (before, count) in enumerate(zip(pasts, rows.counts, strict=True)):
        multipliers = rows.multipliers[lag][:count]
        older = rows.multipliers[lag + 1][:count, :n] if lag + 1 < rows.length else np.zeros((count, n))
        # f and g jointly on the box of that step, slopes combined first; then what is known of it.
        of_maps = maps.rows(multipliers, older)
        found = of_maps.joint_box(maps.states(before.state), before.h)
        known = [shift_box(system, before.y, before.u, before.noise), inputs[lag], moves[lag]]
        weights = jnp.concatenate([multipliers, rows.boxes[lag][:count], rows.moves[lag][:count]], -1)
        sides = (jnp.concatenate([getattr(box, side) for box in known]) for side in ("lower", "upper"))
        part = plain_image(weights, widened_for_sums(Interval.unchecked(*sides), weights.shape[-1] + terms))
        if rounding.outward():
            part = plainly_wider(part, loose_matvec_upper(rows.left[lag][:count], magnitude(inputs[lag])))
        total = Interval.unchecked(
            added(total.lower, found.lower + part.lower), added(total.upper, found.upper + part.upper)
        )
        constants = added(constants, abs(of_maps.constant))
        measured = (multipliers[:, n:] != 0).any(-1)
        unused = (multipliers == 0).all(-1)
        told = unused | (before.trusted & (~measured | before.believed))
        holds = jnp.concatenate([holds[:count] & told, holds[count:]])
    loose = wider(constants, terms)
    return everything_unless(holds, Interval.unchecked(-(total.upper + loose), -(total.lower - loose)))


def _of_now(maps: Any, rows: InputRows, now: Any, ahead: Interval, d: Interval) -> tuple[Interval, Any]:
    """What rows take of step k, as they add it up, and the sizes of constants: these are widened for the sum of one
    row, and go on through those of all lags."""
    system, n = maps.observer.system, maps.observer.system.n
    of_x = rows.multipliers[0][:, :n]
    if not rows.looks_ahead:
        none: Any = jnp.zeros(len(rows.targets), now.state.dtype)
        return _negative(plain_image(of_x, widened_for_sums(now.state, n + rows.terms))), none
    of_g = maps.rows(maps.on_outputs(rows.output), of_x)
    found = of_g.joint_box(maps.states(now.state), now.h)
    seen = output_box(system, now.y, now.u, now.noise.v)
    known = [_negative(seen), ahead]
    weights = jnp.concatenate([rows.output, rows.ahead], -1)
    sides = (jnp.concatenate([getattr(box, side) for box in known]) for side in ("lower", "upper"))
    part = plain_image(weights, widened_for_sums(Interval.unchecked(*sides), weights.shape[-1] + rows.terms))
    if rounding.outward():
        # |d[k]| is at most |d[k-1]| and the move; what has no bound of it is in no output that rows use.
        part = plainly_wider(part, loose_matvec_upper(rows.left_now, magnitude(d) + magnitude(ahead)))
    return Interval.unchecked(found.lower + part.lower, found.upper + part.upper), abs(of_g.constant)


def _moves(observer: Any, memory: InputMemory, lag: int, dtype: Any) -> Interval:
    """Box (p,) of d[k-1-lag] - d[k-2-lag]; lag -1: that of d[k] - d[k-1]."""
    system = observer.system
    zero = jnp.zeros(system.p, dtype)
    still = Interval.unchecked(zero, zero)
    rate = entire_like(zero) if system.input_rate is None else typed(system.input_rate, dtype)
    if system.input_constant is None:
        return rate
    return choose(memory.phase == lag % system.input_constant, rate, still)


def _moved(observer: Any, memory: InputMemory) -> Interval:
    """Box (p,) of d[k-1] from that of d[k-2]."""
    return add(memory.boxes[0], _moves(observer, memory, 0, memory.boxes.dtype))


def _met(d: Interval, other: Interval, kind: Source) -> tuple[Interval, Domain]:
    met = Domain.of(d, 0.0).intersect(other[None], kind)
    return met.box, met


def _negative(box: Interval) -> Interval:
    return Interval.unchecked(-box.upper, -box.lower)


def _sides(box: Interval) -> tuple[Any, Any]:
    return box.lower, box.upper
