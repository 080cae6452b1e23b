"""What a fit of noise bounds returns, and what may honestly be said about it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from gsisio_jax._extras import need
from gsisio_jax.plant.system import Noise


@dataclass(frozen=True)
class HeldOut:
    """The fitted bounds on records that were not fitted.

    Attributes:
        records: how many records.
        contradicted: how many of them hold a conflict, or a logged truth outside its box.
        conflicts: steps with a conflict, per record (records,).
        logged: steps with a logged truth, all records together; outside: those whose truth is not in its box.
    """

    records: int
    contradicted: int
    conflicts: np.ndarray
    logged: int
    outside: int

    @property
    def most(self) -> float:
        """Upper 95 % limit (Clopper and Pearson) of the share of records like these that contradict the bounds.

        It holds if fitted, held-out and future records are drawn independently from one source.

        >>> round(HeldOut(10, 0, np.zeros(10), 0, 0).most, 3)
        0.259
        """
        if self.contradicted >= self.records:
            return 1.0
        special = need("scipy.special", extra="tune", purpose="the limit of a share")
        return float(special.betaincinv(self.contradicted + 1, self.records - self.contradicted, 0.95))

    def __str__(self) -> str:
        if not self.records:
            return "nothing was held out, so nothing is known about other records"
        text = f"{self.contradicted} of {self.records} records contradict the fitted bounds"
        if self.logged:
            text += f"; truth inside its box in {self.logged - self.outside} of {self.logged} steps"
        return f"{text}; of records like these at most {self.most:.0%} do (95 % confidence, if drawn independently)"


@dataclass(frozen=True)
class TunedNoise:
    """Fitted noise bounds. Print it; draw it with `plot`.

    Attributes:
        noise: the bounds; nothing in the fitted records contradicts them.
        factors: the factor of every fitted bound, by name; the template is 1.
        cost: weighted sum of widths; `start_cost` that of the start, as it was given.
        lower_bound: no feasible bounds of this shape cost less (linear systems, method "lp"; one common factor has no
            such bound on other systems), else -inf.
        method: "bisection", "lp" or "optax".
        explained: what too small bounds would have contradicted.
        records: number of fitted records; steps: their rows.
        held_out: the bounds on records that were not fitted.
        history: arrays "evaluations", "cost" (of the best feasible bounds so far), "trial", "lower".
        notes: what a reader should know besides.
    """

    noise: Noise
    factors: dict[str, float]
    cost: float
    start_cost: float
    lower_bound: float
    method: str
    explained: str
    records: int
    steps: int
    held_out: HeldOut
    history: dict[str, np.ndarray]
    notes: tuple[str, ...] = ()

    def __str__(self) -> str:
        lines = [
            f"Noise bounds fitted to {self.records} records ({self.steps} rows) by {self.method}",
            f"  cost {self.cost:.6g} (start {self.start_cost:.6g}"
            + (f", no less than {self.lower_bound:.6g} possible)" if np.isfinite(self.lower_bound) else ")"),
            f"  what can contradict them: {self.explained}",
            f"  {'bound':<8}{'lower':>14}{'upper':>14}",
        ]
        for letter, box in (("w", self.noise.w), ("v", self.noise.v)):
            for i, (low, high) in enumerate(zip(box.lower, box.upper, strict=True)):
                lines.append(f"  {letter + str(i + 1):<8}{low:>14.6g}{high:>14.6g}")
        lines.append(f"  held out: {self.held_out}")
        lines.extend(f"  note: {note}" for note in self.notes)
        lines.append(
            "  These bounds are evidence, not proof: the smallest of this shape that explain the fitted records. The "
            "true noise\n  may be larger; a guarantee needs bounds from physics or data sheets, or a margin on top of "
            "these."
        )
        return "\n".join(lines)

    def plot(self, ax: Any = None) -> Any:
        """Draw how the search went: cost of the best bounds so far, trials, lower bound, against evaluations.

        Args:
            ax: matplotlib axes; a new figure where left out.

        Returns:
            The axes.

        Raises:
            MissingExtra: matplotlib is not installed.
        """
        need("matplotlib", extra="plot", purpose="drawing a picture")
        if ax is None:
            from matplotlib import pyplot

            ax = pyplot.figure(figsize=(7, 4), layout="constrained").subplots()
        at, lower = self.history["evaluations"], self.history["lower"]
        ax.plot(at, self.history["trial"], ".", color="#999999", label="tried")
        ax.step(at, self.history["cost"], where="post", color="#3366aa", label="best that nothing contradicts")
        if np.isfinite(lower).any():
            ax.step(at, lower, where="post", color="#bb5500", linestyle="--", label="proven lower bound")
        low = min(self.cost, float(np.min(lower, where=np.isfinite(lower), initial=self.cost)))
        high = float(max(self.history["cost"].max(), self.start_cost))
        room = 0.05 * max(high - low, 1e-3 * abs(high))
        ax.set_ylim(low - room, high + room)
        ax.set_xlabel("evaluations of all records")
        ax.set_ylabel("weighted sum of noise widths")
        ax.legend()
        return ax
