"""What `tightness` returns: boxes beside the hull, the ratios of their widths, a table and a picture of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Tightness:
    """How near to the hull the boxes of a record are. Print it; draw it with `plot`.

    Attributes:
        steps: the steps k that were looked at, (K,).
        lower, upper: the observer's boxes of x[k], (K, n), units of the states.
        hull_lower, hull_upper: the hull of all x[k] that agree with the record, (K, n); NaN where no run does
            (`exact`), or where none was found.
        exact: f and g are affine on the state bounds, and the hull is exact. Otherwise it is that of the runs that
            were found: a lower bound of the hull's width, so that `ratio` is an upper bound of what is left to gain.
        horizon: number of steps that the hull looks back, or None for all.
    """

    steps: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    hull_lower: np.ndarray
    hull_upper: np.ndarray
    exact: bool
    horizon: int | None

    @property
    def width(self) -> np.ndarray:
        """Widths of the boxes, (K, n)."""
        return self.upper - self.lower

    @property
    def hull_width(self) -> np.ndarray:
        """Widths of the hull, (K, n): where not `exact`, lower bounds of them."""
        return self.hull_upper - self.hull_lower

    @property
    def ratio(self) -> np.ndarray:
        """Width of the box over that of the hull, (K, n); 1 where both are 0 or both infinite."""
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = self.width / self.hull_width
        same = (self.width == self.hull_width) & ((self.width == 0) | np.isinf(self.width))
        return np.where(same, 1.0, ratio)

    @property
    def mean(self) -> np.ndarray:
        """Mean ratio of every state over the steps that have one, (n,)."""
        return self._over_steps(np.mean)

    @property
    def worst(self) -> np.ndarray:
        """Largest ratio of every state, (n,)."""
        return self._over_steps(np.max)

    def _over_steps(self, of: Any) -> np.ndarray:
        return np.array([of(row[~np.isnan(row)]) if not np.isnan(row).all() else np.nan for row in self.ratio.T])

    @property
    def against(self) -> str:
        """What the boxes are compared with, in words."""
        over = "the whole record" if self.horizon is None else f"the last {self.horizon} steps and the box before"
        return f"the exact hull of {over}" if self.exact else f"the runs found that agree with {over}"

    def __str__(self) -> str:
        lines = [
            f"Widths of boxes over those of {self.against}, {len(self.steps)} steps from {self.steps[0]} to "
            f"{self.steps[-1]}",
            f"  {'state':<6}{'mean':>11}{'worst':>11}{'at step':>9}{'mean width':>13}{'of the hull':>13}",
        ]
        for i, ratio in enumerate(self.ratio.T):
            known = ~np.isnan(ratio)
            if not known.any():
                lines.append(f"  {f'x{i + 1}':<6}{'-':>11}{'-':>11}{'-':>9}{'-':>13}{'-':>13}")
                continue
            at = self.steps[known][ratio[known].argmax()]
            width, hull = (w[known, i].mean() for w in (self.width, self.hull_width))
            lines.append(
                f"  {f'x{i + 1}':<6}{self.mean[i]:>11.4g}{self.worst[i]:>11.4g}{at:>9}{width:>13.4g}{hull:>13.4g}"
            )
        if not self.exact:
            lines.append(
                "  f or g is not affine: the hull is at least as wide as these runs; a ratio is the most to gain"
            )
        if (none := self.steps[np.isnan(self.ratio).any(axis=1)]).size:
            said = "agrees with the record" if self.exact else "was found"
            lines.append(f"  no run {said} at steps {', '.join(map(str, none))}")
        return "\n".join(lines)

    def plot(self, ax: Any = None) -> Any:
        """Draw the ratio of every state over the steps: `gsisio_jax.plot.tightness`."""
        from gsisio_jax.plot import tightness

        return tightness(self, ax)
