"""The smallest factors that nothing contradicts: by bisection, by linear programs, by an exact penalty.

What all three rest on: bounds that contain the true ones are never contradicted. So on a ray of growing bounds
everything from some point on is feasible, and bisection that keeps "infeasible below, feasible above" ends below the
true bounds, or within its tolerance of them, whatever happens further down.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gsisio_jax._extras import need
from gsisio_jax.tuning.rollout import POINTS, Scores

Progress = Callable[[str], None]
SMALLEST = 1e-6  # factors do not go below that share of their start: boxes of width 0 meet or miss by rounding alone


@dataclass
class Search:
    """State of a search: the cheapest feasible factors so far, and how they were found.

    Attributes:
        scores: the records.
        price: (k,) cost of a unit of every factor.
        base: cost of what is not fitted.
        floor: (k,) factors do not go below.
        best: (k,) feasible.
        lower: no feasible factors cost less (linear systems), else -inf.
    """

    scores: Scores
    price: np.ndarray
    base: float
    tolerance: float
    progress: Progress | None
    floor: np.ndarray
    best: np.ndarray = field(default_factory=lambda: np.zeros(0))
    lower: float = -np.inf
    history: list[dict[str, float]] = field(default_factory=list)

    def cost(self, factors: np.ndarray) -> float:
        return float(self.price @ factors + self.base)

    def note(self, trial: float) -> None:
        """Add a line to the history."""
        row = {"evaluations": self.scores.calls, "cost": self.cost(self.best), "trial": trial, "lower": self.lower}
        self.history.append(row)
        if self.progress is not None:
            bound = f", at least {self.lower:.6g}" if np.isfinite(self.lower) else ""
            self.progress(f"{len(self.history):4d}: cost {row['cost']:.6g}{bound}, tried {trial:.6g}")

    def towards(self, inside: np.ndarray, outside: np.ndarray, rounds: int) -> tuple[np.ndarray, np.ndarray | None]:
        """The last feasible point on the way from a feasible point to another one, and its infeasible neighbour.

        Every round looks at `POINTS` points; the neighbour is None where all of the way is feasible.
        """
        for turn in range(rounds):
            share = np.arange(POINTS) / POINTS if turn == 0 else np.arange(1, POINTS + 1) / (POINTS + 1)
            points = outside + share[:, None] * (inside - outside)
            good = self.scores.feasible(points)
            bad = np.flatnonzero(~good)
            if not len(bad):
                if turn == 0:
                    return points[0], None
                inside = points[0]
                continue
            # From the feasible side: the first infeasible point counts, whatever lies behind it.
            last = bad[-1]
            inside, outside = (points[last + 1] if last + 1 < POINTS else inside), points[last]
        return inside, outside

    def rounds(self, tolerance: float) -> int:
        """Rounds of `towards` after which the bracket is that share of the way."""
        return 1 + int(np.ceil(np.log(max(1 / POINTS / tolerance, 1)) / np.log(POINTS + 1)))


def common_factor(search: Search, start: np.ndarray, call: str) -> None:
    """Stretch the start until nothing contradicts it, then shrink all of it: the smallest multiple, into `best`.

    Raises:
        ValueError: no multiple explains the records.
    """
    for exponent in range(0, 24, POINTS):
        multiples = 2.0 ** np.arange(exponent, exponent + POINTS)
        good = search.scores.feasible(multiples[:, None] * start)
        if good.any():
            first = multiples[np.argmax(good)]
            break
    else:
        score = search.scores.values(multiples[-1:, None] * start)
        record = int(np.flatnonzero((score.when[0] >= 0) & search.scores.fitted)[0])
        raise ValueError(
            f"{call}: no noise bounds of this shape explain the records: even {multiples[-1]:.3g} times the start is "
            f"contradicted, in record {record} at row {int(score.when[0, record])}. Fit more of the bounds "
            "(`parameters`), or look for an error in the model, the initial box or that row."
        )
    below = SMALLEST if first == 1.0 else first / 2
    search.best = first * start
    rounds = search.rounds(search.tolerance / 4)
    search.best, _ = search.towards(search.best, below * start, rounds)
    search.note(search.cost(search.best))


def linear_program(search: Search, rounds: int = 80) -> None:
    """The exact optimum on linear systems, by supporting hyperplanes.

    With f and g affine and fixed gains every upper bound, and the negative of every lower bound, is a minimum of sums
    of others with nonnegative weights: concave in the factors. So is the slack of every intersection, and its gradient
    at an infeasible point is a cut that holds for all feasible factors. Every cut enters a linear program of k
    unknowns, whose optimum is a lower bound; the way from there to a point inside gives a feasible point and the next
    cuts.

    Raises:
        MissingExtra: SciPy is not installed.
    """
    optimize = need("scipy.optimize", extra="tune", purpose="tuning by linear programs")
    size = search.best
    cuts: list[np.ndarray] = []
    limits: list[float] = []

    def cut(point: np.ndarray) -> None:
        value, slope, _ = search.scores.gradient(point, penalty=False)
        for first, row in zip(value, slope, strict=True):
            if first < 0 and np.isfinite(row).all() and (row > 0).any():
                scale = np.abs(row * size).max()
                cuts.append(-row * size / scale)
                limits.append((first - row @ point) / scale)

    cut(0.999 * search.best)
    cut(0.5 * search.best)
    box = [(low, 1e3) for low in search.floor / size]
    for _ in range(rounds):
        found = optimize.linprog(
            search.price * size, np.array(cuts) if cuts else None, limits or None, bounds=box, method="highs"
        )
        if found.x is None:
            break
        target = found.x * size
        search.lower = max(search.lower, min(search.cost(target), search.cost(search.best)))
        gap = search.cost(search.best) - search.lower
        if gap <= search.tolerance * abs(search.cost(search.best)):
            break
        # Larger bounds are feasible as well, and inside; the closer to the optimum, the sharper the cuts.
        inside = search.best * (1 + max(0.25 * gap / abs(search.cost(search.best)), search.tolerance))
        feasible, neighbour = search.towards(inside, target, 3)
        if search.cost(feasible) < search.cost(search.best):
            search.best = feasible
        if neighbour is None:
            search.lower = search.cost(search.best)
            break
        cut(neighbour)
        cut(target)
        search.note(search.cost(target))
    search.note(search.cost(search.best))


def penalty_method(search: Search, iterations: int, optimizer: Any) -> None:
    """Descend on ``cost + weight * penalty`` over factors; exact for a weight that is large enough.

    Every tenth iterate is taken back to the feasible side on the way to the best factors so far, so the cost never
    rises; where that way is long the weight was too small, and is doubled.

    Raises:
        MissingExtra: optax is not installed and no optimizer was given.
    """
    optax = need("optax", extra="tune", purpose="tuning by gradients")
    if optimizer is None:
        optimizer = optax.adam(optax.cosine_decay_schedule(0.05, iterations, alpha=0.05))
    cost = search.cost(search.best)
    unit = search.best
    weight = _first_weight(search, unit)
    z = np.ones_like(unit)
    state = optimizer.init(z)
    for k in range(1, iterations + 1):
        _, slope, _ = search.scores.gradient(z * unit, penalty=True)
        step = search.price / cost + weight * slope.sum(axis=0)
        updates, state = optimizer.update(step * unit, state, z)
        z = np.maximum(np.asarray(optax.apply_updates(z, updates), float), search.floor / unit)
        if k % 10 == 0 or k == iterations:
            trial = z * unit
            inside = search.best * (1 + search.tolerance)
            feasible, neighbour = search.towards(inside, trial, 3)
            if neighbour is not None and (np.abs(feasible - trial) > 0.02 * unit).any():
                weight *= 2
            if search.cost(feasible) < search.cost(search.best):
                search.best = feasible
            search.note(search.cost(trial))


def _first_weight(search: Search, theta: np.ndarray) -> float:
    """A weight for which the penalty is worth more than the cost, along the common factor."""
    for shrink in (0.99, 0.95, 0.8, 0.5):
        value, slope, _ = search.scores.gradient(shrink * theta, penalty=True)
        gain = -(slope.sum(axis=0) @ theta)
        if value.sum() > 0 and gain > 0:
            return 2.0 / gain
    return 1.0


def to_stderr(line: str) -> None:
    """A line of progress."""
    print(line, file=sys.stderr, flush=True)
