"""Algorithm 1 (GSISIO) as one call: gains by Theorem 1, boxes by (eq:xup)-(eq:hlow), bounds of widths by Lemma 5."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from gsisio_jax._calls import named_arguments
from gsisio_jax.design.build import design_observer
from gsisio_jax.design.prediction import DEFAULT_BOUNDS, LeftInverse
from gsisio_jax.interval.box import Interval
from gsisio_jax.observer.estimation import estimate
from gsisio_jax.paper.lipschitz import lipschitz_constants
from gsisio_jax.paper.stability import Stability, stability
from gsisio_jax.paper.widths import width_bounds
from gsisio_jax.plant.system import Noise, System

# Lemma 2 knows how wide these bounds of f and g can be; the others alone are sound, but of no known width.
_OF_KNOWN_WIDTH = ("decomposition", "remainder", "mean_value")


class Gsisio(NamedTuple):
    """The four outputs of Algorithm 1, one row per step k = 1..T.

    Attributes:
        state: box of x[k] from y[0..k-1], (T, n). Crossed (lower > upper) only where it was asked for uncertified.
        input: box of d[k-1], (T, p).
        state_width_bound: delta^x_k, (T,): bound of the 2-norm of the width of `state`; ``inf`` is "no bound".
        input_width_bound: delta^d_{k-1}, (T,).

    Source: paper, Algorithm 1.
    """

    state: Interval
    input: Interval
    state_width_bound: np.ndarray
    input_width_bound: np.ndarray


@named_arguments
def gsisio(
    f: Callable[..., Any],
    g: Callable[..., Any],
    B: Any,
    G: Any,
    D: Any,
    H: Any,
    w: Interval,
    v: Interval,
    initial: Interval,
    y: Any,
    u: Any = None,
    *,
    region: Interval | None = None,
    left_inverse: LeftInverse | Any = "pseudo",
    bounds: Sequence[str] = DEFAULT_BOUNDS,
    derivative: Interval | None = None,
    printed: bool = False,
    allow_uncertified: bool = False,
) -> Gsisio:
    """Algorithm 1 on one record: the box of x[k] from y[0..k-1], that of d[k-1], and bounds of both widths.

    For more than a look at the paper use `gsisio_jax.design_observer`: its current form also serves rank-deficient H.

    Args:
        f: state map, a JAX function of x (n,) or of (x, u); returns (n,).
        g: output map; returns (l,).
        B: (n, m), or None.
        G: (n, p).
        D: (l, m), or None.
        H: (l, p).
        w: bounds of the process noise, (n,).
        v: bounds of the measurement noise, (l,).
        initial: box of x[0], (n,).
        y: measurements y[0..T-1], (T, l), T >= 1.
        u: known inputs (T, m); needed where m > 0.
        region: box (n,) on which Lemma 2's constants are computed; None is all of R^n. From the first box on that
            leaves it the width bounds are infinite.
        left_inverse: J of [G; H], as in `design_observer`; "pseudo" is the paper's.
        bounds: methods of Corollary 1. The width bounds are infinite unless "decomposition", "remainder" or
            "mean_value" is among them.
        derivative: box (n + l, n) that contains the derivative of [f; g] everywhere, for "decomposition" and
            "remainder", as the paper uses it; Lemma 2's constants then hold everywhere, too. None encloses it on every
            box, which is tighter, and on `region` for Lemma 2.
        printed: width bounds by Lemma 2, Theorem 2 and Lemma 5 as printed (no bounds in general: theory 2.8-2.11).
        allow_uncertified: run the recursion where it is no framer. Boxes may then be crossed and miss the truth; the
            width bounds are those of the norm of |upper - lower|.

    Returns:
        `Gsisio`.

    Raises:
        FramerNotGuaranteed: rho(|G||J1|) >= 1, so the boxes would be wrong, and `allow_uncertified` is not set.
        ValueError: shapes do not agree, or a derivative is not bounded on the region.

    Source: paper, Algorithm 1; theory 2.
    """
    given = [np.shape(matrix)[1] for matrix in (B, D) if matrix is not None and np.ndim(matrix) == 2]
    rows = np.shape(u)[-1] if u is not None and np.ndim(u) == 2 else None
    system = System(f, g, G, H, B, D, m=None if given else rows)
    noise = Noise(w, v)
    y = np.asarray(y, dtype=np.float64)
    if y.ndim != 2 or y.shape[1] != system.l or not len(y):
        raise ValueError(f"gsisio: `y` must have shape (T, {system.l}) with T >= 1, got {y.shape}")
    if system.m and (u is None or np.shape(u) != (len(y), system.m)):
        raise ValueError(
            f"gsisio: the system has {system.m} known inputs; give `u` of shape ({len(y)}, {system.m}), got "
            f"{None if u is None else np.shape(u)}"
        )
    region = Interval.entire(system.n) if region is None else region
    known = np.zeros((len(y), 0)) if not system.m else np.asarray(u, dtype=np.float64)
    u_region = Interval(known.min(0), known.max(0))
    with jax.enable_x64(True):
        observer = design_observer(
            system, noise, region, form="prediction", u_region=u_region, bounds=bounds, left_inverse=left_inverse,
            allow_uncertified=allow_uncertified, derivative=derivative,
        )  # fmt: skip
        answer = None
        if any(method in observer.bounds for method in _OF_KNOWN_WIDTH):
            pair = None
            if derivative is not None and ("decomposition" in observer.bounds or "remainder" in observer.bounds):
                pair, region = (derivative[: system.n], derivative[system.n :]), Interval.entire(system.n)
            constants = lipschitz_constants(system, region, u_region, pair)
            answer = stability(system, noise, region, printed, observer.left_inverse, u_region, constants)
        # The box of x[T] needs no y[T]: a row of missing measurements stands in for it.
        y = np.concatenate([y, np.full((1, system.l), np.nan)])
        found = estimate(observer, initial, y, np.concatenate([known, known[-1:]]) if system.m else None)
    state, inputs = (Interval.unchecked(np.asarray(b.lower), np.asarray(b.upper)) for b in (found.state, found.input))
    return Gsisio(state[1:], inputs, *_width_bounds(answer, np.asarray(initial.width), state, region, printed))


def _width_bounds(
    answer: Stability | None, first: np.ndarray, state: Interval, region: Interval, printed: bool
) -> tuple[np.ndarray, np.ndarray]:
    """delta^x and delta^d, infinite from the first box on that leaves the region of the constants."""
    steps = len(state) - 1
    if answer is None or not np.isfinite(first).all():
        return np.full(steps, np.inf), np.full(steps, np.inf)
    widths = width_bounds(answer, first, steps, printed)
    low, high = np.minimum(state.lower, state.upper), np.maximum(state.lower, state.upper)
    inside = ((region.lower <= low) & (high <= region.upper)).all(1)[:-1]
    held = np.logical_and.accumulate(inside)
    return np.where(held, widths.state[1:], np.inf), np.where(held, widths.input, np.inf)
