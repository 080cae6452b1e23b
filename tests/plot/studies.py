"""Datasets as `sweep` and `monte_carlo` make them, with numbers that a test can foresee."""

from __future__ import annotations

import numpy as np
import xarray as xr

LEVELS = np.geomspace(0.01, 10.0, 6)
SIZES = np.array([3.0, 1.0, 2.0, 7.0])
TIME = 0.5 * np.arange(20)


def widths() -> np.ndarray:
    """(4, 6, 2): last widths of two states."""
    return SIZES[:, None, None] * LEVELS[:, None] * np.array([1.0, 10.0])


def swept() -> xr.Dataset:
    """Initial boxes x noise levels, with an infinite width and one that is not there."""
    width = widths()
    width[3, 5], width[0, 0] = np.inf, np.nan
    bits = np.zeros((4, 6), dtype=np.int32)
    bits[3], bits[2, 1] = 4, 5
    names = {"CONFLICT": 1, "MISSING": 2, "UNBOUNDED": 4}
    flags = {"long_name": "status bits that occurred", "flag_masks": np.array([*names.values()], np.int32),
             "flag_meanings": " ".join(names)}  # fmt: skip
    settled = np.where(np.arange(4)[:, None] > 2, np.nan, np.full((4, 6), 3.0))
    return xr.Dataset(
        {
            "state_width_final": (("size", "level", "state"), width, {"long_name": "last width of the state box"}),
            "input_width_final": (("size", "level", "input"), 3 * width[..., :1], {"long_name": "last width"}),
            "status_any": (("size", "level"), bits, flags),
            "settled_at": (("size", "level"), settled, {"long_name": "step of settling"}),
            "steady_width": ("state", [0.2, 2.0], {}),
            "predicted_state_width": (("level", "state"), 2.5 * LEVELS[:, None] * np.array([1.0, 10.0]), {}),
            "predicted_input_width": (("level", "input"), 9 * LEVELS[:, None], {}),
        },
        {
            "size": ("size", SIZES, {"units": "m"}),
            "level": ("level", LEVELS, {"units": "V"}),
            "state": ["tank_level", "speed"],
            "state_unit": ("state", ["cm", "m/s"]),
            "input": ["leak"],
        },
        {"title": "Two tanks"},
    )


def runs(count: int = 60) -> xr.Dataset:
    """Noise levels x runs, as of a Monte Carlo study with its summary."""
    width = LEVELS[:, None, None] * (1 + np.arange(count) / count)[:, None] * np.array([1.0, 10.0])
    covered = np.ones((6, count, 2))
    covered[2, 5, 0] = 0.9
    table = np.stack([width.mean(1), 0.9 * width.mean(1), 1.1 * width.mean(1), width.max(1)], axis=-1)
    about = {"long_name": "last width of the state box", "units": "m"}
    return xr.Dataset(
        {
            "state_width_final": (("level", "run", "state"), width, about),
            "state_coverage": (("level", "run", "state"), covered, {"long_name": "share", "units": "1"}),
            "state_width_final_summary": (("level", "state", "statistic"), table, about),
            "predicted_state_width": (("level", "state"), 3 * LEVELS[:, None] * np.array([1.0, 10.0]), {}),
        },
        {
            "level": LEVELS, "run": np.arange(count), "state": ["x1", "x2"],
            "statistic": ["mean", "mean_lower", "mean_upper", "max"],
        },
        {"confidence": 0.95},
    )  # fmt: skip


def kept(cases: int = 30) -> xr.Dataset:
    """Boxes over time of cases x 4 levels around one truth, ``sin(time)`` (the input: 0)."""
    levels = np.array([0.4, 0.1, 0.2, 0.3])
    half = levels[:, None] + 5 * np.exp(-TIME) * np.linspace(0.1, 1, cases)[:, None, None]
    state, d = np.sin(TIME) + np.stack([-half, half]), np.stack([-half, half])
    d[..., -1] = np.nan
    sides = {}
    for index, side in enumerate(("lower", "upper")):
        sides[f"state_{side}"] = (("box", "level", "time", "state"), state[index][..., None])
        sides[f"input_{side}"] = (("box", "level", "time", "input"), d[index][..., None])
    status = np.zeros((cases, 4, len(TIME)), dtype=np.int32)
    status[:, :, 7], status[:, :, 9] = 2, 1
    return xr.Dataset(
        {
            **sides,
            "status": (("box", "level", "time"), status),
            "steady_width": ("state", [0.9]),
            "predicted_state_width": (("level", "state"), 2.2 * levels[:, None]),
            "predicted_input_width": (("level", "input"), np.full((4, 1), np.inf)),
        },
        {
            "level": ("level", levels, {"units": "V"}), "time": ("time", TIME, {"units": "s"}), "state": ["position"],
            "state_unit": ("state", ["m"]), "input": ["force"],
        },
    )  # fmt: skip
