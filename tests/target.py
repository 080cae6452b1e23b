"""One target for the tests of missing data and of conflicts: position and velocity of a mover on a line.

    p+ = p + h v + h^2/2 a + w_p        v+ = v + h a + w_v        y = (p, v) + noise        |v| <= SPEED, a: anything

`oracles.linear_observer` has its exact boxes. All records have STEPS rows.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from oracles.linear_observer import OracleRun, observe

import gsisio_jax as gx
from gsisio_jax import Interval

STEP, SPEED = 0.5, 4.0
POSITION_NOISE, VELOCITY_NOISE = 0.75, 0.5
PROCESS_NOISE = (0.02, 0.1)
STEPS, BATCH = 60, 32
_A = np.array([[1.0, STEP], [0.0, 1.0]])


@dataclass(frozen=True)
class Target:
    """The observer, and runs of it over named records."""

    observer: gx.Observer
    initial: Interval
    bounds: Interval

    def simulate(self, seed: int, count: int | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """States (count, STEPS, 2), measurements, accelerations (count, STEPS); every third noise on its bound."""
        count = BATCH if count is None else count
        rng = np.random.default_rng(seed)

        def noise(radius: Any) -> np.ndarray:
            drawn = rng.uniform(-1, 1, (count, STEPS, 2))
            return np.asarray(radius) * np.where(rng.random(drawn.shape) < 1 / 3, np.sign(drawn), drawn)

        w, v = noise(PROCESS_NOISE), noise((POSITION_NOISE, VELOCITY_NOISE))
        x, a = np.zeros((count, STEPS, 2)), np.zeros((count, STEPS))
        x[:, 0] = rng.uniform(self.initial.lower, self.initial.upper, (count, 2))
        for k in range(STEPS - 1):
            wish = rng.uniform(-1.2 * SPEED, 1.2 * SPEED, count)  # flat out every so often
            a[:, k] = (np.clip(wish, -SPEED, SPEED) - x[:, k, 1] - w[:, k, 1]) / STEP
            x[:, k + 1] = x[:, k] @ _A.T + a[:, k, None] * [STEP**2 / 2, STEP] + w[:, k]
        x[..., 1] = np.clip(x[..., 1], -SPEED, SPEED)  # rounding only
        return x, x + v, a

    def oracle(self, y: np.ndarray) -> OracleRun:
        """The exact boxes for one record (STEPS, 2)."""
        return observe(
            y[:, None], POSITION_NOISE, VELOCITY_NOISE, PROCESS_NOISE, SPEED, float(self.initial.upper[0]), STEP
        )

    def run(self, y: Any, on_conflict: str = "restart", initial: Interval | None = None) -> gx.Estimate:
        """Estimate of records (records, STEPS, 2), each with its own initial box if wanted."""
        box = self.initial if initial is None else initial
        box = Interval(*(jnp.broadcast_to(side, (len(y), 2)) for side in (box.lower, box.upper)))
        found = jax.vmap(partial(gx.estimate, self.observer, on_conflict=on_conflict))(box, jnp.asarray(y))
        return jax.tree.map(np.asarray, found)


def design() -> Target:
    """The target with its bank of gains for missing entries."""
    bounds = Interval([-np.inf, -SPEED], [np.inf, SPEED])
    system = gx.System(
        lambda x: jnp.asarray(_A) @ x,
        lambda x: x,
        G=[[STEP**2 / 2], [STEP]],
        H=np.zeros((2, 1)),
        state_bounds=bounds,
    )
    noise = gx.Noise(Interval.symmetric(PROCESS_NOISE), Interval.symmetric([POSITION_NOISE, VELOCITY_NOISE]))
    return Target(
        gx.design_observer(system, noise, Interval.entire(2), sweeps=1),
        Interval([-10.0, -SPEED], [10.0, SPEED]),
        bounds,
    )


def record(estimate: gx.Estimate, index: int) -> gx.Estimate:
    """One record of a batch."""
    return jax.tree.map(lambda leaf: leaf[index], estimate)
