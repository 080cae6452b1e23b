"""Affine abstraction (paper, Prop. 1): the linear program over the vertices, sigma, and the proof of its planes.

Planes that hold at the vertices of a box hold everywhere on it once moved apart by sigma: any x of the box is a mean
of vertices (weights p_v), so ``f(x) - A x - e <= f(x) - sum p_v f(v)``, and sigma bounds that interpolation error.
sigma only moves planes that touch f at the vertices, so the program is solved without it. A constant sigma knows
nothing of where f bends; bounds of f on sub-boxes do, and replace it where they prove less.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.design.gains import solve
from gsisio_jax.inclusion import UnknownPrimitiveError, affine, jacobian
from gsisio_jax.inclusion.planes import Abstraction
from gsisio_jax.interval.box import Interval

_MAX_STATES, _MAX_VERTICES = 12, 2**16
_BATCH = 1024  # boxes per call of a compiled function
_COLUMNS = 2**14  # entries of the vertex table per linear program
_CLOSE = 1e-3  # the proof stops within this share of the gap
_ROUNDING = 16 * np.finfo(float).eps  # of the planes' evaluation, in units of the largest number in it
_VIOLATION = 1e-9  # beyond sigma by this share of the largest number is no rounding
_REMEDIES = 'give `constant`, or take another class: "Lipschitz" where f has kinks, "C0" with the modulus of continuity'


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
        raise _error(f'`smoothness` must be "C0", "Lipschitz", "C1" or "C2", got {smoothness!r}')
    if slopes not in ("free", "zero"):
        raise _error(f'`slopes` must be "free" or "zero", got {slopes!r}')
    lower, upper, single = _cells(region, mesh)
    with jax.enable_x64(True):
        signs = np.array(list(itertools.product([-1.0, 1.0], repeat=lower.shape[1])))
        corners = np.where(signs > 0, upper[:, None, :], lower[:, None, :])
        values = _values_at(f, corners)
        m = values.shape[-1]
        if sigma is None:
            sigma = _sigma(f, lower, upper, smoothness, constant, m, tighten)
        else:
            sigma = np.broadcast_to(_amount("sigma", sigma, m), (len(lower), m))
        planes = _planes(corners, values, signs, upper - lower, slopes, sigma)
        theta = _gap(planes, corners)
        try:
            seen, proved = _prove(f, Interval(lower, upper), planes, sigma, theta, tighten, budget)
        except UnknownPrimitiveError:  # only where sigma comes from the user: its enclosure would have failed, too
            seen, proved = np.zeros(planes.offset.shape), np.full(planes.offset.shape, np.inf)
    most, rounding = sigma[:, None], planes.rounding[:, None]
    # What was seen is 0 at least (the planes touch f), and beyond sigma only by rounding.
    widening = np.maximum(np.minimum(proved, most) if tighten else most, seen)
    planes = planes._replace(offset=planes.offset + widening + rounding)
    slope, offset = planes.slope, planes.offset
    parts: Any = (
        lower, upper, -slope[:, 1], slope[:, 0], -offset[:, 1], offset[:, 0], theta, sigma.copy(), _gap(planes, corners)
    )  # fmt: skip
    low, high, *rest = (part[0] if single else part for part in parts)
    verified = "engine" if (proved <= most + rounding).all() else "sigma"
    return Abstraction(Interval(low, high), *rest, verified=verified)


class _Planes(NamedTuple):
    """Planes above f, then planes above -f: slope (cells, 2, m, n) and offset (cells, 2, m)."""

    slope: np.ndarray
    offset: np.ndarray
    rounding: np.ndarray  # (cells, m), what evaluating them in float64 may lose


def _error(text: str) -> ValueError:
    return ValueError(f"affine_abstraction: {text}")


def _cells(region: Any, mesh: Any) -> tuple[np.ndarray, np.ndarray, bool]:
    """Lower and upper corners (cells, n) of the mesh, and whether it is the region itself."""
    if not isinstance(region, Interval) or len(region.shape) != 1 or not region.shape[0]:
        raise _error(f"`region` must be an Interval of shape (n,) with n >= 1, got {getattr(region, 'shape', region)}")
    low, high = np.asarray(region.lower, np.float64), np.asarray(region.upper, np.float64)
    n = len(low)
    good = np.isfinite(high - low) & (low <= high)
    if not good.all():
        i = int(np.argmin(good))
        raise _error(f"`region` must be finite with lower <= upper, got [{low[i]}, {high[i]}] in component {i}")
    if n > _MAX_STATES:
        raise _error(
            f"`region` has n = {n} components, at most {_MAX_STATES} are allowed (2^n vertices); bound the components "
            "of f that depend on fewer variables apart, or use inclusion.affine"
        )
    counts = np.broadcast_to(mesh, (n,)) if np.ndim(mesh) == 0 or np.shape(mesh) == (n,) else np.zeros(n)
    if counts.dtype.kind not in "iu" or (counts < 1).any():
        raise _error(f"`mesh` must be a positive integer or {n} of them, got {mesh!r}")
    counts = np.where(high > low, counts, 1)
    vertices = float(np.prod(counts, dtype=float)) * 2**n
    if vertices > _MAX_VERTICES:
        raise _error(f"`mesh` {mesh!r} makes {vertices:.0f} vertices, allowed are {_MAX_VERTICES}; make it coarser")
    edges = [np.linspace(a, b, count + 1) for a, b, count in zip(low, high, counts, strict=True)]
    lower = np.array(list(itertools.product(*(edge[:-1] for edge in edges))))
    upper = np.array(list(itertools.product(*(edge[1:] for edge in edges))))
    return lower, upper, len(lower) == 1


def _amount(name: str, value: Any, m: int) -> np.ndarray:
    try:
        number = np.broadcast_to(np.asarray(value, np.float64), (m,))
    except (TypeError, ValueError):
        number = np.full(m, np.nan)
    if not (number >= 0).all() or not np.isfinite(number).all():
        raise _error(f"`{name}` must be a nonnegative number or {m} of them, got {value!r}")
    return number


# Bounds on many boxes -------------------------------------------------------------------------------------------------
_QUESTIONS: dict[str, Callable[[Any, Interval], Any]] = {
    "value": lambda f, box: f(box.lower),
    "bounds": lambda f, box: (affine(f)(box), f(0.5 * box.lower + 0.5 * box.upper)),
    "first": lambda f, box: (jacobian(f)(box), None),
    "second": lambda f, box: (jacobian(f)(box), jacobian(jax.jacfwd(f))(box)),
}
# jit keeps what is compiled for as long as f lives: a second mesh costs no second compilation. That is what takes
# the time here, so it is done without optimisation.
_filter_jit: Any = eqx.filter_jit


@_filter_jit(compiler_options={"xla_backend_optimization_level": 0})
def _compiled(question: str, f: Any, lower: Any, upper: Any) -> Any:
    return jax.vmap(lambda a, b: _QUESTIONS[question](f, Interval.unchecked(a, b)))(lower, upper)


def _on_boxes(question: str, f: Any, lower: np.ndarray, upper: np.ndarray, size: int = _BATCH) -> Any:
    """Results on all boxes (boxes, n), as NumPy arrays; in batches of one size, the last one filled up."""
    parts = []
    for start in range(0, len(lower), size):
        index = np.minimum(np.arange(start, start + size), len(lower) - 1)
        parts.append(_compiled(question, f, lower[index], upper[index]))
    return jax.tree.map(lambda *rows: np.concatenate(rows)[: len(lower)], parts[0], *parts[1:])


def _values_at(f: Any, corners: np.ndarray) -> np.ndarray:
    """f at the vertices of all cells (cells, vertices, m)."""
    flat = corners.reshape(-1, corners.shape[-1])
    out = jax.eval_shape(f, flat[0])
    if len(getattr(out, "shape", ())) != 1 or not jnp.issubdtype(out.dtype, jnp.floating):
        raise _error(f"f must map an array {flat.shape[1:]} to a floating array (m,), got {out}; jnp.ravel its result")
    found = _on_boxes("value", f, flat, flat)
    if not np.isfinite(found).all():
        where, i = np.argwhere(~np.isfinite(found))[0]
        raise _error(f"component {i} of f is {found[where, i]} at the vertex {flat[where]}; take a smaller region")
    return found.reshape(*corners.shape[:2], -1)


# sigma ----------------------------------------------------------------------------------------------------------------
def _sigma(
    f: Any, lower: np.ndarray, upper: np.ndarray, smoothness: str, constant: Any, m: int, tighten: bool
) -> np.ndarray:
    """sigma per cell and component (cells, m)."""
    half = 0.5 * (upper - lower)
    delta = np.linalg.norm(half, axis=1)[:, None]
    if smoothness == "C0":
        if not callable(constant):
            raise _error(
                f'smoothness="C0" needs `constant`, a function omega with |f(x) - f(y)| <= omega(|x - y|), got '
                f'{constant!r}; smoothness="Lipschitz" needs no constant'
            )
        return 2 * np.array([_amount("constant(delta)", constant(float(d)), m) for d in delta[:, 0]])
    if constant is not None:
        number = _amount("constant", constant, m)
        return number * delta if smoothness != "C2" else 0.5 * number * delta**2
    first, second = _enclosed_derivatives(f, lower, upper, smoothness == "C2")
    moving = (half > 0)[:, None, :]
    size = _magnitude(first, moving, "the derivative", smoothness)
    if second is None:
        # |f(x) - f(v)| <= sum |f'_j| |x_j - v_j|, of mean at most half_j; a common slope of f and both planes is free.
        printed = np.linalg.norm(size, axis=-1) * delta
        sharp = np.einsum("kij,kj->ki", np.where(moving, first.radius, 0.0), half)
    else:
        size = _magnitude(second, moving[..., None] & moving[..., None, :], "the second derivative", smoothness)
        # The norm of a matrix is at most that of its magnitudes; the second form does not depend on the units of x.
        printed = 0.5 * np.linalg.norm(size, 2, axis=(-2, -1)) * delta**2
        sharp = 0.5 * np.einsum("kj,kijl,kl->ki", half, size, half)
    return np.minimum(printed, sharp) if tighten else printed


def _enclosed_derivatives(f: Any, lower: np.ndarray, upper: np.ndarray, second: bool) -> tuple[Any, Any]:
    obstacle = _foreign_rule(jax.make_jaxpr(f)(lower[0]).jaxpr) if second else None
    if obstacle is not None:
        raise _error(f"f uses {obstacle}, so JAX's second derivative may not be the true one; {_REMEDIES}")
    try:
        return _on_boxes("second" if second else "first", f, lower, upper, size=64)
    except (TypeError, ValueError, NotImplementedError) as error:
        raise _error(f"the derivatives of f cannot be enclosed ({error}); {_REMEDIES}") from error


def _magnitude(box: Interval, moving: np.ndarray, what: str, smoothness: str) -> np.ndarray:
    """Largest magnitude in each enclosure, 0 along axes on which the cell has no width."""
    size = np.where(moving, np.maximum(np.abs(box.lower), np.abs(box.upper)), 0.0)
    if not np.isfinite(size).all():
        cell, i = np.argwhere(~np.isfinite(size))[0][:2]
        raise _error(
            f'smoothness="{smoothness}" needs {what} bounded, but that of component {i} has no finite bound on cell '
            f"{cell} (a kink, a jump, a pole, or a box too large for the bounds); {_REMEDIES}"
        )
    return size


def _foreign_rule(jaxpr: Any) -> str | None:
    """What makes JAX differentiate something other than f: a custom rule that is not JAX's own, or stop_gradient."""
    home = f" at {os.path.dirname(jax.__file__)}"
    for eqn in jaxpr.eqns:
        name, values = eqn.primitive.name, list(eqn.params.values())
        infos = [getattr(getattr(value, "jaxpr", value), "debug_info", None) for value in values]
        sources = [getattr(info, "func_src_info", None) or "" for info in infos if info is not None]
        if name == "stop_gradient":
            return "stop_gradient"
        if name.startswith("custom_") and not (sources and all(home in source for source in sources)):
            return f"a custom derivative rule ({', '.join(sources)})"
        nested = [getattr(v, "jaxpr", v) for value in values for v in (value if isinstance(value, tuple) else [value])]
        for inner in nested:
            if hasattr(inner, "eqns") and (found := _foreign_rule(inner)) is not None:
                return found
    return None


