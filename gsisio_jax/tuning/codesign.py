"""Steady widths of the best gain as a differentiable function of the plant: design and gain at once.

The gain solves a linear program at every point, and the derivative of its optimum needs no derivative of the gain. Row
i of the best gain N minimises, at the steady width W,

    cost_i = sum_j |(P F - N_y E)_ij| W_j + |P|_ij (F_radius W + dw)_j + |N_y|_ij (E_radius W + dv)_j + |N_z|_ij (R W)_j
             + |N_z T2|_ij dv_j + ...,      P = I - N_z C,      subject to  N [H; C G] = G,

and W_i = cost_i. By the envelope theorem the derivative of the minimum is that of its Lagrangian at fixed N: with the
multipliers Lambda of the equality, and a multiplier S in [-1, 1] in the place of the sign of every argument that the
optimum has put to 0. With M = A + |N_z| R, ``dW = (I - M)^{-1} d(Lagrangian)``. Where the optimum is degenerate W has a
kink, and this is one of its one-sided slopes or between them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import cvxpy as cp
import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax import inclusion
from gsisio_jax._calls import named_arguments
from gsisio_jax.design.feedthrough import factorise
from gsisio_jax.design.gain_selection import main_gain, units
from gsisio_jax.design.gains import solve
from gsisio_jax.design.problem import GainProblem
from gsisio_jax.errors import NoDesignFound
from gsisio_jax.interval.box import Interval
from gsisio_jax.plant.system import Noise, System

Plant = Callable[[Any], tuple[System, Noise, Interval]]


class Enclosed(NamedTuple):
    """What of a `GainProblem` changes with the plant, as JAX arrays."""

    F: Any
    F_radius: Any
    E: Any
    E_radius: Any
    C: Any
    R: Any
    dw: Any
    dv: Any


class Optimum(NamedTuple):
    """The best gain and its multipliers: N (n, columns), W (n,), S1 for P F - N_y E, S2 for P, S3 for what is left of
    bounded inputs, Lambda (n, p) of the equality, and ``(I - M)^{-1}``."""

    N: Any
    W: Any
    S1: Any
    S2: Any
    S3: Any
    Lambda: Any
    inverse: Any


@named_arguments
def optimal_widths(plant: Plant, theta: Any, u_region: Interval | None = None) -> Any:
    """Steady widths of the certificate with the gain re-optimised at `theta`, (n,); differentiable in `theta`.

    Made for co-design: `jax.grad` through it moves noise bounds, region or the parameters of f and g (where a sensor
    sits, say) while the gain stays the best one. Works under `jax.jit`, which is worth it: the linear program is called
    from the compiled program. First derivatives only, in reverse or forward mode.

    Args:
        plant: takes `theta` and returns the system, the noise bounds and the region. G, H and the bounds of states and
            inputs must not depend on `theta`.
        theta: a pytree of arrays.
        u_region: box (m,) of known inputs; needed where f or g takes u.

    Returns:
        Widths (n,), units of the states; ``inf`` (with derivative 0) where no gain contracts.

    Raises:
        ValueError: the matrices of the system depend on `theta`, or `u_region` is missing.

    >>> def plant(radius):
    ...     system = System(lambda x: 0.5 * x, lambda x: x, G=np.zeros((1, 0)), H=np.zeros((1, 0)))
    ...     noise = Noise(Interval.symmetric(np.ones(1)), Interval(-radius, radius))
    ...     return system, noise, Interval.entire(1)
    >>> with jax.enable_x64(True):
    ...     slope = jax.jacobian(lambda r: optimal_widths(plant, r))(jnp.array([0.1]))
    >>> slope.round(6).tolist()
    [[2.0]]

    Source: theory 4.
    """
    if not callable(plant):
        raise ValueError(
            f"optimal_widths: `plant` must be a function of theta that returns (system, noise, region), got "
            f"{type(plant).__name__}"
        )
    try:
        system, noise, region = plant(theta)
    except ValueError as error:
        if not isinstance(error.__cause__, TypeError):
            raise
        # NumPy was asked for the numbers of a traced array.
        raise ValueError(
            "optimal_widths: a matrix or a bound of the system depends on `theta`; only f, g, the noise and the region "
            "may"
        ) from error
    if u_region is None:
        if system.takes_u:
            raise ValueError("optimal_widths: f or g takes u; give `u_region`, the box of known inputs")
        u_region = Interval(np.zeros(system.m), np.zeros(system.m))
    T2 = factorise(np.asarray(system.H)).T2
    data = enclose(system, noise, region, u_region, T2)

    def best(data: Enclosed, lower: Any, upper: Any) -> Optimum:
        return _optimum(_problem(system, T2, data), Interval(np.asarray(lower), np.asarray(upper)))

    n = system.n
    free = ~np.isfinite(np.asarray(system.input_bounds.width))
    shapes = {
        "N": (n, system.l + data.C.shape[0]), "W": (n,), "S1": (n, n), "S2": (n, n), "S3": (n, int((~free).sum())),
        "Lambda": (n, int(free.sum())), "inverse": (n, n),
    }  # fmt: skip
    dtype = data.F.dtype
    like = Optimum(**{name: jax.ShapeDtypeStruct(shape, dtype) for name, shape in shapes.items()})
    fixed = jax.lax.stop_gradient((data, jnp.asarray(region.lower, dtype), jnp.asarray(region.upper, dtype)))
    at = jax.lax.stop_gradient(jax.pure_callback(best, like, *fixed, vmap_method="sequential"))
    lagrangian = _lagrangian(system, T2, data, at, free)
    finite = jnp.isfinite(at.W)
    moved = at.inverse @ (lagrangian - jax.lax.stop_gradient(lagrangian))
    return at.W + jnp.where(finite, moved, 0)


def enclose(system: System, noise: Noise, region: Interval, u_region: Interval, T2: np.ndarray) -> Enclosed:
    """Enclosures of the Jacobians on the region, as a differentiable function of everything."""
    outputs = jnp.asarray(T2)
    dtype = jnp.result_type(float, region.lower, noise.w.lower)
    region, u_region = region.astype(dtype), u_region.astype(dtype)

    def parts(function: Callable[..., Any]) -> tuple[Any, Any]:
        jacobian = inclusion.jacobian(function)(region, u_region)
        center = 0.5 * (jacobian.lower + jacobian.upper)
        return center, 0.5 * (jacobian.upper - jacobian.lower)

    F, F_radius = parts(system.dynamics)
    E, E_radius = parts(system.measurement)
    Z, R = parts(lambda x, u: outputs @ system.measurement(x, u))
    bounded = np.isfinite(np.asarray(system.state_bounds.width))
    C = jnp.concatenate([Z, jnp.asarray(np.eye(system.n)[bounded], Z.dtype)])
    return Enclosed(F, F_radius, E, E_radius, C, R, jnp.asarray(noise.w.width), jnp.asarray(noise.v.width))


def _problem(system: System, T2: np.ndarray, data: Enclosed) -> GainProblem:
    state, known = (np.asarray(box.width) for box in (system.state_bounds, system.input_bounds))
    F, F_radius, E, E_radius, C, R, dw, dv = (np.asarray(a, np.float64) for a in data)
    return GainProblem(
        F, F_radius, E, E_radius, T2, C, R, np.asarray(system.G), np.asarray(system.H), ~np.isfinite(known),
        dw, dv, state[np.isfinite(state)], known[np.isfinite(known)],
    )  # fmt: skip


def _lagrangian(system: System, T2: np.ndarray, data: Enclosed, at: Optimum, free: np.ndarray) -> Any:
    """Row costs at the fixed gain, with the multipliers of `at`, (n,)."""
    n, l, q = system.n, system.l, T2.shape[0]
    W = jnp.where(jnp.isfinite(at.W), at.W, 0)
    N_y, N_z = at.N[:, :l], at.N[:, l : l + q]
    P = jnp.eye(n, dtype=W.dtype) - at.N[:, l:] @ data.C
    seen = jnp.concatenate([jnp.asarray(system.H, W.dtype), data.C @ jnp.asarray(system.G, W.dtype)])
    residual = jnp.asarray(system.G, W.dtype) - at.N @ seen
    known = np.asarray(system.input_bounds.width)[~free]
    return (
        (at.S1 * (P @ data.F - N_y @ data.E)) @ W
        + (at.S2 * P) @ (data.F_radius @ W + data.dw)
        + jnp.abs(N_y) @ (data.E_radius @ W + data.dv)
        + jnp.abs(N_z) @ (data.R @ W)
        + jnp.abs(N_z @ jnp.asarray(T2, W.dtype)) @ data.dv
        + (at.S3 * residual[:, ~free]) @ known
        + (at.Lambda * residual[:, free]).sum(-1)
    )


def _optimum(problem: GainProblem, region: Interval) -> Optimum:
    """Solve the design's program, and once more, at the steady width and row by row, for the multipliers."""
    n, b, f = problem.n, int((~problem.free).sum()), int(problem.free.sum())
    try:
        N = main_gain(problem, region)
        W = problem.steady_width(N)
    except NoDesignFound:
        N, W = np.zeros((n, problem.columns)), np.full(n, np.inf)
    if not np.isfinite(W).all():
        none = np.zeros((n, n))
        return Optimum(N, np.full(n, np.inf), none, none, np.zeros((n, b)), np.zeros((n, f)), none)
    inverse = np.linalg.inv(np.eye(n) - problem.growth(N) - problem.implicit(N))
    S1, S2, S3, Lambda = _multipliers(problem, W)
    return Optimum(N, W, S1, S2, S3, Lambda, inverse)


