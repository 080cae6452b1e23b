"""Where to look for a point that leaves its bounds: inside a box, on its faces, at its corners. Plain NumPy."""

from __future__ import annotations

import itertools

import numpy as np


def points(lower, upper, count: int = 40, seed: int = 0) -> np.ndarray:
    """Points of a box of shape (n,), n <= 4: interior, every face, every corner; shape (many, n).

    Infinite sides are cut off far out, on a logarithmic scale.
    """
    rng = np.random.default_rng(seed)
    lower, upper = np.asarray(lower, float), np.asarray(upper, float)
    n = lower.size
    inner = _draw(rng, lower, upper, count)
    faces = []
    for i, side in itertools.product(range(n), (lower, upper)):
        face = _draw(rng, lower, upper, max(4, count // 4))
        face[:, i] = side[i]
        faces.append(face)
    corners = np.array(list(itertools.product(*zip(lower, upper, strict=True))))
    everything = np.concatenate([inner, *faces, corners])
    return everything[np.isfinite(everything).all(1)]


def _draw(rng, lower, upper, count):
    out = np.empty((count, lower.size))
    for i, (a, b) in enumerate(zip(lower, upper, strict=True)):
        far = 10.0 ** rng.uniform(-2, 4, count)
        if np.isfinite(a) and np.isfinite(b):
            out[:, i] = a + (b - a) * rng.uniform(0, 1, count)
        elif np.isfinite(a):
            out[:, i] = a + far
        elif np.isfinite(b):
            out[:, i] = b - far
        else:
            out[:, i] = far * rng.choice([-1, 1], count)
    return np.clip(out, lower, upper)


def grid(a: float, b: float, count: int = 20001) -> np.ndarray:
    """A dense grid of an interval, both ends (and 0, where functions turn) in it.

    Infinite ends are followed out on a logarithmic scale.
    """
    far = 10.0 ** np.linspace(-3, 8, count)
    if np.isfinite(a) and np.isfinite(b):
        t = np.linspace(a, b, count)
        return np.insert(t, np.searchsorted(t, 0.0), 0.0) if a < 0 < b else t
    if np.isfinite(a):
        return np.concatenate([[a], a + far])
    if np.isfinite(b):
        return np.concatenate([b - far, [b]])
    return np.concatenate([-far[::-1], [0.0], far])
