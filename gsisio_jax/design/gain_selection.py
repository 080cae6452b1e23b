"""Which gains an observer keeps: the certified one, gains for other box sizes, and gains for missing measurements."""

from __future__ import annotations

from collections.abc import Collection
from itertools import combinations

import numpy as np

from gsisio_jax.design.gains import improve, optimal_gain, profile_gain
from gsisio_jax.design.problem import GainProblem
from gsisio_jax.errors import NoDesignFound
from gsisio_jax.interval.box import Interval
from gsisio_jax.observer.certificate import spectral_radius

_MOST_OUTPUTS_FOR_ALL_PATTERNS = 4  # 2^4 patterns of missing entries get a gain each; beyond, one entry at a time


def main_gain(problem: GainProblem, region: Interval, usable: np.ndarray | None = None) -> np.ndarray:
    """The certified gain if there is one; else the gain that keeps boxes of a typical width smallest.

    Args:
        problem: the gain problem.
        region: of the design.
        usable: as in `profile_gain`; None: all.

    Raises:
        NoDesignFound: there is none whose boxes would be finite.
    """
    scale = typical_width(problem, region)
    everything = np.full(problem.columns, True) if usable is None else usable.copy()
    gain = optimal_gain(problem, np.ones(problem.n), scale, everything)
    if gain is not None and np.isfinite(problem.steady_width(gain)).all():
        # Solve once more in units of the answer: states of very different size are then equally accurate.
        again = optimal_gain(problem, np.ones(problem.n), units(problem.steady_width(gain)), everything)
        if again is not None and (problem.steady_width(again) <= problem.steady_width(gain)).all():
            gain = again
        return improve(problem, gain, usable=everything)
    # No gain contracts. Widths of the cheapest gains over a few steps are the profile to be good at.
    width, gain = scale, None
    for _ in range(3):
        gain = profile_gain(problem, width, everything, units(width))
        if gain is None:
            break
        width = problem.row_cost(gain, width)
    if gain is None:
        raise NoDesignFound(
            "design_observer: the linear program for the gain has no solution although the rank condition holds; the "
            "problem is badly scaled. Choose units in which states, outputs and noise have similar size."
        )
    if spectral_radius(problem.implicit(gain)) < 1 - 1e-9:
        return gain
    # Without T2 g(x[k]) there is no such term; where no input has to be cancelled that is a gain, too.
    everything[problem.l : problem.l + problem.q] = False
    plain = profile_gain(problem, scale, everything, units(scale))
    if plain is None:
        raise NoDesignFound(
            "design_observer: on this region the output is too nonlinear for the gain: rho(|N_z| R) = "
            f"{spectral_radius(problem.implicit(gain)):.3g} >= 1, so the box of x[k] would not be finite. "
            f"{problem.how_inputs_show()} What may help: `state_bounds`, or more outputs."
        )
    return plain


def profile_bank(problem: GainProblem, main: np.ndarray, region: Interval, count: int) -> list[np.ndarray]:
    """Gains that are best, row by row, for boxes from well below the steady width up to the region (log-spaced).

    Smaller ones too: the intersection of a bank is narrower than the steady width of any one gain.
    """
    found = [profile_at(problem, main, region, share) for share in np.linspace(-1, 1, max(count, 0))]
    return [gain for gain in found if gain is not None]


def profile_at(problem: GainProblem, main: np.ndarray, region: Interval, share: float) -> np.ndarray | None:
    """The gain for boxes of the steady width (share 0), of the region (1), of a hundredth of the steady width (-1)."""
    steady = problem.steady_width(main)
    steady = profile_of(problem, steady, region)
    width = np.asarray(region.width)
    largest = np.where(np.isfinite(width), np.maximum(width / steady, 2.0), 100.0)
    profile = steady * np.where(share < 0, 100.0, largest) ** share
    return profile_gain(problem, profile, np.full(problem.columns, True), units(profile))


def gains_for_missing(
    problem: GainProblem, main: np.ndarray, region: Interval, together: Collection[int] = ()
) -> list[np.ndarray]:
    """Gains for steps in which y[k-1] or entries of y[k] are missing, also all those `together` (theory 8)."""
    l, q = problem.l, problem.q
    width = np.asarray(region.width)
    steady = problem.steady_width(main)
    typical = np.where(np.isfinite(steady), 4 * units(steady), typical_width(problem, region))
    width = np.where(np.isfinite(width), width, typical)
    support = problem.T2 != 0
    if l <= _MOST_OUTPUTS_FOR_ALL_PATTERNS:
        present = [set(kept) for size in range(l + 1) for kept in combinations(range(l), size)]
    else:
        present = [set(), *(set(range(l)) - {j} for j in range(l)), set(range(l))]
        if 1 < len(together) < l:
            present.append(set(range(l)) - set(together))
    found = []
    for before in (False, True):
        for kept in present:
            usable = np.full(problem.columns, True)
            usable[:l] = before
            usable[l : l + q] = [set(np.flatnonzero(row)) <= kept for row in support]
            if not before or len(kept) < l:
                found.append(profile_gain(problem, width, usable, units(width)))
    return [gain for gain in found if gain is not None]


def gains_without_state_bounds(problem: GainProblem, main: np.ndarray, region: Interval) -> list[np.ndarray]:
    """Gains that do not use bounds of the states: with y[k] and without it.

    A gain that is best for its own steady width may put a bound in the place of a state that it could have followed:
    its boxes then widen to that bound, where without it they would have stayed narrow.
    """
    if not len(problem.ds):
        return []
    profile = 0.1 * profile_of(problem, problem.steady_width(main), region)
    found = []
    for measured in (True, False):
        usable = np.full(problem.columns, True)
        usable[problem.l : problem.l + problem.q] = measured
        usable[problem.l + problem.q :] = False
        found.append(profile_gain(problem, profile, usable, units(profile)))
    return [gain for gain in found if gain is not None]


def distinct(bank: list[np.ndarray]) -> list[np.ndarray]:
    """Drop gains that repeat an earlier one; keep the first, certified one in front."""
    kept: list[np.ndarray] = []
    for gain in bank:
        if not any(
            np.allclose(gain, other, rtol=1e-7, atol=1e-12) and ((gain != 0) == (other != 0)).all() for other in kept
        ):
            kept.append(gain)
    return kept


def typical_width(problem: GainProblem, region: Interval) -> np.ndarray:
    """A first guess of the width of the boxes, (n,): from the region, else from what the outputs resolve."""
    width = np.asarray(region.width)
    with np.errstate(all="ignore"):
        resolved = np.abs(np.linalg.pinv(problem.E)) @ problem.dv + problem.dw if problem.l else problem.dw
    return np.where(np.isfinite(width) & (width > 0), width, units(resolved))


def profile_of(problem: GainProblem, steady: np.ndarray, region: Interval) -> np.ndarray:
    """Steady widths as units, (n,); the typical ones where some do not settle."""
    return units(steady) if np.isfinite(steady).all() else typical_width(problem, region)


def with_rows(main: np.ndarray, rows: list[list[np.ndarray]]) -> list[np.ndarray]:
    """As few gains as hold further rows, given for every state; a gain has that of `main` where there is no other."""
    count = max(map(len, rows), default=0)
    return [np.stack([mine[k] if k < len(mine) else main[i] for i, mine in enumerate(rows)]) for k in range(count)]


def units(width: np.ndarray) -> np.ndarray:
    """Widths as units: zeros become a share of the largest."""
    largest = width.max(initial=0.0)
    return np.maximum(width, 1e-3 * largest) if largest > 0 else np.ones_like(width)
