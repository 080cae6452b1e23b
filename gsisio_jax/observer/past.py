"""What a step keeps of the steps before the last one, for rows that look back farther (theory 5.7 and 5.8)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from gsisio_jax.inclusion.atoms import AtomBounds
from gsisio_jax.interval.box import Interval, entire_like, magnitude
from gsisio_jax.interval.image import image, widened_for_sums
from gsisio_jax.observer.known_inputs import moved
from gsisio_jax.observer.measurement import shift_box
from gsisio_jax.plant.system import Noise


class Past(eqx.Module):
    """A step before the last one.

    Attributes:
        y, u, noise: of that step.
        believed: its measurement was.
        trusted: no conflict since has thrown away what was known then.
        state: box of x, (n,); None for steps on whose box no row leans.
        h: bounds of f and g on it; None, like the next one, for steps that windows do not reach.
        input: upper bound (p,) of |d| then.
    """

    y: Any
    u: Any
    noise: Noise
    believed: Any
    trusted: Any
    state: Interval | None = None
    h: AtomBounds | None = None
    input: Any = None

    def measured(self, state: bool) -> Past:
        """What was measured then alone, or with the box of the state."""
        return replace(self, state=self.state if state else None, h=None, input=None)


def before_all(carry: Any, observer: Any) -> tuple[Past, ...]:
    """What a first step has of a past: nothing that counts."""
    no = jnp.asarray(False)
    empty = Past(
        carry.y, carry.u, carry.noise, no, no,
        entire_like(carry.state), _kept(carry.h), jnp.full(observer.system.p, jnp.inf, carry.y.dtype),
    )  # fmt: skip
    return _as_needed((empty,) * (_depth(observer) - 1), observer)


def shifted(carry: Any, observer: Any, d: Interval, dropped: Any) -> tuple[Past, ...]:
    """The past of the next step: the step before this one goes in front, unless a conflict has dropped all of it."""
    if _depth(observer) < 2:
        return ()
    found = (last(carry, magnitude(d)), *carry.older)[: _depth(observer) - 1]
    return _as_needed(tuple(replace(past, trusted=past.trusted & ~dropped) for past in found), observer)


def last(carry: Any, d: Any) -> Past:
    """The step before this one, with an upper bound of its input."""
    return Past(carry.y, carry.u, carry.noise, carry.believed, ~carry.starts, carry.state, _kept(carry.h), d)


def known(observer: Any, past: Past, terms: int, inputs: Any = None) -> Interval:
    """[B u + w; D u + v - y] of a step, and the bounds of inputs that have them, widened for sums; with `inputs`, a
    matrix (n + l, m) (`known_inputs`), what f and g make of u besides."""
    system = observer.system
    shift = shift_box(system, past.y, past.u, past.noise)
    if inputs is not None:
        shift = moved(inputs, past.u, shift)
    bounded = image(observer.bounded_inputs, system.input_bounds)
    lower, upper = (jnp.concatenate([getattr(box, side) for box in (shift, bounded)]) for side in ("lower", "upper"))
    return widened_for_sums(Interval.unchecked(lower, upper), terms)


def _depth(observer: Any) -> int:
    """How many steps back the rows of an observer look."""
    rows = (observer.window, observer.input_rows, *(observer.recovery or ()))
    return max((group.length for group in rows if group is not None), default=1)


def _as_needed(pasts: tuple[Past, ...], observer: Any) -> tuple[Past, ...]:
    whole = max((rows.length - 1 for rows in (observer.window, observer.input_rows) if rows is not None), default=0)
    boxes = max((rows.length - 1 for rows in observer.recovery or () if rows.anchor is not None), default=0)
    return (*pasts[:whole], *(past.measured(lag < boxes) for lag, past in enumerate(pasts[whole:], whole)))


def _kept(h: AtomBounds) -> AtomBounds:
    """Values at the center serve the certificate alone, which looks back one step."""
    return replace(h, value=None, value_error=None)
