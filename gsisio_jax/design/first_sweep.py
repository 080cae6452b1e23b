"""Is the first contraction of a step finite? Known offline, because it starts from the state bounds at every step."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax import inclusion
from gsisio_jax.certificate import spectral_radius
from gsisio_jax.design.enclosures import Slopes
from gsisio_jax.design.problem import GainProblem
from gsisio_jax.errors import NoDesignFound
from gsisio_jax.interval import Interval
from gsisio_jax.system import System

_SINGULAR = 1e-6  # determinants (of matrices near the identity) below this are not divided by


def closed_form_inverses(
    system: System,
    problem: GainProblem,
    bank: list[np.ndarray],
    everywhere: Slopes,
    u_region: Interval,
) -> tuple[list[np.ndarray], np.ndarray | None]:
    """The bank, and for each of its gains ``(I - |N_z| R)^{-1}`` on the state bounds where the first sweep needs it.

    The first sweep is finite for the certified gain if the affine bounds of T2 g on the state bounds have a finite
    remainder (in the rows that the gain uses) and ``I + N_z (S - C)`` can be inverted. Then nothing is needed (None).
    Otherwise ``|N_z| R`` must contract on the state bounds, and gains for which it does not are dropped.

    Raises:
        NoDesignFound: neither holds for the certified gain.

    Source: design 4.3, step 3.
    """
    if _first_sweep_is_finite(system, problem, bank[0], u_region):
        return bank, None
    C = problem.C[: problem.q]
    with np.errstate(invalid="ignore"):
        R = np.abs(everywhere.Z - C) + everywhere.Z_radius
    implicit = [_weighted(np.abs(problem.split(gain)[1]), R) for gain in bank]
    rates = [spectral_radius(matrix) for matrix in implicit]
    if rates[0] >= 1 - 1e-9:
        raise NoDesignFound(
            "design_observer: the box of x[k] would never become finite. On the state bounds the affine bounds of the "
            "outputs have an infinite remainder (or lose a direction), and their nonlinearity is too strong for the "
            f"closed form: rho(|N_z| R) = {rates[0]:.3g} >= 1. Give `state_bounds` that are finite where the outputs are "
            "nonlinear; a smaller region alone does not help."
        )
    kept = [(gain, matrix) for gain, matrix, rate in zip(bank, implicit, rates, strict=True) if rate < 1 - 1e-9]
    inverses = [np.maximum(np.linalg.inv(np.eye(problem.n) - matrix), 0.0) for _, matrix in kept]
    return [gain for gain, _ in kept], np.stack(inverses)


def _weighted(weights: np.ndarray, R: np.ndarray) -> np.ndarray:
    """``weights @ R`` with 0 * inf = 0."""
    return np.where(weights[:, :, None] == 0, 0.0, weights[:, :, None] * np.where(weights[:, :, None] == 0, 0.0, R)).sum(1)


def _first_sweep_is_finite(system: System, problem: GainProblem, gain: np.ndarray, u_region: Interval) -> bool:
    with jax.enable_x64(True):
        T2 = jnp.asarray(problem.T2)
        bounds, u_box = system.state_bounds.astype(np.float64), u_region.astype(np.float64)
        form = jax.jit(inclusion.affine(lambda x, u: T2 @ system.measurement(x, u)))(bounds, u_box)
        slope, lower, upper = (np.array(a) for a in (form.slope, form.offset.lower, form.offset.upper))
    N_z = problem.split(gain)[1]
    used = (N_z != 0).any(axis=0)
    if not (np.isfinite(lower) & np.isfinite(upper))[used].all():
        return False
    matrix = np.eye(problem.n) + N_z[:, used] @ (slope - problem.C[: problem.q])[used]
    return bool(abs(np.linalg.det(matrix)) > _SINGULAR)
