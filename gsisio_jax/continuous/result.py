"""What `discretize` returns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.continuous import sides
from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.reading import check_type, read_array
from gsisio_jax.plant.calls import takes_u
from gsisio_jax.plant.system import Noise, System


@dataclass(frozen=True)
class Discretization:
    """A discrete map and a bound of what it leaves out; `discretize` makes it.

    ``x(t + dt) = f(x(t), u) + G d + e`` with e in `error`, for every start in `region`, every u in `u_bounds` and every
    d in `input_bounds`, both constant over the step.

    Attributes:
        f: discrete map, of x (n,) or of (x, u); returns (n,).
        error: box (n,) of e, units of the state; None if no bound was asked for.
        G: how the unknown input enters over a step, shape (n, p); None without one.
        dt: length of the step, in the unit of time of the vector field.
        method: as asked for.
        region: box (n,) of states at the start of a step for which `error` holds.
        u_bounds: box (m,) of known inputs for which it holds; None where f takes none.
        input_bounds: box (p,) of unknown inputs for which it holds; None where it needs none.
        state_bounds: box (n,) that the plant was said never to leave; None where nothing was said.
        notes: what would make `error` smaller, where the bound shows it.
    """

    f: Callable[..., Any]
    error: Interval | None
    G: np.ndarray | None
    dt: float
    method: str
    region: Interval
    u_bounds: Interval | None = None
    input_bounds: Interval | None = None
    state_bounds: Interval | None = None
    notes: tuple[str, ...] = ()

    def system(self, g: Callable[..., Any], H: Any = None, **options: Any) -> System:
        """The plant with the output map g; `f`, `G`, `input_bounds`, `state_bounds` and the number of known
        inputs are filled in.

        Args:
            g: output map of x (n,) or (x, u); returns (l,).
            H: how d enters the output, shape (l, p); zero if not given.
            options: further arguments of `System`: D, state_bounds, periodic, ...

        Raises:
            ValueError: as `System`.
        """
        m = options.pop("m", None)
        m = self.u_bounds.shape[0] if m is None and self.u_bounds is not None else m
        n = self.region.shape[0]
        G = np.zeros((n, 0)) if self.G is None else self.G
        if H is None:
            H = np.zeros((_outputs(g, n, m), G.shape[1]))
        for name, box in (("input_bounds", self.input_bounds), ("state_bounds", self.state_bounds)):
            if box is not None:
                options.setdefault(name, box)
        return System(self.f, g, G=G, H=H, m=m, **options)

    def noise(self, v: Interval, w: Interval | None = None) -> Noise:
        """Noise bounds of which the discretisation error is part of w.

        Args:
            v: box (l,) of the measurement noise.
            w: box (n,) of process noise besides, per step and in units of the state; none if not given.

        Raises:
            ValueError: `discretize` was called with ``bound=False``, or a bound does not fit.
        """
        if self.error is None:
            raise ValueError(
                "Discretization.noise: there is no bound of the error (bound=False): call gx.discretize with "
                "bound=True and a region, or gx.Noise(w, v) with a w of your own"
            )
        if w is None:
            return Noise(self.error, v)
        check_type("Discretization.noise", "w", w, Interval, "gx.Interval.symmetric(r) is the box from -r to r")
        if w.shape[-1:] != self.error.shape:
            raise ValueError(f"Discretization.noise: `w` must have shape {self.error.shape}, got {w.shape}")
        return Noise(Interval(*sides.add(sides.sides(self.error), sides.sides(w))), v)

    def holds(self, state: Interval, u: Any = None) -> np.ndarray:
        """For every step of a run: is its box proved, so that the region was no assumption?

        A box is proved while all boxes before it lie in `region`, by induction: the first box holds the state, so the
        error of the first step is bounded, so the second box holds it, and so on.

        Args:
            state: boxes (T, n) of `estimate`.
            u: known inputs (T, m), if f takes any: a row outside `u_bounds` ends the proof.

        Returns:
            Array (T,) of truth values; the first is True.

        Raises:
            ValueError: there is no bound, u is missing, or a shape does not fit.
        """
        if self.error is None:
            raise ValueError("Discretization.holds: there is no bound of the error (bound=False), so nothing is proved")
        check_type("Discretization.holds", "state", state, Interval, "give est.state")
        n = self.region.shape[0]
        if len(state.shape) != 2 or state.shape[1] != n:
            raise ValueError(f"Discretization.holds: `state` must have shape (T, {n}), got {state.shape}")
        low, high = sides.sides(state)
        good: np.ndarray = np.asarray(
            ((low >= np.asarray(self.region.lower)) & (high <= np.asarray(self.region.upper))).all(1)
        )
        if self.u_bounds is not None:
            m = self.u_bounds.shape[0]
            values = np.zeros((0, 0)) if u is None else np.asarray(read_array("Discretization.holds", "u", u))
            if values.shape != (len(good), m):
                raise ValueError(
                    f"Discretization.holds: the error depends on u; give `u` of shape ({len(good)}, {m}), got "
                    f"{'none' if u is None else values.shape}"
                )
            good = good & np.asarray(self.u_bounds.contains(values)).all(1)
        return np.concatenate([[True], np.logical_and.accumulate(good)])[: len(good)]


def _outputs(g: Callable[..., Any], n: int, m: int | None) -> int:
    """How many numbers g returns."""
    kind, with_u = jnp.result_type(float), takes_u(g, "g", m)[0]
    x, u = jax.ShapeDtypeStruct((n,), kind), jax.ShapeDtypeStruct((m or 0,), kind)
    out = jax.eval_shape(lambda x, u: g(x, u) if with_u else g(x), x, u)
    return len(out) if isinstance(out, list | tuple) else int(np.prod(out.shape[:1]))
