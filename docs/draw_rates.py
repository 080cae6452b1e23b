"""Draws `docs/images/rates.png` from the code of `docs/how-to/rates.md`: what a slow output does to widths.

Run from the root of the repository: ``python docs/draw_rates.py``.
"""

from __future__ import annotations

import re
from pathlib import Path

import matplotlib
import numpy as np

DOCS = Path(__file__).parent


def main() -> None:
    matplotlib.use("Agg")
    from matplotlib import pyplot

    names: dict = {}
    for block in re.findall(r"```python\n(.*?)```", (DOCS / "how-to" / "rates.md").read_text(), re.DOTALL):
        exec(block, names)  # the reader's own code
    gx, system, noise, y, STEP = (names[name] for name in ("gx", "system", "noise", "y", "STEP"))
    start, region = gx.Interval.symmetric([50.0, 50.0, 5.0]), gx.Interval.entire(3)
    plain = gx.estimate(gx.design_observer(system, noise, region, sweeps=1), start, y)
    time = STEP * np.arange(len(y))
    figure, axes = pyplot.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
    for axis, state, what, unit in ((axes[0], 0, "position", "m"), (axes[1], 1, "speed", "m/s")):
        promised = np.tile(names["promised"][:, state], len(y) // len(names["promised"]))
        axis.plot(time, plain.state.width[:, state], color="0.6", label="without rates")
        axis.plot(time, names["boxes"].state.width[:, state], color="C0", label="with rates=[1, 20]")
        axis.plot(time, promised, "k--", linewidth=1, label="promised in every row")
        axis.set(xlabel="time [s]", ylabel=f"width of {what} [{unit}]", ylim=(0, 1.2 * promised.max()))
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    figure.savefig(DOCS / "images" / "rates.png", dpi=110)


if __name__ == "__main__":
    main()
