"""Did every box hold the truth? The first miss of a run, and the message that leads back to it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.errors import ContainmentLost
from gsisio_jax.interval.box import Interval
from gsisio_jax.observer.types import StepOutput
from gsisio_jax.study.later import delay_of
from gsisio_jax.study.reduction_base import Context, Kept, Variable
from gsisio_jax.study.truth import Coverage

# Where noise has no room to keep off its bounds, the simulated plant rounds where the real one would not, and that may
# push the truth out of a box by some units in the last place. Relative to the truth and to the width of its box, or to
# the width that boxes settle at where that is less: what a wider box says of the truth is not what was rounded. Double
# and single precision. A truth that is known to be exact gets no slack.
SLACK = {True: 1e-9, False: 1e-3}


BROKEN = (
    "the first state lies outside of the initial box",
    "the state left `state_bounds` of the system",
    "the input left `input_bounds` of the system",
    "`draw` returned noise outside of its bounds",
    "the simulated state or measurement is not finite",
)
"""How a simulated run may leave what the boxes rely on, one sentence for every bit (the lowest first) of the variable
``broken`` of `monte_carlo`."""


@dataclass(frozen=True)
class Containment(Coverage):
    """`Coverage` up to the rounding of the truth, and the first step at which a box missed it."""

    double: bool

    def compare(self, total: Any, box: Interval, truth: Any, exact: Any = False, usual: Any = jnp.inf) -> Any:
        below, above = box.lower - truth, truth - box.upper
        outside = jnp.maximum(below, above)
        # The width says how large the numbers are that were rounded; an infinite one says nothing of the other side.
        size = jnp.where(jnp.isfinite(box.width), box.width, jnp.abs(jnp.where(below > above, box.lower, box.upper)))
        size = jnp.abs(truth) + jnp.minimum(jnp.where(jnp.isfinite(size), size, 0), usual)
        rounded = (outside <= SLACK[self.double] * size) & ~jnp.asarray(exact)
        outside = jnp.where(rounded, jnp.minimum(outside, 0), outside)
        outside = jnp.where(jnp.isnan(box.lower) | jnp.isnan(box.upper), jnp.inf, outside)  # no box holds anything
        return total[0] + (outside <= 0), jnp.maximum(total[1], outside)

    def init(self, first: StepOutput, context: Context) -> Any:
        x, d = super().init(first, context)
        return x, d, jnp.where((x[1] > 0).any(), jnp.int32(0), jnp.int32(-1))

    def update(self, state: Any, out: StepOutput, k: Any, context: Context) -> Any:
        x, d = super().update(state[:2], out, k, context)
        missed = (x[1] > 0).any() | (d[1] > 0).any()
        return x, d, jnp.where((state[2] < 0) & missed, jnp.int32(k), state[2])

    def finish(self, state: Any, steps: Any, context: Context) -> dict[str, Any]:
        first = jnp.where(state[2] < 0, jnp.nan, state[2]).astype(jnp.result_type(context.steady))
        return {**super().finish(state[:2], steps, context), "first_miss": first}

    def describe(self) -> dict[str, Variable]:
        return {**super().describe(), "first_miss": Variable((), "first step at which a box misses the truth")}


@dataclass(frozen=True)
class TrueRun(Kept):
    """The simulated states and inputs themselves, beside the boxes."""

    name = "truth"

    def row(self, out: StepOutput, k: Any, context: Context) -> Any:
        return context.x, context.d

    def finish(self, state: Any, steps: Any, context: Context) -> dict[str, Any]:
        x, d = state
        # d[k] is known to the box of step k + 1, as in `Boxes`.
        return {"state_true": x, "input_true": jnp.concatenate([d[1:], jnp.full_like(d[:1], jnp.nan)])}

    def describe(self) -> dict[str, Variable]:
        return {f"{of}_true": Variable(("time", of), f"true {of}", of) for of in ("state", "input")}


def check(job: Any, cases: np.ndarray, results: dict[str, np.ndarray]) -> None:
    """Refuse a tile with a run that broke its own bounds, or a box that missed the truth; the earliest such run speaks.

    Raises:
        ContainmentLost: with all that it takes to do the run again.
    """
    broken_at, missed_at = results["broken_at"], results["first_miss"]
    # After a run broke its own bounds nothing is promised any more: a miss counts only before.
    missed = ~np.isnan(missed_at) & ~(broken_at < missed_at)
    for bad, at, what in (
        (~np.isnan(broken_at), broken_at, _break), (missed, missed_at, _miss),
    ):  # fmt: skip
        if not bad.any():
            continue
        row = int(np.argmax(bad))
        step, (place, number) = int(at[row]), _place(job, cases[row])
        data = np.asarray(job.arguments["key"]).tolist()
        impl = "" if job.rows.impl == str(jax.random.key_impl(jax.random.key(0))) else f", impl={job.rows.impl!r}"
        steps = step + 1 + delay_of(job.observer)
        raise ContainmentLost(
            f"{job.call}: {what(results, row)} in run {number}{place} at step {step}. To see it, call {job.call} with "
            f"the same arguments, but key=jax.random.wrap_key_data(jax.numpy.array({data}, dtype='uint32'){impl}), "
            f'runs=[{number}], steps={steps}, reduce=None, on_miss="record"; {int(bad.sum())} of {len(cases)} runs '
            "of this tile are concerned"
        )


def _break(results: dict[str, np.ndarray], row: int) -> str:
    bits = int(results["broken"][row])
    reasons = [text for bit, text in enumerate(BROKEN) if bits >> bit & 1]
    return f"{' and '.join(reasons)}, where the boxes promise nothing: change x0, d, noise or the bounds. This was"


def _miss(results: dict[str, np.ndarray], row: int) -> str:
    signals = [
        f"{letter}{i + 1} by {miss:.3g}"
        for letter, of in (("x", "state"), ("d", "input"))
        for i, miss in enumerate(results[f"{of}_miss"][row])
        if miss > 0
    ]
    return f"a box misses the truth ({', '.join(signals)})"


def _place(job: Any, case: Any) -> tuple[str, int]:
    """Where a case lies on the axes, and the number of its run."""
    index = np.unravel_index(case, job.layout.sizes)
    labels = {name: job.layout.coordinates[name].values[i] for name, i in zip(job.layout.names, index, strict=True)}
    number = int(labels.pop("run"))
    return "".join(f", {name} {value}" for name, value in labels.items()), number
