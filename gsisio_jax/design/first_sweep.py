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


def first_form(system: System, T2: np.ndarray, u_region: Interval) -> inclusion.AffineForm:
    """Affine bounds of T2 g on the state bounds, uniformly over `u_region`: every step begins with them.

    Source: design 4.3, step 3.
    """
    with jax.enable_x64(True):
        matrix = jnp.asarray(T2)
        bounds, u_box = system.state_bounds.astype(np.float64), u_region.astype(np.float64)
        form = jax.jit(inclusion.affine(lambda x, u: matrix @ system.measurement(x, u)))(bounds, u_box)
        return jax.tree.map(np.array, form)


def contracting_gains(problem: GainProblem, bank: list[np.ndarray], everywhere: Slopes) -> list[np.ndarray | None]:
    """For each gain ``(I - |N_z| R)^{-1}`` on the state bounds, or None where ``|N_z| R`` does not contract there."""
    with np.errstate(invalid="ignore"):
        R = np.abs(everywhere.Z - problem.C[: problem.q]) + everywhere.Z_radius
    inverses: list[np.ndarray | None] = []
    for gain in bank:
        implicit = _weighted(np.abs(problem.split(gain)[1]), R)
        contracts = spectral_radius(implicit) < 1 - 1e-9
        inverses.append(np.maximum(np.linalg.inv(np.eye(problem.n) - implicit), 0.0) if contracts else None)
    return inverses


def check_first_sweep(problem: GainProblem, gain: np.ndarray, form: inclusion.AffineForm, contracts: bool) -> None:
    """Raise `NoDesignFound` where the box of x[k] would never become finite.

    It becomes finite if ``|N_z| R`` contracts on the state bounds, or if the affine bounds there have a finite
    remainder in the rows that the gain uses and ``I + N_z (S - C)`` can be inverted.
    """
    if contracts:
        return
    N_z = problem.split(gain)[1]
    used = (N_z != 0).any(axis=0)
    matrix = np.eye(problem.n) + N_z[:, used] @ (form.slope - problem.C[: problem.q])[used]
    finite = (np.isfinite(form.offset.lower) & np.isfinite(form.offset.upper))[used].all()
    if finite and abs(np.linalg.det(matrix)) > _SINGULAR:
        return
    raise NoDesignFound(
        "design_observer: the box of x[k] would never become finite. On the state bounds the affine bounds of the "
        f"outputs {'lose a direction' if finite else 'have an infinite remainder'}, and they are too nonlinear "
        "for the closed form (rho(|N_z| R) >= 1 there). Give `state_bounds` that are finite where the outputs are "
        "nonlinear; a smaller region alone does not help."
    )


def _weighted(weights: np.ndarray, R: np.ndarray) -> np.ndarray:
    """``weights @ R`` with 0 * inf = 0."""
    with np.errstate(invalid="ignore"):
        return np.where(weights[:, :, None] == 0, 0.0, weights[:, :, None] * R).sum(axis=1)
