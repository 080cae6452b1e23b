"""Linear plants of python-control and SciPy, or plain matrices, as a `System`. Neither package is imported."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from gsisio_jax._calls import named_arguments
from gsisio_jax.continuous import maps
from gsisio_jax.continuous.hold import held
from gsisio_jax.interval.reading import is_whole, read_array
from gsisio_jax.plant.system import System

_CALL = "from_state_space"


@named_arguments
def from_state_space(
    sys: Any,
    *,
    G: Any = None,
    H: Any = None,
    unknown: Sequence[int] = (),
    dt: float | None = None,
    **options: Any,
) -> System:
    """A `System` from a linear model ``x+ = A x + B u, y = C x + D u``, and how the unknown input enters it.

    Args:
        sys: a discrete ``control.StateSpace``, ``scipy.signal.dlti`` or ``StateSpace``; anything with A, B, C, D and
            dt; or a tuple of matrices (A, B, C, D), which is discrete, or (A, B, C, D, period), with a period of 0 for
            a continuous one. A continuous one needs `dt`.
        G: how the unknown input d enters the state, shape (n, p); zero if only H is given. For a continuous model: how
            it enters x'.
        H: how it enters the output, shape (l, p); zero if only G is given. With neither there is no unknown input.
        unknown: columns of B and D, by index, whose inputs are unknown: they are moved into G and H (before those
            given).
        dt: for a continuous model: the sampling time. u and d are taken to be constant over a step (zero-order hold,
            exact to rounding: the promise refers to the matrices that come out, as floating-point numbers). C and D
            stay.
        options: further arguments of `System`: state_bounds, input_bounds, periodic, ...

    Returns:
        A `System`; its known inputs u, shape (m,), are those of the model that are not `unknown`.

    Raises:
        ValueError: no state-space model; a continuous one without dt, or a discrete one with another, or with any
            where its period is not known; a shape does not fit; `options` hold what comes from the model.

    >>> plant = from_state_space(([[1.0, 0.1], [0.0, 1.0]], [[0.0], [0.1]], [[1.0, 0.0]], [[0.0]]), unknown=[0])
    >>> plant.n, plant.m, plant.p
    (2, 0, 1)

    Source: theory 1; zero-order hold: K. J. Astrom and B. Wittenmark, *Computer-Controlled Systems*, 1997, section 2.3.
    """
    taken = [name for name in ("f", "g", "B", "D", "m") if name in options]
    if taken:
        raise ValueError(f"{_CALL}: `{taken[0]}` comes from the model; leave it out")
    (A, B, C, D), period = _read(sys)
    G, H = _unknown(G, H, len(A), len(C))
    columns = _columns(unknown, B.shape[1])
    known = [j for j in range(B.shape[1]) if j not in columns]
    G, H = np.hstack([B[:, columns], G]), np.hstack([D[:, columns], H])
    B, D = B[:, known], D[:, known]
    if period == 0:
        if dt is None:
            raise ValueError(
                f"{_CALL}: the model is continuous; give dt=..., the sampling time (zero-order hold), or use "
                "gx.discretize"
            )
        A, B, G = _held(A, B, G, dt)
    elif dt is not None and period is True:
        # Taken for discrete matrices as they are, those of a continuous model would make another plant, silently.
        raise ValueError(
            f"{_CALL}: `dt` is for a continuous model, and {_kind(sys)} is discrete; leave out dt, or give the "
            "matrices of a continuous one as (A, B, C, D, 0) or scipy.signal.StateSpace(A, B, C, D)"
        )
    elif dt is not None and dt != period:
        raise ValueError(
            f"{_CALL}: the model is discrete already, with a period of {period:g}, not {dt:g}; leave out dt"
        )
    if B.shape[1]:
        options.update(B=B, D=D)
    return System(partial(maps.linear, A), partial(maps.linear, C), G=G, H=H, **options)


def _read(sys: Any) -> tuple[list[np.ndarray], Any]:
    """A, B, C, D and the period: 0 for a continuous model, True for a discrete one of unknown period."""
    if isinstance(sys, tuple | list) and len(sys) in (4, 5):
        matrices, period = sys[:4], sys[4] if len(sys) == 5 else True
    elif all(hasattr(sys, name) for name in "ABCD"):
        matrices, period = [getattr(sys, name) for name in "ABCD"], _period(sys)
    else:
        raise ValueError(
            f"{_CALL}: `sys` must have matrices A, B, C, D (control.StateSpace, scipy.signal.dlti(...).to_ss(), or a "
            f"tuple), got {type(sys).__name__}; transfer functions: control.tf2ss(sys), or sys.to_ss() in SciPy"
        )
    found = [
        np.asarray(read_array(_CALL, name, value), np.float64) for name, value in zip("ABCD", matrices, strict=True)
    ]
    A, B, C, D = found
    n, m, l = len(A), B.shape[-1], len(C)
    for name, matrix, shape in (("A", A, (n, n)), ("B", B, (n, m)), ("C", C, (l, n)), ("D", D, (l, m))):
        if matrix.shape != shape:
            raise ValueError(
                f"{_CALL}: {name} must have shape {shape}, got {matrix.shape}; give matrices of two dimensions"
            )
        if not np.isfinite(matrix).all():
            raise ValueError(f"{_CALL}: {name} has an entry that is not finite; every number of the model is needed")
    if period is not True and not (isinstance(period, int | float | np.number) and period >= 0):
        raise ValueError(f"{_CALL}: the period of a discrete model must be a positive number, or True; got {period!r}")
    return found, period


def _kind(sys: Any) -> str:
    return "a tuple of four matrices" if isinstance(sys, tuple | list) else f"a {type(sys).__name__} with dt = True"


def _period(sys: Any) -> Any:
    period = getattr(sys, "dt", True)
    if period is not None:
        return period
    if type(sys).__module__.startswith("scipy"):  # there None is a continuous model
        return 0
    raise ValueError(
        f"{_CALL}: the time base of the model is not specified (dt is None); set sys.dt to its period, to True "
        "(discrete) or to 0 (continuous)"
    )


def _unknown(G: Any, H: Any, n: int, l: int) -> tuple[np.ndarray, np.ndarray]:
    given = {
        name: np.asarray(read_array(_CALL, name, value), np.float64)
        for name, value in (("G", G), ("H", H)) if value is not None
    }  # fmt: skip
    for name, matrix in given.items():
        if matrix.ndim != 2 or len(matrix) != (n if name == "G" else l):
            raise ValueError(f"{_CALL}: {name} must have shape ({n if name == 'G' else l}, p), got {matrix.shape}")
    p = next((matrix.shape[1] for matrix in given.values()), 0)
    return given.get("G", np.zeros((n, p))), given.get("H", np.zeros((l, p)))


def _columns(unknown: Sequence[int], m: int) -> list[int]:
    columns = list(unknown)
    for j in columns:
        if not is_whole(j) or not 0 <= j < m:
            raise ValueError(f"{_CALL}: `unknown` must hold indices of inputs, 0 to {m - 1}, got {unknown!r}")
    if len(set(columns)) < len(columns):
        raise ValueError(f"{_CALL}: `unknown` names an input twice: {unknown!r}")
    return columns


def _held(A: np.ndarray, B: np.ndarray, G: np.ndarray, dt: float) -> list[np.ndarray]:
    h = np.asarray(read_array(_CALL, "dt", dt))
    if h.shape or not np.isfinite(h) or h <= 0:
        raise ValueError(f"{_CALL}: `dt` must be a positive number, the sampling time; got {dt!r}")
    return held(_CALL, A, [B, G], float(h))[0]
