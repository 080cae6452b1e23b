"""Lemma 2: how much wider than a box the bounds of f and g on it can be, as printed and as corrected.

Printed: one constant per map, ``L_q + 2 ||C_q||``. Its proof evaluates every row of the decomposition function at one
and the same point z, but the cases differ from row to row, so each row has its own. Counterexample (linear, so C = 0):
``q(x) = (x1 + x2, x1 - x2)`` has L_q = sqrt(2), yet on [0, 1]^2 the exact bounds are (2, 2) wide, and 2 sqrt(2) is
more than sqrt(2) ||(1, 1)|| = 2. Corrected: elementwise, ``width of q <= W_q (width of the box)``, and ``||W_q||`` for
norms.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax import inclusion
from gsisio_jax._calls import named_arguments
from gsisio_jax.inclusion.mixed_monotone import decomposition_gain, width_gain
from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.reading import check_type
from gsisio_jax.plant.system import System
from gsisio_jax.scalar.numpy_program import numpy_function

_BATCH = 64  # boxes per call of the engine: one shape, one trace
_ROUNDS = 400
_ROUNDING = 1e-14  # relative error allowed to a computed norm
_VERTICES = 6  # up to 2^6 vertices of an interval matrix are tried; beyond that center plus radius


class LipschitzConstants(NamedTuple):
    """Constants of Lemma 2 on a region.

    Attributes:
        L_f, L_g: upper bounds of the Lipschitz constants (2-norm) of f and g, proved by the engine.
        L_f_attained, L_g_attained: lower bounds, attained up to rounding; the truth lies in between.
        df, dg: enclosures of the Jacobians, (n, n) and (l, n).
        C_f, C_g: matrices of the decomposition functions, ``q_d(x, y) = q(z) + C_q (x - y)``; nonnegative.
        W_f, W_g: elementwise width gains, nonnegative; the corrected Lemma 2.

    Source: paper, Lemma 2 and (eq:decompconstruct); theory 2.11.
    """

    L_f: float
    L_g: float
    L_f_attained: float
    L_g_attained: float
    df: Interval
    dg: Interval
    C_f: np.ndarray
    C_g: np.ndarray
    W_f: np.ndarray
    W_g: np.ndarray

    @property
    def L_fd(self) -> float:
        """``L_f + 2 ||C_f||`` as printed: no bound in general."""
        return self.L_f + 2 * spectral_norm(self.C_f)

    @property
    def L_gd(self) -> float:
        """``L_g + 2 ||C_g||`` as printed: no bound in general."""
        return self.L_g + 2 * spectral_norm(self.C_g)

    @property
    def L_fd_corrected(self) -> float:
        """``||W_f||``: ``||f_d(x, y) - f_d(y, x)|| <= ||W_f|| ||x - y||``."""
        return spectral_norm(self.W_f)

    @property
    def L_gd_corrected(self) -> float:
        """``||W_g||``."""
        return spectral_norm(self.W_g)


class PrintedNumbers(NamedTuple):
    """Every number that the section "Illustrative Example" prints about its constants (epsilon set to 0)."""

    df: Interval
    dg: Interval
    L_f: float
    L_g: float
    C_f: np.ndarray
    C_g: np.ndarray
    L_fd: float
    L_gd: float
    K: np.ndarray
    L: np.ndarray
    contraction: float


PRINTED = PrintedNumbers(
    df=Interval([[0.38, -0.52], [-0.2, -0.14]], [[0.82, 0.21], [-0.2, -0.14]]),
    dg=Interval([[-0.04, 0.49], [-1.0, 0.0]], [[0.44, 0.81], [1.0, 0.0]]),
    L_f=0.35,
    L_g=0.74,
    C_f=np.array([[0.251, 0.0], [0.0029, 0.201]]),
    C_g=np.array([[0.0, 0.225], [-0.374, -0.045]]),
    L_fd=0.852,
    L_gd=1.19,
    K=np.array([[0.0267, 0.0, 0.0666, 0.1061], [0.4177, 2.1203, 1.0817, 2.0209]]),
    L=np.array([[0.0, 0.1017, 0.0, 0.0], [0.5194, 1.1814, 1.2787, 1.9302]]),
    contraction=0.643,
)


@named_arguments
def lipschitz_constants(
    system: System,
    region: Interval,
    u_region: Interval | None = None,
    derivative: tuple[Interval, Interval] | None = None,
    tolerance: float = 1e-3,
) -> LipschitzConstants:
    """Constants of Lemma 2 for f and g on a box of states.

    L_q is the supremum over the region of the spectral norm of the Jacobian, bounded from above by subdivision of the
    finite sides of the region with the engine's enclosures.

    Args:
        system: the plant.
        region: box (n,); infinite sides are legal where the derivatives are bounded.
        u_region: box (m,) of known inputs; needed where f or g takes ``u``.
        derivative: bounds of df (n, n) and dg (l, n) that the user vouches for; None takes the engine's.
        tolerance: relative gap between the bound and the attained value at which subdivision stops.

    Returns:
        `LipschitzConstants`; where the effort is spent first, L_f is still a bound, but looser than `tolerance`.

    Raises:
        ValueError: a shape does not fit, `u_region` is missing, or a derivative is not bounded on the region.

    Source: paper, Lemma 2; theory 2.11 and 2.12.
    """
    u_region = check_region("lipschitz_constants", system, region, u_region)
    if derivative is None:
        maps = (system.dynamics, system.measurement)
        with jax.enable_x64(True):
            enclose = _stacked(maps, u_region, system.n)
            pairs = [_largest_norm(lambda boxes, i=i: enclose(boxes)[i], region, tolerance) for i in range(2)]
            (upper_f, lower_f, df), (upper_g, lower_g, dg) = pairs
    else:
        df, dg = derivative
        for name, box, shape in (("df", df, (system.n, system.n)), ("dg", dg, (system.l, system.n))):
            if box.shape != shape:
                raise ValueError(
                    f"lipschitz_constants: the bounds of {name} must have shape {shape}, got {box.shape}; "
                    "give one interval per partial derivative"
                )
        upper_f, upper_g = (float(norm_bound(np.asarray(b.lower), np.asarray(b.upper))) for b in (df, dg))
        lower_f, lower_g = (float(spectral_norm(np.asarray(b.center))) for b in (df, dg))
    for name, box in (("f", df), ("g", dg)):
        if not (np.isfinite(box.lower).all() and np.isfinite(box.upper).all()):
            raise ValueError(
                f"lipschitz_constants: a derivative of {name} is not bounded on the region {region}; "
                "give a smaller region, or bounds in `derivative`"
            )
    return LipschitzConstants(
        upper_f, upper_g, lower_f, lower_g, df, dg,
        *(np.asarray(decomposition_gain(box), np.float64) for box in (df, dg)),
        *(np.asarray(width_gain(box), np.float64) for box in (df, dg)),
    )  # fmt: skip


def check_region(call: str, system: System, region: Interval, u_region: Interval | None) -> Interval:
    """The box of known inputs to use, after the shapes were checked."""
    check_type(call, "system", system, System)
    check_type(call, "region", region, Interval, f"gx.Interval(lower, upper) of shape ({system.n},)")
    if region.shape != (system.n,):
        raise ValueError(f"{call}: `region` must have shape ({system.n},), got {region.shape}")
    if u_region is None:
        if system.takes_u:
            raise ValueError(f"{call}: f or g takes u; give `u_region`, the box of known inputs")
        return Interval(np.zeros(system.m), np.zeros(system.m))
    if u_region.shape != (system.m,):
        raise ValueError(f"{call}: `u_region` must have shape ({system.m},), got {u_region.shape}")
    return u_region


def spectral_norm(matrix: np.ndarray) -> float:
    """Largest singular value; 0 for a matrix without entries."""
    return float(np.linalg.norm(matrix, 2)) if matrix.size else 0.0


def norm_bound(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Upper bound of the spectral norm over interval matrices (..., m, n); the exact maximum where few entries vary.

    The norm is convex, so its maximum over an interval matrix is at a vertex. Rounding of the norm itself is covered.
    """
    if not lower.shape[-1] or not lower.shape[-2]:
        return np.zeros(lower.shape[:-2])
    finite = np.asarray(np.isfinite(lower).all((-2, -1)) & np.isfinite(upper).all((-2, -1)))
    safe_lower, safe_upper = (np.where(finite[..., None, None], side, 0.0) for side in (lower, upper))
    center, radius = 0.5 * safe_lower + 0.5 * safe_upper, 0.5 * (safe_upper - safe_lower)
    bound = np.linalg.norm(center, 2, axis=(-2, -1)) + np.linalg.norm(radius, 2, axis=(-2, -1))
    bound = np.minimum(bound, np.linalg.norm(np.abs(center) + radius, 2, axis=(-2, -1)))
    varying = np.argwhere((safe_lower != safe_upper).any(tuple(range(lower.ndim - 2))))
    if len(varying) <= _VERTICES:
        rows, columns = varying.T if len(varying) else (np.zeros(0, int), np.zeros(0, int))
        at_vertices = np.zeros(bound.shape)
        for signs in itertools.product((False, True), repeat=len(varying)):
            vertex = safe_lower.copy()
            vertex[..., rows, columns] = np.where(signs, safe_upper[..., rows, columns], vertex[..., rows, columns])
            at_vertices = np.maximum(at_vertices, np.linalg.norm(vertex, 2, axis=(-2, -1)))
        bound = np.minimum(bound, at_vertices)
    return np.where(finite, bound * (1 + _ROUNDING), np.inf)


