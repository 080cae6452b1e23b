"""Where a region is cut, so that a certificate counts slopes part by part: most where they vary (theory 6)."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np

from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.reading import is_whole
from gsisio_jax.observer.certificate import Certificate
from gsisio_jax.observer.enclosures import Slopes
from gsisio_jax.observer.slice_bounds import slices_of
from gsisio_jax.observer.slices import Slices
from gsisio_jax.plant.system import Noise

_FINE = 2  # thin slices for every one that is kept
_COUNTS = (4, 8, 16)  # that split="auto" tries
_GAIN = 0.98  # share of a width below which more slices are worth their operations


def check_split(split: Any, form: str) -> None:
    """Raises ValueError where `split` is no number of slices, or goes with nothing."""
    whole = is_whole(split)
    if not (whole and split >= 1) and not (isinstance(split, str) and split == "auto"):
        raise ValueError(f'design_observer: `split` must be a number of slices, at least 1, or "auto", got {split!r}')
    if form == "prediction" and split != 1:
        raise ValueError(
            f"design_observer: `split` must be 1 in the prediction form, which has no such promise, got {split!r}"
        )


def with_slices(
    certificate: Certificate,
    noise: Noise,
    weights: np.ndarray,
    slopes_on: Callable[[Interval], Slopes],
    region: Interval,
    split: int | str,
) -> Certificate:
    """The certificate that counts slopes slice by slice; as it was, where these vary along no state.

    Args:
        certificate: of the design.
        noise: of the design.
        weights: rows of the certified gain on [f; g], (n, n + l).
        slopes_on: from `slopes_of`.
        region: of the design.
        split: number of slices of a state, or "auto".
    """
    counts = _COUNTS if isinstance(split, str) else (int(split),)
    thin = slices_of(weights, slopes_on, _even_edges(slopes_on(region), region, _FINE * counts[-1]), np.float64)
    if not _varies(thin).any():
        return certificate
    best = certificate
    for count in counts:
        found = certificate.with_slices(_merged(thin, count), noise)
        before, after = (np.asarray(one.steady_width) for one in (best, found))
        if best.slices is not None and not (after < _GAIN * before).any():
            break
        best = found
    return best


def what_split_gives(
    certificate: Certificate,
    noise: Noise,
    weights: np.ndarray,
    slopes_on: Callable[[Interval], Slopes],
    region: Interval,
) -> str:
    """For an empty certificate: that a few slices would make it say something, as a note; "" where they do not. More
    are not tried, as every design with an empty certificate would wait for them."""
    found = with_slices(certificate, noise, weights, slopes_on, region, _COUNTS[0])
    if found.slices is None or not found.self_consistent:
        return ""
    widths = ", ".join(f"{width:.3g}" for width in np.asarray(found.steady_width))
    return (
        f"with split={_COUNTS[0]} it is not empty: slopes count part by part of the region, and widths settle at or "
        f"below {widths}"
    )


def _even_edges(slopes: Slopes, region: Interval, count: int) -> np.ndarray:
    """Edges of slices of one length, for the states along which slopes may vary; one slice for all others."""
    lower, upper = (np.asarray(side, np.float64) for side in (region.lower, region.upper))
    edges = np.repeat(upper[:, None], count + 1, 1)
    edges[:, 0] = lower
    if slopes.affine:
        return edges
    for j in np.flatnonzero(np.isfinite(upper - lower)):
        edges[j] = np.linspace(lower[j], upper[j], count + 1)
        edges[j, 0], edges[j, -1] = lower[j], upper[j]
    return edges


def _varies(slices: Slices) -> np.ndarray:
    """States along which a slope differs from slice to slice, (n,)."""
    used = (slices.edges[:, 1:] > slices.edges[:, :-1])[None]
    sides = (slices.rising, slices.falling)
    spread = [np.where(used, d, -np.inf).max(-1) - np.where(used, d, np.inf).min(-1) for d in sides]
    return (np.maximum(*spread) > 1e-9 * np.maximum(*sides).max(initial=0.0)).any(0)


def _merged(thin: Slices, count: int) -> Slices:
    """At most so many slices a state: neighbours with the most alike slopes are joined, at the larger one."""
    n, r = len(thin.edges), len(thin.rising)
    edges = np.repeat(thin.edges[:, -1:], count + 1, 1)
    densities = np.zeros((2, r, n, count))
    for j in range(n):
        ends = list(thin.edges[j])
        parts = list(np.stack([thin.rising[:, j], thin.falling[:, j]]).transpose(2, 0, 1))
        lengths = [b - a if b > a else 0.0 for a, b in pairwise(ends)]
        while len(parts) > count:
            joined = [np.maximum(a, b) for a, b in pairwise(parts)]
            costs = [
                (lengths[s] * (joined[s] - parts[s]) + lengths[s + 1] * (joined[s] - parts[s + 1])).sum()
                if lengths[s] and lengths[s + 1] else -np.inf
                for s in range(len(joined))
            ]  # fmt: skip
            s = int(np.argmin(costs))
            parts[s : s + 2], lengths[s : s + 2] = [joined[s]], [lengths[s] + lengths[s + 1]]
            del ends[s + 1]
        edges[j, : len(ends)] = ends
        densities[:, :, j, : len(parts)] = np.stack(parts).transpose(1, 2, 0)
    return Slices(edges, densities[0], densities[1])
