"""What a design promises: how wide the boxes can get, and where that promise holds. NumPy only, no solver."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import equinox as eqx
import numpy as np

from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.reading import check_type, is_whole
from gsisio_jax.plant.system import Noise


class Certificate(eqx.Module):
    """The width promise of a design, and everything needed to check it.

    As long as two successive boxes of the state lie in `region` (anywhere, where f and g are affine) and no measurement
    is missing, the widths obey ``next_width``, and so settle at or below `steady_width`.

    Attributes:
        certified: widths settle: `rate` < 1, or see `slices`.
        rate: spectral radius of ``A + |N_z| R`` (prediction form: ``|G||J1|`` in the place of ``|N_z| R``).
        implicit_rate: spectral radius of ``|N_z| R`` on the region; below 1 the box of x[k] is finite.
        steady_width: (n,) width that the state boxes settle at or below, design noise; ``inf`` if not certified.
        input_width: (p,) the same for the input boxes.
        region: box (n,) the enclosures of the derivatives hold on.
        region_matters: False where f and g are affine and the region is all of R^n: there is nothing to leave.
        slack: (n,) region width minus `steady_width`.
        self_consistent: all slacks are nonnegative; otherwise the boxes cannot be promised to stay in the region, and
            the certificate is empty.
        equality_residual: largest entry of ``G - N_y H - N_z C G`` in the columns of free inputs.
        recoverable: after one lost row of measurements all boxes become finite again (None: not examined). State by
            state, from lost rows or from nothing: `rows_until_finite`.
        recovery_steps: (n,) the row of measurements, counted from 0, from which on a box is finite if nothing is known
            of the state before (a start from R^n, any gap, a conflict); ``inf``: not within n + 4 rows; () where it was
            not examined. Proved where f and g have affine bounds, else tried without noise from the centre of the
            region.
        recovery_width: (n,) bound of the width of the box in that row, at the noise of the design; where f and g are
            not affine and no row proves it, what the trial shows.
        lost_row_steps: the same after 1, 2, ... lost rows between boxes that were finite; more rows than listed take
            what the last entry says. Tried, or proved by rows that lean on the box before the gap; where f and g are
            affine the trial is the rule.
        lost_row_width: (m, n), how wide boxes are in these rows: `recovered_width`.
        window: what rows over several steps make of widths (`WindowWidths`), where f and g are affine; else None.
        rates: what gains and rows over several steps make of widths in the phases of a pattern (`RateWidths`): of the
            `rates` of the design, or of P = 1 phase, where rows over several steps promise widths and the first gain
            does not; else None.
        rate_width: (P, n) width that the state boxes settle at or below in every phase, from any finite box, at the
            noise of the design, while outputs come as `rates` say; ``inf`` where none is promised. For other noise
            ``rates.settled(noise)``. None where `rates` is.
        rounds: how often the certified bound is applied in a step, about the middle of what it has left (theory 5.6).
        excess: (n,), width that they leave of boxes as wide as the region.
        slices: the slopes on parts of the region (`Slices`), where the design was asked to `split` it; else None. Then
            `next_width` and `steady_width` count them, and widths may settle where `rate` is above 1.
        notes: what a reader should know besides.
        framer: the boxes are certain; False only for a prediction form that is none and was asked for all the same.

    Source: theory 4 and 6.
    """

    region: Interval
    region_matters: bool = eqx.field(static=True)
    growth: Any  # A, (n, n)
    implicit: Any  # |N_z| R, (n, n)
    noise_w: Any  # |P|, (n, n)
    noise_v: Any  # |N_y| + |N_z T2|, (n, l)
    noise_fixed: Any  # width that state bounds and known input bounds contribute, (n,)
    input_state_now: Any  # |J1|, (p, n): weight of width[k]
    input_state_before: Any  # (p, n): weight of width[k-1]
    input_noise_v: Any  # |J2|, (p, l)
    input_fixed: Any  # width that known input bounds contribute, (p,)
    steady_width: Any
    input_width: Any
    equality_residual: Any
    promised: bool = eqx.field(static=True)  # `certified`, known while tracing
    recoverable: bool | None = eqx.field(static=True)
    notes: tuple[str, ...] = eqx.field(static=True)
    framer: bool = eqx.field(static=True, default=True)
    recovery_steps: tuple[float, ...] = eqx.field(static=True, default=())
    recovery_width: Any = None
    lost_row_steps: tuple[tuple[float, ...], ...] = eqx.field(static=True, default=())
    lost_row_width: Any = None
    window: Any = None
    slices: Any = None
    input_noise_w: Any = None  # (p, n), weight of w in input boxes beside that of `input_state_now`; None: nothing
    excess: Any = 0.0
    rounds: int = eqx.field(static=True, default=0)
    rates: Any = None
    rate_width: Any = None

    @property
    def rate(self) -> float:
        """Spectral radius of ``A + |N_z| R``: the factor by which widths approach their steady value per step."""
        return spectral_radius(np.asarray(self.growth) + np.asarray(self.implicit))

    @property
    def implicit_rate(self) -> float:
        """Spectral radius of ``|N_z| R`` on the region."""
        return spectral_radius(np.asarray(self.implicit))

    @property
    def certified(self) -> bool:
        """Widths settle."""
        return self.promised

    @property
    def settles_by_rates(self) -> bool:
        """All widths settle by rows over several steps, in every phase of `rates`."""
        return self.rates is not None and bool(np.isfinite(self.rate_width).all())

    @property
    def settled_widths(self) -> tuple[np.ndarray, np.ndarray]:
        """(n,) and (p,): widths at or below which boxes of states and of inputs settle in every row while outputs come
        as the design assumed; ``inf`` where none is promised. With `rates` the widest of all phases."""
        if self.rates is None:
            return np.asarray(self.steady_width), np.asarray(self.input_width)
        return np.asarray(self.rate_width).max(0), np.full(np.shape(self.input_width), np.inf)

    @property
    def slack(self) -> np.ndarray:
        """Region width minus steady width, (n,)."""
        if not self.certified:
            return np.full(np.shape(self.steady_width), -np.inf)
        return np.asarray(self.region.width) - np.asarray(self.steady_width)

    @property
    def self_consistent(self) -> bool:
        """The certificate is not empty: boxes of the steady width fit into the region."""
        return self.certified and (not self.region_matters or bool((self.slack >= 0).all()))

    def without_promise(self, why: str) -> Certificate:
        """No width is promised, for that reason, which becomes a note."""
        infinite: dict[str, Any] = {name: np.full(np.shape(getattr(self, name)), np.inf) for name in (
            "growth", "implicit", "input_state_before", "steady_width", "input_width",
        )}  # fmt: skip
        return replace(self, **infinite, promised=False, slices=None, notes=(*self.notes, why))

    def with_notes(self, *notes: str | None) -> Certificate:
        """The same with more notes; those that are empty are left out."""
        return replace(self, notes=(*self.notes, *filter(None, notes)))

    def noise_width(self, noise: Noise) -> Any:
        """What one step adds to the width, b of theory 4.1, (n,) or (T, n)."""
        check_type("Certificate", "noise", noise, Noise, "gx.Noise(w, v)")
        for name, box, size in (("w", noise.w, self.noise_w.shape[1]), ("v", noise.v, self.noise_v.shape[1])):
            if box.shape[-1:] != (size,):
                raise ValueError(f"Certificate: the bounds of `{name}` must have shape ({size},), got {box.shape}")
        return noise.w.width @ self.noise_w.T + noise.v.width @ self.noise_v.T + self.noise_fixed

    def next_width(self, width: Any, noise: Noise) -> Any:
        """The recursion ``V (A width + b) + excess``, (n,) or a stack (..., n); V is `inverse`."""
        grown = width @ self.growth.T if self.slices is None else self.slices.growth(width)
        return (grown + self.noise_width(noise)) @ self.inverse.T + self.excess

    @property
    def inverse(self) -> np.ndarray:
        """V, (n, n): what so many `rounds` make of ``(I - |N_z| R)^{-1}``, or that itself."""
        implicit = np.asarray(self.implicit)
        if self.rounds:
            return partial_sum(implicit, self.rounds)
        return np.linalg.inv(np.eye(len(implicit)) - implicit)

    @property
    def response(self) -> np.ndarray:
        """Derivative (n, n) of `widths` by what one step adds, where `slices` do not count."""
        V = self.inverse
        return np.linalg.inv(np.eye(len(V)) - V @ np.asarray(self.growth)) @ V

    def widths(self, noise: Noise) -> Any:
        """Steady width (n,) or (..., n) for other noise bounds; all ``inf`` if the recursion does not contract."""
        added = self.noise_width(noise)
        if not self.certified:
            return np.full(np.shape(added), np.inf)
        settled = np.full(np.shape(added), np.inf)
        if self.slices is None or self.rate < 1:
            V = self.inverse
            settled = (added @ V.T + self.excess) @ np.linalg.inv(np.eye(len(V)) - V @ self.growth).T
        if self.slices is not None:
            return self.slices.settled(np.minimum(settled, self.region.width), self.inverse, added, self.excess)
        return settled if self.window is None else self.window.settled(settled, noise)

    def with_window(self, window: Any, noise: Noise) -> Certificate:
        """The promise of the first gain and of rows over several steps (`WindowWidths`), at the noise of the design."""
        if not self.promised:
            return self
        found = replace(self, window=window)
        return replace(found, steady_width=found.widths(noise), input_width=found.input_widths(noise))

    def with_rates(self, rates: Any, noise: Noise) -> Certificate:
        """The promise for a pattern of outputs (`RateWidths`), at the noise of the design; None: none can be made."""
        if rates is None:
            return self.with_notes("no width is promised for `rates`, as f and g are not affine: boxes are certain")
        return replace(self, rates=rates, rate_width=rates.settled(noise))

    def with_slices(self, slices: Any, noise: Noise) -> Certificate:
        """The promise that counts slopes slice by slice (`Slices`), at the noise of the design; as it was, where no
        width is promised either way."""
        settles = self.promised or np.isfinite(self.region.width).all()
        if not (settles and np.isfinite(self.growth).all() and self.implicit_rate < 1 - 1e-9):
            return self
        found = replace(self, slices=slices, promised=True)
        return replace(found, steady_width=found.widths(noise), input_width=found.input_widths(noise))

    def input_widths(self, noise: Noise) -> Any:
        """Steady width (p,) or (..., p) of the input boxes for other noise bounds; ``inf`` as in `widths`."""
        state = self.widths(noise)
        if not self.certified:
            return np.full((*np.shape(state)[:-1], len(self.input_width)), np.inf)
        return self.input_width_after(state, state, noise)

    def input_width_after(self, now: Any, before: Any, noise: Noise) -> Any:
        """Width of the box of d[k-1] from the state widths at k and k-1, (p,) or a stack (..., p)."""
        of_w = self.input_state_now if self.input_noise_w is None else self.input_state_now + self.input_noise_w
        known = noise.w.width @ of_w.T + noise.v.width @ self.input_noise_v.T
        return now @ self.input_state_now.T + before @ self.input_state_before.T + known + self.input_fixed

    def rows_until_finite(self, lost: int | None = None) -> np.ndarray:
        """From which row of measurements on the box of each state is finite again, counted from 0, (n,); ``inf``: it is
        not within n + 4 rows.

        Args:
            lost: after so many lost rows in succession, at least 1; None: whatever was before (a start from R^n, a
                conflict).

        Raises:
            ValueError: `lost` is no such number, or recovery was not examined (``missing=False`` in the design).
        """
        found = (self.recovery_steps,) if lost is None else self.lost_row_steps
        self._check_lost("rows_until_finite", lost, found)
        return np.array(found[-1 if lost is None else min(lost, len(found)) - 1])

    def recovered_width(self, lost: int | None = None) -> np.ndarray:
        """Bound of the width of the box of each state in the row that `rows_until_finite` says, (n,), units of the
        states, at the noise of the design; ``inf``: never finite, or the gap is longer than was examined.

        After lost rows it is that for boxes which had settled before (no wider than `steady_width`; where that is
        infinite, than the region or than what outputs resolve). Where f and g are not affine, it is what a trial shows.

        Args:
            lost: as in `rows_until_finite`.

        Raises:
            ValueError: as `rows_until_finite`.

        Source: theory 5.8.
        """
        steps = (self.recovery_steps,) if lost is None else self.lost_row_steps
        self._check_lost("recovered_width", lost, steps)
        if lost is None:
            return np.array(self.recovery_width)
        if lost <= len(steps):
            return np.array(self.lost_row_width[lost - 1])
        # What comes back no sooner than from any state is no wider then.
        return np.where(np.equal(steps[-1], self.recovery_steps), self.recovery_width, np.inf)

    def _check_lost(self, call: str, lost: Any, steps: tuple[Any, ...]) -> None:
        if lost is not None and (not is_whole(lost) or lost < 1):
            raise ValueError(f"{call}: `lost` must be a number of rows, at least 1, or None (any state), got {lost!r}")
        if not steps or not steps[0]:
            raise ValueError(
                f"{call}: the certificate must be that of a design with missing=True in the current form, "
                "whose nominal trajectory stays where f and g have numbers; this one has nothing on recovery"
            )

    def __str__(self) -> str:
        lines = [self._headline()]
        lines.append(f"  rate {self.rate:.6g} per step · implicit part {self.implicit_rate:.3g} · equality residual "
                     f"{self.equality_residual:.1e}")  # fmt: skip
        lines.append(f"  {'':<10}{'steady width':>14}{'region width':>14}{'slack':>14}")
        region_width = np.asarray(self.region.width)
        for i, width in enumerate(np.asarray(self.steady_width)):
            # Where f and g are affine there is no region to leave, whatever region was given.
            within = (f"{x:.6g}" if self.region_matters else "-" for x in (region_width[i], self.slack[i]))
            lines.append(f"  state {i + 1:<4}{width:>14.6g}" + "".join(f"{x:>14}" for x in within))
        for j, width in enumerate(np.asarray(self.input_width)):
            lines.append(f"  input {j + 1:<4}{width:>14.6g}{'-':>14}{'-':>14}")
        if self.recoverable is not None:
            lines.append(f"  a lost row of measurements is {'' if self.recoverable else 'NOT '}recovered from")
        if self.recovery_steps and self.lost_row_steps:
            lines.extend(self._recovery())
        if self.rates is not None:
            lines.extend(self._by_rates())
        lines.extend(f"  note: {note}" for note in self.notes)
        return "\n".join(lines)

    def _recovery(self) -> list[str]:
        """From which row on a box is finite, by what was before, and how wide it is then."""
        most = len(self.lost_row_steps)
        columns = {"1 lost row": self.lost_row_steps[0], "width then": self.recovered_width(1)}
        if self.lost_row_steps[-1] != self.lost_row_steps[0]:
            columns[f"{most}+ lost rows"] = self.lost_row_steps[-1]
        columns |= {"any state": self.recovery_steps, "its width": self.recovered_width()}
        lines = ["  boxes are finite from the row (0: the first measured one) after"]
        lines.append("  " + " " * 10 + "".join(f"{name:>14}" for name in columns))
        for i in range(len(self.recovery_steps)):
            cells = (
                f"{column[i]:.4g}" if "width" in name else "never" if np.isinf(column[i]) else f"{column[i]:.0f}"
                for name, column in columns.items()
            )
            lines.append(f"  state {i + 1:<4}" + "".join(f"{text:>14}" for text in cells))
        return lines

    def _by_rates(self) -> list[str]:
        """What is promised for the rates of the outputs."""
        width = np.asarray(self.rate_width)
        if len(width) == 1:
            columns = {"widest": width[0]}
            lines = [
                "  rows over several steps: while no entry is missing widths settle, from any finite box, at or below"
            ]
        else:
            columns = {"all come": width[0], "before that": width[-1], "widest": width.max(0)}
            every = ", ".join(str(rate) for rate in self.rates.rates)
            lines = [f"  outputs every {every} rows: widths settle from any finite box, in the row where they"]
        lines.append("  " + " " * 10 + "".join(f"{name:>14}" for name in columns))
        for i in range(width.shape[1]):
            lines.append(f"  state {i + 1:<4}" + "".join(f"{column[i]:>14.6g}" for column in columns.values()))
        return lines

    def _headline(self) -> str:
        if not self.framer:
            return "Certificate: NONE. This recursion is NO framer: its boxes may cross and miss the truth."
        if not self.certified and self.settles_by_rates:
            return "Certificate: widths settle by rows over several steps (below); the gain of one step promises none."
        if not self.certified:
            return "Certificate: NONE. The boxes are certain, but no bound on their width is promised."
        if not self.self_consistent:
            return (
                "Certificate: EMPTY. The steady width does not fit into the region (negative slack): the boxes are "
                "certain, but cannot be promised to stay where the width bound holds."
            )
        if not self.region_matters:
            return "Certificate: the widths settle at or below the steady width, from any initial box."
        return "Certificate: while the boxes lie in the region, the widths settle at or below the steady width."


def partial_sum(matrix: np.ndarray, terms: int) -> np.ndarray:
    """``I + M + ... + M^(terms - 1)``."""
    found = power = np.eye(len(matrix))
    for _ in range(terms - 1):
        power = power @ matrix
        found = found + power
    return found


def spectral_radius(matrix: np.ndarray) -> float:
    """Largest modulus of an eigenvalue; ``inf`` where an entry is not finite."""
    if not np.isfinite(matrix).all():
        return float("inf")
    return float(np.abs(np.linalg.eigvals(matrix)).max(initial=0.0))
