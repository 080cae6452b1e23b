"""From seconds to indices of an evenly spaced grid, block by block.

The index goes from row to row: a row lies n steps after the one before, n being the time between them in sample
times, rounded. Counting from the first row instead would add up the rounding of a sample time that was written with a
few digits (0.0333 for 1/30 is a whole step off after a thousand rows). Where every stamp is within a tolerance of less
than a quarter of a step from the true grid, a difference of two is within half a step of its true value, so every n is
exact and errors cannot add up. Across a gap of many steps a rounded sample time would count wrongly again; there, the
mean time between neighbouring rows takes its place as soon as the two differ by more than the jitter explains.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..errors import UserError
from .stamps import NAMES, Stamps, likely_unit

MAXIMUM_STEPS = 50_000_000  # of one gap, and of a file that is read as a whole
TOLERANCE = 0.1  # of the sample time
SPARE = 1.1  # as later rows may be off by more
CHANCE = 0.01  # that stamps on no grid are taken for some on one
NEAR = 8  # steps between two rows that still tell how long a step is
DRIFT = 2e-3  # how far the mean time between rows may be from sample_time: 0.0333 for 1/30 passes, 0.033 does not


@dataclass
class Clock:
    """Places rows on the grid. All of it is plain numbers: copied (`dataclasses.asdict`) and made anew it goes on.

    Attributes:
        sample_time: seconds between two points of the grid.
        tolerance: seconds that a stamp may be off its point; a tenth of the sample time by default.
        unit: of the numbers of the clock, for messages; empty where it shows dates.
        found: whether `sample_time` was found in the times, so that it has no rounding to be held against them.
        sparse: whether most points of the grid may be without a row.
        rows, index, start, since, shown: points that have a row, the last one, seconds of the first and the last row,
            text of the last stamp.
        gaps, jitter: for `describe`.
        near_time, near_steps, runs: seconds and steps between neighbouring rows, and how often such a run began.
        usual: median of the first differences, seconds.
    """

    sample_time: float
    tolerance: float
    unit: str = "s"
    found: bool = False
    sparse: bool = False
    rows: int = 0
    index: int = 0
    start: float = 0.0
    since: float = 0.0
    shown: str = ""
    gaps: int = 0
    jitter: float = 0.0
    near_time: float = 0.0
    near_steps: int = 0
    runs: int = 1
    usual: float = 0.0

    def place(self, stamps: Stamps, duplicates: bool = False) -> np.ndarray:
        """Indices of the rows of a block, after those before.

        Args:
            stamps: times of the rows; none is NaN.
            duplicates: whether several rows may share a point of the grid.

        Returns:
            (R,) int64, not falling; 0 is the point of the first row.

        Raises:
            UserError: a stamp falls behind the one before, is there twice, or is off the grid; the clock has another
                unit than the sample time; the mean time between rows is not the sample time.
        """
        since = stamps.since
        if not len(since):
            return np.empty(0, np.int64)
        if not self.rows:
            self.start = self.since = float(since[0])
        step = np.diff(since, prepend=self.since)
        first = 0 if self.rows else 1  # the very first row has none before it
        check_order(stamps, step, self.shown, duplicates, self.rows > 0)
        self._plausible(stamps, step[first:])
        period = self._period(step[first:])
        count = np.rint(step / period)
        slack = self._slack(stamps)
        off = np.abs(step - count * period) > slack
        if off.any():
            self._off(stamps, int(np.argmax(off)))
        shared = count[first:] == 0
        if not duplicates and shared.any():
            bad = int(np.argmax(shared)) + first
            raise UserError(
                f"{stamps.place(bad)}: the times {self._before(stamps, bad)} and {stamps.show(bad)} fall on the same "
                f'step of sample_time = {self.sample_time:g} s; set on_duplicate = "first", "last" or "mean", or '
                "mend sample_time"
            )
        if count.max() > MAXIMUM_STEPS:
            bad = int(np.argmax(count))
            raise UserError(
                f"{stamps.place(bad)}: the time {stamps.show(bad)} comes more than {MAXIMUM_STEPS:,} steps of "
                f"{self.sample_time:g} s after {self._before(stamps, bad)}; check time.unit and sample_time"
            )
        index = self.index + np.cumsum(count).astype(np.int64)
        self._no_drift(stamps, index, since - self.start, slack)
        self.gaps += int(np.count_nonzero(count > 1))
        self.jitter = max(self.jitter, float(np.abs(step - count * period).max()))
        self.rows += int(np.count_nonzero(count)) + (self.rows == 0)
        self.index, self.since = int(index[-1]), float(since[-1])
        self.shown = stamps.show(len(stamps) - 1)
        return index

    def finish(self, name: str) -> None:
        """Complain about a grid that is mostly empty.

        Raises:
            UserError: over half of its points have no row, and that is not one long gap between even rows.
        """
        points = self.index + 1
        if self.sparse or 2 * self.rows >= points or round(self.usual / self.sample_time) <= 1:
            return
        raise UserError(
            f"{name}: {points - self.rows:,} of the {points:,} steps of sample_time = {self.sample_time:g} s would be "
            f"without a row; the times differ by {self.usual:.6g} s a row. Set sample_time = {self.usual:.6g}, or "
            "sparse = true where rows are meant to be rare"
        )

    def describe(self) -> str:
        """What was found, in one line."""
        absent = self.index + 1 - self.rows
        how = "found sample_time = " if self.found else "sample_time = "
        gaps = f"{self.gaps} gap{'s' if self.gaps != 1 else ''}" + (
            f" ({absent:,} step{'s' if absent > 1 else ''} without a row)" if absent else ""
        )
        share = f"{self.rows:,} rows on {self.index + 1:,} steps ({100 * self.rows / (self.index + 1):.4g} %)"
        return f"{how}{self.sample_time:.9g} s: {share}, {gaps}, largest jitter {self.jitter:.2g} s"

    def _before(self, stamps: Stamps, index: int) -> str:
        return stamps.show(index - 1) if index else self.shown

    def _plausible(self, stamps: Stamps, step: np.ndarray) -> None:
        """A clock in another unit than the sample time is named as such before its rows are counted."""
        step = step[step > 0]
        if not len(step) or self.usual:
            return
        self.usual = float(np.median(step))
        ratio = self.usual / self.sample_time
        unit = likely_unit(ratio, self.unit) if self.unit else None
        if unit is None or self.sparse or 0.5 < ratio < 2:
            return
        what = f"would leave {1 - 1 / ratio:.1%} of the steps without a row" if ratio > 1 else "would merge rows"
        raise UserError(
            f"{stamps.place(0)}: the times differ by {self.usual:.6g} s a row, which with sample_time = "
            f'{self.sample_time:g} s {what}: {NAMES[unit]}? Set time.unit = "{unit}"'
        )

    def _period(self, step: np.ndarray) -> float:
        """Seconds of a step: the sample time, or the mean over neighbouring rows where the two surely differ."""
        count = np.rint(step / self.sample_time)
        near = (count > 0) & (count <= NEAR)
        self.near_time += float(step[near].sum())
        self.near_steps += int(count[near].sum())
        self.runs += int(np.count_nonzero(count > NEAR))
        if not self.near_steps:
            return self.sample_time
        mean = self.near_time / self.near_steps
        error = 2 * self.tolerance * self.runs / self.near_steps
        if abs(mean - self.sample_time) <= error or abs(mean / self.sample_time - 1) > DRIFT:
            return self.sample_time
        return mean

    def _slack(self, stamps: Stamps) -> float:
        """Two stamps may both be off; and a large clock value is itself only known to a few units in its last place."""
        return max(2 * self.tolerance, 8 * stamps.resolution, 8 * float(np.spacing(np.abs(stamps.since).max())))

    def _off(self, stamps: Stamps, bad: int) -> None:
        between = stamps.since[bad] - (stamps.since[bad - 1] if bad else self.since)
        raise UserError(
            f"{stamps.place(bad)}: the time {stamps.show(bad)} is not on the grid of sample_time = "
            f"{self.sample_time:.9g} s: it comes {between:.6g} s ({between / self.sample_time:.4g} steps) after "
            f"{self._before(stamps, bad)}, and each may be off by {self.tolerance:.3g} s (time.tolerance); rows that "
            'lie on no grid need dt = "as_input"'
        )

    def _no_drift(self, stamps: Stamps, index: np.ndarray, since: np.ndarray, slack: float) -> None:
        limit = slack + (0.05 if self.found else DRIFT) * since
        wrong = np.abs(since - index * self.sample_time) > limit
        if wrong.any():
            bad = int(np.argmax(wrong))
            mean = since[-1] / index[-1] if index[-1] else self.usual
            raise UserError(
                f"{stamps.place(bad)}: the rows are {mean:.6g} s apart on average, not "
                f'sample_time = {self.sample_time:.9g} s; set sample_time = {rounded(mean, 1e-4 * mean):.9g}, or "auto"'
            )


def check_order(stamps: Stamps, step: np.ndarray, shown: str, duplicates: bool, later: bool) -> None:
    """Times must not fall from row to row, nor stand still where `duplicates` is false.

    Args:
        stamps: of the block.
        step: (R,) seconds from the row before; that of the very first row is 0.
        shown: text of the last stamp before the block.
        duplicates: whether equal stamps are allowed.
        later: whether there were rows before the block.
    """
    wrong = step < 0
    if not duplicates:
        wrong[0 if later else 1 :] |= step[0 if later else 1 :] == 0
    if not wrong.any():
        return
    bad = int(np.argmax(wrong))
    before = stamps.show(bad - 1) if bad else shown
    if step[bad] < 0:
        what, remedy = f"comes after {before}", 'times must increase from row to row, or set on_unsorted = "sort"'
    else:
        what, remedy = "is there twice", 'set on_duplicate = "first", "last" or "mean" to accept that'
    raise UserError(f"{stamps.place(bad)}: the time {stamps.show(bad)} {what}; {remedy}")


def find_sample_time(stamps: Stamps, tolerance: float | None = None) -> float:
    """The time between neighbouring rows, for ``sample_time = "auto"``.

    The median of the differences is within the jitter of a step, whatever gaps there are, as long as more than half of
    the rows have a neighbour. The mean over such neighbours is far closer, because the jitter of all stamps between the
    ends of a run cancels. Of the numbers that are as close as that, the one with the fewest digits is taken, as a
    frequency in Hz or as a time.

    Args:
        stamps: times of the rows.
        tolerance: seconds that a stamp may be off its point; a tenth of the time between rows by default.

    Raises:
        UserError: fewer than three different times; or fewer than nine in ten rows fit the grid.
    """
    mean, median, count, deviation = _even_steps(stamps)
    good = (deviation <= 2 * (TOLERANCE * mean if tolerance is None else tolerance)) & (count > 0)
    if good.mean() < 0.9:
        wider = tolerance_needed(stamps)
        remedy = f"set time.tolerance = {wider:g}, " if wider is not None else ""
        raise UserError(
            f'{stamps.place(0)}: sample_time = "auto" found steps of about {median:.4g} s, but only '
            f"{good.mean():.0%} of the rows lie on such a grid; {remedy}give sample_time, or "
            'dt = "as_input" where rows are uneven'
        )
    near = (count > 0) & (count <= NEAR)
    runs = 1 + int(np.count_nonzero(~near))
    jitter = float(deviation[good].max())
    error = max(2 * jitter, 4 * stamps.resolution, 1e-12 * mean)
    return rounded(mean, error * runs / float(count[near].sum()))


def tolerance_needed(stamps: Stamps) -> float | None:
    """Seconds that stamps are off their grid, rounded up; None where they are too far off to tell which point is whose,
    or where stamps without a grid would often be as near to one.

    Raises:
        UserError: fewer than three different times.
    """
    mean, _, count, deviation = _even_steps(stamps)
    needed = SPARE * float(deviation.max()) / 2
    # Of stamps on no grid, differences are anywhere up to half a step off.
    if needed <= 0 or (count > 0).mean() < 0.9 or (4 * needed / mean) ** len(count) > CHANCE:
        return None
    digit = 10.0 ** (math.floor(math.log10(needed)) - 1)
    tolerance = float(f"{math.ceil(needed / digit) * digit:.2g}")
    return tolerance if tolerance <= mean / 4 else None


def _even_steps(stamps: Stamps) -> tuple[float, float, np.ndarray, np.ndarray]:
    """Mean and median of the time between neighbours; steps from each time to the next, and how far off those are."""
    step = np.diff(np.sort(stamps.since))
    step = step[step > 0]
    if len(step) < 2:
        raise UserError(f'{stamps.place(0)}: sample_time = "auto" needs at least three different times; give a number')
    median = mean = float(np.median(step))
    # The second mean is over differences that are whole steps of the first, not of a median that jitters.
    for _ in range(2):
        count = np.rint(step / mean)
        near = (count > 0) & (count <= NEAR)
        mean = float(step[near].sum() / count[near].sum())
    count = np.rint(step / mean)
    return mean, median, count, np.abs(step - count * mean)


def rounded(value: float, error: float) -> float:
    """The number with the fewest digits within `error` of a value, as a whole number of Hz where that has fewer.

    >>> rounded(0.033333349, 1e-6) == 1 / 30, rounded(0.1000003, 1e-5)
    (True, 0.1)
    """
    if not math.isfinite(value) or value <= 0:
        return value
    for digits in range(1, 17):
        time, rate = float(f"{value:.{digits}g}"), float(f"{1 / value:.{digits}g}")
        if abs(time - value) <= error:
            return time
        if rate.is_integer() and abs(1 / rate - value) <= error:
            return 1 / rate
    return value
