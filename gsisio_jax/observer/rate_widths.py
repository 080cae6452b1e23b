"""The width that a pattern of measured and missing entries promises, where f and g are affine (theory 6).

A row of state i bounds the width of x[k] by its slopes times the widths of earlier steps, plus noise; whether it holds
depends on which outputs came, and so on the phase of the pattern alone. The least of them over all rows is a recursion
of widths that no run exceeds.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import numpy as np

from gsisio_jax.observer.window_widths import added_by
from gsisio_jax.plant.system import Noise

_FAR = 1e6  # times what noise adds: the boxes that the recursion begins with
_MOST_STEPS = 3000  # of the recursion
_ROUNDS = 200  # after it, over all phases, each of which is a promise by itself
_SETTLED = 1e-6  # relative change of a period or a round that ends them


class RateWidths(eqx.Module):
    """What R rows make of widths in the P phases of a pattern.

    Attributes:
        slopes: (N, R, n), magnitudes of the slopes on the box of x[k-1-t] for every lag t.
        noise_w, noise_v: (R, n) and (R, l), weights of the widths of the noise.
        fixed: (R,), what bounds of states and inputs contribute.
        holds: (P, R), the row needs no output that is missing in this phase or in those before.
        targets: the state of every row.
        rates: every how many rows each output comes, (l,); in phase 0 all do.
    """

    slopes: Any
    noise_w: Any
    noise_v: Any
    fixed: Any
    holds: Any
    targets: tuple[int, ...] = eqx.field(static=True)
    rates: tuple[int, ...] = eqx.field(static=True)

    @property
    def period(self) -> int:
        """P, in rows."""
        return self.holds.shape[0]

    def settled(self, noise: Noise) -> np.ndarray:
        """Widths (P, n) at or below which boxes settle in every phase, from boxes of any finite width; ``inf`` for
        states that do not. Noise bounds (n,) and (l,).

        From a history in which every width is D the recursion gives U_k, k = 0, 1, ... If widths once were at most
        a D over N steps, a >= 1, then from there on they are at most a U_k: all rows are monotone, and
        what noise adds is no more than a times that. If N steps of U that end in phase 0 are at most D / 2, a halves
        until it is 1; and U_{k+m} <= U_k for their end m, so later widths are at most the largest of any m
        successive U of their phase. Every round of the recursion over all phases keeps that.
        """
        added = added_by(self, noise)
        n, targets = self.slopes.shape[2], np.array(self.targets)
        least = [added[targets == i].min(initial=np.inf) for i in range(n)]
        largest = max([size for size in least if np.isfinite(size)], default=1.0) or 1.0
        far = _FAR * np.clip(np.where(np.isfinite(least), least, largest), 1e-6 * largest, None)
        found = np.full((self.period, n), np.inf)
        for _ in range(n + 1):
            if not np.isfinite(far).any():
                break
            found, settles = self._from(far, added)
            if settles.all():
                break
            far = np.where(settles, far, np.inf)
        # The history of a run begins with one box: rows that look farther back say nothing yet.
        settled = np.array(np.isfinite(found).all(0))
        return found if self._stays_finite(settled, far, added) else np.full_like(found, np.inf)

    def _stays_finite(self, states: np.ndarray, far: np.ndarray, added: np.ndarray) -> bool:
        """Whether boxes of these states (n,) are finite for N steps in a row, if one box is, whatever was before it: as
        some row over one step says so in every phase, or from some step on behind a box in any phase."""
        slopes, holds = np.asarray(self.slopes), np.asarray(self.holds, bool)
        one = ~(slopes[1:] > 0).any((0, 2)) & ~(slopes[0][:, ~states] > 0).any(1)
        says = [(holds & one)[:, np.array(self.targets) == i].any(1).all() for i in np.flatnonzero(states)]
        if all(says):
            return True
        N, P, unknown = len(slopes), self.period, np.full((len(slopes), len(far)), np.inf)
        for begin in range(P):
            lags = np.vstack([np.where(states, far, np.inf), unknown])[:N]
            for step in range(1, N + P + 1):
                lags = np.vstack([self.next_widths(lags, (begin + step) % P, added), lags])[:N]
            if not np.isfinite(lags[:, states]).all():
                return False
        return True

    def _from(self, far: np.ndarray, added: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Widths of all phases, and of which states they settle, (n,); those that begin infinite may stay so."""
        N, P, known = len(self.slopes), self.period, np.isfinite(far)
        block = -(-N // P) * P  # whole periods that hold a window
        past, runs, end = np.tile(far, (block, 1)), [], 0
        for _ in range(max(3, _MOST_STEPS // block)):
            before = past
            for phase in [*range(P)] * (block // P):
                past = np.vstack([past[1:], self.next_widths(past[::-1][:N], phase, added)])
                runs.append(past[-1])
            if not end and (past <= far / 2)[:, known].all():
                end = len(runs)
            if end and len(runs) >= 2 * end and np.allclose(past, before, rtol=_SETTLED, atol=0):
                break
        if not end:
            return np.full((P, len(far)), np.inf), ~known | (past <= far / 2).all(0)
        widths = np.array(runs[-end:]).reshape(-1, P, len(far)).max(0)
        for _ in range(_ROUNDS):
            before = widths
            for phase in range(P):
                lags = widths[(phase - 1 - np.arange(N)) % P]
                new = np.minimum(widths[phase], self.next_widths(lags, phase, added))
                widths = np.vstack([widths[:phase], new, widths[phase + 1 :]])
            if np.allclose(widths, before, rtol=_SETTLED, atol=0):
                break
        return widths, np.full(len(far), True)

    def next_widths(self, lags: np.ndarray, phase: int, added: np.ndarray) -> np.ndarray:
        """Widths (n,) in a phase from those of N steps before, the newest first."""
        slopes, infinite = np.asarray(self.slopes), np.isinf(lags)
        rows = np.einsum("trj,tj->r", slopes, np.where(infinite, 0, lags)) + added
        says = np.asarray(self.holds[phase], bool)
        if infinite.any():
            says = says & ~((slopes > 0) & infinite[:, None]).any((0, 2))
        least = np.full(lags.shape[1], np.inf)
        np.minimum.at(least, list(self.targets), np.where(says, rows, np.inf))
        return least
