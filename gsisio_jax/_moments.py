"""Seconds since 1970 as date and time of day, in a zone."""

from __future__ import annotations

import datetime
import re
import zoneinfo

EPOCH = "1970-01-01T00:00:00Z"


def time_zone(name: str) -> datetime.tzinfo:
    """A zone by its name or its offset from UTC; UTC itself where it is not known on this machine.

    >>> str(time_zone("+02:00")), str(time_zone("UTC"))
    ('UTC+02:00', 'UTC')
    """
    offset = re.fullmatch(r"(?:UTC)?([+-])(\d\d):?(\d\d)?", name)
    if offset:
        minutes = 60 * int(offset[2]) + int(offset[3] or 0)
        return datetime.timezone(datetime.timedelta(minutes=-minutes if offset[1] == "-" else minutes))
    if name in ("UTC", "Z", "z"):
        return datetime.UTC
    try:
        return zoneinfo.ZoneInfo(name)
    except (zoneinfo.ZoneInfoNotFoundError, ValueError, OSError):
        return datetime.UTC


def zone_name(zone: datetime.tzinfo) -> str:
    """A name that `time_zone` knows; UTC where there is none."""
    name = str(zone)
    return name if time_zone(name) is not datetime.UTC else "UTC"


def moment(seconds: float, zone: str) -> str:
    """Date and time of day in a zone ("": UTC), to the microsecond: numbers of that size hold no more.

    >>> moment(1714557600.0, "UTC"), moment(1714557600.25, "+02:00")
    ('2024-05-01 10:00:00', '2024-05-01 12:00:00.25')
    """
    try:
        since = datetime.timedelta(microseconds=round(seconds * 1e6))
        date = (datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC) + since).astimezone(time_zone(zone))
    except (OverflowError, ValueError):  # no year of four digits
        return f"{seconds:.15g} s"
    fraction = f".{date.microsecond:06d}".rstrip("0").rstrip(".")
    return f"{date:%Y-%m-%d %H:%M:%S}{fraction}"
