"""What observers that stand around an ordinary one have in common: most of what is asked of them, it answers."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Self

import equinox as eqx

from gsisio_jax._memo import Remembers, once
from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.rounding import Rounding
from gsisio_jax.observer.types import Observer


class Wrapped(Remembers, eqx.Module):
    """An observer around another one, `inner`."""

    if TYPE_CHECKING:  # a field of those that inherit, which say where among theirs
        inner: Observer

    @property
    def rounding(self) -> Rounding:
        """As in `Observer`."""
        return self.inner.rounding

    @property
    def guaranteed(self) -> bool:
        """The boxes hold on the machine."""
        return self.inner.guaranteed

    @property
    def u_region(self) -> Interval:
        """Box (m,) of known inputs for which the enclosures hold."""
        return self.inner.u_region

    @property
    def current_input_directions(self) -> Any:
        """V1 (p, p_H)."""
        return self.inner.current_input_directions

    def with_rounding(self, rounding: Rounding) -> Self:
        """The same observer with another rounding."""
        return once(self, ("rounding", rounding), lambda: replace(self, inner=self.inner.with_rounding(rounding)))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write every number of the design into a file, as `Observer.save`."""
        from gsisio_jax.files import save_observer

        save_observer(path, self)  # type: ignore[arg-type]
