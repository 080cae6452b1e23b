"""The flight in one picture: where the target can have been, where it says it is, and where the two contradict."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gsisio_jax._extras import need

if TYPE_CHECKING:
    import xarray as xr

LONG_GAP = 10
"""Seconds without a position from which a gap is shaded."""
SILENCE = 120
"""Seconds without a position from which the reachable box is drawn on the map."""
LABELLED = 400
"""Seconds without a position from which the gap is labelled with its length."""
PANELS = {"velocity_east": None, "velocity_north": None, "acceleration_east": 120.0, "acceleration_north": 120.0}
"""Signals over time, and where their axis is cut [unit of the signal]."""
GAP, BOX, PALE, REPORT, ALARM = "#dcdee2", "#2f66b3", "#b9cdea", "#10243f", "#d1301f"


@dataclass(frozen=True)
class _Gap:
    """Rows `first` to `last` (inclusive) without a position; the next position is at row `last` + 1."""

    first: int
    last: int


@dataclass(frozen=True)
class _Alarm:
    """A contradiction at a row, the last row with a position before it, and what was violated."""

    row: int
    before: int
    text: str


def draw(dataset: xr.Dataset, path: str | Path) -> None:
    """Draw the flight.

    Args:
        dataset: result of the command line for ``flight.toml``: ``<signal>_lower`` and ``<signal>_upper`` of the
            states and inputs named there, ``measured_reported_*``, coordinate ``time`` [s], attribute ``alarms``.
        path: picture to write, 1600 x 1000 pixels; the format follows its suffix.
    """
    figure_module = need("matplotlib.figure", extra="plot", purpose="plotting")
    agg = need("matplotlib.backends.backend_agg", extra="plot", purpose="plotting")
    figure = figure_module.Figure(figsize=(12.0, 7.5), dpi=1600 / 12, facecolor="white")
    agg.FigureCanvasAgg(figure)
    flight = _Flight(dataset)
    grid = figure.add_gridspec(
        1 + len(PANELS), 2, width_ratios=[0.9, 1.0], left=0.06, right=0.985, top=0.85, bottom=0.075, hspace=0.16,
        wspace=0.19,
    )  # fmt: skip
    _draw_map(figure.add_subplot(grid[:, 0]), flight)
    panels = [figure.add_subplot(grid[0, 1])]
    _draw_width(panels[0], flight)
    patches = need("matplotlib.patches", extra="plot", purpose="plotting")
    panels[0].legend(
        handles=[
            patches.Patch(color=BOX, label="box"),
            patches.Patch(color=PALE, label="box while a message is missing"),
            patches.Patch(color=GAP, label=f"no position for {LONG_GAP} s or more"),
        ],
        loc="lower left", bbox_to_anchor=(-0.02, 1.13), ncols=3, frameon=False, fontsize=9, handlelength=1.2,
        columnspacing=0.9,
    )  # fmt: skip
    for row, (name, limit) in enumerate(PANELS.items(), start=1):
        panels.append(figure.add_subplot(grid[row, 1], sharex=panels[0]))
        _draw_series(panels[-1], flight, name, limit)
    for axes in panels:
        axes.tick_params(labelbottom=axes is panels[-1], labelsize=9)
        axes.grid(color="#e6e6e6", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.yaxis.set_label_coords(-0.085, 0.5)
    panels[0].set_xlim(flight.time[0], flight.time[-1])
    panels[-1].set_xlabel("time [s]")
    panels[-1].xaxis.set_major_formatter("{x:,.0f}")
    figure.text(0.05, 0.966, dataset.attrs.get("title", ""), fontsize=16, fontweight="bold", va="center")
    figure.text(0.05, 0.931, _sentence(flight), fontsize=11, color="#333333", va="center")
    figure.savefig(path)


class _Flight:
    """The numbers of the dataset that the picture needs, and the gaps and alarms in them."""

    def __init__(self, dataset: xr.Dataset):
        self.dataset = dataset
        self.time = dataset["time"].to_numpy().astype(float)
        self.reported = self._pair("measured_reported_{}")
        self.lower, self.upper = self._pair("{}_lower"), self._pair("{}_upper")
        self.seen = np.asarray(np.isfinite(self.reported).all(axis=-1))
        self.gaps = _gaps(self.seen)
        self.alarms = self._alarms()

    def _pair(self, pattern: str) -> np.ndarray:
        """East and north of a variable, shape (T, 2)."""
        return np.stack([self.dataset[pattern.format(name)].to_numpy() for name in ("east", "north")], axis=-1)

    def _alarms(self) -> list[_Alarm]:
        alarms: dict[int, _Alarm] = {}
        for record in json.loads(self.dataset.attrs.get("alarms", "[]")):
            row = int(np.argmin(np.abs(self.time - record["time"])))
            earlier = np.flatnonzero(self.seen[:row])
            if not self.seen[row] or len(earlier) == 0:
                alarms.setdefault(row, _Alarm(row, row, f"{self.time[row]:,.0f} s: contradiction"))
                continue
            before = int(earlier[-1])
            way = float(np.linalg.norm(self.reported[row] - self.reported[before])) / 1e3
            span = self.time[row] - self.time[before]
            speed = round(1e3 * way / span, -1)
            text = f"{self.time[row]:,.0f} s: jump of {way:,.{1 if way < 100.0 else 0}f} km"
            alarms.setdefault(row, _Alarm(row, before, f"{text}\nin {span:,.0f} s, {speed:,.0f} m/s"))
        return list(alarms.values())

    def box(self, row: int) -> tuple[float, float, float, float]:
        """West, south, width and height [km] of the position box at a row."""
        west, south = self.lower[row] / 1e3
        width, height = (self.upper[row] - self.lower[row]) / 1e3
        return west, south, width, height


def _gaps(seen: np.ndarray) -> list[_Gap]:
    """Stretches of at least `LONG_GAP` rows without a position."""
    edges = np.flatnonzero(np.diff(np.concatenate([[True], seen, [True]]).astype(int)))
    return [_Gap(int(a), int(b) - 1) for a, b in edges.reshape(-1, 2) if b - a >= LONG_GAP]


def _sentence(flight: _Flight) -> str:
    if not flight.alarms:
        return "No alarm: every message fits a target that never exceeds the speed limit."
    times = " and ".join(f"{flight.time[alarm.row]:,.0f} s" for alarm in flight.alarms)
    return (
        f"Certified alarm{'s' if len(flight.alarms) > 1 else ''} at {times}: whatever its acceleration, no target that "
        "stays below 350 m/s fits the messages before and after."
    )


def _draw_map(axes: Any, flight: _Flight) -> None:
    _draw_track(axes, flight, lambda row: True)
    axes.set_aspect("equal", adjustable="datalim")
    axes.tick_params(labelsize=9)
    axes.set_xlabel("plane east [km]")
    axes.set_ylabel("plane north [km]", labelpad=0)
    rows = np.flatnonzero(flight.seen)
    for row in (rows[0], rows[-1]) if len(rows) else ():
        _note(axes, flight.reported[row] / 1e3, f"{flight.time[row]:,.0f} s", (9, 0), REPORT)
    for gap in flight.gaps:
        length = gap.last - gap.first + 1
        if length >= LABELLED and gap.first > 0 and gap.last + 1 not in {alarm.row for alarm in flight.alarms}:
            west, south, width, _ = flight.box(gap.last)
            text = f"{flight.time[gap.last]:,.0f} s, after {length:,} s\nof silence: box still\n"
            _note(axes, (west, south), f"{text}finite, {width:,.0f} km wide", (4, 5), BOX, va="bottom")
            _note(axes, flight.reported[gap.first - 1] / 1e3, f"{flight.time[gap.first - 1]:,.0f} s", (9, 0), REPORT)
    _zoom(axes, flight)
    lines, patches = (need(f"matplotlib.{name}", extra="plot", purpose="plotting") for name in ("lines", "patches"))
    axes.legend(
        handles=[
            lines.Line2D([], [], color=REPORT, marker=".", linestyle="none", label="reported position"),
            patches.Patch(facecolor=PALE, alpha=0.5, edgecolor=BOX, label="position box when messages return"),
            patches.Patch(facecolor="#f6d5d1", edgecolor=ALARM, label="the same, but they return outside of it"),
            lines.Line2D([], [], color=ALARM, linestyle="--", label="jump beyond any airliner's speed"),
        ],
        loc="lower left", fontsize=8.5, framealpha=0.95,
    )  # fmt: skip


def _draw_track(axes: Any, flight: _Flight, wanted: Any, size: float = 3.0) -> None:
    """Reported positions, the boxes at the end of long silences and before every alarm, the jumps."""
    patches = need("matplotlib.patches", extra="plot", purpose="plotting")
    violated = {alarm.row - 1 for alarm in flight.alarms}
    boxes = [(gap.last, BOX) for gap in flight.gaps if gap.last - gap.first + 1 >= SILENCE and gap.last not in violated]
    boxes += [(row, ALARM) for row in sorted(violated)]
    for row, colour in boxes:
        west, south, width, height = flight.box(row)
        if wanted(row) and np.isfinite([west, south, width, height]).all():
            for style in ({"facecolor": colour, "alpha": 0.12}, {"facecolor": "none", "edgecolor": colour}):
                axes.add_patch(patches.Rectangle((west, south), width, height, linewidth=1.2, **style))
    axes.plot(*flight.reported[flight.seen].T / 1e3, ".", color=REPORT, markersize=size)
    for alarm in flight.alarms:
        if alarm.before < alarm.row and wanted(alarm.row):
            start, end = flight.reported[alarm.before] / 1e3, flight.reported[alarm.row] / 1e3
            arrow = {"arrowstyle": "-|>,head_width=0.3", "color": ALARM, "linewidth": 1.8, "linestyle": "--"}
            axes.annotate(
                "", end, xytext=start, arrowprops={**arrow, "shrinkA": 0, "shrinkB": 0}, annotation_clip=False
            )
    axes.grid(color="#e6e6e6", linewidth=0.6)
    axes.set_axisbelow(True)


def _zoom(axes: Any, flight: _Flight) -> None:
    """Label the jumps; the first one that is too short to be seen on the map gets a window of its own."""
    window_free = True
    for alarm in flight.alarms:
        start, end = flight.reported[alarm.before] / 1e3, flight.reported[alarm.row] / 1e3
        way = float(np.linalg.norm(end - start))
        if not (window_free and 0.0 < way < 100.0):
            _note(axes, 0.42 * start + 0.58 * end, alarm.text, (-14, 0), ALARM, ha="right")
            continue
        window_free = False
        inset = axes.inset_axes((0.5, 0.66, 0.48, 0.325))
        _draw_track(inset, flight, lambda row, at=alarm.row: row in (at, at - 1), size=5.0)
        middle = 0.5 * (start + end)
        inset.set_xlim(middle[0] - 0.8 * way, middle[0] + 0.8 * way)
        inset.set_ylim(middle[1] - 0.8 * way, middle[1] + 0.8 * way)
        inset.set_aspect("equal")
        inset.tick_params(labelsize=8, direction="in")
        inset.text(
            0.04, 0.97, alarm.text, transform=inset.transAxes, va="top", color=ALARM, fontweight="bold", fontsize=8.5
        )
        axes.indicate_inset_zoom(inset, edgecolor="#555555")


def _note(
    axes: Any, at: Any, text: str, offset: tuple[int, int], colour: str, va: str = "center", ha: str = "left"
) -> None:
    axes.annotate(
        text, at, xytext=offset, textcoords="offset points", va=va, ha=ha, color=colour,
        fontsize=8.5, fontweight="bold" if colour == ALARM else "normal",
        bbox={"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 1.0},
    )  # fmt: skip


def _draw_width(axes: Any, flight: _Flight) -> None:
    """Width of the position box, logarithmic, with the gaps and alarms labelled."""
    width = (flight.upper - flight.lower).max(axis=-1) / 1e3
    axes.semilogy(flight.time, np.where(np.isfinite(width), width, np.nan), color=BOX, linewidth=0.9)
    axes.set_ylabel("position box\nwidth [km]")
    axes.yaxis.set_major_locator(need("matplotlib.ticker", extra="plot", purpose="plotting").LogLocator(numticks=9))
    axes.yaxis.set_major_formatter("{x:,g}")
    _mark_times(axes, flight)
    for gap in flight.gaps:
        if gap.last - gap.first + 1 >= LABELLED:
            middle = 0.5 * (flight.time[gap.first] + flight.time[gap.last])
            text = f"{gap.last - gap.first + 1:,} s"
            axes.text(middle, 0.08, text, transform=axes.get_xaxis_transform(), ha="center", fontsize=9)
    ends = [flight.time[alarm.row] for alarm in flight.alarms]
    for index, time in enumerate(ends):
        crowded = index + 1 < len(ends) and ends[index + 1] - time < 0.2 * (flight.time[-1] - flight.time[0])
        axes.annotate(
            f"alarm {time:,.0f} s", (time, 1.0), xycoords=("data", "axes fraction"), xytext=(4 if crowded else -4, 5),
            textcoords="offset points", ha="right" if crowded else "left", color=ALARM, fontweight="bold",
        )  # fmt: skip


def _draw_series(axes: Any, flight: _Flight, name: str, limit: float | None) -> None:
    """A box over time: strong where both messages it needs are there, pale where one is missing."""
    lower, upper = (flight.dataset[f"{name}_{side}"].to_numpy() for side in ("lower", "upper"))
    width = np.where(np.isfinite(upper - lower), upper - lower, np.inf)
    narrow = width < 4.0 * np.min(width)
    style = {"color": PALE, "linewidth": 0.0, "step": "post", "zorder": 1}
    axes.fill_between(flight.time, lower, upper, where=~np.isnan(lower), **style)
    axes.vlines(flight.time[narrow], lower[narrow], upper[narrow], color=BOX, linewidth=1.0, zorder=2)
    _mark_times(axes, flight)
    unit = str(flight.dataset[f"{name}_lower"].attrs.get("units", "")).replace("^2", "²")
    axes.set_ylabel(f"{name.replace('_', ' ').replace(' ', chr(10))} [{unit}]")
    if limit is not None and np.nanmax(np.abs(np.stack([lower, upper]))) > limit:
        axes.set_ylim(-limit, limit)
        axes.text(
            0.995, 0.05, f"axis cut at ±{limit:g} {unit}", transform=axes.transAxes, ha="right", fontsize=8,
            bbox={"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 1.0},
        )  # fmt: skip


def _mark_times(axes: Any, flight: _Flight) -> None:
    for gap in flight.gaps:
        axes.axvspan(flight.time[gap.first], flight.time[gap.last], color=GAP, linewidth=0.0, zorder=0.5)
    for alarm in flight.alarms:
        axes.axvline(flight.time[alarm.row], color=ALARM, linewidth=1.6, zorder=3)
