"""Figures 2 and 3 of the paper, for any boxes: signals in their boxes, and errors, widths and their bounds.

A component of a box whose lower side lies above its upper one holds no point; it is drawn in red.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from gsisio_jax._extras import need
from gsisio_jax.interval.box import Interval

BOX, EDGE, TRUTH, WRONG, BOUND = "#88aadd", "#3366aa", "#111111", "#cc2233", "#bb5500"
EMPTY, SILENT = "#ddaa66", "#dddddd"


class Boxes(NamedTuple):
    """What both figures show of one observer on one record.

    Attributes:
        title: what is shown, one line.
        x, d: the truth, (K + 1, n) for k = 0..K and (K, p) for k = 0..K-1.
        state, input: boxes of the same shapes; crossed ones are drawn in red.
        state_bound, input_bound: bounds of the 2-norm of their widths, (K + 1,) and (K,); NaN or inf: none.
        bound_label: what these bounds are.
        silent: (K + 1,) steps at which those bounds promise nothing.
    """

    title: str
    x: np.ndarray
    d: np.ndarray
    state: Interval
    input: Interval
    state_bound: np.ndarray
    input_bound: np.ndarray
    bound_label: str
    silent: np.ndarray

    def first(self, steps: int) -> Boxes:
        """The same for k = 0..steps only."""
        now, before = slice(steps + 1), slice(steps)
        return self._replace(
            x=self.x[now], d=self.d[before], state=self.state[now], input=self.input[before],
            state_bound=self.state_bound[now], input_bound=self.input_bound[before], silent=self.silent[now],
        )  # fmt: skip


def crossed(box: Interval) -> Any:
    """Rows at which some component of the box has its lower side above its upper one, (T,)."""
    return np.asarray(box.lower > box.upper).any(axis=-1)


def figure_2(boxes: Boxes) -> Any:
    """States and unknown inputs with their boxes: a matplotlib Figure, to be saved by ``savefig``.

    Source: paper, Fig. 2.
    """
    groups = (("x", boxes.x, boxes.state), ("d", boxes.d, boxes.input))
    figure, axes = _panels(boxes.title, max(boxes.x.shape[1], boxes.d.shape[1]), 6.6)
    for column, (name, truth, box) in enumerate(groups):
        for i, axis in enumerate(axes[:, column]):
            if i < truth.shape[1]:
                _boxes(axis, np.asarray(box.lower)[:, i], np.asarray(box.upper)[:, i], crossed(box))
                axis.plot(np.arange(len(truth)), truth[:, i], color=TRUTH, linewidth=1.3, label="truth", zorder=4)
                axis.set_ylabel(f"${name}_{{{i + 1},k}}$ [–]")
            else:
                axis.remove()
    _finish(figure, axes)
    return figure


def figure_3(boxes: Boxes) -> Any:
    """Errors, widths and the bounds of the widths, for states and unknown inputs: a matplotlib Figure.

    The error is ``max(||x - lower||, ||upper - x||)``, the width ``||upper - lower||``. Logarithmic for crossed boxes.

    Source: paper, Theorem 2 and Fig. 3.
    """
    figure, axes = _panels(boxes.title, 1, 4.4)
    groups = (("x", boxes.x, boxes.state, boxes.state_bound), ("d", boxes.d, boxes.input, boxes.input_bound))
    for axis, (name, truth, box, bound) in zip(axes[0], groups, strict=True):
        k, low, high = np.arange(len(truth)), np.asarray(box.lower), np.asarray(box.upper)
        error = np.maximum(np.linalg.norm(truth - low, axis=1), np.linalg.norm(high - truth, axis=1))
        width, wrong, known = np.linalg.norm(high - low, axis=1), crossed(box), np.isfinite(bound)
        axis.plot(k[known], bound[known], color=BOUND, linewidth=1.8, label=f"bound $\\delta$: {boxes.bound_label}")
        axis.plot(k, width, color=EDGE, linewidth=1.6, label=r"width $\|\Delta\|$")
        axis.plot(k, error, color=TRUTH, linewidth=1.0, label=r"error $\|\tilde{x}\|$, $\|\tilde{d}\|$")
        if wrong.any():
            axis.plot(k[wrong], width[wrong], "o", color=WRONG, markersize=5, label="crossed: no box, no width")
            axis.set_yscale("log")
        else:
            axis.set_ylim(0, 1.08 * max(width.max(), error.max(), bound[known].max(initial=0.0)))
        # d[k] is bounded by the widths at k and k + 1, so its promise is that of step k + 1.
        for step in np.flatnonzero(boxes.silent if name == "x" else boxes.silent[1:]):
            label = "box outside the region: nothing is promised"
            axis.axvspan(step - 0.5, step + 0.5, color=SILENT, linewidth=0, zorder=0, label=label)
        axis.set_ylabel("2-norm [–]")
        axis.set_title(f"{'states' if name == 'x' else 'unknown inputs'} ${name}_k$", fontsize="medium")
    _finish(figure, axes)
    return figure


def _boxes(axis: Any, low: np.ndarray, high: np.ndarray, empty: np.ndarray) -> None:
    """One component, each step as wide as a step; `empty` says at which steps the box as a whole holds no point."""
    k = np.arange(len(low))
    at = np.stack([k - 0.5, k + 0.5], axis=1).ravel()
    bottom, top = (np.repeat(side, 2) for side in (np.minimum(low, high), np.maximum(low, high)))
    wrong = low > high
    for mask, color, label in (
        (~empty, BOX, "box"),
        (wrong, WRONG, "crossed: lower side above upper side"),
        (empty & ~wrong, EMPTY, "not crossed itself, but the box is"),
    ):
        if mask.any():
            shown = np.where(np.repeat(mask, 2), top, np.nan)
            axis.fill_between(at, bottom, shown, color=color, alpha=0.45, linewidth=0, label=label)
    if empty.any():
        for side, mark in ((high, "^"), (low, "v")):
            name = "upper side" if mark == "^" else "lower side"
            axis.plot(k, side, mark, color=WRONG, markersize=5, label=name)
        axis.set_yscale("symlog", linthresh=1)
    else:
        for side in (low, high):
            axis.plot(at, np.repeat(side, 2), color=EDGE, linewidth=0.8)
    axis.margins(x=0.01)


def _panels(title: str, rows: int, height: float) -> tuple[Any, Any]:
    figure = need("matplotlib.figure", extra="plot", purpose="drawing a picture").Figure(
        (10, height), layout="constrained"
    )
    figure.suptitle(title, fontsize="medium")
    return figure, figure.subplots(rows, 2, squeeze=False)


def _finish(figure: Any, axes: Any) -> None:
    entries: dict[str, Any] = {}
    for axis in figure.axes:
        axis.grid(alpha=0.25)
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    for axis in axes[-1]:
        axis.set_xlabel("step k")
    columns = len(entries) if len(entries) <= 4 else 3
    figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=columns, frameon=False)
