"""`tune_noise`: the smallest noise bounds that explain logged records."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from gsisio_jax._calls import named_arguments
from gsisio_jax._room import with_room
from gsisio_jax.interval.reading import check_type, read_array
from gsisio_jax.observer.types import Observer
from gsisio_jax.plant.system import Noise
from gsisio_jax.tuning import search as searching
from gsisio_jax.tuning.identify import identify, is_affine
from gsisio_jax.tuning.records import Records
from gsisio_jax.tuning.result import HeldOut, TunedNoise
from gsisio_jax.tuning.rollout import Scores
from gsisio_jax.tuning.search import Progress, Search
from gsisio_jax.tuning.shape import Parameters, Shape, read_shape


@with_room
@named_arguments
def tune_noise(
    observer: Observer,
    records: Records,
    noise: Noise | None = None,
    parameters: Parameters = "each",
    *,
    objective: Literal["bounds", "widths"] = "bounds",
    weights: Mapping[str, Any] | None = None,
    held_out: Records | float = 0.2,
    start: TunedNoise | Noise | None = None,
    method: Literal["auto", "lp", "optax"] = "auto",
    containment_margin: Any = 0.0,
    tolerance: float = 1e-3,
    iterations: int = 150,
    optimizer: Any = None,
    progress: bool | Progress = False,
) -> TunedNoise:
    """The smallest noise bounds that explain logged records: no CONFLICT, and any logged truth inside its box.

    First it is decided whether the records can tell at all. Then all bounds are shrunk together as far as the records
    allow, and from there each factor on its own, downwards in cost, always ending where nothing contradicts them. On
    linear systems (f and g affine) the result is the optimum, with a proven lower bound. On others it is a local one,
    never worse than the smallest multiple of the start.

    True bounds are never contradicted, so where they have the shape of the template the smallest multiple found does
    not exceed them (beyond `tolerance`), and the optimum of a linear system costs no more than they do, whatever they
    are.

    Args:
        observer: from `design_observer`; its gains stay as they are.
        records: `gx.tuning.Records`.
        noise: the template, constant; None takes the bounds of the design. Components of width 0 are not fitted.
        parameters: what is fitted: "each" (a factor per component of w and v), "scale" (one for all), "sides" (lower
            and upper bounds apart), or names per component, equal names sharing a factor and None not fitted:
            ``{"w": None, "v": ["position", "position", "speed", "speed"]}``.
        objective: "bounds" adds up the widths of the bounds, "widths" the steady widths that the certificate promises
            for them, each in units of those of the template.
        weights: of the widths: ``{"w": (n,), "v": (l,)}``, or ``{"state": (n,)}`` for the objective "widths".
        held_out: records to validate on, or the share of `records` (its last ones) to keep for that.
        start: warm start: an earlier result, or noise bounds.
        method: "lp" for linear systems, "optax" for others, "auto" chooses. One factor alone is found by bisection.
        containment_margin: how far inside its box a logged state must lie, (n,) or one number, units of the state.
        tolerance: relative, of the cost.
        iterations: of the optimizer.
        optimizer: an `optax.GradientTransformation`; None takes Adam with a decaying step.
        progress: print a line per iteration to standard error, or call a function with it.

    Returns:
        `TunedNoise`. Fitted bounds are evidence, not proof.

    Raises:
        ValueError: the bounds are not identifiable from these records, no bounds of this shape explain them, or an
            argument does not fit.
        MissingExtra: SciPy or optax is not installed.

    Source: theory 8.
    """
    _check(observer, records, objective, method, tolerance, iterations)
    system = observer.system
    records.check("tune_noise", system)
    template = observer.noise if noise is None else noise
    shape = read_shape("tune_noise", template, parameters)
    fitted, everything = _split(records, held_out, system)
    evidence = identify("tune_noise", system, everything.select(fitted).truth)
    room = np.asarray(read_array("tune_noise", "containment_margin", containment_margin), float)
    if room.shape not in ((), (system.n,)) or np.isnan(room).any():
        raise ValueError(f"tune_noise: `containment_margin` must be a number or ({system.n},), got {room.tolist()}")
    room = np.broadcast_to(room, (system.n,))
    scores = Scores(observer, shape, everything, fitted, room)
    price, base = shape.cost(_weights(observer, shape, objective, weights))
    tell = searching.to_stderr if progress is True else progress or None
    first = _start(shape, start)
    search = Search(scores, price, base, tolerance, tell, searching.SMALLEST * first)
    searching.common_factor(search, first, "tune_noise")
    chosen = "bisection"
    vanished = bool((search.best <= search.floor).all())
    if evidence.weak and vanished:
        raise ValueError(
            "tune_noise: noise bounds are not identifiable from these records: even a millionth of the bounds explains "
            f"them, because {evidence.text}, and they never were. Log the true state (`x` of the records), or measure "
            "more."
        )
    affine = is_affine(observer)
    if len(shape.names) > 1 and not vanished:
        chosen = method if method != "auto" else ("lp" if affine else "optax")
        if chosen == "lp":
            if not affine:
                raise ValueError('tune_noise: `method="lp"` needs f and g to be affine in x; use "optax"')
            searching.linear_program(search)
        else:
            searching.penalty_method(search, iterations, optimizer)
    return _result(search, first, everything, fitted, chosen, affine, evidence.text)


def _check(observer: Any, records: Any, objective: str, method: str, tolerance: float, iterations: int) -> None:
    if not isinstance(observer, Observer):
        raise ValueError(
            "tune_noise: `observer` must be of the current form, from `design_observer(..., form='current')` without "
            "`delay` and `tolerate`, got "
            f"{type(observer).__name__}"
        )
    if not isinstance(records, Records):
        raise ValueError(f"tune_noise: `records` must be gsisio_jax.tuning.Records, got {type(records).__name__}")
    observer.system.check_unchanged("tune_noise")
    if objective not in ("bounds", "widths"):
        raise ValueError(f'tune_noise: `objective` must be "bounds" or "widths", got {objective!r}')
    if method not in ("auto", "lp", "optax"):
        raise ValueError(f'tune_noise: `method` must be "auto", "lp" or "optax", got {method!r}')
    if not 0 < tolerance < 0.5 or iterations < 1:
        raise ValueError(
            f"tune_noise: `tolerance` must lie between 0 and 0.5 and `iterations` be at least 1, got {tolerance} and "
            f"{iterations}"
        )


def _split(records: Records, held_out: Records | float, system: Any) -> tuple[np.ndarray, Records]:
    """Mask of the records to fit, and all records."""
    if isinstance(held_out, Records):
        held_out.check("tune_noise", system)
        return np.arange(len(records) + len(held_out)) < len(records), records.join(held_out)
    if not 0 <= held_out < 1:
        raise ValueError(f"tune_noise: `held_out` must be Records or a share from 0 to below 1, got {held_out}")
    return np.arange(len(records)) < len(records) - int(held_out * len(records)), records


def _weights(observer: Observer, shape: Shape, objective: str, given: Mapping[str, Any] | None) -> np.ndarray:
    """Price of a unit of width of every component of w and v, (n + l,)."""
    n, l = observer.system.n, observer.system.l
    width = np.concatenate([np.asarray(box.width) for box in (shape.template.w, shape.template.v)])
    legal = {"w": n, "v": l} if objective == "bounds" else {"state": n}
    given = dict(given or {})
    for name, value in given.items():
        if name not in legal or np.shape(value) != (legal[name],) or not (np.asarray(value) >= 0).all():
            raise ValueError(
                f'tune_noise: with objective="{objective}" `weights` takes nonnegative arrays '
                + ", ".join(f'"{key}" of shape ({size},)' for key, size in legal.items())
                + f"; got {name!r} of shape {np.shape(value)}"
            )
    if objective == "bounds":
        unit = np.where(width > 0, 1 / np.where(width > 0, width, 1), 0)
        return np.concatenate([np.asarray(given.get(k, part), float)
                               for k, part in zip("wv", np.split(unit, [n]), strict=True)])  # fmt: skip
    certificate = observer.certificate
    if not certificate.certified:
        raise ValueError(
            'tune_noise: objective="widths" needs a certificate, and this design has none; use objective="bounds"'
        )
    # The steady width is linear in the noise, which adds |P| dw + (|N_y| + |N_z T2|) dv + what is fixed in a step.
    added = np.concatenate([np.asarray(certificate.noise_w), np.asarray(certificate.noise_v)], axis=1)
    steady = np.asarray(certificate.widths(shape.template))
    return np.asarray(given.get("state", 1 / np.where(steady > 0, steady, 1)), float) @ certificate.response @ added


def _start(shape: Shape, start: TunedNoise | Noise | None) -> np.ndarray:
    if start is None:
        return np.ones(len(shape.names))
    noise = start.noise if isinstance(start, TunedNoise) else start
    check_type("tune_noise", "start", noise, (Noise, TunedNoise), "give earlier bounds, or leave it out")
    factors = shape.factors(noise)
    if not (np.isfinite(factors).all() and factors.any()):
        raise ValueError(f"tune_noise: `start` gives no bounds to start from, factors {factors.tolist()}")
    # A bound of 0 would stay 0 under every multiple.
    return np.maximum(factors, 1e-3 * factors.max())


def _result(
    search: Search, first: np.ndarray, records: Records, fitted: np.ndarray, method: str, affine: bool, explained: str
) -> TunedNoise:
    names = search.scores.shape.names
    score = search.scores.values(search.best[None])
    conflicts, outside, logged = (a[0][~fitted] for a in (score.conflicts, score.outside, score.logged))
    held = HeldOut(
        int((~fitted).sum()), int(((conflicts > 0) | (outside > 0)).sum()), conflicts, int(logged.sum()),
        int(outside.sum()),
    )  # fmt: skip
    notes = []
    zero = [name for name, factor in zip(names, search.best, strict=True) if factor <= 1e-3 * first.max()]
    if zero:
        notes.append(
            f"the records do not need {', '.join(zero)}: the other bounds explain them alone. That is no evidence that "
            "these are small"
        )
    if method == "optax" and not affine:
        notes.append("this system is not linear: the result is a local optimum")
    history = {key: np.array([row[key] for row in search.history]) for key in search.history[0]}
    return TunedNoise(
        noise=search.scores.shape.noise(search.best),
        factors=dict(zip(names, search.best.tolist(), strict=True)),
        cost=search.cost(search.best),
        start_cost=search.cost(first),
        lower_bound=search.lower,
        method=method,
        explained=explained,
        records=int(fitted.sum()),
        steps=int(records.length[fitted].sum()),
        held_out=held,
        history=history,
        notes=tuple(notes),
    )
