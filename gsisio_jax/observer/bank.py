"""Linear bounds of x[k] and d[k-1]: what a design's gains and left inverses are, online; what they stand on."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp

from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.image import plain_image, widened_for_sums


class LinearBounds(eqx.Module):
    """K linear bounds of one vector (x[k], or d[k-1]), stacked: rows of weights on what is known to within a box.

        value = state x[k] + residual [f + B u + w; g + D u + v - y][k-1] + output (y - D u - v)[k]
                - remainder psi(x[k]) + bounds (bounded states) + known (bounded inputs)

    Attributes:
        residual: (K, r, n + l).
        output: (K, r, l).
        remainder: (K, r, q); for gains this is N_z.
        bounds: (K, r, s).
        known: (K, r, b).
        state: (K, r, n), or None where x[k] itself does not enter.

    Source: theory 3.1 (identity (*)) and 7.
    """

    residual: Any
    output: Any
    remainder: Any
    bounds: Any
    known: Any
    state: Any = None

    def linear(self, terms: Terms) -> Interval:
        """The terms that are linear in boxes known beforehand, (K, r): noise, measurements, state and input bounds.
        NaN where it overflows."""
        weights = jnp.concatenate([self.residual, self.output, self.bounds, self.known], -1)
        boxes = (terms.shift, terms.output, terms.bounds, terms.known)
        lower = jnp.concatenate([box.lower for box in boxes])
        joined = Interval.unchecked(lower, jnp.concatenate([box.upper for box in boxes]))
        return plain_image(weights, widened_for_sums(joined, weights.shape[-1]))


class CancellationResidual(eqx.Module):
    """Upper bounds of what the bounds of a `LinearBounds` leave, by rounding, of what they do not know.

    Attributes:
        x: (K, r, n), of x[k].
        d: (K, r, p), of d[k-1].
    """

    x: Any
    d: Any


class Terms(eqx.Module):
    """Boxes that enter a `LinearBounds` linearly.

    Attributes:
        shift: (n + l,) of [B u + w; D u + v - y] one step before.
        output: (l,) of (y - D u - v) now.
        bounds: (s,) bounds of the states that have two.
        known: (b,) bounds of the inputs that have them.
    """

    shift: Interval
    output: Interval
    bounds: Interval
    known: Interval


class Known(NamedTuple):
    """What a step knows without any box of x: shared by all boxes that see the same record and noise.

    Attributes:
        terms: boxes that enter gains and left inverses linearly.
        right, inputs: their part of the bounds of x[k], (K, n), and of d[k-1], (K, p).
        z: box (q,) of T2 (y - D u - v).
    """

    terms: Terms
    right: Interval
    inputs: Interval
    z: Interval
