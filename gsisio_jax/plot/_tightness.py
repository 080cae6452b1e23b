"""`tightness`: widths of boxes over those of the hull, state by state over the steps."""

from __future__ import annotations

from typing import Any

import numpy as np

from gsisio_jax._calls import named_arguments
from gsisio_jax.plot import style

LINES = ("-", "--", ":", "-.")


@named_arguments
def tightness(found: Any, ax: Any = None) -> Any:
    """Draw how much wider than the hull the boxes are: the ratio of widths of every state over the steps; 1 is as
    narrow as any observer can be.

    Where the hull is that of runs that were found, the ratio is an upper bound, and the label says so. Triangles at the
    upper edge are boxes without a bound. The scale is logarithmic where ratios span more than a factor of 30.

    Args:
        found: from `gsisio_jax.tightness`.
        ax: matplotlib axes; a new figure where left out.

    Returns:
        The axes.

    Raises:
        ValueError: `found` is something else, or `ax` is not one axes.
        MissingExtra: matplotlib is not installed.
    """
    style.require()
    if not hasattr(found, "hull_lower"):
        raise ValueError(f"tightness: expected the result of gsisio_jax.tightness, got {type(found).__name__}")
    axes, figure = style.panels("tightness", 1, ax, style.stacked)
    axis = axes[0]
    ratio = np.where(np.isinf(found.ratio), np.nan, found.ratio)
    for i, row in enumerate(ratio.T):
        color, line = style.CYCLE[i % len(style.CYCLE)], LINES[i // len(style.CYCLE) % len(LINES)]
        axis.plot(found.steps, row, line, marker=".", color=color, linewidth=1.4, label=f"x{i + 1}")
        style.mark_unbounded(axis, found.steps, np.isinf(found.ratio[:, i]), "box not bounded", color)
    axis.axhline(1, color=style.TRUTH, linewidth=1.0, zorder=1)
    style.fit(axis, [ratio, np.ones(1)])
    axis.grid(alpha=0.25)
    axis.set_xlabel("step")
    axis.xaxis.get_major_locator().set_params(integer=True)
    axis.set_ylabel("width / width of the hull" + ("" if found.exact else ",\nat most"))
    if figure is not None:
        style.complete(figure, axes, f"Boxes against {found.against}")
    return axis