# The linear program ---------------------------------------------------------------------------------------------------
def _planes(
    corners: np.ndarray, values: np.ndarray, signs: np.ndarray, width: np.ndarray, slopes: str, sigma: np.ndarray
) -> _Planes:
    """Planes that hold at the vertices and touch there."""
    (cells, vertices, n), m = corners.shape, values.shape[-1]
    slope = np.zeros((cells, 2, m, n))
    if slopes == "free":
        # On the cube [-1, 1]^n all cells share one program matrix; one column per cell and component.
        flat = values.transpose(1, 0, 2).reshape(vertices, cells * m)
        up, low = _best_slopes(signs, flat)
        half = 0.5 * width[:, None, None, :]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            slope = np.stack([part.T.reshape(cells, m, n) for part in (up, -low)], axis=1) / half
        slope = np.where(half == 0, 0.0, slope)
    if not np.isfinite(slope).all():
        raise _error("the slopes overflow, the region is too small for the change of f on it; give a wider region")
    # Only the slopes are the solver's: the offsets are evaluated, so that the planes hold at every vertex.
    offset = (np.stack([values, -values], axis=1) - np.einsum("isjk,ivk->isvj", slope, corners)).max(axis=2)
    size = np.einsum("isjk,ik->isj", np.abs(slope), np.abs(corners).max(1)).max(1)
    return _Planes(slope, offset, _ROUNDING * (np.abs(values).max(1) + size + sigma))


