"""Full-rank controls S2: the paper's f, g, G, noise and initial box with a feedthrough H of full rank.

Here Theorem 1 is right (rho(|G||J1|) < 1), so what Theorem 2 and Lemma 5 say of widths can be held against boxes.
`run` is the paper's recursion with decomposition bounds, in NumPy and from the printed equations.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import systems

import gsisio_jax as gx
from gsisio_jax import Interval
from gsisio_jax.design.framer import framer_gains
from gsisio_jax.examples import paper

STEPS = 200
VARIANTS = "abc"
"""Those of theory 12.2; "d" is a fourth one, on which the corrected condition (i) of Theorem 2 holds."""
_SHARE = {"a": 0.5, "b": 1.0, "c": 1.0, "d": 0.3}  # of the paper's f
_FEEDTHROUGH = {
    "a": [[1.0, 0.3], [0.2, -1.0]],
    "b": [[3.0, 0.9], [0.6, -3.0]],
    "c": [[-1.0, 0.3], [0.25, -0.75]],
    "d": [[9.0, 2.7], [1.8, -9.0]],
}
# Bounds of the paper's partial derivatives on all of R^2.
DF = np.array([[0.38, -0.45], [-0.2, -0.14]]), np.array([[0.82, 0.21], [-0.2, -0.14]])
DG = np.array([[-0.04, 0.49], [-1.0, 0.0]]), np.array([[0.44, 0.81], [1.0, 0.0]])


def _g(x: Any) -> Any:
    return paper.output_map(x)


# One function object per variant: System compares its maps by identity.
_F = {
    variant: functools.partial(lambda share, x: share * paper.state_map(x), share) for variant, share in _SHARE.items()
}


def unknown_input(steps: int = STEPS) -> np.ndarray:
    """(2 sin .2k, 1.5 cos .13k), (steps, 2)."""
    k = np.arange(steps)
    return np.stack([2 * np.sin(0.2 * k), 1.5 * np.cos(0.13 * k)], axis=1)


def s2(variant: str) -> systems.Case:
    """(a) f halved, (b) large H, (c) f of (b), H of (a)'s size, (d) contractive; designed on all of R^2."""
    if variant not in _FEEDTHROUGH:
        raise ValueError(f"s2: `variant` must be one of a, b, c, d, got {variant!r}")
    return systems.Case(
        system=gx.System(_F[variant], _g, G=paper.G, H=np.array(_FEEDTHROUGH[variant])),
        noise=gx.Noise(w=Interval.symmetric(np.full(2, paper.NOISE)), v=Interval.symmetric(np.full(2, paper.NOISE))),
        initial=Interval(paper.INITIAL_LOWER, paper.INITIAL_UPPER),
        region=Interval.entire(2),
        steps=STEPS,
        d=lambda key, steps: jnp.asarray(unknown_input(steps)),
    )


class Plant(NamedTuple):
    """What the recursion needs of a system, in NumPy: maps, and bounds (lower, upper) of their derivatives."""

    f: Callable[[Any], Any]
    g: Callable[[Any], Any]
    df: tuple[np.ndarray, np.ndarray]
    dg: tuple[np.ndarray, np.ndarray]


def plant(variant: str) -> Plant:
    share = _SHARE[variant]
    return Plant(
        lambda x: share * np.asarray(paper.state_map(x, np)), lambda x: np.asarray(paper.output_map(x, np)),
        (share * DF[0], share * DF[1]), DG,
    )  # fmt: skip


class Run(NamedTuple):
    """Truth x (T+1, n), d (T, p) and the boxes of the printed recursion, lower and upper, of x and d."""

    x: np.ndarray
    d: np.ndarray
    x_lower: np.ndarray
    x_upper: np.ndarray
    d_lower: np.ndarray
    d_upper: np.ndarray

    @property
    def x_width(self) -> np.ndarray:
        return self.x_upper - self.x_lower

    @property
    def d_width(self) -> np.ndarray:
        return self.d_upper - self.d_lower

    def misses(self) -> int:
        """Steps at which a box does not contain the truth (rounding aside)."""
        pairs = ((self.x, self.x_lower, self.x_upper), (self.d, self.d_lower, self.d_upper))
        outside = [(value < low - 1e-9) | (value > up + 1e-9) for value, low, up in pairs]
        return sum(int(bad.any(axis=1).sum()) for bad in outside)


def run(system: gx.System, maps: Plant, noise: gx.Noise, lower: Any, upper: Any, d: np.ndarray, seed: int = 0) -> Run:
    """Simulate the plant and run (eq:xup)-(eq:hlow) with the decomposition bounds of Corollary 1 (no known input)."""
    random = np.random.default_rng(seed)
    gains = framer_gains(system)
    G, H = np.asarray(system.G), np.asarray(system.H)
    w, v = (
        np.asarray(box.lower) + random.uniform(size=(len(d), *box.shape)) * np.asarray(box.width)
        for box in (noise.w, noise.v)
    )
    low, up = np.asarray(lower, float), np.asarray(upper, float)
    x = low + random.uniform(size=low.shape) * (up - low)
    truth, boxes, inputs = [x], [(low, up)], []
    w_box, v_box = (np.concatenate([box.upper, box.lower]) for box in (noise.w, noise.v))
    for k in range(len(d)):
        y = maps.g(x) + H @ d[k] + v[k]
        x = maps.f(x) + G @ d[k] + w[k]
        f_up, f_low = (decomposition(maps.f, maps.df, *pair) for pair in ((up, low), (low, up)))
        g_up, g_low = (decomposition(maps.g, maps.dg, *pair) for pair in ((up, low), (low, up)))
        both = (
            gains.M_f @ np.concatenate([f_up, f_low]) + gains.M_g @ np.concatenate([g_up, g_low])
            + gains.M_w @ w_box + gains.M_v @ v_box + gains.M_y @ y
        )  # fmt: skip
        up, low = np.split(both, 2)
        h_up = np.concatenate([up - f_low - noise.w.lower, y - g_low - noise.v.lower])
        h_low = np.concatenate([low - f_up - noise.w.upper, y - g_up - noise.v.upper])
        inputs.append((gains.N21 @ h_up + gains.N22 @ h_low, gains.N11 @ h_up + gains.N12 @ h_low))
        truth.append(x)
        boxes.append((low, up))
    sides, of_input = np.array(boxes), np.array(inputs)
    return Run(np.array(truth), d, sides[:, 0], sides[:, 1], of_input[:, 0], of_input[:, 1])


def decomposition(
    q: Callable[[Any], Any], derivative: tuple[np.ndarray, np.ndarray], x: np.ndarray, y: np.ndarray
) -> np.ndarray:
    """``q_d(x, y)``: row i is ``q_i(z_i) + C_i (x - y)``, the four cases entry by entry (a loop, as printed)."""
    lower, upper = derivative
    out = np.empty(len(lower))
    for i in range(len(lower)):
        z, extra = np.empty(len(x)), 0.0
        for j in range(len(x)):
            a, b = lower[i, j], upper[i, j]
            first = a >= 0 or (b > 0 and -a <= b)
            z[j] = x[j] if first else y[j]
            if a < 0 < b:
                extra += min(-a, b) * (x[j] - y[j])
        out[i] = q(z)[i] + extra
    return out
