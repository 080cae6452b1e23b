"""The widths that the certificate promises for the noise of a study, to be read beside the measured ones."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from gsisio_jax.interval.box import Interval
from gsisio_jax.observer.certificate import Certificate
from gsisio_jax.observer.checks import AnyObserver
from gsisio_jax.plant.system import Noise
from gsisio_jax.study.axes import Axis, Layout, bare
from gsisio_jax.study.labels import Labels


def promised(certificate: Certificate, noise: Any) -> tuple[np.ndarray, np.ndarray]:
    """Steady widths of states and inputs for the noise of a study: (n,) and (p,), or with the axis of the noise."""
    bounds = bare(noise)
    # Widths grow with those of the noise: the largest over time bound all.
    widths = [np.asarray(box.width, np.float64) for box in (bounds.w, bounds.v)]
    widths = [width.max(axis=1) if width.ndim == 3 else width for width in widths]
    if not isinstance(noise, Axis) and all(np.ndim(box.lower) != 2 for box in (bounds.w, bounds.v)):
        widths = [width[0] if width.ndim == 2 and len(width) == 1 else width for width in widths]
    largest = Noise.unchecked(*(Interval.unchecked(-0.5 * width, 0.5 * width) for width in widths))
    return np.asarray(certificate.widths(largest)), np.asarray(certificate.input_widths(largest))


def along(noise: Any, value: np.ndarray) -> Any:
    """A quantity of the noise, on the axis of the noise."""
    return replace(noise, value=value, coordinate=None) if isinstance(noise, Axis) else value


def beside(
    observer: AnyObserver, layout: Layout, widths: tuple[np.ndarray, np.ndarray], labels: Labels
) -> dict[str, Any]:
    """What the certificate promises, to be read beside what was measured."""
    axis = layout.placed["noise"].axis
    lead = () if axis is None else (layout.names[axis],)
    design = {"long_name": "steady width of the state box, noise of the design", **labels.unit("state")}
    result: dict[str, Any] = {"steady_width": ("state", np.asarray(observer.certificate.steady_width), design)}
    for of, value in zip(("state", "input"), widths, strict=True):
        about = {"long_name": f"steady width of the {of} box that the certificate promises", **labels.unit(of)}
        result[f"predicted_{of}_width"] = ((*lead, of), value, about)
    return result