def _best_slopes(signs: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Slopes (n, columns) of the planes above and below with the smallest gap at the vertices of the cube."""
    spread = np.maximum(values.max(0) - values.min(0), np.finfo(float).tiny)
    scaled = (values - values.mean(0)) / spread
    # Least squares are exact for affine functions, where an interior-point method is not.
    up = signs.T @ scaled / len(signs)
    low, theta = up.copy(), _cube_gap(signs, scaled, up, up)
    hard = np.flatnonzero(theta > 1e-12)
    share = max(1, _COLUMNS // len(signs))
    for columns in (hard[start : start + share] for start in range(0, len(hard), share)):
        found = _solve(signs, scaled[:, columns])
        better = _cube_gap(signs, scaled[:, columns], *found) < theta[columns]
        up[:, columns] = np.where(better, found[0], up[:, columns])
        low[:, columns] = np.where(better, found[1], low[:, columns])
    return up * spread, low * spread


def _solve(signs: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(eq:abstraction) with sigma = 0, one program for many columns that share nothing but the vertices."""
    import cvxpy as cp

    table = np.column_stack([signs, np.ones(len(signs))])
    above, below = (cp.Variable((table.shape[1], values.shape[1])) for _ in range(2))
    theta = cp.Variable((1, values.shape[1]))
    constraints: list[Any] = [
        table @ above >= values,
        table @ below <= values,
        table @ (above - below) <= np.ones((len(signs), 1)) @ theta,
    ]
    if not solve(cp.Problem(cp.Minimize(cp.sum(theta)), constraints)) or above.value is None or below.value is None:
        raise _error("the solver failed on the linear program; rescale f and x to similar magnitudes")
    return above.value[:-1], below.value[:-1]


def _cube_gap(signs: np.ndarray, values: np.ndarray, up: np.ndarray, low: np.ndarray) -> np.ndarray:
    """theta of these slopes, with the best offsets: evaluated, not taken from the solver."""
    above, below = signs @ up, signs @ low
    return (above - below).max(0) + (values - above).max(0) + (below - values).max(0)


def _gap(planes: _Planes, corners: np.ndarray) -> np.ndarray:
    """Largest distance of the two planes on each cell (cells, m); it is reached at a vertex."""
    height = np.einsum("ijk,ivk->ivj", planes.slope.sum(1), corners) + planes.offset.sum(1)[:, None, :]
    return np.maximum(height.max(1), 0.0)


# The proof ------------------------------------------------------------------------------------------------------------
def _prove(
    f: Any, cells: Interval, planes: _Planes, sigma: np.ndarray, theta: np.ndarray, tighten: bool, budget: int
) -> tuple[np.ndarray, np.ndarray]:
    """How far f leaves the planes (cells, 2, m): as seen at points, and as proved on the whole cell.

    Branch and bound on all cells at once: what may still hold the largest excess is split, until that is known.
    """
    seen, proved = np.zeros(planes.offset.shape), np.full(planes.offset.shape, -np.inf)
    most, rounding = sigma[:, None], planes.rounding[:, None]
    scale = np.where(cells.width > 0, cells.width, np.inf)
    low, high, cell = cells.lower, cells.upper, np.arange(len(sigma))
    left = np.full(len(sigma), budget - 1)
    while len(cell):
        bound, value = _leaving(f, low, high, planes.slope[cell], planes.offset[cell])
        _refuse_violation(value, (most + _VIOLATION / _ROUNDING * rounding)[cell], low, high)
        np.maximum.at(seen, cell, value)
        enough = seen + _CLOSE * (seen.sum(1) + theta)[:, None] if tighten else most
        # The bounds of f may be rounded outward by more than the planes are.
        missing = (bound - (enough + 64 * rounding)[cell]).max(axis=(1, 2))
        rows = np.arange(len(cell))
        axis = np.argmax((high - low) / scale[cell], axis=1)
        cut = (0.5 * low + 0.5 * high)[rows, axis]
        chosen = (missing > 0) & (low[rows, axis] < cut) & (cut < high[rows, axis])
        # What is left of a cell's budget goes to its worst boxes.
        order = np.lexsort((-missing, ~chosen, cell))
        rank = rows - np.searchsorted(cell[order], cell[order])
        chosen[order] &= 2 * (rank + 1) <= left[cell[order]]
        np.maximum.at(proved, cell[~chosen], bound[~chosen])
        low, high, cell, axis, cut = low[chosen], high[chosen], cell[chosen], axis[chosen], cut[chosen]
        np.subtract.at(left, cell, 2)
        first, second = high.copy(), low.copy()
        first[np.arange(len(cell)), axis] = second[np.arange(len(cell)), axis] = cut
        low, high, cell = np.concatenate([low, second]), np.concatenate([first, high]), np.concatenate([cell, cell])
    return seen, proved


def _leaving(f: Any, low: np.ndarray, high: np.ndarray, slope: np.ndarray, offset: np.ndarray) -> tuple[Any, Any]:
    """Upper bounds of ``f - plane`` and ``plane' - f`` on boxes (boxes, 2, m), and their values at the centers."""
    form, at = _on_boxes("bounds", f, low, high)
    bound, value = np.empty_like(offset), np.empty_like(offset)
    a, b, center = low[:, None, :], high[:, None, :], 0.5 * low + 0.5 * high
    tops = (1, form.offset.upper, form.range.upper), (-1, -form.offset.lower, -form.range.lower)
    for side, (sign, form_top, top) in enumerate(tops):
        plane, tilt = slope[:, side], sign * form.slope - slope[:, side]
        by_form = form_top + np.where(tilt > 0, tilt * b, tilt * a).sum(-1)
        bound[:, side] = np.fmin(by_form, top - np.where(plane > 0, plane * a, plane * b).sum(-1))
        value[:, side] = sign * at - np.einsum("bij,bj->bi", plane, center)
    return np.where(np.isnan(bound), np.inf, bound) - offset, value - offset


def _refuse_violation(value: np.ndarray, allowed: np.ndarray, low: np.ndarray, high: np.ndarray) -> None:
    if not (value <= allowed).all():
        box, side, i = np.argwhere(~(value <= allowed))[0]
        raise _error(
            f"at x = {0.5 * low[box] + 0.5 * high[box]} component {i} of f is {value[box, side, i]:.6g} "
            f"{('above', 'below')[side]} the plane through the vertices, where sigma = {allowed[box, 0, i]:.6g} was "
            "promised; give a larger `constant` or `sigma`, or the smoothness class that f has"
        )
