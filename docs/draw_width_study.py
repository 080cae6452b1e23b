"""Draws `notebooks/width_study.png`: widths of the paper's example over noise bound and initial box.

Run from the root of the repository: ``python docs/draw_width_study.py``.
"""

from __future__ import annotations

from pathlib import Path

import jax
import matplotlib
import numpy as np

import gsisio_jax as gx
from gsisio_jax.examples import paper

PATH = Path(__file__).parents[1] / "notebooks" / "width_study.png"
BOXES, LEVELS, STEPS = 60, 40, 100


def study():
    """Last widths of the states over initial boxes and noise bounds, as in `notebooks/02_width_study.ipynb`."""
    system = paper.system()

    def ball(radius):
        return gx.Interval.symmetric(np.asarray(radius))

    noise = gx.Noise(w=ball([paper.NOISE] * 2), v=ball([paper.NOISE] * 2))
    observer = gx.design_observer(system, noise, ball([1.0, 1.5]), missing=False)
    key = jax.random.key(1)
    calm = gx.Noise(w=ball([0.05, 0.05]), v=ball([0.05, 0.05]))
    record = gx.simulate(system, key, np.array([0.3, -0.2]), 0.3 * jax.random.normal(key, (STEPS, 2)), calm)
    size, level, start = np.geomspace(0.1, 10.0, BOXES), np.linspace(0.05, 0.3, LEVELS), np.asarray(record.x[0])
    bounds = gx.Interval(-level[:, None] * np.ones(2), level[:, None] * np.ones(2))
    found = gx.sweep(
        observer,
        gx.grid("initial", gx.Interval(start - size[:, None], start + size[:, None]), coordinate=size),
        record.y,
        noise=gx.grid("noise", gx.Noise(w=bounds, v=bounds), coordinate=level),
        reduce=("final",),
        state_units=["1", "1"],
    )
    found["initial"].attrs |= {"long_name": "radius of the initial box", "units": "1"}
    found["noise"].attrs |= {"long_name": "bound of w and v", "units": "1"}
    return found


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    matplotlib.use("Agg")
    from matplotlib import pyplot

    found = study()
    figure, axes = pyplot.subplots(1, 2, figsize=(12, 5.2), layout="constrained")
    gx.plot.heatmap(found, "state_width_final", signal="x1", ax=axes[0])
    gx.plot.curves(found.sel(initial=slice(None, 0.7)), "state_width_final", x="noise", signal="x1", ax=axes[1])
    axes[0].set_title("x1: last width from every initial box")
    axes[1].set_title("x1: initial boxes up to a radius of 0.7")
    entries = [entry for axis in axes for entry in zip(*axis.get_legend_handles_labels(), strict=True)]
    figure.legend(*zip(*entries, strict=True), loc="outside lower center", ncols=5, frameon=False)
    figure.suptitle("Paper's example: width after 100 steps, all quantities without unit")
    figure.savefig(PATH, dpi=110)


if __name__ == "__main__":
    main()
