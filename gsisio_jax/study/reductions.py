"""The reductions by name: widths, settling, conflicts, quantiles, and everything kept."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from gsisio_jax._calls import named_arguments
from gsisio_jax.observer.status import Status
from gsisio_jax.observer.types import StepOutput
from gsisio_jax.study.reduction_base import Context, Kept, Reduction, Variable
from gsisio_jax.study.truth import Coverage, Error


class _Widths(Reduction):
    """Folds the widths of the boxes. The box of d[k-1] comes at step k, so inputs count from step 1 on."""

    empty: ClassVar[float] = 0.0
    text: ClassVar[str]

    def fold(self, total: Any, width: Any) -> Any:
        raise NotImplementedError

    def end(self, total: Any, count: Any) -> Any:
        return total

    def init(self, first: StepOutput, context: Context) -> Any:
        state, d = first.state.width, first.input.width
        return self.fold(jnp.full_like(state, self.empty), state), jnp.full_like(d, self.empty)

    def update(self, state: Any, out: StepOutput, k: Any, context: Context) -> Any:
        return self.fold(state[0], out.state.width), self.fold(state[1], out.input.width)

    def finish(self, state: Any, steps: Any, context: Context) -> dict[str, Any]:
        counts = steps, steps - 1
        ends = (jnp.where(n > 0, self.end(x, n), jnp.nan) for x, n in zip(state, counts, strict=True))
        return dict(zip((f"state_width_{self.name}", f"input_width_{self.name}"), ends, strict=True))

    def describe(self) -> dict[str, Variable]:
        return {
            f"state_width_{self.name}": Variable(("state",), f"{self.text} of the state box", "state"),
            f"input_width_{self.name}": Variable(("input",), f"{self.text} of the input box", "input"),
        }


@dataclass(frozen=True)
class Final(_Widths):
    """Widths at the last step."""

    name = "final"
    empty = np.nan
    text = "last width"

    def fold(self, total: Any, width: Any) -> Any:
        return width


@dataclass(frozen=True)
class Max(_Widths):
    """Largest widths."""

    name = "max"
    empty = -np.inf
    text = "largest width"

    def fold(self, total: Any, width: Any) -> Any:
        return jnp.maximum(total, width)


@dataclass(frozen=True)
class Mean(_Widths):
    """Mean widths over time; infinite where one width was."""

    name = "mean"
    text = "mean width"

    def fold(self, total: Any, width: Any) -> Any:
        return total + width

    def end(self, total: Any, count: Any) -> Any:
        return total / count


@dataclass(frozen=True)
class Rms(_Widths):
    """Root mean square of the widths over time."""

    name = "rms"
    text = "root mean square width"

    def fold(self, total: Any, width: Any) -> Any:
        return total + width**2

    def end(self, total: Any, count: Any) -> Any:
        return jnp.sqrt(total / count)


@dataclass(frozen=True)
class Settle(Reduction):
    """First step from which on every state width is at most `factor` times the certificate's steady width.

    NaN where that never happens, and where no steady width is promised.
    """

    factor: float = 2.0
    name = "settle"

    def init(self, first: StepOutput, context: Context) -> Any:
        return self.update(jnp.int32(0), first, 0, context)

    def update(self, state: Any, out: StepOutput, k: Any, context: Context) -> Any:
        small = (out.state.width <= self.factor * context.steady).all()
        return jnp.where(small, state, jnp.int32(k + 1))

    def finish(self, state: Any, steps: Any, context: Context) -> dict[str, Any]:
        reached = (state < steps) & jnp.isfinite(context.steady).all()
        return {"settled_at": _step_or_nan(reached, state, context)}

    def describe(self) -> dict[str, Variable]:
        text = f"first step from which on all state widths are at most {self.factor:g} times the steady width"
        return {"settled_at": Variable((), text)}


@dataclass(frozen=True)
class FirstConflict(Reduction):
    """First step with the status CONFLICT; NaN where there is none."""

    name = "first_conflict"

    def init(self, first: StepOutput, context: Context) -> Any:
        return self.update(jnp.int32(-1), first, 0, context)

    def update(self, state: Any, out: StepOutput, k: Any, context: Context) -> Any:
        return jnp.where((state < 0) & _conflict(out), jnp.int32(k), state)

    def finish(self, state: Any, steps: Any, context: Context) -> dict[str, Any]:
        return {"first_conflict": _step_or_nan(state >= 0, state, context)}

    def describe(self) -> dict[str, Variable]:
        return {"first_conflict": Variable((), "first step whose data contradict the stated bounds")}


@dataclass(frozen=True)
class AnyStatus(Reduction):
    """All status bits that occurred, and the number of conflicts."""

    name = "status"

    def init(self, first: StepOutput, context: Context) -> Any:
        return first.status, _conflict(first).astype(jnp.int32)

    def update(self, state: Any, out: StepOutput, k: Any, context: Context) -> Any:
        return state[0] | out.status, state[1] + _conflict(out)

    def finish(self, state: Any, steps: Any, context: Context) -> dict[str, Any]:
        return {"status_any": state[0], "conflicts": state[1]}

    def describe(self) -> dict[str, Variable]:
        return {
            "status_any": Variable((), "status bits that occurred (0 = OK)", "status"),
            "conflicts": Variable((), "number of steps whose data contradict the stated bounds"),
        }


@dataclass(frozen=True)
class Quantiles(Kept):
    """Quantiles of the widths over time; see `quantiles`."""

    probabilities: tuple[float, ...]
    name = "quantiles"

    def row(self, out: StepOutput, k: Any, context: Context) -> Any:
        return out.state.width, out.input.width

    def finish(self, state: Any, steps: Any, context: Context) -> dict[str, Any]:
        widths, inputs = state
        return {
            "state_width_quantile": _quantiles(widths, steps, self.probabilities),
            "input_width_quantile": _quantiles(inputs[1:], steps - 1, self.probabilities),
        }

    def describe(self) -> dict[str, Variable]:
        return {
            f"{of}_width_quantile": Variable(("quantile", of), f"quantile over time of the width of the {of} box", of)
            for of in ("state", "input")
        }

    def coordinates(self) -> dict[str, np.ndarray]:
        return {"quantile": np.asarray(self.probabilities)}


@dataclass(frozen=True)
class Boxes(Kept):
    """Every box and every status: T rows for each case. Rows behind `length` are those of missing measurements."""

    name = "boxes"

    def row(self, out: StepOutput, k: Any, context: Context) -> Any:
        return out.state, out.input, out.status

    def finish(self, state: Any, steps: Any, context: Context) -> dict[str, Any]:
        x, d, status = state
        named = {"state_lower": x.lower, "state_upper": x.upper, "status": status}
        for side, bound in (("lower", d.lower), ("upper", d.upper)):
            # The box of d[k] comes with step k + 1: the last one is not known yet.
            named[f"input_{side}"] = jnp.concatenate([bound[1:], jnp.full_like(bound[:1], jnp.nan)])
        return named

    def describe(self) -> dict[str, Variable]:
        bounds = {
            f"{of}_{side}": Variable(("time", of), f"{side} bound of the {of}", of)
            for of in ("state", "input")
            for side in ("lower", "upper")
        }
        return {**bounds, "status": Variable(("time",), "status of the step (0 = OK)", "status")}


@named_arguments
def quantiles(*probabilities: float) -> Quantiles:
    """Quantiles over time of the widths, exact (linear between the sorted widths).

    All widths of a tile are held until its last step: 16 (n + p) T bytes a case in double precision. The size of a
    tile takes that into account, so tiles get smaller, not the machine fuller.

    Args:
        probabilities: in [0, 1].

    Raises:
        ValueError: a probability is outside [0, 1], or there is none.

    >>> quantiles(0.5, 0.95).probabilities
    (0.5, 0.95)
    """
    if not probabilities or not all(isinstance(q, int | float | np.number) and 0 <= q <= 1 for q in probabilities):
        raise ValueError(f"quantiles: give probabilities between 0 and 1, for example 0.5, 0.95; got {probabilities}")
    return Quantiles(tuple(float(q) for q in probabilities))


@named_arguments
def settle(factor: float = 2.0) -> Settle:
    """First step from which on all state widths are at most `factor` times the certificate's steady width.

    Raises:
        ValueError: the factor is not positive.
    """
    if not factor > 0:
        raise ValueError(f"settle: `factor` must be positive, got {factor}")
    return Settle(float(factor))


REDUCTIONS: dict[str, Reduction] = {
    reduction.name: reduction
    for reduction in (
        Final(), Max(), Mean(), Rms(), Settle(), FirstConflict(), AnyStatus(), Coverage(), Error(), Boxes(),
    )
}  # fmt: skip
"""Every reduction that `sweep` and `monte_carlo` know by name: what is kept of a run. More are made by `quantiles` and
`settle`, or are subclasses of `Reduction`."""


def resolve(call: str, reduce: Any, truth: bool) -> tuple[Reduction, ...]:
    """The reductions that `reduce` names: names, `Reduction` objects, one or several; None keeps every box.

    Raises:
        ValueError: an unknown name, one twice, or a reduction that needs the truth where there is none.
    """
    if not (reduce is None or isinstance(reduce, str | Reduction | Iterable)):
        raise ValueError(
            f'{call}: `reduce` must name reductions, as "final" or ["final", "mean"], got {type(reduce).__name__}'
        )
    asked = ("boxes",) if reduce is None else (reduce,) if isinstance(reduce, str | Reduction) else tuple(reduce)
    known = ", ".join(REDUCTIONS)
    found = []
    for one in asked:
        reduction = one if isinstance(one, Reduction) else REDUCTIONS.get(one) if isinstance(one, str) else None
        if reduction is None:
            raise ValueError(
                f"{call}: unknown reduction {one!r}; known are {known}, and gx.study.quantiles(0.5, 0.95), "
                "gx.study.settle(3) or your own gx.study.Reduction"
            )
        if reduction.needs_truth and not truth:
            raise ValueError(f"{call}: the reduction {reduction.name!r} needs the truth; give truth=(x, d)")
        found.append(reduction)
    names = [reduction.name for reduction in found]
    if not names or len(set(names)) != len(names):
        raise ValueError(f"{call}: `reduce` must name at least one reduction, and each of them once; got {names}")
    return tuple(found)


def _conflict(out: StepOutput) -> Any:
    return (out.status & int(Status.CONFLICT)) != 0


def _step_or_nan(happened: Any, step: Any, context: Context) -> Any:
    """Floating, because a count has no NaN."""
    return jnp.where(happened, step, jnp.nan).astype(jnp.result_type(context.steady))


def _quantiles(widths: Any, steps: Any, probabilities: tuple[float, ...]) -> Any:
    """Quantiles of the first `steps` rows, (Q, n). Infinite widths stay infinite and never make a NaN."""
    rows = widths.shape[0]
    if rows == 0:
        return jnp.full((len(probabilities), *widths.shape[1:]), jnp.nan, widths.dtype)
    counted = (jnp.arange(rows) < steps)[:, None]
    ordered = jnp.sort(jnp.where(counted, widths, jnp.inf), axis=0)
    ends = []
    for probability in probabilities:
        place = jnp.asarray(probability, widths.dtype) * jnp.maximum(steps - 1, 0)
        low = jnp.clip(jnp.floor(place).astype(jnp.int32), 0, rows - 1)
        a, b = ordered[low], ordered[jnp.minimum(jnp.ceil(place).astype(jnp.int32), rows - 1)]
        share = place - low
        between = jnp.where(jnp.isfinite(b), a + share * (b - a), b)
        ends.append(jnp.where(steps > 0, jnp.where(a == b, a, between), jnp.nan))
    return jnp.stack(ends)
