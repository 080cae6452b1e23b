"""Pictures: boxes over time, their widths, heat maps and curves of studies, labelled without being asked.

`framers` draws boxes over time, `widths` their widths beside what the certificate promises, `funnel` many boxes closing
in. `heatmap` and `curves` draw what a study kept over the axes that it varied; `tightness` draws widths over those of
the exact hull. `save` writes `framers` into a file.
matplotlib is imported when a picture is drawn, never before.
"""

from __future__ import annotations

from gsisio_jax.plot._curves import curves
from gsisio_jax.plot._framers import framers, save
from gsisio_jax.plot._funnel import funnel
from gsisio_jax.plot._heatmap import heatmap
from gsisio_jax.plot._tightness import tightness
from gsisio_jax.plot._widths import widths

__all__ = ["curves", "framers", "funnel", "heatmap", "save", "tightness", "widths"]
