"""A real airliner whose satellite navigation was disturbed and spoofed: model and measurements.

The target is a point in a conformal plane. Its acceleration is the unknown input: nothing is assumed about it. What is
assumed about the messages (ADS-B, table with one row per second, every column repeats its last value) is said here and
in the comments of ``flight.toml``, with the figures that the noise bounds come from.

Source: theory 12.7.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np

from gsisio_jax._extras import need
from gsisio_jax.examples.projection import ObliqueMercator
from gsisio_jax.interval import Interval
from gsisio_jax.plant import System

if TYPE_CHECKING:
    import pandas as pd

SAMPLE_TIME = 1.0
"""Grid of the table [s]."""
KNOT = 1852.0 / 3600.0
"""[m/s]"""
PLANE = ObliqueMercator(start=(41.4, 28.8), end=(57.0, 15.9))
"""The line of smallest distortion runs from the first to the last position of the flight (Istanbul to the Baltic)."""

MAX_POSITION_AGE = 1.0
"""A position counts in the second in which it appears, and only if it is no older than this [s]."""
MAX_SILENCE = 5.0
"""After a longer silence [s] a repeated speed and track says nothing: no message may have come since."""
MAX_DIRECTION_AGE = 60.0
"""Without a position younger than this [s] it is not known how the plane is turned where the target is."""

_TRANSITION = np.array(
    [[1.0, 0.0, SAMPLE_TIME, 0.0], [0.0, 1.0, 0.0, SAMPLE_TIME], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
_NEEDED = ("time_s", "latitude_deg", "longitude_deg", "groundspeed_kt", "track_deg", "position_time_s")


def _motion(x: Any) -> Any:
    return jnp.asarray(_TRANSITION, x.dtype) @ x


def _everything(x: Any) -> Any:
    return x


def system(speed_bound: float = 351.0) -> System:
    """A target in the plane; state east, north [m], velocity east, north [m/s], input acceleration east, north [m/s^2].

    The input is the mean acceleration over the second, so the velocity's equation is exact; how the acceleration is
    spread over the second moves the position, which is the process noise. All four states are measured.

    Args:
        speed_bound: largest absolute component of the plane velocity [m/s]. The default is 350 m/s, which no airliner
            exceeds, times 1.0029, the plane's scale 430 km off its line (on the flight's own track it is below 1.0005).

    Source: theory 12.7; theory 3.4 and 8.1.
    """
    free = np.full(2, np.inf)
    bound = np.concatenate([free, np.full(2, speed_bound)])
    return System(
        f=_motion,
        g=_everything,
        G=np.vstack([0.5 * SAMPLE_TIME**2 * np.eye(2), SAMPLE_TIME * np.eye(2)]),
        H=np.zeros((4, 2)),
        state_bounds=Interval(-bound, bound),
    )


def measurements(table: pd.DataFrame) -> pd.DataFrame:
    """What the raw table says for certain at each of its rows, in plane coordinates.

    The table repeats old values, so a number in it is not a measurement. The rules:

    - A position counts at the row where its time stamp changes, if it is at most `MAX_POSITION_AGE` old. It is moved
      on by its age times the reported velocity.
    - Speed and track count at a row where one of them changes, and (an assumption: the table does not say when a
      repeated velocity was received) at a row with a fresh position, unless more than `MAX_SILENCE` seconds without
      any message lie before it.
    - They also need a position no older than `MAX_DIRECTION_AGE`: it gives the direction of true north in the plane.

    Args:
        table: columns as described in ``data/README.md``; rows in order of time, not necessarily every second.

    Returns:
        One row per row of the table (seconds without a row stay absent): time_s, east_m, north_m, velocity_east_m_s,
        velocity_north_m_s; NaN where nothing was measured.

    Raises:
        ValueError: a column is missing or the times do not increase.
    """
    pandas = need("pandas", extra="cli", purpose="the flight example")
    absent = [name for name in _NEEDED if name not in table.columns]
    if absent:
        raise ValueError(f"flight.measurements: the table lacks the columns {absent}; it has {list(table.columns)}")
    column = {name: table[name].to_numpy(dtype=float) for name in _NEEDED}
    time = column["time_s"]
    if not np.all(np.diff(time) > 0.0):
        raise ValueError("flight.measurements: `time_s` must increase from row to row; sort the table first")

    age = time - column["position_time_s"]
    fresh = _changed(column["position_time_s"]) & np.isfinite(column["latitude_deg"] + column["longitude_deg"])
    fresh &= np.abs(age) <= MAX_POSITION_AGE
    message = _changed(column["groundspeed_kt"]) | _changed(column["track_deg"])
    message[:1] = False  # the first row has no row before it to differ from
    silence = time - _last(np.where(fresh | message, time, np.nan), before=True)
    velocity = message | (fresh & (silence <= MAX_SILENCE))

    known_age = time - _last(column["position_time_s"])
    velocity &= (known_age <= MAX_DIRECTION_AGE) & np.isfinite(column["groundspeed_kt"] + column["track_deg"])
    point = PLANE(_last(column["latitude_deg"]), _last(column["longitude_deg"]))
    velocity_east, velocity_north = PLANE.velocity(point, column["groundspeed_kt"] * KNOT, column["track_deg"])
    return pandas.DataFrame(
        {
            "time_s": time,
            "east_m": np.where(fresh, point.east + age * velocity_east, np.nan),
            "north_m": np.where(fresh, point.north + age * velocity_north, np.nan),
            "velocity_east_m_s": np.where(velocity, velocity_east, np.nan),
            "velocity_north_m_s": np.where(velocity, velocity_north, np.nan),
        }
    )


def _changed(values: np.ndarray) -> np.ndarray:
    """True at rows whose value is there and differs from the row before; the first row counts as changed."""
    return np.isfinite(values) & np.concatenate([[True], values[1:] != values[:-1]])


def _last(values: np.ndarray, before: bool = False) -> np.ndarray:
    """The last finite value up to each row (or strictly before it); NaN until there is one."""
    row = np.maximum.accumulate(np.where(np.isfinite(values), np.arange(len(values)), -1))
    if before:
        row = np.concatenate([[-1], row[:-1]])
    return np.where(row >= 0, values[row], np.nan)
