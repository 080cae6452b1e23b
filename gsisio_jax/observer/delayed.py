"""An observer with a delay: the box of x[k] from y[0..k+L], for plants whose unknown input shows L steps later.

It is the ordinary observer of a lifted plant (`gsisio_jax.plant.lift`), whose outputs of step k are y[k] and the
combinations of y[k..k+L] that are free of d. What is given and returned is in terms of the plant itself. The step that
takes y[k] finishes step k - L, so a run begins with L steps that finish nothing.

Source: theory 5.9.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax._memo import once
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, add, entire_like
from gsisio_jax.interval.direct import where
from gsisio_jax.interval.image import image
from gsisio_jax.observer import step as current_step
from gsisio_jax.observer.certificate import Certificate
from gsisio_jax.observer.measurement import point
from gsisio_jax.observer.status import Status
from gsisio_jax.observer.types import Carry, Observer, StepOutput, cast
from gsisio_jax.observer.wrapped import Wrapped
from gsisio_jax.plant.lift import LiftedOutput, output_of
from gsisio_jax.plant.system import Noise, System


class DelayedObserver(Wrapped):
    """A designed observer that waits for L more measurements. Made by `design_observer(delay=L)`.

    Attributes:
        system: the plant, as it was given.
        noise: the bounds it was designed for (any others are legal at run time).
        certificate: what the design promises, in terms of the noise of the plant; print it.
        inner: the observer of the lifted plant, which does the work.
        delay: L: the box of x[k] is from y[0..k+L].
    """

    system: System
    noise: Noise
    certificate: Certificate
    inner: Observer
    delay: int = eqx.field(static=True)

    @property
    def output_rows(self) -> tuple[tuple[int, ...], ...]:
        """For every row of T2 the outputs of the plant that enter it, now or later."""
        l, later = self.system.l, self.lift.rows(np.float64).entries
        return tuple(
            tuple(sorted({i for j in row for i in ((j,) if j < l else later[j - l])})) for row in self.inner.output_rows
        )

    @property
    def window(self) -> Any:
        """Rows over several steps of the lifted plant, as of an `Observer`; None where there are none."""
        return self.inner.window

    @property
    def lift(self) -> LiftedOutput:
        """How the outputs of the lifted plant come from y[k..k+L]."""
        lift = output_of(self.inner.system)
        assert lift is not None
        return lift

    def astype(self, dtype: Any) -> DelayedObserver:
        """The same observer in another floating type; boxes are rounded outward (`Observer.astype`)."""
        dtype = np.dtype(jax.dtypes.canonicalize_dtype(dtype))

        def made() -> DelayedObserver:
            inner = self.inner.astype(dtype)
            self.lift.rows(dtype)  # refused here rather than in the middle of a run
            with jax.ensure_compile_time_eval():  # as in `Observer.astype`
                return replace(cast(replace(self, inner=None), dtype), inner=inner)

        return once(self, ("type", dtype), made)

    def row(self, y: Any, u: Any, noise: Noise) -> tuple[Any, Noise]:
        """Measurement (l',) and noise bounds of the lifted plant for step k, from y, u and noise of k..k+L, (L+1, .).

        A combination is known to within what its products lose; that becomes part of its noise.
        """
        rows = self.lift.rows(y.dtype)
        flat, seen = y.ravel(), jnp.isfinite(y.ravel())
        value = image(rows.outputs, point(where(seen, flat, 0)))
        if rows.known.any():
            value = add(value, image(-rows.known, point(u.ravel())))
        middle = value.center
        lost = add(point(middle), Interval.unchecked(-value.upper, -value.lower))
        w, v = (Interval.unchecked(box.lower.ravel(), box.upper.ravel()) for box in (noise.w, noise.v))
        more = add(image(rows.process, w), image(rows.outputs, v), lost)
        missing = ((rows.outputs != 0) & ~seen).any(-1)
        joined = Interval.unchecked(*(
            jnp.concatenate([now[0], later])
            for now, later in ((noise.v.lower, more.lower), (noise.v.upper, more.upper))
        ))  # fmt: skip
        return jnp.concatenate([y[0], where(missing, jnp.nan, middle)]), Noise.unchecked(noise.w[0], joined)


class Waiting(eqx.Module):
    """The last L rows, which are not finished, oldest first; it stands in `Carry.older`.

    Attributes:
        y, u, noise: (L, .).
        filled: (L,) False for rows before the record.
        older: what `Carry.older` holds besides.
    """

    y: Any
    u: Any
    noise: Noise
    filled: Any
    older: Any


def blank(observer: DelayedObserver, initial: Interval) -> Carry:
    """The past of a first step: nothing is known but the initial box."""
    carry, system, L = current_step.blank(observer.inner, initial), observer.system, observer.delay
    y, u, w = (jnp.zeros((L, size), initial.dtype) for size in (system.l, system.m, system.n))
    noise = Noise.unchecked(Interval.unchecked(w, w), Interval.unchecked(y, y))
    return replace(carry, older=Waiting(y + jnp.nan, u, noise, jnp.zeros(L, bool), carry.older))


@rounding.by_observer
def advance(
    observer: DelayedObserver, carry: Carry, y: Any, u: Any, noise: Noise, hold: bool = False
) -> tuple[Carry, StepOutput]:
    """Take y[k] and finish step k - L; as long as that lies before the record, nothing is known (status PENDING)."""
    waiting: Waiting = carry.older
    rows = Waiting(y, u, noise, jnp.asarray(True), None)
    kept = jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), replace(waiting, older=None), rows)
    before = replace(carry, older=waiting.older)
    measured, bounds = observer.row(kept.y, kept.u, kept.noise)
    after, out = current_step.advance(observer.inner, before, measured, kept.u[0], bounds, hold)
    due = kept.filled[0]
    after = jax.tree.map(lambda a, b: where(due, a, b), after, before)
    out = jax.tree.map(lambda a, b: where(due, a, b), out, _nothing(out))
    left = jax.tree.map(lambda rows: rows[1:], kept)
    return replace(after, older=replace(left, older=after.older)), out


def _nothing(out: StepOutput) -> StepOutput:
    """The output of a step that finishes none."""
    return StepOutput(
        entire_like(out.state), entire_like(out.input), entire_like(out.current_input),
        jnp.full_like(out.status, int(Status.PENDING)), jnp.full_like(out.margin, jnp.inf),
        jnp.zeros_like(out.source),
    )  # fmt: skip


def to_the_end(observer: DelayedObserver, y: Any, u: Any, noise: Noise) -> tuple[Any, Any, Noise]:
    """A record with L rows more, which are missing: they finish its last L steps."""
    L = observer.delay

    def longer(rows: Any, fill: float | None = None) -> Any:
        last = jnp.broadcast_to(rows[-1:] if fill is None else jnp.asarray(fill, rows.dtype), (L, *rows.shape[1:]))
        return jnp.concatenate([rows, last])

    boxes = (jax.tree.map(longer, box) if len(box.shape) == 2 else box for box in (noise.w, noise.v))
    return longer(y, np.nan), longer(u, 0.0), Noise.unchecked(*boxes)
