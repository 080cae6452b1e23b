"""How often a step applies the certified bound, and what that leaves of the region in the promise (theory 5.6, 6)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsisio_jax.interval.box import Interval
from gsisio_jax.observer.certificate import Certificate
from gsisio_jax.plant.system import Noise

_CHEAP = 0.005  # share of the width that the promise may be larger where so few rounds leave that
_SHARE = 0.0025  # where there are more
_MOST = 64


def with_rounds(certificate: Certificate, noise: Noise, state_bounds: Interval) -> Certificate:
    """The promise of the fewest rounds that leave little; as it is where ``|N_z| R = 0``, and nothing is left.

    Args:
        certificate: of the gain, as if ``x + N_z psi(x)`` were solved for x without error.
        noise: of the design.
        state_bounds: boxes lie in them, too.
    """
    implicit = np.asarray(certificate.implicit)
    if not implicit.any() or not np.isfinite(implicit).all() or certificate.implicit_rate >= 1:
        return certificate
    width = np.minimum(np.asarray(certificate.region.width), np.asarray(state_bounds.width))
    if not np.isfinite(width[implicit.any(0)]).all():
        return certificate.with_notes(
            "the region is unbounded where outputs are nonlinear, so widths are promised up to the error with which "
            "the outputs are solved for the state (theory 5.6)"
        )
    exact = certificate.steady_width if certificate.certified else certificate.inverse @ certificate.noise_width(noise)
    width = np.where(np.isfinite(width), width, 0.0)  # nothing is multiplied with it
    for rounds in range(1, _MOST + 1):
        found = replace(certificate, rounds=rounds, excess=np.linalg.matrix_power(implicit, rounds) @ width)
        reached = found.widths(noise) if certificate.certified else exact + found.excess
        fits = ~(exact <= certificate.region.width) | (reached <= certificate.region.width)
        if (reached <= exact * (1 + (_CHEAP if rounds <= 2 else _SHARE))).all() and fits.all():
            break
    if not certificate.certified:
        return found
    return replace(found, steady_width=reached, input_width=found.input_widths(noise))
