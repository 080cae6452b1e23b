"""`width_sensitivity`: which noise bound, initial bound or model parameter moves the widths, and by how much."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from gsisio_jax._calls import named_arguments
from gsisio_jax._extras import need
from gsisio_jax._room import with_room
from gsisio_jax.interval.box import Interval
from gsisio_jax.observer import checks
from gsisio_jax.observer.types import Observer
from gsisio_jax.plant.system import Noise, System
from gsisio_jax.tuning.compiled import quickly
from gsisio_jax.tuning.fold import fold_rows
from gsisio_jax.tuning.model import with_model
from gsisio_jax.tuning.promised_slopes import width_slopes

KINDS = ("final", "steady", "certificate")


@with_room
@named_arguments
def width_sensitivity(
    observer: Observer,
    initial: Interval,
    y: Any,
    noise: Noise | None = None,
    u: Any = None,
    *,
    model: Callable[[Any], System] | None = None,
    theta: Any = None,
    names: Mapping[str, Sequence[str]] | None = None,
) -> Any:
    """Derivatives of the widths with respect to every noise bound, initial bound and chosen model parameter.

    Three kinds of width: "final" (last row), "steady" (mean of the second half of the record, of rows where it is
    finite), "certificate" (the steady width it promises for these bounds, gains fixed; with the gain re-optimised the
    derivative by noise bounds is the same). The derivative by a bound is by its width, both sides moving apart by the
    same amount: 2 says that a bound narrower by 1 makes the box narrower by 2.

    Args:
        observer: from `design_observer`.
        initial: box of x[0], (n,).
        y: measurements (T, l).
        noise: constant bounds at run time; None takes those of the design.
        u: known inputs (T, m).
        model: takes `theta` and returns the `System`, the same as that of the observer but for numbers in f and g; for
            example ``lambda theta: gx.System(lambda x: theta * x, g, G, H)``.
        theta: where to take the derivative, a pytree of arrays.
        names: the user's own names, "state", "output" and "input".

    Returns:
        `xarray.Dataset` over kind, signal (states, then inputs) and bound (w, v, initial box, parameters), with `width`
        (kind, signal), `derivative` (kind, signal, bound), and `elasticity`, the share of the width that a share of the
        bound is worth: 1 says that 10 % off the bound takes 10 % off the width. Where a width is infinite, NaN. The
        certificate knows no initial box; its derivative by it is 0, and that by a parameter takes the gain as
        re-optimised (NaN where rows over several steps, or ``split``, promise less than that gain does). The widths of
        the run are those of fixed gains: where the design lets terms cancel exactly, they
        have a kink in the parameters, and the derivative is one of its subgradients.

    Raises:
        ValueError: shapes do not agree, or `model` does not fit the observer.
        MissingExtra: xarray is not installed.

    Source: theory 6.
    """
    xarray = need("xarray", extra="tune", purpose="a labelled table")
    if not isinstance(observer, Observer):
        raise ValueError(
            "width_sensitivity: an observer of the current form without `delay` and `tolerate` is needed, got "
            f"{type(observer).__name__}"
        )
    if (model is None) != (theta is None):
        raise ValueError("width_sensitivity: `model` and `theta` belong together; give both or none")
    call = "width_sensitivity"
    initial, y, u, bounds, typed = checks.prepare(call, observer, initial, y, u, noise, rows=True)
    assert isinstance(typed, Observer)
    observer = typed
    if any(len(box.shape) != 1 for box in (bounds.w, bounds.v)):
        raise ValueError("width_sensitivity: `noise` must be constant, of shapes (n,) and (l,); it changes with time")
    system = observer.system
    parameters, rebuild, keys = _parameters(theta, y.dtype)
    sizes = (system.n, system.l, system.n, len(keys))
    own = _names(system, names)
    labels = [
        *(f"w {name}" for name in own["state"]), *(f"v {name}" for name in own["output"]),
        *(f"initial {name}" for name in own["state"]), *keys,
    ]  # fmt: skip

    def widths(change: Any) -> tuple[Any, Any]:
        w, v, start, values = jnp.split(change, np.cumsum(sizes)[:-1])
        changed = observer if model is None else with_model(observer, model(rebuild(parameters + values)))
        found = _run(changed, _apart(initial, start), y, u, Noise.unchecked(_apart(bounds.w, w), _apart(bounds.v, v)))
        return found, found

    # Forward mode: a few inputs, a few results, and no memory of the steps.
    slopes, found = quickly(jax.jacfwd(widths, has_aux=True))(jnp.zeros(sum(sizes), y.dtype))
    certified, by_bound = _certificate(observer, bounds, model, parameters, rebuild)
    width = np.concatenate([np.asarray(found), certified[None]])
    derivative = np.concatenate([np.asarray(slopes), by_bound[None]])
    derivative = np.where(np.isfinite(width)[..., None], derivative, np.nan)
    at = [np.asarray(box.width) for box in (bounds.w, bounds.v, initial)] + [np.asarray(parameters)]
    at = np.concatenate(at)
    with np.errstate(all="ignore"):
        share = derivative * np.where(np.isfinite(at), at, np.nan) / width[..., None]
    dims = ("kind", "signal", "bound")
    group = np.repeat(["w", "v", "initial", "parameter"], sizes)
    return xarray.Dataset(
        {"width": (dims[:2], width), "derivative": (dims, derivative), "elasticity": (dims, share)},
        {
            "kind": list(KINDS), "signal": [*own["state"], *own["input"]], "bound": labels,
            "group": ("bound", group), "value": ("bound", at),
        },
        {"title": "Sensitivity of box widths to the widths of bounds"},
    )  # fmt: skip


def _run(observer: Observer, initial: Interval, y: Any, u: Any, noise: Noise) -> Any:
    """Final and steady widths of a run, (2, n + p)."""
    half = y.shape[0] // 2

    def update(state: Any, out: Any, k: Any) -> Any:
        _, total, count = state
        width = jnp.concatenate([out.state.width, out.input.width])
        counts = (k >= half) & jnp.isfinite(width)
        return width, total + jnp.where(counts, width, 0), count + counts

    zero = jnp.zeros(observer.system.n + observer.system.p, y.dtype)
    final, total, count = fold_rows(observer, initial, y, u, noise, update, (zero, zero, zero))
    return jnp.stack([final, jnp.where(count > 0, total / jnp.maximum(count, 1), jnp.inf)])


def _apart(box: Interval, change: Any) -> Interval:
    """The box with its width changed, both sides moving."""
    return Interval.unchecked(box.lower - 0.5 * change, box.upper + 0.5 * change)


def _certificate(observer: Observer, noise: Noise, model: Any, parameters: Any, rebuild: Any) -> tuple[Any, Any]:
    """Steady widths (n + p,) that the certificate promises, and their derivatives (n + p, bounds)."""
    certificate, system = observer.certificate, observer.system
    n, l, p = system.n, system.l, system.p
    width = np.concatenate([certificate.widths(noise), certificate.input_widths(noise)]).astype(float)
    slope = np.full((n + p, n + l + n + len(parameters)), np.nan)
    if not certificate.certified:
        return width, slope
    now, before, input_v = (
        np.asarray(a) for a in (certificate.input_state_now, certificate.input_state_before, certificate.input_noise_v)
    )
    state, narrower = width_slopes(certificate, noise)
    of_w = now if certificate.input_noise_w is None else now + np.asarray(certificate.input_noise_w)
    inputs = (now + before) @ state + np.concatenate([of_w, input_v], axis=1)
    slope[:, : n + l] = np.concatenate([state, inputs])
    slope[:, n + l : n + l + n] = 0
    if model is not None:
        from gsisio_jax.tuning.codesign import optimal_widths

        # The gain re-optimised: at the best gain terms cancel exactly, and a fixed one has a kink there.
        region = certificate.region
        u_region = observer.u_region if system.takes_u else None
        best = jax.jit(
            jax.jacrev(lambda q: optimal_widths(lambda at: (model(rebuild(at)), noise, region), q, u_region))
        )
        # What rows over several steps, or slices, narrow further is no function of the gain alone.
        slope[:n, n + l + n :] = np.where(narrower[:, None], np.nan, np.asarray(best(parameters)))
    return width, slope


def _parameters(theta: Any, dtype: Any) -> tuple[Any, Callable[[Any], Any], list[str]]:
    if theta is None:
        return jnp.zeros(0, dtype), lambda flat: None, []
    theta = jax.tree.map(lambda a: jnp.asarray(a, dtype), theta)
    flat, rebuild = ravel_pytree(theta)
    keys = []
    for path, leaf in jax.tree_util.tree_leaves_with_path(theta):
        name = jax.tree_util.keystr(path, simple=True, separator=".") or "theta"
        keys += [name] if leaf.ndim == 0 else [f"{name}{list(index)}" for index in np.ndindex(leaf.shape)]
    return flat, rebuild, keys


def _names(system: System, names: Mapping[str, Sequence[str]] | None) -> dict[str, list[str]]:
    found = {}
    for kind, letter, size in (("state", "x", system.n), ("output", "y", system.l), ("input", "d", system.p)):
        own = (names or {}).get(kind)
        found[kind] = [f"{letter}{i + 1}" for i in range(size)] if own is None else list(own)
        if len(found[kind]) != size:
            raise ValueError(f'width_sensitivity: `names["{kind}"]` must hold {size} names, got {len(found[kind])}')
    return found
