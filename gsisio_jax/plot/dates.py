"""Time axes that show dates: days since 1970, as matplotlib counts, and a label that knows the zone."""

from __future__ import annotations

from typing import Any

import numpy as np

from gsisio_jax._moments import time_zone


class DateLabel(str):
    """Label of an axis that shows dates of a zone, or of none."""

    zone: str

    def __new__(cls, zone: str) -> DateLabel:
        made = super().__new__(cls, f"time ({zone})" if zone else "time")
        made.zone = zone
        return made


def zone_of(dataset: Any) -> str | None:
    """Zone of the dates that the time of a dataset stands for, "" where they have none; None where it counts from a
    beginning of its own."""
    time = dataset["time"]
    if time.dtype.kind == "M" or "epoch" in time.attrs:
        return time.attrs.get("zone", "")
    return None


def days(times: Any) -> np.ndarray:
    """Dates, or seconds since 1970, as matplotlib's numbers."""
    from matplotlib.dates import date2num

    times = np.asarray(times)
    if times.dtype.kind in "mM":
        seconds = times.astype(f"{times.dtype.kind}8[ns]").astype(np.int64) / 1e9
    else:
        seconds = times
    return seconds / 86400 + date2num(np.datetime64("1970-01-01"))


def show_dates(axis: Any, label: str) -> None:
    """Dates at the ticks, where the label is that of dates."""
    if not isinstance(label, DateLabel):
        return
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter

    zone = time_zone(label.zone)
    locator = AutoDateLocator(tz=zone)
    axis.xaxis.set_major_locator(locator)
    axis.xaxis.set_major_formatter(ConciseDateFormatter(locator, tz=zone))