def _stacked(maps: tuple[Callable[..., Any], ...], u_region: Interval, n: int) -> Callable[[Any], list[Any]]:
    """Jacobian enclosures of all maps on a stack (k, 2, n) of at most `_BATCH` boxes, each as an array (k, 2, m, n)."""
    u_box = u_region.astype(np.float64)

    def at(sides: Any) -> list[Any]:
        found = [inclusion.jacobian(q)(Interval.unchecked(sides[0], sides[1]), u_box) for q in maps]
        return [jnp.stack([jac.lower, jac.upper]) for jac in found]

    program = numpy_function(jax.vmap(at), np.zeros((_BATCH, 2, n)))

    def call(sides: np.ndarray) -> list[Any]:
        full = np.concatenate([sides, np.broadcast_to(sides[:1], (_BATCH - len(sides), *sides.shape[1:]))])
        return [found[: len(sides)] for found in program(full)]

    return call


def _largest_norm(enclose: Callable[[Any], Any], region: Interval, tolerance: float) -> tuple[float, float, Interval]:
    """Bound and attained value of the largest norm on the region, and the enclosure on the whole of it."""
    sides = np.stack([np.asarray(region.lower, np.float64), np.asarray(region.upper, np.float64)])[None]
    whole = enclose(sides)[0]
    width = sides[0, 1] - sides[0, 0]
    axes = np.flatnonzero(np.isfinite(width) & (width > 0))[: _BATCH // 2]
    bounds, attained = norm_bound(whole[None, 0], whole[None, 1]), _attained(enclose, _points_in(sides[0]))
    for _ in range(_ROUNDS if len(axes) else 0):
        if bounds.max() <= attained * (1 + tolerance):
            break
        order = np.argsort(-bounds, kind="stable")[: _BATCH // (2 * len(axes))]
        order = order[bounds[order] > attained]
        children, of_children = _best_split(enclose, sides[order], bounds[order], axes)
        attained = max(attained, _attained(enclose, children.mean(1) if np.isfinite(children).all() else children[:0]))
        sides = np.concatenate([np.delete(sides, order, axis=0), children])
        bounds = np.concatenate([np.delete(bounds, order), of_children])
    return float(bounds.max()), attained, Interval(whole[0], whole[1])


def _best_split(
    enclose: Callable[[Any], Any], parents: np.ndarray, bounds: np.ndarray, axes: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Halve every box along the axis that lowers its bound most, found by trying all axes: most hardly matter."""
    count = len(axes)
    halves = np.repeat(np.repeat(parents[:, None, None], count, axis=1), 2, axis=2)  # parent, axis, half, side, n
    for i, axis in enumerate(axes):
        middle = 0.5 * parents[:, 0, axis] + 0.5 * parents[:, 1, axis]
        halves[:, i, 0, 1, axis] = middle
        halves[:, i, 1, 0, axis] = middle
    jacobians = enclose(halves.reshape(-1, 2, parents.shape[-1]))
    found = norm_bound(jacobians[:, 0], jacobians[:, 1]).reshape(len(parents), count, 2)
    # The sum decides between axes whose worse half is equally bad.
    width = parents[:, 1, axes] - parents[:, 0, axes]
    best = (found.max(-1) + 1e-3 * found.sum(-1) - 1e-9 * width / width.max(-1, keepdims=True)).argmin(1)
    pick = np.arange(len(parents))
    children = halves[pick, best].transpose(1, 0, 2, 3).reshape(-1, 2, parents.shape[-1])
    return children, np.minimum(found[pick, best].T.reshape(-1), np.tile(bounds, 2))


def _points_in(sides: np.ndarray) -> np.ndarray:
    """Points of a box to look for a large norm at: the center, corners and random ones, near 0 on infinite sides."""
    random = np.random.default_rng(0)
    share = random.uniform(size=(_BATCH, sides.shape[1]))
    share[: _BATCH // 2] = np.round(share[: _BATCH // 2])
    share[0] = 0.5
    reach = np.where(np.isfinite(sides), sides, 0.0)
    reach[0] = np.where(np.isfinite(sides[0]), sides[0], reach[1] - 10.0)
    reach[1] = np.where(np.isfinite(sides[1]), sides[1], reach[0] + 10.0)
    return np.clip(reach[0] + share * (reach[1] - reach[0]), sides[0], sides[1])


def _attained(enclose: Callable[[Any], Any], points: np.ndarray) -> float:
    """A lower bound of the largest norm: Jacobians at points, less what their enclosures leave open."""
    if not points.size:
        return 0.0
    jacobians = enclose(np.stack([points, points], 1))
    jacobians = jacobians[np.isfinite(jacobians).all((1, 2, 3))]
    if not jacobians.size:
        return 0.0
    center, radius = 0.5 * jacobians.sum(1), 0.5 * (jacobians[:, 1] - jacobians[:, 0])
    norms = np.linalg.norm(center, 2, axis=(-2, -1)) - np.linalg.norm(radius, 2, axis=(-2, -1))
    return float(max(norms.max() * (1 - _ROUNDING), 0.0))
