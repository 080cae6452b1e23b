"""What `discretize` is given: read, and refused where it does not fit."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from gsisio_jax.continuous import sides
from gsisio_jax.continuous.sides import Sides
from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.reading import check_type, is_whole, read_array

METHODS = ("euler", "rk4", "taylor", "zoh")


@dataclass(frozen=True)
class Arguments:
    """The numbers of a call, in float64.

    Attributes:
        h: length of a step.
        order: up to which the method has the terms of the solution.
        G: (n, p), p = 0 where there is no unknown input.
        drift: centre of the disturbance (n,), None where that is 0; spread: its radius (n,).
        region, u, d: boxes; empty ones where nothing was given.
        eps: of the floating type of the run.
        never: box that the plant never leaves, with infinite sides where nothing is known; the region is met with it.
    """

    h: float
    order: int
    G: np.ndarray
    drift: np.ndarray | None
    spread: np.ndarray
    region: Sides
    u: Sides
    d: Sides
    eps: float
    never: Sides

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.region[0])


def read(
    dt: Any,
    method: str,
    order: Any,
    region: Any,
    u_bounds: Any,
    G: Any,
    input_bounds: Any,
    disturbance: Any,
    dtype: Any,
    state_bounds: Any,
) -> Arguments:
    """All that can be judged without f.

    Raises:
        ValueError: something does not fit.
    """
    n = _sized("region", region)
    matrix = np.zeros((n, 0)) if G is None else np.asarray(read_array("discretize", "G", G), np.float64)
    if matrix.ndim != 2 or matrix.shape[0] != n or not np.isfinite(matrix).all():
        raise ValueError(f"discretize: `G` must be a finite matrix of shape ({n}, p), got shape {matrix.shape}")
    for name, box, size in (("u_bounds", u_bounds, None), ("input_bounds", input_bounds, matrix.shape[1]),
                            ("disturbance", disturbance, n), ("state_bounds", state_bounds, n)):  # fmt: skip
        if box is not None:
            _sized(name, box, size)
    kind = jnp.result_type(float) if dtype is None else jnp.dtype(dtype)
    if not jnp.issubdtype(kind, jnp.floating):
        raise ValueError(f"discretize: `dtype` must be a floating type (float64, float32), got {dtype!r}")
    drift, spread = _disturbance(disturbance, n, kind)
    never = sides.symmetric(np.full(n, np.inf)) if state_bounds is None else sides.sides(state_bounds)
    start = sides.meet(sides.sides(region), never)
    if not (start[0] <= start[1]).all():
        raise ValueError(f"discretize: no state of `region` is in `state_bounds`: {region} and {state_bounds}")
    return Arguments(
        _step(dt), _order(method, order), matrix, drift, spread, start, _or_none(u_bounds),
        _or_none(input_bounds), float(jnp.finfo(kind).eps), never,
    )  # fmt: skip


def check_bounded(method: str, given: Arguments, u_bounds: Any, input_bounds: Any) -> None:
    """Refuse what leaves no finite bound.

    Raises:
        ValueError: names what is missing, or infinite.
    """
    if given.G.shape[1] and input_bounds is None and method != "zoh":
        raise ValueError(
            "discretize: an unknown input without a bound can move the state anywhere within a step, where a "
            'nonlinear f is not known; give `input_bounds`, a box (p,), or use method="zoh" if f is affine'
        )
    for name, pair in (("region", given.region), ("u_bounds", given.u), ("input_bounds", given.d)):
        if name == "region" and method != "zoh":  # states that f does not use, or in sines alone, need no bounds
            continue
        if not np.isfinite(np.array(pair)).all():
            raise ValueError(
                f"discretize: `{name}` must be finite for a bound, got {pair[0]} to {pair[1]}; or give bound=False"
            )


def cells_of(region: Sides, cells: int | Sequence[int]) -> Iterator[Sides]:
    """The parts of the region.

    Raises:
        ValueError: `cells` is no number of parts, nor one for each state.
    """
    n, whole = len(region[0]), np.isfinite(region[0]) & np.isfinite(region[1])
    counts = [cells if cut else 1 for cut in whole] if isinstance(cells, int | np.integer) else list(cells)
    if len(counts) != n or not all(isinstance(c, int | np.integer) and c >= 1 for c in counts):
        raise ValueError(
            f"discretize: `cells` must be a number of parts from 1 on, or one for each of the {n} states; got {cells!r}"
        )
    if any(c > 1 for c, cut in zip(counts, whole, strict=True) if not cut):
        raise ValueError(
            f"discretize: `cells` cut states of which `region` is finite; got {cells!r}, {region[0]} to {region[1]}"
        )
    edges = [
        np.linspace(low, high, count + 1) if count > 1 else np.array([low, high])
        for low, high, count in zip(*region, counts, strict=True)
    ]
    for place in itertools.product(*map(range, counts)):
        ends = [(edge[i], edge[i + 1]) for edge, i in zip(edges, place, strict=True)]
        yield np.array([low for low, _ in ends]), np.array([high for _, high in ends])


def _step(dt: Any) -> float:
    value = np.asarray(read_array("discretize", "dt", dt))
    if value.shape or not np.isfinite(value) or value <= 0:
        raise ValueError(f"discretize: `dt` must be a positive number, the length of a step; got {dt!r}")
    return float(value)


def _order(method: str, order: Any) -> int:
    if method not in METHODS:
        raise ValueError(f"discretize: `method` must be one of {', '.join(METHODS)}; got {method!r}")
    if not is_whole(order) or order < 1:
        raise ValueError(f"discretize: `order` must be an integer from 1 on, got {order!r}")
    fixed = {"euler": 1, "rk4": 4, "zoh": 1}.get(method)
    if fixed is not None and order not in (2, fixed):  # 2 is what it is where nobody gave one
        raise ValueError(f'discretize: `order` = {order} is for method="taylor"; {method!r} has one of its own')
    return int(order) if fixed is None else fixed


def _sized(name: str, box: Any, size: int | None = None) -> int:
    check_type("discretize", name, box, Interval, "gx.Interval(lower, upper)")
    if len(box.shape) != 1 or (size is not None and box.shape[0] != size):
        wanted = "one dimension" if size is None else f"shape ({size},)"
        raise ValueError(f"discretize: `{name}` must be a box of {wanted}, got shape {box.shape}")
    return box.shape[0]


def _disturbance(box: Interval | None, n: int, kind: Any) -> tuple[np.ndarray | None, np.ndarray]:
    """Its centre, a number of the type of the run (None where it is zero), and its radius around that."""
    low, high = (np.zeros(n), np.zeros(n)) if box is None else sides.sides(box)
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise ValueError(f"discretize: `disturbance` must be finite, got {box}; what has no bound belongs into G d")
    center = (0.5 * low + 0.5 * high).astype(kind).astype(np.float64)
    radius = np.nextafter(np.maximum(high - center, center - low), np.inf)
    return (center if center.any() else None), np.where((low == center) & (high == center), 0, radius)


def _or_none(box: Interval | None) -> Sides:
    return (np.zeros(0), np.zeros(0)) if box is None else sides.sides(box)
