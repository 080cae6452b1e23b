"""The plant: a nonlinear discrete-time system with bounded noise and an unknown input without any bound.

x[k+1] = f(x[k], u[k]) + B u[k] + G d[k] + w[k]
y[k]   = g(x[k], u[k]) + D u[k] + H d[k] + v[k]
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from gsisio_jax._calls import named_arguments
from gsisio_jax.interval.box import Interval, is_concrete
from gsisio_jax.interval.reading import check_type, read_array
from gsisio_jax.plant.calls import as_static, as_vector, check_map, hashable, takes_u
from gsisio_jax.plant.captured import Captured, captured, changed
from gsisio_jax.plant.input_model import read_constant, read_rate
from gsisio_jax.plant.periodic import Periods, check_feedthrough, check_states, read_periods, turns
from gsisio_jax.plant.pickled import check_named


class System(eqx.Module):
    """A plant with known maps and an unknown input; a pytree whose structure holds `f` and `g`.

    Args:
        f: state map, a JAX function of ``x`` (n,) or of ``(x, u)``; returns (n,), or a list of n numbers. A second
            argument without a default is the known input; ``u=...`` is, where m > 0; others keep their defaults.
        g: output map, a JAX function of ``x`` or of ``(x, u)``; returns (l,), or a list of l numbers.
        G: how the unknown input enters the state, shape (n, p); p = 0 is a plain observer.
        H: how the unknown input enters the output (feedthrough), shape (l, p), any rank.
        B: how the known input enters the state, shape (n, m); zero if not given.
        D: how the known input enters the output, shape (l, m); zero if not given.
        state_bounds: box (n,) that every state is known to stay in (physics); all of R^n if not given.
        input_bounds: box (p,) that the unknown input is known to stay in; nothing is assumed if not given.
        m: number of known inputs, needed only where f or g takes ``u`` and both B and D are left out.
        periodic: ``{index of an output: period}`` for outputs that are logged modulo a period, such as a heading in
            (-pi, pi]: ``{2: 2 * math.pi}``, or 360 in degrees. g still returns the angle itself (``x[2]``, and not its
            arctangent or remainder, which jump); a measured value stands for itself plus any multiple of the period,
            and the observer finds which. The period is taken to be known to one unit in its last place.
        periodic_states: ``{index of a state: period}`` for states that mean the same after a period: f and g must not
            change but for multiples of the periods of periodic states and outputs (tried at some points). Their boxes
            stay on the real line as long as the multiple is known; where it is lost (an unknown heading, an unbounded
            d that turns it, a gap, a conflict) a box holds the state plus some multiple, see `wrapped` and `nearest`.
            Needs `periodic` outputs (there is nothing to choose without them), and acts in the current form.
        input_rate: bound (p,) of |d[k] - d[k-1]| per step, units of the input, or a box (p,) of d[k] - d[k-1]; inf
            where nothing is known. 0 says that the input never changes.
        input_constant: m, in steps: the unknown input changes at k = 0, m, 2m, ... alone (an actuator or a load that is
            set every m-th step), k counting from the first row of a record. With `input_rate` it changes by at most
            that much there.

    Raises:
        ValueError: a matrix is not finite or has the wrong shape, ``[G; H]`` has not full column rank, f or g returns
            the wrong shape, known inputs have no effect, or a bound does not fit or is negative; an index or a period
            cannot be, an unbounded input enters a periodic output, or f or g change with a periodic state.

    Source: paper, (eq:system); theory 1, 7.5 and 8.4.
    """

    f: Callable[..., Any] = eqx.field(static=True)
    g: Callable[..., Any] = eqx.field(static=True)
    f_takes_u: bool = eqx.field(static=True)
    g_takes_u: bool = eqx.field(static=True)
    G: Any
    H: Any
    B: Any
    D: Any
    state_bounds: Interval
    input_bounds: Interval
    captured: tuple[Captured, Captured] = eqx.field(static=True)  # also tells apart one f before and after a change
    periodic: Periods = eqx.field(static=True)
    periodic_states: Periods = eqx.field(static=True)
    turns: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    input_rate: Interval | None
    input_constant: int | None = eqx.field(static=True)

    @named_arguments
    def __init__(
        self,
        f: Callable[..., Any],
        g: Callable[..., Any],
        G: Any,
        H: Any,
        B: Any = None,
        D: Any = None,
        state_bounds: Interval | None = None,
        input_bounds: Interval | None = None,
        m: int | None = None,
        *,
        periodic: Mapping[int, float] | None = None,
        periodic_states: Mapping[int, float] | None = None,
        input_rate: Any = None,
        input_constant: int | None = None,
    ):
        self.f, self.g = as_static(f), as_static(g)
        self.G, self.H = _matrix("G", G), _matrix("H", H)
        if self.G.shape[1] != self.H.shape[1]:
            raise ValueError(
                f"System: G has shape {self.G.shape} and H has shape {self.H.shape}; both need one column per "
                "unknown input (give zero columns where an input does not act)"
            )
        m = _known_inputs(B, D, m)
        (self.f_takes_u, f_hint), (self.g_takes_u, g_hint) = takes_u(f, "f", m), takes_u(g, "g", m)
        m = _checked_inputs(m, self.takes_u, B, D, f_hint or g_hint)
        self.B = np.zeros((self.n, m)) if B is None else _matrix("B", B, (self.n, m))
        self.D = np.zeros((self.l, m)) if D is None else _matrix("D", D, (self.l, m))
        _check_rank(self.G, self.H)
        self.state_bounds = _bounds("state_bounds", state_bounds, self.n)
        self.input_bounds = _bounds("input_bounds", input_bounds, self.p)
        self.input_rate = read_rate(input_rate, self.p)
        self.input_constant = read_constant(input_constant, self.p)
        self.captured = captured(f), captured(g)
        self.periodic = read_periods("periodic", periodic, self.l, "output")
        self.periodic_states = read_periods("periodic_states", periodic_states, self.n, "state")
        check_feedthrough(self.periodic, self.H, self.input_bounds)
        check_states(self.periodic_states, self.state_bounds)
        self.turns = ()
        check_map("f", self.dynamics, self.n, self.n, m)
        check_map("g", self.measurement, self.l, self.n, m)
        self.turns = turns(self.maps, self.n, self.m, self.periodic, self.periodic_states, self.state_bounds)

    @property
    def n(self) -> int:
        """Number of states."""
        return self.G.shape[0]

    @property
    def p(self) -> int:
        """Number of unknown inputs."""
        return self.G.shape[1]

    @property
    def l(self) -> int:  # noqa: E743
        """Number of outputs."""
        return self.H.shape[0]

    @property
    def m(self) -> int:
        """Number of known inputs."""
        return self.B.shape[1]

    @property
    def takes_u(self) -> bool:
        """f or g takes the known input, so enclosures of their derivatives depend on it."""
        return self.f_takes_u or self.g_takes_u

    @hashable
    def dynamics(self, x: Any, u: Any) -> Any:
        """``f(x)`` or ``f(x, u)``, whichever the user gave."""
        return as_vector(self.f(x, u) if self.f_takes_u else self.f(x), self.n, x.dtype)

    @hashable
    def measurement(self, x: Any, u: Any) -> Any:
        """``g(x)`` or ``g(x, u)``, whichever the user gave."""
        return as_vector(self.g(x, u) if self.g_takes_u else self.g(x), self.l, x.dtype)

    def __reduce_ex__(self, protocol: Any) -> Any:
        check_named({"f": self.f, "g": self.g})
        return super().__reduce_ex__(protocol)

    def check_unchanged(self, call: str) -> None:
        """Refuse to go on where numbers that f or g reads from around it have changed since the system was made."""
        for name, function, before in (("f", self.f, self.captured[0]), ("g", self.g, self.captured[1])):
            if names := changed(function, before):
                raise ValueError(
                    f"{call}: {name} reads {', '.join(f'`{n}`' for n in names)}, which has changed since the System "
                    "was made: its gains and compiled programs hold the old value. Make a new System (and design "
                    "again), or give every system its own values, with functools.partial or a function that returns f"
                )

    @hashable
    def maps(self, x: Any, u: Any) -> Any:
        """f and g together, (n + l,)."""
        return jnp.concatenate([self.dynamics(x, u), self.measurement(x, u)])


class Noise(eqx.Module):
    """Bounds of the process noise `w` and of the measurement noise `v`; a pytree.

    Args:
        w: box (n,), units of the state; or (T, n) for bounds that change with time.
        v: box (l,), units of the output; or (T, l).

    Raises:
        ValueError: a bound is infinite. (NaN and crossed bounds are refused by `Interval`.)

    Source: paper, Section II; theory 1.
    """

    w: Interval
    v: Interval

    @named_arguments
    def __init__(self, w: Interval, v: Interval):
        for name, box in (("w", w), ("v", v)):
            check_type("Noise", name, box, Interval, "gx.Interval.symmetric(r) is the box from -r to r")
            values = (box.lower, box.upper)
            if all(is_concrete(x) for x in values) and not all(np.isfinite(np.asarray(x)).all() for x in values):
                raise ValueError(
                    f"Noise: the bounds of `{name}` must be finite, got {box}; noise without a bound belongs into the "
                    "unknown input d (a column of G or H)"
                )
        self.w, self.v = w, v

    @classmethod
    def unchecked(cls, w: Any, v: Any) -> Noise:
        """Build without looking at the numbers."""
        self = object.__new__(cls)
        object.__setattr__(self, "w", w)
        object.__setattr__(self, "v", v)
        return self

    def astype(self, dtype: Any) -> Noise:
        """The same bounds in another floating type, rounded outward."""
        return Noise.unchecked(self.w.astype(dtype), self.v.astype(dtype))


def _matrix(name: str, value: Any, shape: tuple[int, int] | None = None) -> np.ndarray:
    matrix = read_array("System", name, value)
    try:
        matrix = np.asarray(matrix, np.float64)
    except TypeError as error:  # JAX traces it
        raise ValueError(
            f"System: `{name}` is traced by JAX, and must be known; make the System outside of jit, vmap and grad"
        ) from error
    if matrix.ndim != 2:
        raise ValueError(
            f"System: {name} must be a matrix (2 dimensions), got shape {matrix.shape}; "
            "one column is written [[a], [b]], a row for each state (G, B) or output (H, D)"
        )
    if shape is not None and matrix.shape != shape:
        raise ValueError(f"System: {name} must have shape {shape}, got {matrix.shape}")
    if not np.isfinite(matrix).all():
        raise ValueError(f"System: {name} has an entry that is not finite: {matrix.tolist()}")
    return matrix


def _known_inputs(B: Any, D: Any, m: int | None) -> int | None:
    """What B, D and m say of the number of known inputs; None where they say nothing."""
    sizes = {np.shape(matrix)[1] for matrix in (B, D) if matrix is not None and np.ndim(matrix) == 2}
    if m is not None:
        if isinstance(m, bool) or int(m) != m or m < 0:
            raise ValueError(f"System: `m` must be the number of known inputs, got {m!r}")
        sizes.add(int(m))
    if len(sizes) > 1:
        raise ValueError(f"System: B, D and m disagree on the number of known inputs: {sorted(sizes)}")
    return sizes.pop() if sizes else None


def _checked_inputs(m: int | None, used: bool, B: Any, D: Any, hint: str) -> int:
    if m is None and used:
        raise ValueError(
            "System: f or g takes u, but B and D are not given; say how many known inputs there are: m=..."
        )
    if m and not used and all(matrix is None or not np.any(matrix) for matrix in (B, D)):
        raise ValueError(
            f"System: there are {m} known inputs, but neither f, g, B nor D takes u, so they would have no effect. "
            f"Give f or g a second argument u, or a matrix B or D that is not zero; or leave out m.{hint}"
        )
    return m or 0


def _check_rank(G: np.ndarray, H: np.ndarray) -> None:
    p = G.shape[1]
    if p == 0:
        return
    stacked = np.vstack([G, H])
    _, singular, right = np.linalg.svd(stacked)
    # Columns may have very different units: judge the rank of the normalised ones.
    norms = np.linalg.norm(stacked, axis=0)
    rank = 0 if (norms == 0).any() else np.linalg.matrix_rank(stacked / norms)
    if stacked.shape[0] < p or rank < p:
        raise ValueError(
            f"System: [G; H] must have full column rank {p}; the input direction {np.round(right[-1], 6).tolist()} "
            f"acts on neither state nor output (smallest singular value {singular[-1]:.3g}). Remove or merge "
            "unknown inputs."
        )


def _bounds(name: str, box: Interval | None, size: int) -> Interval:
    if box is None:
        return Interval.entire(size)
    check_type("System", name, box, Interval, f"gx.Interval(lower, upper) of shape ({size},)")
    if box.shape != (size,):
        raise ValueError(f"System: `{name}` must have shape ({size},), got {box.shape}; use -inf and inf where unknown")
    return box
