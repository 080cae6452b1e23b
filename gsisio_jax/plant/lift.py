"""The lifted plant: combinations of later outputs as outputs of now, so that an unknown input that shows later shows.

Source: theory 5.9.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.plant.later_outputs import LiftedRows, Pieces, lifted_rows
from gsisio_jax.plant.system import System


class LiftedOutput:
    """g of the lifted plant: the g of the plant, and behind it the outputs of `LiftedRows`."""

    def __init__(self, plant: System, delay: int, more: tuple[Pieces, ...] = ()):
        self.plant, self.delay, self.more = plant, delay, more
        with jax.enable_x64(True):
            self._rows = {(np.dtype(np.float64), np.dtype(np.float64)): lifted_rows(plant, delay, np.float64, more)}

    def _parts(self) -> tuple[Any, ...]:
        plant = self.plant
        return plant.f, plant.g, self.delay, self.more, *(np.asarray(M).tobytes() for M in (plant.G, plant.H, plant.D))

    def __eq__(self, other: object) -> bool:
        """Made of the same plant in the same way: then compiled programs serve both."""
        return isinstance(other, LiftedOutput) and self._parts() == other._parts()

    def __hash__(self) -> int:
        return hash(self._parts())

    def rows(self, dtype: Any) -> LiftedRows:
        """The rows for the constants that f and g have in that floating type."""
        wide = np.dtype(np.float64)
        # Whether constants are of 64 bits where x is not depends on the setting of JAX.
        key = np.dtype(dtype), wide if dtype == wide else np.dtype(jnp.result_type(float))
        if key not in self._rows:
            found = lifted_rows(self.plant, self.delay, dtype, self.more)
            if found.entries != self._rows[wide, wide].entries:
                raise ValueError(
                    f"design_observer(delay={self.delay}): in {key[0]} other combinations of the outputs are free of "
                    "the unknown input than in float64, or f and g cannot be read; give data in float64"
                )
            self._rows[key] = found
        return self._rows[key]

    def __call__(self, x: Any) -> Any:
        return self.of(x, jnp.zeros(self.plant.m, x.dtype))

    def of(self, x: Any, u: Any) -> Any:
        """All outputs of the lifted plant at x."""
        rows = self.rows(x.dtype)
        f, g = self.plant.dynamics(x, u), self.plant.measurement(x, u)
        later = []
        for of_f, of_g, constant in zip(rows.of_f, rows.of_g, rows.constant, strict=True):
            terms = [_times(piece, f[i]) for i, pieces in of_f for piece in pieces]
            terms += [_times(piece, g[j]) for j, pieces in of_g for piece in pieces]
            terms += [jnp.asarray(piece, x.dtype) for piece in constant]
            later.append(sum(terms[1:], terms[0]))
        return jnp.concatenate([g, jnp.stack(later)]) if later else g


class LiftedOutputOfU(LiftedOutput):
    """The same for plants whose f or g takes u."""

    def __call__(self, x: Any, u: Any) -> Any:  # type: ignore[override]
        return self.of(x, u)


def _times(piece: float, value: Any) -> Any:
    return value if piece == 1 else jnp.asarray(piece, value.dtype) * value


def lifted(plant: System, delay: int, more: tuple[Pieces, ...] = ()) -> System:
    """The plant with the combinations of y[k..k+L] that are free of d as further outputs of step k.

    Args:
        plant: as it was given.
        delay: L.
        more: combinations of these combinations and of y[k], as weights of `LiftedRows.free`, as outputs besides.
    """
    output = (LiftedOutputOfU if plant.takes_u else LiftedOutput)(plant, delay, more)
    count = len(output.rows(np.float64).entries)
    below = np.zeros((count, plant.p)), np.zeros((count, plant.m))
    return System(
        plant.f, output, plant.G, np.vstack([plant.H, below[0]]), plant.B, np.vstack([plant.D, below[1]]),
        plant.state_bounds, plant.input_bounds, input_rate=plant.input_rate, input_constant=plant.input_constant,
    )  # fmt: skip


def output_of(system: System) -> LiftedOutput | None:
    """The lifted output of a system that `lifted` has made; None for any other."""
    g = system.g
    return g if isinstance(g, LiftedOutput) else None
