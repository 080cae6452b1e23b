"""What `design_observer` is given: types, shapes and ranges."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from gsisio_jax.interval.box import Interval, is_concrete
from gsisio_jax.interval.reading import check_type, is_whole
from gsisio_jax.observer.checks import refuse_input_model
from gsisio_jax.plant.system import Noise, System

_MOST_CELLS = 10_000
_MOST_STEPS = 1000


def checked(
    system: System,
    noise: Noise,
    region: Interval | str,
    form: str,
    gains: int | str,
    u_region: Interval | None,
    sweeps: int,
    window: int | str,
    missing: Any,
    certify: Any,
    progress: Any,
) -> tuple[Interval | None, Interval]:
    """The region within the state bounds (None: it is to be looked for) and the box of known inputs.

    Raises:
        ValueError: an argument is no value that it can have; shapes do not agree.
    """
    check_type("design_observer", "system", system, System)
    check_type("design_observer", "noise", noise, Noise, "gx.Noise(w, v)")
    _check_known(noise=noise, region=region, u_region=u_region)
    if form not in ("current", "prediction"):
        raise ValueError(f'design_observer: `form` must be "current" or "prediction", got {form!r}')
    system.check_unchanged("design_observer")
    for name, count, other in (("gains", gains, ' or "auto"'), ("sweeps", sweeps, "")):
        whole = is_whole(count)
        if not (whole and int(count) >= 1) and not (other and isinstance(count, str) and count == "auto"):
            raise ValueError(f"design_observer: `{name}` must be a whole number, at least 1{other}, got {count!r}")
    if progress is not None and not isinstance(progress, bool | np.bool_):
        raise ValueError(f"design_observer: `progress` must be True, False or None, got {progress!r}")
    for name, flag in (("missing", missing), ("certify", certify)):
        if not isinstance(flag, bool | np.bool_):
            raise ValueError(f"design_observer: `{name}` must be True or False, got {flag!r}")
    steps = window if is_whole(window) else 0
    if window != "auto" and steps < 1:
        raise ValueError(
            f'design_observer: `window` must be a whole number of steps, at least 1, or "auto", got {window!r}'
        )
    if steps > _MOST_STEPS:
        raise ValueError(
            f"design_observer: `window` must be at most {_MOST_STEPS} steps, got {window!r}: every row is a linear "
            'program over all of them. "auto" takes the shortest that helps, rarely more than five'
        )
    if window not in (1, "auto") and (form == "prediction" or system.periodic_states):
        raise ValueError(
            "design_observer: `window` must be 1 in the prediction form and where states are periodic (boxes of "
            f"different steps may lie a period apart), got {window!r}"
        )
    if form == "prediction" or system.periodic_states:
        where = "in the prediction form" if form == "prediction" else "where states are periodic"
        refuse_input_model("design_observer", system, f"which says nothing {where}; make the System without it")
    for name, box, size in (("w", noise.w, system.n), ("v", noise.v, system.l)):
        if box.shape != (size,):
            raise ValueError(
                f"design_observer: the noise bounds of `{name}` must have shape ({size},), got {box.shape}"
            )
    auto = isinstance(region, str) and region == "auto"
    if not auto and (not isinstance(region, Interval) or region.shape != (system.n,)):
        got = f"shape {region.shape}" if isinstance(region, Interval) else f"{type(region).__name__} {region!r}"
        raise ValueError(
            f'design_observer: `region` must be an Interval of shape ({system.n},) or "auto", got '
            f"{got if len(got) < 200 else type(region).__name__}"
        )
    if isinstance(region, Interval):
        bounds = system.state_bounds
        apart = np.flatnonzero((region.lower > bounds.upper) | (region.upper < bounds.lower))
        if len(apart):
            i = int(apart[0])
            raise ValueError(
                "design_observer: `region` must have states in common with the state bounds, but of state "
                f"{i + 1} it has [{region.lower[i]:g}, {region.upper[i]:g}] and they have "
                f"[{bounds.lower[i]:g}, {bounds.upper[i]:g}]"
            )
        # No box leaves the state bounds, so the region that boxes can be in, and its width, end there.
        region = Interval(np.maximum(region.lower, bounds.lower), np.minimum(region.upper, bounds.upper))
    if u_region is None:
        if system.takes_u:
            raise ValueError(
                "design_observer: f or g takes u; give `u_region` ([u_region] in a file), the box of known inputs for "
                "which the design holds"
            )
        u_region = Interval(np.zeros(system.m), np.zeros(system.m))
    check_type("design_observer", "u_region", u_region, Interval, f"gx.Interval(lower, upper) of shape ({system.m},)")
    if u_region.shape != (system.m,):
        raise ValueError(f"design_observer: `u_region` must have shape ({system.m},), got {u_region.shape}")
    return (region if isinstance(region, Interval) else None), u_region


def _check_known(**arguments: Any) -> None:
    """Under jax.jit, jax.vmap and jax.grad numbers are not known yet."""
    for name, value in arguments.items():
        if not all(map(is_concrete, jax.tree.leaves(value))):
            raise ValueError(
                f"design_observer: `{name}` is traced by JAX, and must be known; design outside of jit, vmap and grad. "
                "Widths as a function of a plant, its noise and region, with gradients, are "
                "gx.tuning.optimal_widths; other noise at run time is estimate(noise=...)"
            )


def check_cells(cells: Any, form: str) -> None:
    """`cells` is a number of parts that a step can be expected to bound one by one.

    Raises:
        ValueError: it is not.
    """
    if isinstance(cells, str) and cells == "auto":
        return
    if not is_whole(cells) or not 1 <= cells <= _MOST_CELLS:
        raise ValueError(
            f"design_observer: `cells` must be a whole number, 1 (the box as a whole) to {_MOST_CELLS}, or "
            f'"auto", got {cells!r}'
        )
    if cells > 1 and form == "prediction":
        raise ValueError(f"design_observer: `cells` must be 1 in the prediction form, which uses no y[k], got {cells}")
