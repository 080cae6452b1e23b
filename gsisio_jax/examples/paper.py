"""The paper's example: the system as printed, and how its table of measurements was simulated.

Source: paper, section "Illustrative Example"; theory 12.1.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.plant import System

G = np.array([[0.0, -0.1], [0.2, -0.2]])
H = np.array([[-0.1, 0.3], [0.25, -0.75]])
NOISE = 0.2
"""Radius of every component of w and v, as printed."""
INITIAL_LOWER, INITIAL_UPPER = np.array([-1.1, -2.0]), np.array([2.0, 1.1])
SEED = 7
STEPS = 60
QUIET_NOISE = 0.02
"""Radius of the noise in the quiet record, of which a tenth of the printed bounds is true as well."""


def state_map(x: Any, xp: Any = jnp) -> Any:
    """f of the paper; `xp` is the array module (jax.numpy or numpy)."""
    return xp.stack(
        [
            0.6 * x[0] - 0.12 * x[1] + 1.1 * xp.sin(0.3 * x[1] - 0.2 * x[0]),
            -0.2 * x[0] - 0.14 * x[1],
        ]
    )


def output_map(x: Any, xp: Any = jnp) -> Any:
    """g of the paper; `xp` is the array module (jax.numpy or numpy)."""
    return xp.stack(
        [
            0.2 * x[0] + 0.65 * x[1] + 0.8 * xp.sin(0.3 * x[0] + 0.2 * x[1]),
            xp.sin(x[0]),
        ]
    )


def _f(x: Any) -> Any:
    return state_map(x)


def _g(x: Any) -> Any:
    return output_map(x)


def system() -> System:
    """The printed system: two states, two outputs, two unknown inputs, feedthrough of rank one, no known input."""
    return System(f=_f, g=_g, G=G, H=H)


def random_input(key: Any, k: Any, x: Any) -> Any:
    """Unknown inputs for simulated runs: standard normal, without any bound."""
    return jax.random.normal(key, (2,), x.dtype)


def record(seed: int = SEED, steps: int = STEPS, noise: float = NOISE) -> dict[str, np.ndarray]:
    """Simulate the tables that the example is shipped with.

    Args:
        seed: of NumPy's default generator.
        steps: rows of the table, one per second.
        noise: radius of every component of w and v.

    Returns:
        Columns time_s, y1, y2 and the truth x1, x2, d1, d2. x_0 is uniform in the printed box, the unknown input
        standard normal, the noise uniform in its bounds.
    """
    random = np.random.default_rng(seed)
    x = random.uniform(INITIAL_LOWER, INITIAL_UPPER)
    d = random.standard_normal((steps, 2))
    w, v = random.uniform(-noise, noise, (2, steps, 2))
    states, outputs = np.empty((steps, 2)), np.empty((steps, 2))
    for k in range(steps):
        states[k] = x
        outputs[k] = output_map(x, np) + H @ d[k] + v[k]
        x = state_map(x, np) + G @ d[k] + w[k]
    columns = np.column_stack([np.arange(steps), outputs, states, d])
    return dict(zip(("time_s", "y1", "y2", "x1", "x2", "d1", "d2"), columns.T, strict=True))
