"""Linear plants drawn at random for `benchmarks.tightness_default`: fixed seeds, chosen before their widths were known.

Stable and marginally unstable, some outputs much worse than others, inputs that show in the outputs at once, one step
later, or both.
"""

from __future__ import annotations

import numpy as np

from benchmarks.tightness import Plant

SEEDS = range(14)
_RADII = (0.7, 0.9, 0.98, 1.0, 1.03)


def random_plant(seed: int) -> Plant:
    """Two to eight states, up to two inputs, at least one output more than inputs. Draws are repeated until the inputs
    show within a step and there is an observer of one gain whose boxes settle."""
    rng = np.random.default_rng([15, seed])
    n, p = 2 + seed % 7, seed % 3
    while True:
        plant = _drawn(rng, n, p)
        if _settles(plant):
            return plant


def _drawn(rng: np.random.Generator, n: int, p: int) -> Plant:
    l = int(rng.integers(p + 1, max(p + 2, n + 1)))
    A = rng.normal(size=(n, n)) * (rng.random((n, n)) < max(0.4, 2 / n))
    A *= rng.choice(_RADII) / max(np.abs(np.linalg.eigvals(A)).max(), 1e-3)
    own = rng.permutation(max(n, l))[:l] % n
    C = np.eye(n)[own] + 0.4 * rng.normal(size=(l, n)) * (rng.random((l, n)) < 0.25)
    G = rng.normal(size=(n, p)) * (rng.random((n, p)) < 0.6)
    H = rng.normal(size=(l, p)) * (rng.random((l, p)) < 0.3) * (rng.random(p) < 0.5)
    v = 0.05 * 10 ** (1.6 * rng.random(l) * (rng.random(l) < 0.5))  # every other one up to forty times worse
    return Plant(A, C, G, H, np.full(n, 0.02), v, np.full(n, 3.0))


def _settles(plant: Plant) -> bool:
    import gsisio_jax as gx

    A, C, ball = plant.A, plant.C, gx.Interval.symmetric
    if np.linalg.matrix_rank(np.vstack([plant.G, plant.H])) < plant.G.shape[1]:
        return False
    system = gx.System(lambda x: A @ x, lambda x: C @ x, G=plant.G, H=plant.H)
    noise = gx.Noise(ball(plant.w), ball(plant.v))
    try:
        found = gx.design_observer(system, noise, gx.Interval.entire(len(A)), missing=False, window=1)
    except (gx.ObserverDoesNotExist, gx.NoDesignFound):
        return False
    return bool(np.isfinite(found.certificate.steady_width).all())
