"""Decomposition functions in plain NumPy, one (i, j) at a time, straight from the papers; and the functions to try."""

from __future__ import annotations

import itertools

import numpy as np

# Every function takes x with the coordinates along axis 0, and the array module.
FUNCTIONS = {
    1: {
        "square": lambda x, xp: x[0] ** 2,
        "cube": lambda x, xp: x[0] ** 3,
        "cubic with two turns": lambda x, xp: x[0] ** 3 - 2 * x[0],
        "sine": lambda x, xp: xp.sin(2 * x[0]),
        "sine plus slope": lambda x, xp: xp.sin(2 * x[0]) + 2.5 * x[0],
        "falling tanh": lambda x, xp: -xp.tanh(x[0]),
        "bell": lambda x, xp: xp.exp(-x[0] * x[0]),
        "abs": lambda x, xp: xp.abs(x[0] - 0.3),
        "clip": lambda x, xp: xp.clip(x[0], -0.4, 0.7),
        "floor": lambda x, xp: xp.floor(1.7 * x[0]),
        "fraction": lambda x, xp: x[0] / (1 + x[0] ** 2),
        "root": lambda x, xp: xp.sqrt(x[0] + 1.2),
        "constant": lambda x, xp: 0 * x[0] + 1.5,
    },
    2: {
        "paper f1": lambda x, xp: 0.6 * x[0] - 0.12 * x[1] + 1.1 * xp.sin(0.3 * x[1] - 0.2 * x[0]),
        "paper f2": lambda x, xp: -0.2 * x[0] - 0.14 * x[1],
        "paper g1": lambda x, xp: 0.2 * x[0] + 0.65 * x[1] + 0.8 * xp.sin(0.3 * x[0] + 0.2 * x[1]),
        "product": lambda x, xp: x[0] * x[1],
        "saddle": lambda x, xp: x[0] ** 2 - x[1] ** 2,
        "bowl": lambda x, xp: x[0] ** 2 + x[0] * x[1] + x[1] ** 2,
        "rotation": lambda x, xp: x[0] * xp.cos(x[1]),
        "distance": lambda x, xp: xp.sqrt(0.1 + (x[0] - 1) ** 2 + x[1] ** 2),
        "greatest": lambda x, xp: xp.maximum(x[0], xp.sin(x[1])),
        "bearing": lambda x, xp: xp.arctan2(x[0], 3 + x[1]),
        "quotient": lambda x, xp: x[1] / (2.5 + x[0]),
        "one of two": lambda x, xp: x[1] ** 3 - x[1],
    },
    3: {
        "triple product": lambda x, xp: x[0] * x[1] * x[2],
        "mixed": lambda x, xp: xp.sin(x[0] + x[1]) - 0.5 * x[2] * x[0],
        "monotone": lambda x, xp: xp.tanh(x[0]) + x[1] ** 3 - xp.exp(0.3 * x[2]),
        "norm": lambda x, xp: xp.sqrt(1 + x[0] ** 2 + x[1] ** 2 + x[2] ** 2),
        "gated": lambda x, xp: x[0] / (1 + xp.exp(-x[1])) + x[2],
        "affine": lambda x, xp: x[0] - 2 * x[1] + 0.5 * x[2] - 1,
    },
    4: {
        "bilinear": lambda x, xp: x[0] * x[3] - x[1] * x[2],
        "unicycle": lambda x, xp: x[0] + x[3] * xp.cos(x[2]) - 0.1 * x[1],
        "network": lambda x, xp: xp.tanh(x[0] - x[1] + 0.5 * x[2]) - 0.3 * xp.maximum(x[3] + x[1], 0),
        "logistic map": lambda x, xp: x[0] * (1 - x[1]) + 0.2 * x[2] ** 2 * x[3],
    },
}


def rows(n: int, x, xp=np):
    """All functions of n variables at x, (n, ...): shape (m, ...)."""
    return xp.stack([f(x, xp) for f in FUNCTIONS[n].values()])


def case(a: float, b: float) -> tuple[str, float]:
    """Which argument z takes, and C: Yang, Mickelin and Ozay, Theorem 2, (10)-(13)."""
    if a >= 0:
        return "x", 0.0
    if b <= 0:
        return "y", 0.0
    return ("x", abs(a)) if abs(a) <= abs(b) else ("y", abs(b))


def f_d(f, a, b, x, y) -> np.ndarray:
    """The four cases with a z for every row; f takes and returns NumPy vectors."""
    m, n = np.shape(a)
    out = np.empty(m)
    for i in range(m):
        z, total = np.empty(n), 0.0
        for j in range(n):
            source, gain = case(a[i][j], b[i][j])
            z[j] = x[j] if source == "x" else y[j]
            total += gain * (x[j] - y[j])
        out[i] = f(z)[i] + total
    return out


def f_d_one_z(f, a, b, x, y, sources) -> np.ndarray:
    """As the paper's Lemma 2 writes it: one z for all rows, coordinate j from x or y as `sources` says."""
    z = np.array([x[j] if source == "x" else y[j] for j, source in enumerate(sources)])
    gain = np.array([[case(*entry)[1] for entry in zip(*row, strict=True)] for row in zip(a, b, strict=True)])
    return f(z) + gain @ (np.asarray(x) - y)


def remainder(f, a, b, lower, upper) -> tuple[np.ndarray, np.ndarray]:
    """f = (f - h x) + h x for every h with h_j in {a_j, b_j}: exact ranges of both parts, the best sum."""
    m, n = np.shape(a)
    best = np.full(m, -np.inf), np.full(m, np.inf)
    for i in range(m):
        for choice in itertools.product("ab", repeat=n):
            h = np.array([a[i][j] if choice[j] == "a" else b[i][j] for j in range(n)])
            # f - h x grows where h is the smallest slope, and falls where it is the largest.
            least = np.array([lower[j] if choice[j] == "a" else upper[j] for j in range(n)])
            most = np.array([upper[j] if choice[j] == "a" else lower[j] for j in range(n)])
            linear = np.minimum(h * lower, h * upper).sum(), np.maximum(h * lower, h * upper).sum()
            best[0][i] = max(best[0][i], f(least)[i] - h @ least + linear[0])
            best[1][i] = min(best[1][i], f(most)[i] - h @ most + linear[1])
    return best


def mean_value(value, a, b, center, lower, upper) -> tuple[np.ndarray, np.ndarray]:
    """``f(c) + [a, b] (x - c)`` of one row around one center; `value` is f(c)."""
    low = np.minimum(a * (upper - center), b * (lower - center)).sum(-1)
    high = np.maximum(b * (upper - center), a * (lower - center)).sum(-1)
    return value + low, value + high
