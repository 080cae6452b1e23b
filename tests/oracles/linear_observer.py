"""Independent truth for targets with position, velocity and an unknown acceleration: exact one-step boxes in NumPy.

For each axis and step of length h

    p+ = p + h v + h^2/2 a + w_p        v+ = v + h a + w_v        a: anything at all

the unknown acceleration is eliminated jointly with everything known about the new velocity (measurement AND speed
bound), which leaves one constraint

    p+ - h/2 v+  in  P + h/2 V + W_p + h/2 (-W_v)

between the two new unknowns. One pass over each of them gives the exact hull of that constraint and the boxes of p+
and v+, so no sound observer that carries boxes only can return smaller state boxes, and a good one returns these.
A lost message leaves the speed bound, and the position box grows at that speed: not at twice that, as it would if a
box of the acceleration were computed first.

Source: theory 8.1 (joint elimination), 7.1 (basic left inverses).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class OracleRun:
    """Boxes of every step.

    Attributes:
        lower, upper: state boxes, shape (T, axes, 2): position, velocity.
        input_lower, input_upper: acceleration of the step that starts at row k, shape (T - 1, axes); infinite where row
            k + 1 is in conflict.
        conflict: shape (T,), True where the data contradict the bounds and the box was restarted.
        gap: shape (T, axes, 2): by how much the intersection of that component is empty, 0 where it is not.
    """

    lower: np.ndarray
    upper: np.ndarray
    input_lower: np.ndarray
    input_upper: np.ndarray
    conflict: np.ndarray
    gap: np.ndarray


def observe(
    measured: np.ndarray,
    position_noise: float,
    velocity_noise: float,
    process_noise: tuple[float, float],
    speed_bound: float,
    position_bound: float = np.inf,
    step: float = 1.0,
) -> OracleRun:
    """Run the interval observer over a record, restarting at every conflict.

    Args:
        measured: (T, axes, 2), position and velocity, NaN where missing.
        position_noise, velocity_noise: radii of the measurement noise.
        process_noise: radii of the process noise of position and velocity.
        speed_bound: largest absolute velocity component.
        position_bound: radius of the position box before the first measurement.
        step: sample time.
    """
    count, axes, _ = measured.shape
    noise = np.array([position_noise, velocity_noise])
    seen = np.isfinite(measured)
    # What one row says alone: measurement strip and speed bound.
    bound = np.array([np.inf, speed_bound])
    row_lower = np.maximum(np.where(seen, measured - noise, -np.inf), -bound)
    row_upper = np.minimum(np.where(seen, measured + noise, np.inf), bound)
    lower, upper = row_lower.copy(), row_upper.copy()
    lower[0, :, 0] = np.maximum(lower[0, :, 0], -position_bound)
    upper[0, :, 0] = np.minimum(upper[0, :, 0], position_bound)
    input_lower, input_upper = np.full((count - 1, axes), -np.inf), np.full((count - 1, axes), np.inf)
    conflict, gap = np.zeros(count, dtype=bool), np.zeros((count, axes, 2))
    half, (w_p, w_v) = 0.5 * step, process_noise
    slack = w_p + half * w_v
    for k in range(1, count):
        (p_lo, v_lo), (p_hi, v_hi) = lower[k - 1].T, upper[k - 1].T
        (q_lo, u_lo), (q_hi, u_hi) = row_lower[k].T, row_upper[k].T
        mix_lo, mix_hi = p_lo + half * v_lo - slack, p_hi + half * v_hi + slack
        new_p_lo, new_p_hi = np.maximum(q_lo, mix_lo + half * u_lo), np.minimum(q_hi, mix_hi + half * u_hi)
        new_v_lo, new_v_hi = np.maximum(u_lo, (q_lo - mix_hi) / half), np.minimum(u_hi, (q_hi - mix_lo) / half)
        gap[k] = np.maximum(0.0, np.stack([new_p_lo - new_p_hi, new_v_lo - new_v_hi], -1))
        conflict[k] = (gap[k] > 0.0).any()
        if conflict[k]:
            continue
        lower[k], upper[k] = np.stack([new_p_lo, new_v_lo], -1), np.stack([new_p_hi, new_v_hi], -1)
        # The three left inverses of (h^2/2, h): from the velocity row, from the position row, and free of v.
        move_lo, move_hi = new_p_lo - p_hi - w_p, new_p_hi - p_lo + w_p
        forms_lo = [new_v_lo - v_hi - w_v, (move_lo - step * v_hi) / half, 2.0 * new_v_lo - 2.0 * w_v - move_hi / half]
        forms_hi = [new_v_hi - v_lo + w_v, (move_hi - step * v_lo) / half, 2.0 * new_v_hi + 2.0 * w_v - move_lo / half]
        input_lower[k - 1] = np.max(forms_lo, axis=0) / step
        input_upper[k - 1] = np.min(forms_hi, axis=0) / step
    return OracleRun(lower, upper, input_lower, input_upper, conflict, gap)
