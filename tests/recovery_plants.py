"""Linear plants that lose and regain their state, with runs of them; shared by the tests of recovery and of votes."""

from functools import cache

import numpy as np

import gsisio_jax as gx
from gsisio_jax import Interval

ROWS = 30
C_, S_ = 0.95 * np.cos(0.3), 0.95 * np.sin(0.3)


def plant(A, C, G=None, H=None, w=0.02, v=0.1):
    A, C = np.atleast_2d(A).astype(float), np.atleast_2d(C).astype(float)
    n, l = len(A), len(C)
    G = np.zeros((n, 0)) if G is None else np.atleast_2d(G).astype(float)
    H = np.zeros((l, G.shape[1])) if H is None else np.atleast_2d(H).astype(float)
    return A, C, G, H, np.broadcast_to(w, n).astype(float), np.broadcast_to(v, l).astype(float)


def random_plant(seed):
    """n = 2..6, of which an input drives some and biases an output."""
    rng = np.random.default_rng(seed)
    n = 2 + seed % 5
    l, p = max(2, n - 1), 1 + (n > 4)
    A = rng.normal(size=(n, n))
    A *= 0.95 / np.abs(np.linalg.eigvals(A)).max()
    G, H = rng.normal(size=(n, p)), np.zeros((l, p))
    if p == 2:
        G[:, 1], H[0, 1] = 0, 1
    return plant(A, rng.normal(size=(l, n)), G, H)


CHAIN = np.block(
    [[np.eye(3), 0.2 * np.eye(3)], [0.6 * np.array([[-2, 1, 0], [1, -2, 1], [0, 1, -2.0]]), 0.9 * np.eye(3)]]
)
PLANTS = {
    "one output": plant([[0, -0.5], [1, 1]], [[-2, 1]], w=[0.12, 0.02], v=0.2),
    "rotation": plant([[C_, -S_], [S_, C_]], np.eye(2), v=[0.05, 2.0]),
    "one state seen": plant([[C_, -S_], [S_, C_]], [[1, 0]]),
    "staircase": plant([[0.9, 0, 0], [0.5, 0, 0], [0, 0.5, 0]], [[1, 0, 0]]),  # known after 0, 1 and 2 steps
    "chain": plant(
        CHAIN, np.eye(6)[[0, 1, 2, 4]], np.eye(6)[:, [4]], w=0.01,
    ),
    "biased outputs": plant(
        [[0.8, 0.2, 0], [-0.1, 0.9, 0.3], [0.05, -0.2, 0.7]], np.vstack([np.eye(3), [[1, 1, 0], [0, 1, -1]]]),
        [[0.5, 0, 1], [0, 1, 0], [0, 0, 0.4]], np.vstack([np.eye(3), np.zeros((2, 3))]),
    ),
    "outputs alone": plant([[1.4, 0.3], [-1.2, -0.2]], [[-0.3, -0.2], [0.6, -1.3]]),  # but for rounding, gains say so
    **{f"random {seed}": random_plant(seed) for seed in range(5)},
    "one row only": plant(
        [[0, -1, 0, 0], [0, 0, 0, -1], [0, -0.5, -0.4, 0], [0, 0, 0, 0.95]],
        [[0, 0, 0, 0.2], [0, -0.4, 0, 0], [-0.5, 0, 1.3, 0]], [[-1.8, 0], [0, 0], [0, 1.5], [0, -0.2]],
    ),
}  # fmt: skip
UNDETERMINED = ("one row only",)  # two of its states: never known from R^n, nor if more than one row is lost
DETERMINED = tuple(name for name in PLANTS if name not in UNDETERMINED)


@cache
def designed(name):
    return design(PLANTS[name])


def design(plant):
    A, C, G, H, w, v = plant
    system = gx.System(lambda x: A @ x, lambda x: C @ x, G=G, H=H)
    noise = gx.Noise(Interval.symmetric(w), Interval.symmetric(v))
    return gx.design_observer(system, noise, Interval.symmetric(np.full(len(A), 5.0)), certify=False, sweeps=1)


def records(name, seeds, rows=ROWS, size=1.0):
    """States (S, T, n) and measurements (S, T, l)."""
    A, C, G, H, w, v = PLANTS[name]
    rng = np.random.default_rng(seeds)
    count = 1 if np.isscalar(seeds) else len(seeds)
    x = rng.uniform(-2, 2, (count, len(A)))
    states, seen = [], []
    for _ in range(rows):
        d = size * rng.normal(size=(count, G.shape[1]))
        states.append(x)
        seen.append(x @ C.T + d @ H.T + rng.uniform(-v, v, (count, len(C))))
        x = x @ A.T + d @ G.T + rng.uniform(-w, w, x.shape)
    return np.stack(states, 1), np.stack(seen, 1)


def steps_until_determined(name):
    """N such that y[0..N] determine x[N] whatever x[0] and the inputs are: no run that is not seen at all moves it."""
    A, C, G, H, *_ = PLANTS[name]
    n, p = G.shape
    # Every state and output as a linear map of x[0] and all inputs.
    for steps in range(n + 1):
        size = n + (steps + 1) * p
        x, rows = np.eye(n, size), []
        for k in range(steps + 1):
            d = np.zeros((p, size))
            d[:, n + k * p : n + (k + 1) * p] = np.eye(p)
            rows.append(C @ x + H @ d)
            x, now = A @ x + G @ d, x
        _, values, rest = np.linalg.svd(np.vstack(rows))
        unseen = rest[int((values > 1e-9).sum()) :]
        if np.abs(now @ unseen.T).max(initial=0.0) < 1e-9:
            return steps
    return None
