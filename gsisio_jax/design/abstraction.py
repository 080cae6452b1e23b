"""Affine abstraction (paper, Prop. 1): the linear program over the vertices, sigma, and the proof of its planes.

Planes that hold at the vertices of a box hold everywhere on it once moved apart by sigma: any x of the box is a mean
of vertices (weights p_v), so ``f(x) - A x - e <= f(x) - sum p_v f(v)``, and sigma bounds that interpolation error.
sigma only moves planes that touch f at the vertices, so the program is solved without it. A constant sigma knows
nothing of where f bends; bounds of f on sub-boxes do, and replace it where they prove less.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, Literal

import jax
import numpy as np

from gsisio_jax._calls import named_arguments
from gsisio_jax.design.abstraction_program import gap, planes_at_vertices
from gsisio_jax.design.abstraction_proof import prove
from gsisio_jax.design.abstraction_sigma import amount, refusal, sigma_of, values_at, with_hash
from gsisio_jax.inclusion import UnknownPrimitiveError
from gsisio_jax.inclusion.planes import Abstraction
from gsisio_jax.interval.box import Interval

_MAX_STATES, _MAX_VERTICES = 12, 2**16


@named_arguments
def affine_abstraction(
    f: Callable[[Any], Any],
    region: Interval,
    smoothness: Literal["C0", "Lipschitz", "C1", "C2"] = "C2",
    constant: Any = None,
    slopes: Literal["free", "zero"] = "free",
    mesh: int | tuple[int, ...] = 1,
    sigma: Any = None,
    tighten: bool = True,
    budget: int = 2000,
) -> Abstraction:
    """Two planes that enclose f on a region, as close as the linear program of Prop. 1 can make them.

    Every component of f has a program of its own, which is never worse than the paper's common theta. With
    delta the distance from the center of a cell to its corners, sigma is ``2 omega(delta)`` for C0 (omega: modulus of
    continuity), ``L delta`` for Lipschitz and C1 (L: Lipschitz constant, largest norm of f'), and
    ``M delta^2 / 2`` for C2 (M: largest norm of f''), each per component.

    Args:
        f: takes an array of shape (n,), returns one of shape (m,).
        region: finite box (n,), n <= 12; where its width is zero the slopes are 0.
        smoothness: the class that sigma is computed for.
        constant: omega (a function of a distance) for C0; else L or M, a number or shape (m,), valid on the region.
            None computes it per cell from enclosures of the derivatives (not for C0; C2: no custom rules in f).
        slopes: "zero" makes the planes constant, the paper's way to bound derivatives.
        mesh: cells per axis, an integer or shape (n,); planes for each cell.
        sigma: a number or shape (m,) instead of the one computed, units [f].
        tighten: widen each plane by what bounds of f on sub-boxes prove, if less than sigma; False: sigma, as printed.
        budget: sub-boxes per cell that the proof may look at.

    Returns:
        An `Abstraction` with float64 NumPy arrays.

    Raises:
        ValueError: the region is infinite or has too many vertices, f is not finite at a vertex, no sigma of this
            class exists, f lies outside planes that the given constant promises, or the solver failed.

    >>> planes = affine_abstraction(lambda x: x * x, Interval([1.0], [3.0]))
    >>> planes.upper_slope.tolist(), planes.over(Interval([1.0], [3.0])).upper.round(6).tolist()
    ([[4.0]], [9.0])

    Source: paper, Prop. 1, (eq:abstraction) and Cor. 1; theory 9.
    """
    if smoothness not in ("C0", "Lipschitz", "C1", "C2"):
        raise refusal(f'`smoothness` must be "C0", "Lipschitz", "C1" or "C2", got {smoothness!r}')
    if slopes not in ("free", "zero"):
        raise refusal(f'`slopes` must be "free" or "zero", got {slopes!r}')
    lower, upper, single = _cells(region, mesh)
    f = with_hash(f)
    with jax.enable_x64(True):
        signs = np.array(list(itertools.product([-1.0, 1.0], repeat=lower.shape[1])))
        corners = np.where(signs > 0, upper[:, None, :], lower[:, None, :])
        values = values_at(f, corners)
        m = values.shape[-1]
        if sigma is None:
            sigma = sigma_of(f, lower, upper, smoothness, constant, m, tighten)
        else:
            sigma = np.broadcast_to(amount("sigma", sigma, m), (len(lower), m))
        planes = planes_at_vertices(corners, values, signs, upper - lower, slopes, sigma)
        theta = gap(planes, corners)
        try:
            seen, proved = prove(f, Interval(lower, upper), planes, sigma, theta, tighten, budget)
        except UnknownPrimitiveError:  # only where sigma comes from the user: its enclosure would have failed, too
            seen, proved = np.zeros(planes.offset.shape), np.full(planes.offset.shape, np.inf)
    most, rounding = sigma[:, None], planes.rounding[:, None]
    # What was seen is 0 at least (the planes touch f), and beyond sigma only by rounding.
    widening = np.maximum(np.minimum(proved, most) if tighten else most, seen)
    planes = planes._replace(offset=planes.offset + widening + rounding)
    slope, offset = planes.slope, planes.offset
    parts: Any = (
        lower, upper, -slope[:, 1], slope[:, 0], -offset[:, 1], offset[:, 0], theta, sigma.copy(), gap(planes, corners)
    )  # fmt: skip
    low, high, *rest = (part[0] if single else part for part in parts)
    verified = "engine" if (proved <= most + rounding).all() else "sigma"
    return Abstraction(Interval(low, high), *rest, verified=verified)


def _cells(region: Any, mesh: Any) -> tuple[np.ndarray, np.ndarray, bool]:
    """Lower and upper corners (cells, n) of the mesh, and whether it is the region itself."""
    if not isinstance(region, Interval) or len(region.shape) != 1 or not region.shape[0]:
        got = f"a box of shape {region.shape}" if isinstance(region, Interval) else type(region).__name__
        raise refusal(f"`region` must be an Interval of shape (n,) with n >= 1, got {got}")
    low, high = np.asarray(region.lower, np.float64), np.asarray(region.upper, np.float64)
    n = len(low)
    good = np.isfinite(high - low) & (low <= high)
    if not good.all():
        i = int(np.argmin(good))
        raise refusal(f"`region` must be finite with lower <= upper, got [{low[i]}, {high[i]}] in component {i}")
    if n > _MAX_STATES:
        raise refusal(
            f"`region` has n = {n} components, at most {_MAX_STATES} are allowed (2^n vertices); bound the components "
            "of f that depend on fewer variables apart, or use inclusion.affine"
        )
    counts = np.broadcast_to(mesh, (n,)) if np.ndim(mesh) == 0 or np.shape(mesh) == (n,) else np.zeros(n)
    if counts.dtype.kind not in "iu" or (counts < 1).any():
        raise refusal(f"`mesh` must be a positive integer or {n} of them, got {mesh!r}")
    counts = np.where(high > low, counts, 1)
    vertices = float(np.prod(counts, dtype=float)) * 2**n
    if vertices > _MAX_VERTICES:
        raise refusal(f"`mesh` {mesh!r} makes {vertices:.0f} vertices, allowed are {_MAX_VERTICES}; make it coarser")
    edges = [np.linspace(a, b, count + 1) for a, b, count in zip(low, high, counts, strict=True)]
    lower = np.array(list(itertools.product(*(edge[:-1] for edge in edges))))
    upper = np.array(list(itertools.product(*(edge[1:] for edge in edges))))
    return lower, upper, len(lower) == 1
