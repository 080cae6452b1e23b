"""The width that rows over several steps promise, where f and g are affine (theory 6).

A row r of state i bounds the width of x[k] by the sum over all lags of its slopes times the widths then, plus noise. If
widths settle at or below W, they also settle at or below the least of that over all rows of the state, and so on.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import numpy as np

from gsisio_jax.observer.window import Window
from gsisio_jax.plant.system import Noise

_MOST = 10_000  # rounds, each of which is a promise by itself
_SETTLED = 1e-9  # relative change of a round that ends them


def slopes_by_lag(window: Window, F: np.ndarray, E: np.ndarray) -> np.ndarray:
    """What rows make of the box of x[k-1-t] for every lag t, (N, R, n), with the slopes of f and g."""
    n = len(F)
    of_f, of_g = window.multipliers[:, :, :n], window.multipliers[:, :, n:]
    return np.array([of_f[t] @ F + of_g[t] @ E - window.states(t, n) for t in range(window.length)])


def added_by(rows: Any, noise: Noise) -> np.ndarray:
    """What noise, and all that is `fixed`, add to the widths by these rows, (..., R)."""
    return np.asarray(noise.w.width @ rows.noise_w.T + noise.v.width @ rows.noise_v.T + rows.fixed)


class WindowWidths(eqx.Module):
    """What R rows make of widths.

    Attributes:
        slopes: (R, n), magnitudes of the slopes on the boxes of all lags, summed up.
        noise_w, noise_v: (R, n) and (R, l), weights of the widths of the noise.
        fixed: (R,), what inputs with known bounds contribute.
        targets: the state of every row.
    """

    slopes: Any
    noise_w: Any
    noise_v: Any
    fixed: Any
    targets: tuple[int, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, window: Window, F: np.ndarray, E: np.ndarray, T2: np.ndarray, inputs: np.ndarray) -> WindowWidths:
        """From the rows, the slopes of f and g, T2, and the widths (b,) of inputs with known bounds."""
        n = len(F)
        of_f, of_g = window.multipliers[:, :, :n], window.multipliers[:, :, n:]
        return cls(
            slopes=np.abs(slopes_by_lag(window, F, E)).sum(0),
            noise_w=np.abs(of_f).sum(0),
            noise_v=np.abs(of_g).sum(0) + np.abs(window.remainder @ T2),
            fixed=np.abs(window.known).sum(0) @ inputs,
            targets=window.targets,
        )

    def settled(self, width: Any, noise: Noise) -> np.ndarray:
        """Widths (..., n) at or below which boxes settle, if they settle at or below `width`."""
        added = added_by(self, noise)
        found, targets = np.asarray(width, np.float64), np.array(self.targets)
        for _ in range(_MOST):
            rows = found @ self.slopes.T + added
            least = np.stack([rows[..., targets == i].min(-1, initial=np.inf) for i in range(found.shape[-1])], -1)
            found, before = np.minimum(found, least), found
            if (before - found <= _SETTLED * before).all():
                break
        return found
