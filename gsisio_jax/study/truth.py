"""Reductions that hold the boxes against a known truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp

from gsisio_jax.interval.box import Interval
from gsisio_jax.observer.types import StepOutput
from gsisio_jax.study.reduction_base import Context, Reduction, Variable


class _Truth(Reduction):
    """Compares boxes with the truth, states from step 0 and inputs from step 1 on."""

    needs_truth = True

    def compare(self, total: Any, box: Interval, truth: Any, exact: Any = False, usual: Any = jnp.inf) -> Any:
        """The totals after one more step; `exact`: the truth is not rounded, `usual`: width that boxes settle at."""
        raise NotImplementedError

    def results(self, total: Any, count: Any) -> dict[str, Any]:
        raise NotImplementedError

    def init(self, first: StepOutput, context: Context) -> Any:
        zero = jnp.zeros_like(first.state.lower), jnp.zeros_like(first.state.lower)
        none = jnp.zeros_like(first.input.lower), jnp.zeros_like(first.input.lower)
        compared = self.compare(zero, first.state, context.x, context.exact, context.steady)
        return compared, None if context.d is None else none

    def update(self, state: Any, out: StepOutput, k: Any, context: Context) -> Any:
        x, d = state
        x = self.compare(x, out.state, context.x, context.exact, context.steady)
        return x, None if d is None else self.compare(d, out.input, context.d, context.exact)

    def finish(self, state: Any, steps: Any, context: Context) -> dict[str, Any]:
        named = {f"state_{key}": value for key, value in self.results(state[0], steps).items()}
        if state[1] is not None:
            named |= {f"input_{key}": value for key, value in self.results(state[1], steps - 1).items()}
        return named


@dataclass(frozen=True)
class Coverage(_Truth):
    """Share of steps at which the box contains the truth, and the farthest that the truth was outside.

    Strict: a truth that was rounded onto the wrong side of its own bound counts as a miss. How far says which it is.
    """

    name = "coverage"

    def compare(self, total: Any, box: Interval, truth: Any, exact: Any = False, usual: Any = jnp.inf) -> Any:
        outside = jnp.maximum(box.lower - truth, truth - box.upper)
        return total[0] + (outside <= 0), jnp.maximum(total[1], outside)

    def results(self, total: Any, count: Any) -> dict[str, Any]:
        return {"coverage": jnp.where(count > 0, total[0] / count, jnp.nan), "miss": total[1]}

    def describe(self) -> dict[str, Variable]:
        return {
            f"{of}_{key}": Variable((of,), text, unit or of)
            for of in ("state", "input")
            for key, text, unit in (
                ("coverage", f"share of steps at which the box contains the true {of}", "1"),
                ("miss", f"farthest that the true {of} was outside of its box", ""),
            )
        }


@dataclass(frozen=True)
class Error(_Truth):
    """Distance of the truth from the middle of its box: root mean square and largest. Infinite where a box is."""

    name = "error"

    def compare(self, total: Any, box: Interval, truth: Any, exact: Any = False, usual: Any = jnp.inf) -> Any:
        finite = jnp.isfinite(box.lower) & jnp.isfinite(box.upper)
        error = jnp.where(finite, jnp.abs(box.center - truth), jnp.inf)
        return total[0] + error**2, jnp.maximum(total[1], error)

    def results(self, total: Any, count: Any) -> dict[str, Any]:
        ends = {"error_rms": jnp.sqrt(total[0] / count), "error_max": total[1]}
        return {key: jnp.where(count > 0, end, jnp.nan) for key, end in ends.items()}

    def describe(self) -> dict[str, Variable]:
        return {
            f"{of}_error_{key}": Variable((of,), f"{text} distance of the true {of} from the middle of its box", of)
            for of in ("state", "input")
            for key, text in (("rms", "root mean square"), ("max", "largest"))
        }
