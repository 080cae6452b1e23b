"""Derivatives of the widths that a certificate promises by the widths of the noise: of all that `widths` counts."""

from __future__ import annotations

import numpy as np

from gsisio_jax.observer.certificate import Certificate
from gsisio_jax.observer.window_widths import added_by
from gsisio_jax.plant.system import Noise

_AT = 1e-7  # relative distance within which a width is where a bound of it ends: iterations end at 1e-9
_STEP = 1e-6  # share of a width by which `Slices.growth`, which is linear in pieces, is differentiated


def width_slopes(certificate: Certificate, noise: Noise) -> tuple[np.ndarray, np.ndarray]:
    """Of a certificate that promises widths.

    Returns:
        ``d widths / d (widths of w and v)``, (n, n + l); and for which states (n,) the promise is narrower than that of
        the certified gain with the slopes of the whole region. At a kink it is the slope of one side.
    """
    by = np.hstack([certificate.noise_w, certificate.noise_v]).astype(float)
    of_gain = certificate.response @ by
    if certificate.slices is not None:
        return _sliced(certificate, noise, by, of_gain)
    n, widths = len(by), np.asarray(certificate.widths(noise))
    M, rows, narrower = np.zeros((n, n)), of_gain.copy(), np.zeros(n, bool)
    if certificate.window is not None:
        window = certificate.window
        gain, targets = _of_gain_alone(certificate, noise), np.array(window.targets)
        reached = widths @ window.slopes.T + added_by(window, noise)
        narrower = widths < gain * (1 - _AT)
        for i in np.flatnonzero(narrower):
            mine = np.flatnonzero(targets == i)
            r = mine[np.argmin(reached[mine])]
            M[i], rows[i] = window.slopes[r], np.concatenate([window.noise_w[r], window.noise_v[r]])
    return np.linalg.solve(np.eye(n) - M, rows), narrower


def _of_gain_alone(certificate: Certificate, noise: Noise) -> np.ndarray:
    """What the certified gain promises with the slopes of the whole region; inf where it settles nothing."""
    if certificate.rate >= 1:
        return np.full(len(certificate.growth), np.inf)
    V = certificate.inverse
    return certificate.response @ np.asarray(certificate.noise_width(noise)) + certificate.response @ np.linalg.solve(
        V, np.broadcast_to(certificate.excess, len(V))
    )


def _sliced(
    certificate: Certificate, noise: Noise, by: np.ndarray, of_gain: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """``W = min(start, V (growth(W) + added) + excess)``, differentiated row by row."""
    widths, V, n = np.asarray(certificate.widths(noise), float), certificate.inverse, len(by)
    gain, region = _of_gain_alone(certificate, noise), np.asarray(certificate.region.width)
    start = np.minimum(gain, region)
    inside = np.minimum(widths, start)
    step = _STEP * np.diag(np.where(inside > 0, inside, 1.0))
    ahead, behind = (certificate.slices.growth(inside + side) for side in (step, -step))
    J = V @ ((ahead - behind) / (2 * np.diag(step)[:, None])).T
    settled = widths < start * (1 - _AT)
    M = np.where(settled[:, None], J, 0.0)
    rows = np.where(settled[:, None], V @ by, np.where((gain <= region)[:, None], of_gain, 0.0))
    slopes = np.linalg.solve(np.eye(n) - M, rows)
    beyond = widths > start * (1 + _AT)  # widths that do not fit into the region
    return np.where(beyond[:, None], J @ slopes + V @ by, slopes), settled
