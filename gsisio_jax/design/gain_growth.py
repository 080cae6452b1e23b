"""``gains="auto"``: the bank grows until the last gain brings less than one per cent."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gsisio_jax.design.recovery import Trial
from gsisio_jax.interval.box import Interval
from gsisio_jax.observer.types import Observer

_WORTH = 0.01  # share of the width of some state, on average over a run, that a gain must bring
_SHARES = (1.0, 0.5, -0.5, 0.75, 0.25, -1.0, -0.25)  # between the steady width (0) and the region (1), see `profile_at`


def grown(
    main: list[np.ndarray],
    gain_at: Callable[[float], np.ndarray | None],
    widths: Callable[[list[np.ndarray]], np.ndarray | None],
) -> list[np.ndarray]:
    """The bank with more gains, from that for boxes of the region inwards, as long as the last one was worth it.

    Args:
        main: what the bank begins with.
        gain_at: the best gain for boxes between the steady width and the region; None where there is none.
        widths: of the boxes (T, n) of a run with a bank; None where no run can be had, then it does not grow.
    """
    first = widths(main)
    if first is None:
        return main
    bank, before = main, _size(first)
    for share in _SHARES:
        gain = gain_at(share)
        if gain is None or any(np.allclose(gain, other, rtol=1e-7, atol=1e-12) for other in bank):
            continue
        run = widths([*bank, gain])
        if run is None or not (_size(run) < before + np.log1p(-_WORTH)).any():
            break
        bank, before = [*bank, gain], _size(run)
    return bank


def widths_of_run(observer: Observer, region: Interval, width: np.ndarray, u_region: Interval) -> np.ndarray | None:
    """Widths (T, n) of the boxes of a noise-free run that begins in the middle of the region and knows no more.

    Args:
        observer: a finished observer.
        region: infinite sides are taken as a hundred widths.
        width: (n,), typical.
        u_region: known inputs of the design; its centre is applied.
    """
    trial = Trial.of(observer, u_region)
    if trial is None:
        return None
    around = Interval(trial.start - 50 * width, trial.start + 50 * width)
    finite = np.isfinite(np.asarray(region.width))
    lower, upper = np.where(finite, region.lower, around.lower), np.where(finite, region.upper, around.upper)
    return trial.widths(Interval(lower, upper), trial.rows)


def _size(widths: np.ndarray) -> np.ndarray:
    """Mean logarithms of widths, (n,)."""
    return np.log(np.clip(widths, 1e-300, 1e300)).mean(0)
