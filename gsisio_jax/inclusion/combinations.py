"""Ranges of linear combinations, with one widening for every operand instead of one for every operation.

A multiple ``c x`` by a known number, and sums of such, are bounded by sums as they come, of operands that were widened
once, before: a side s becomes ``s -+ (kappa |s| + floor)``, whatever it is multiplied by. Every operation after that
costs one operation a side instead of five, and an operand that enters several combinations is widened once.

**Proof.** A lower bound (upper ones alike) is then what the machine makes of ``sum_j a_j w_j``, where j counts
occurrences of operands, a_j is the exact product of the constants on the way from there to the result, and w_j is the
widened side s_j of the operand that the sign of a_j asks for. With at most D roundings on any way, each ``exact (1 + a)
+ b`` with ``|a| <= eps``, ``|b| <= tiny`` (`rounding`), the machine's number is at most

    sum a_j w_j + ((1 + eps)^D - 1) sum |a_j| |w_j| + lost.

The subtraction that made w_j gives ``a_j w_j <= a_j s_j - |a_j| (kappa |s_j| + floor) (1 - 2 eps) + eps |a_j| |w_j|``,
and ``|w_j| <= (|s_j| (1 + kappa) + floor) (1 + eps)``. So it is below ``sum a_j s_j`` if ``kappa >= (D + 1) eps`` up to
second order and ``lost <= sum |a_j| floor / 2``. With D = `MOST` and kappa = ``(MOST + 4) eps`` the first holds: 3 eps
are more than ``(MOST + 4)^2 eps^2``, also in float32.

The second is counted, with numbers known while tracing: `Share` holds the roundings on the longest way (a constant that
was itself rounded counts as one), the smallest ``|a_j|``, and the largest `lost`, in units of tiny. ``c x`` loses
``|c| lost + 1``, ``x + y`` loses ``lost_x + lost_y + 1``; the floor is `rounding.FLUSHED` of them, so only constants of
extreme size are refused, and get a widening of their own. An entry multiplied by 0 is 0 and loses nothing: the smallest
``|a_j|`` is that of those which are not 0.

XLA may merge constants (a rounding of both in the place of one of the two), contract ``a b + c`` (one less), and add
the terms of one sum in any order (each of them counts as many roundings as the sum has terms).

What overflows is infinite on the wrong side or NaN, stays so in sums and products, and is "no bound" where it is
looked at (`node.normalise`).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval

MOST = 12
"""Roundings on any way from an operand to the result."""
_KAPPA = MOST + 4.0  # in eps
_START = 4.0  # tiny: what widening an operand may flush


class Share(NamedTuple):
    """What is known of a linear combination of widened operands; see above."""

    roundings: int
    least: float
    lost: float

    def holds(self) -> bool:
        enough = self.lost <= self.least * (rounding.FLUSHED / 2)
        return self.roundings <= MOST and math.isfinite(self.lost) and enough


OPERAND = Share(0, 1.0, _START)


def widened(a: Interval) -> Interval:
    """An operand, ready for linear combinations."""
    return Interval.unchecked(
        rounding.down(a.lower, _KAPPA, rounding.FLUSHED), rounding.up(a.upper, _KAPPA, rounding.FLUSHED)
    )


def times(factor: np.ndarray, share: Share | None, ulps: float) -> Share | None:
    """Share of a known factor, itself rounded where `ulps` is more than 2, times an operand or a combination."""
    size = np.abs(factor[factor != 0]).astype(float)
    if not size.size:
        return None
    before = share or OPERAND
    found = Share(
        before.roundings + (1 if ulps == 2.0 else 2),
        before.least * float(size.min()),
        before.lost * float(size.max()) + 1,
    )
    return found if found.holds() else None


def plus(x: Share, y: Share) -> Share | None:
    """Share of a sum of two."""
    found = Share(max(x.roundings, y.roundings) + 1, min(x.least, y.least), x.lost + y.lost + 1)
    return found if found.holds() else None


def together(shares: list[Share | None], terms: int) -> Share | None:
    """Share of arrays put together, with sums of so many of their entries; None where one of them has none."""
    known = [share for share in shares if share is not None]
    if len(known) < len(shares):
        return None
    added = terms if terms > 1 else 0
    found = Share(
        max(share.roundings for share in known) + added,
        min(share.least for share in known),
        max(share.lost for share in known) * max(terms, 1) + added,
    )
    return found if found.holds() else None


def scaled(factor: np.ndarray, a: Interval) -> Interval:
    """Known finite numbers times a box, to nearest; ``0 * inf = 0``."""

    def multiple(value: Any) -> Any:
        return jnp.where(factor == 0, 0, factor * value) if (factor == 0).any() else factor * value

    up = factor >= 0
    if up.all():
        return Interval.unchecked(multiple(a.lower), multiple(a.upper))
    if not up.any():
        return Interval.unchecked(multiple(a.upper), multiple(a.lower))
    return Interval.unchecked(multiple(jnp.where(up, a.lower, a.upper)), multiple(jnp.where(up, a.upper, a.lower)))


def added(x: Interval, y: Interval) -> Interval:
    """A sum to nearest."""
    return Interval.unchecked(x.lower + y.lower, x.upper + y.upper)