def _multipliers(problem: GainProblem, W: np.ndarray) -> tuple[np.ndarray, ...]:
    """S1, S2, S3 and Lambda of the row programs at the width W."""
    x = units(W)
    inner = problem.scaled(x)
    w, l, q = W / x, problem.l, problem.q
    N = cp.Variable((inner.n, inner.columns))
    P = np.eye(inner.n) - N[:, l:] @ inner.C if inner.columns > l else np.eye(inner.n) + N[:, :0] @ inner.C
    residual = inner.G - N @ inner.seen if inner.G.shape[1] else None
    cost, pairs = 0, []

    def absolute(argument: Any, weight: np.ndarray) -> None:
        """Add sum |argument| weight to the cost, with inequalities that have multipliers of their own."""
        nonlocal cost
        if argument is None or not argument.shape[1]:
            pairs.append((None, None, weight))
            return
        size = cp.Variable(argument.shape)
        pairs.append((argument - size <= 0, -argument - size <= 0, weight))
        cost = cost + cp.sum(size @ weight)

    free, bounded = np.flatnonzero(inner.free), np.flatnonzero(~inner.free)
    absolute(P @ inner.F - (N[:, :l] @ inner.E if l else 0), w)
    absolute(P, inner.F_radius @ w + inner.dw)
    absolute(residual[:, bounded] if residual is not None and len(bounded) else None, inner.dd)
    signs = len(pairs)
    absolute(N[:, :l] if l else None, inner.E_radius @ w + inner.dv)
    absolute(N[:, l : l + q] if q else None, inner.R @ w)
    absolute(N[:, l : l + q] @ inner.T2 if q else None, inner.dv)
    absolute(N[:, l + q :] if inner.columns > l + q else None, inner.ds)
    constraints = [c for upper, lower, _ in pairs for c in (upper, lower) if c is not None]
    equality = residual[:, free] == 0 if residual is not None and len(free) else None
    if equality is not None:
        constraints.append(equality)
    if not solve(cp.Problem(cp.Minimize(cost), constraints)):
        raise ValueError(
            "optimal_widths: the solver found no multipliers of the gain; choose other units of the states"
        )
    found = []
    for upper, lower, weight in pairs[:signs]:
        if upper is None:
            found.append(np.zeros((inner.n, len(weight))))
            continue
        difference = np.asarray(upper.dual_value) - np.asarray(lower.dual_value)
        found.append(difference / np.where(weight > 0, weight, 1))
    if equality is None:
        return (*found, np.zeros((inner.n, 0)))
    # Back to the user's units: cost_i / x_i + nu_ij residual_ij d_j / x_i, with d_j the unit of input j.
    return (*found, np.asarray(equality.dual_value).reshape(inner.n, -1) * problem.input_units(x)[free])
