"""What ``gsisio reproduce`` does: the example's numbers, and its two figures for two observers.

The printed recursion is Theorem 1 with the pseudo-inverse and decomposition bounds from the printed bounds of the
derivatives; it is no framer here (P3, P4). The current form of this library runs on the same record.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from gsisio_jax.design.build import design_observer
from gsisio_jax.examples import paper
from gsisio_jax.interval.box import Interval
from gsisio_jax.observer.certificate import Certificate
from gsisio_jax.observer.estimation import estimate
from gsisio_jax.observer.status import Status
from gsisio_jax.paper.algorithm import gsisio
from gsisio_jax.paper.example import INPUTS, Record, Row, initial, noise, numbers, printed_claim, record
from gsisio_jax.paper.figures import Boxes, crossed, figure_2, figure_3
from gsisio_jax.paper.lipschitz import PRINTED

REGION = Interval([-1.37, -2.1], [1.37, 2.1])
"""Region of the current form's design: its steady width fits, with room for the boxes to move."""
FILES = ("numbers.csv", "figure_2.png", "figure_3.png", "figure_2_printed.png", "figure_3_printed.png")
_SHOWN = 8  # steps of the printed recursion: it doubles every step
_COLUMNS = ("name", "printed", "computed", "agrees", "reason", "finding")


class Reproduction(NamedTuple):
    """Numbers and boxes of the example.

    Attributes:
        rows: every printed number beside the computed one.
        record: the simulated run both observers see.
        printed: the printed recursion, all steps.
        current: the current form.
        certificate: what the current form promises.
    """

    rows: list[Row]
    record: Record
    printed: Boxes
    current: Boxes
    certificate: Certificate

    def facts(self) -> list[tuple[str, str]]:
        """The outcome in a few lines: (what, how it went)."""
        steps, agree = len(self.record.d), sum(row.agrees for row in self.rows)
        empty, promised = crossed(self.printed.state), ~self.current.silent
        (x_wrong, d_wrong), (x_right, d_right) = (
            [
                int((~_misses(truth, box)).sum())
                for truth, box in ((run.x[first:], run.state[first:]), (run.d, run.input))
            ]
            for run, first in ((self.printed, 1), (self.current, 0))
        )
        of_x, of_d = len(self.current.x), len(self.current.d)
        holding = f"{x_right} of {of_x} state and {d_right} of {of_d} input boxes hold the truth"
        width, bound = np.linalg.norm(np.asarray(self.current.state.width), axis=1), self.current.state_bound
        kept = int((width[promised] <= bound[promised] + 1e-9).sum())
        return [
            ("numbers", f"{agree} of {len(self.rows)} printed numbers follow from the printed f, g, G, H"),
            ("record", f"{steps} steps, {INPUTS}; the inputs of the paper's figures are not printed"),
            (
                "as printed",
                f"{int(empty.sum())} of {steps} state boxes crossed, the first at k = {int(empty.argmax())}; "
                f"{x_wrong} state and {d_wrong} input boxes hold the truth",
            ),
            ("current form", f"{int(crossed(self.current.state).sum())} of {of_x} state boxes crossed; {holding}"),
            (
                "its widths",
                f"last {width[-1]:.3g}, promised {bound[-1]:.3g}; the promise speaks of {int(promised.sum())} steps, "
                f"{kept} keep it",
            ),
        ]

    def writers(self) -> dict[str, Callable[[Path], None]]:
        """For every file of `FILES` the function that writes it."""
        early = self.printed.first(_SHOWN)
        pictures = (
            (figure_2, self.current), (figure_3, self.current), (figure_2, early), (figure_3, early),
        )  # fmt: skip
        out: dict[str, Callable[[Path], None]] = {FILES[0]: lambda path: write_numbers(self.rows, path)}
        for name, (draw, boxes) in zip(FILES[1:], pictures, strict=True):
            out[name] = lambda path, draw=draw, boxes=boxes: draw(boxes).savefig(path, dpi=130)
        return out


def reproduce(steps: int = 60) -> Reproduction:
    """Compute everything: the table, the printed recursion and the current form on one record of `steps` steps.

    Source: paper, section "Illustrative Example"; theory 2 and 3-8.
    """
    with jax.enable_x64(True):
        run = record(steps)
        return Reproduction(numbers(), run, _printed(run), *_current(run))


def write_numbers(rows: list[Row], path: Path) -> None:
    """Write the table as CSV; computed numbers read back exactly."""
    with open(path, "w", encoding="utf-8", newline="") as stream:
        table = csv.writer(stream, lineterminator="\n")
        table.writerow(_COLUMNS)
        for row in rows:
            agrees = "yes" if row.agrees else "no"
            table.writerow([row.name, row.printed, repr(row.computed), agrees, row.reason, row.finding])


def _printed(run: Record) -> Boxes:
    system, derivative = paper.system(), Interval(
        *(np.vstack([getattr(box, side) for box in (PRINTED.df, PRINTED.dg)]) for side in ("lower", "upper"))
    )  # fmt: skip
    start = initial()
    found = gsisio(
        system.f, system.g, None, system.G, None, system.H, noise().w, noise().v, start, run.y,
        bounds=("decomposition",), derivative=derivative, allow_uncertified=True,
    )  # fmt: skip
    claim = printed_claim(len(run.d))
    sides = (np.vstack([getattr(start, side), getattr(found.state, side)]) for side in ("lower", "upper"))
    return Boxes(
        title=f"The recursion of Theorem 1 as printed, {INPUTS}: the boxes cross at once",
        x=run.x, d=run.d, state=Interval.unchecked(*sides), input=found.input,
        state_bound=claim.state, input_bound=claim.input,
        bound_label=f"Lemma 5, as printed ($\\mathcal{{L}}$ = {PRINTED.contraction})",
        silent=np.zeros(len(run.x), bool),
    )  # fmt: skip


def _current(run: Record) -> tuple[Boxes, Certificate]:
    observer = design_observer(paper.system(), noise(), REGION, missing=False)
    found, certificate = estimate(observer, initial(), run.y), observer.certificate
    state, inputs = (Interval.unchecked(np.asarray(b.lower), np.asarray(b.upper)) for b in (found.state, found.input))
    outside = (np.asarray(found.status) & int(Status.OUTSIDE_REGION)) != 0
    # From the first box of which the promise speaks, by its own recursion: no width seen later enters.
    begin = int(np.argmin(outside))
    widths = np.full(state.shape, np.nan)
    widths[begin - 1 if begin else 0] = state.width[begin - 1 if begin else 0]
    for k in range(begin or 1, len(widths)):
        widths[k] = certificate.next_width(widths[k - 1], noise())
    of_input = np.asarray(certificate.input_width_after(widths[1:], widths[:-1], noise()))
    boxes = Boxes(
        title=f"The current form, certified, {INPUTS}",
        x=run.x[:-1], d=run.d[:-1], state=state, input=inputs,
        state_bound=np.linalg.norm(widths, axis=1), input_bound=np.linalg.norm(of_input, axis=1),
        bound_label="promised by the certificate", silent=outside,
    )  # fmt: skip
    return boxes, certificate


def _misses(truth: np.ndarray, box: Interval) -> Any:
    """Rows at which the truth is outside, rounding aside, (T,)."""
    return ((truth < box.lower - 1e-9) | (truth > box.upper + 1e-9)).any(axis=1)
