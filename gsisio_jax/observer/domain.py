"""A box under contraction: intersections, what they leave, and whether one of them was empty."""

from __future__ import annotations

from functools import reduce
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.direct import entries, where
from gsisio_jax.interval.minmax import cut, raised, smaller
from gsisio_jax.observer.status import SOURCE_STRIDE, Source

_ROUNDING = 2.0**12  # gaps below this many ulps of the largest number of a step are not called contradictions


class Domain(eqx.Module):
    """A box under contraction, and the tightest intersection so far.

    Attributes:
        box: the box (n,), never crossed.
        tolerance: gaps up to this size are no contradiction. The boxes are rounded outward, so a gap is real; but the
            record may itself hold rounded numbers (noise on its bound, zero noise), which miss the plant by as much.
        gap: the smallest slack of all; below ``-tolerance`` the data contradict the stated bounds. (Apart from the
            margin, which costs nothing where nobody asks for it.)
        margin: signed slack of the first intersection that was empty (its largest gap), else the smallest slack; None
            as long as there was no intersection.
        source: which piece that was, ``Source * SOURCE_STRIDE + index``.
    """

    box: Interval
    tolerance: Any
    gap: Any
    margin: Any
    source: Any

    @classmethod
    def of(cls, box: Interval, size: Any) -> Domain:
        """Nothing intersected yet; `size` is the largest number that entered the step."""
        none = jnp.asarray(jnp.inf, box.dtype)
        return cls(box, _ROUNDING * float(jnp.finfo(box.dtype).eps) * size, none, None, None)

    def with_box(self, box: Interval) -> Domain:
        return Domain(box, self.tolerance, self.gap, self.margin, self.source)

    def record_margin(self, slack: Any, kind: Source) -> Domain:
        """Note the slacks (k,) of an intersection that leaves the box as it is; NaN (it overflowed) says nothing."""
        if not slack.shape[0]:
            return self
        first = int(kind) * SOURCE_STRIDE
        best, code, gap = np.asarray(np.inf, self.box.dtype), np.int32(first), self.gap
        # No argmin and no gather: both are slow in batches.
        for i, entry in enumerate(entries(slack)):
            code = where(entry < best, np.int32(first + i), code) if i else code
            best, gap = cut(best, entry), cut(gap, entry)
        return self._noted(best, code, gap)

    def taken(self, other: Domain) -> Domain:
        """Note what was found for another box of the same step."""
        return self if other.margin is None else self._noted(other.margin, other.source, cut(self.gap, other.gap))

    def _noted(self, margin: Any, source: Any, gap: Any) -> Domain:
        if self.margin is None:
            return Domain(self.box, self.tolerance, gap, margin, source)
        new = (margin < self.margin) & ~(self.margin < -self.tolerance)
        margin, source = where(new, margin, self.margin), where(new, source, self.source)
        return Domain(self.box, self.tolerance, gap, margin, source)

    def intersect(self, others: Interval | None, kind: Source, quiet: Interval | None = None) -> Domain:
        """Intersect the box with stacks (k, n) of boxes of the same vector, all at once.

        A side that is NaN (it overflowed) is passed over. Where others contradict the box or each other, the box stays
        what it is, and the gap is noted.

        Args:
            others: boxes; none of them crossed.
            kind: what they are.
            quiet: more boxes, whose slacks have been noted already.
        """
        box = self.box
        room: Any = jnp.asarray(jnp.inf, box.dtype)
        lower, upper = box.lower, box.upper
        if others is not None and others.lower.shape[0]:
            low, high = _meeting(others)
            lower, upper = raised(lower, low), cut(upper, high)
            room = smaller(box.upper - low, high - box.lower)
        if quiet is not None and quiet.lower.shape[0]:
            low, high = _meeting(quiet)
            lower, upper = raised(lower, low), cut(upper, high)
        if lower is box.lower or not box.shape[0]:
            return self
        width = upper - lower
        empty = width < 0
        met = Interval.unchecked(where(empty, box.lower, lower), where(empty, box.upper, upper))
        # Boxes may also miss each other where each of them meets this one.
        noted = self.record_margin(cut(room, where(empty, width, jnp.inf)), kind)
        gap = reduce(cut, entries(width), self.gap)
        return Domain(met, self.tolerance, gap, noted.margin, noted.source)

    @property
    def conflict(self) -> Any:
        """Some intersection was empty."""
        return self.gap < -self.tolerance

    def report(self) -> tuple[Any, Any]:
        """Margin and source; a gap within the tolerance counts as 0."""
        if self.margin is None:
            return jnp.asarray(jnp.inf, self.box.dtype), jnp.int32(0)
        margin = where((self.margin < 0) & (self.margin >= -self.tolerance), 0, self.margin)
        return margin, where(jnp.isinf(margin), 0, self.source)


def _meeting(boxes: Interval) -> tuple[Any, Any]:
    """Largest lower and smallest upper bound of a stack of boxes."""
    return reduce(raised, entries(boxes.lower)), reduce(cut, entries(boxes.upper))


def largest_magnitude(*values: Any) -> Any:
    """The largest finite absolute value of some arrays."""
    finite = [where(jnp.isfinite(value), jnp.abs(value), 0) for value in values]
    return jax.lax.stop_gradient(jnp.concatenate([value.ravel() for value in finite]).max(initial=0.0))
