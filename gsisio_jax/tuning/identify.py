"""Can the records say anything about the noise bounds at all?

Bounds that are too small show in two ways only: a step finds an empty intersection (a conflict), or a logged truth lies
outside its box. A conflict between measurements needs a combination of outputs that no unknown input reaches. The gain
equation (theory 3) has the rows [H; C G], as many as there are outputs; its rank is the number p of free inputs. With
l > p some combination ``N_y y[k-1] + N_z z[k]`` is free of the input and of known size. With l = p there is none: the
rows are square and invertible, so for every y some input explains the step, however small the noise bounds are.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gsisio_jax import inclusion
from gsisio_jax.interval.box import Interval
from gsisio_jax.observer.types import Observer
from gsisio_jax.plant.system import System


class Evidence(NamedTuple):
    """What can contradict too small bounds: `text` says it; `weak` if only bounds of states or inputs can."""

    text: str
    weak: bool


def identify(call: str, system: System, truth: bool) -> Evidence:
    """Decide from the structure alone whether records can tell noise bounds that are too small.

    Args:
        call: for error messages.
        system: the plant.
        truth: the true state or input is logged.

    Raises:
        ValueError: they cannot.

    Source: theory 3.2 and 7.2 (circuits).
    """
    width = np.asarray(system.input_bounds.width)
    free, outputs = int((~np.isfinite(width)).sum()), system.l
    if outputs > free:
        spare = outputs - free
        what = f"{outputs} outputs for {free} free unknown inputs"
        return Evidence(
            f"{what}: {spare} combination{'s' * (spare > 1)} of outputs per step can be contradicted", False
        )
    if truth:
        return Evidence(f"{outputs} outputs for {free} free unknown inputs: the logged truth alone", False)
    if np.isfinite(np.asarray(system.state_bounds.width)).any():
        return Evidence("only the state bounds can be contradicted", True)
    raise ValueError(
        f"{call}: noise bounds are not identifiable from these records. There are {outputs} outputs for {free} unknown "
        "inputs of which nothing is known, so some input explains every record, however small the noise bounds: no "
        "conflict can arise. What helps: log the true state (`x` of the records), measure more than "
        f"{free} outputs, or bound the inputs (`input_bounds`)."
    )


def is_affine(observer: Observer) -> bool:
    """Are f and g affine in x wherever the state may be? Then every slack of a step is concave in the noise bounds."""
    system = observer.system
    u = observer.u_region if system.takes_u else Interval(np.zeros(system.m), np.zeros(system.m))
    jacobian = inclusion.jacobian(system.maps, "nearest")(system.state_bounds, u)
    return bool(np.array_equal(np.asarray(jacobian.lower), np.asarray(jacobian.upper)))
