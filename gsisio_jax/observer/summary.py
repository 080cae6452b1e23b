"""What a run was like, in a few lines: conflicts, gaps, and where the width promise did not apply."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from gsisio_jax.observer.status import Status

if TYPE_CHECKING:
    from gsisio_jax.observer.estimation import Estimate

NEARLY_ALL = 0.75  # of the steps with measurements: so many conflicts are no faults


@dataclass(frozen=True)
class Outside:
    """Steps for which no width is promised, because of where they are or of what was measured.

    Attributes:
        steps: of the run.
        outside: of them without a promise: the box or u of this step, or of the one before, is outside (the status
            OUTSIDE_REGION), or they are among the `unread`.
        boxes: steps whose box is not inside the region; None where it is not known.
        inputs: steps whose u is not inside `u_region`; None where it is not known.
        unread: steps of which an output, or one of the step before, is missing, ambiguous or contradicted.
    """

    steps: int
    outside: int
    boxes: int | None = None
    inputs: int | None = None
    unread: int = 0

    def __str__(self) -> str:
        if not self.outside:
            return f"0 of {self.steps} steps"
        reasons = [
            f"{what} at {count}"
            for what, count in (
                ("the box leaves the region", self.boxes),
                ("u leaves u_region", self.inputs),
                ("outputs are missing or contradicted", self.unread),
            )
            if count
        ]
        why = f" ({', '.join(reasons)})" if reasons else ""
        return (
            f"{self.outside} of {self.steps} steps{why}: {percent(self.outside / self.steps)} without a promised width"
        )

    def of_promise(self) -> str:
        """What a certificate that holds in its region is worth for this run; "" where it applies throughout."""
        if not self.outside:
            return ""
        applies = self.steps - self.outside
        at = "at no step" if not applies else f"at {applies} of {self.steps} steps"
        remedies = [
            *(["a region around the run (`around`), or a larger one"] if self.boxes else []),
            *(["a `u_region` that holds the known inputs"] if self.inputs else []),
        ]
        remedy = f"; what may help: {', and '.join(remedies)}" if remedies else ""
        return f"applies {at} of this run: elsewhere boxes are certain, and no width is promised{remedy}"


def units_hint(conflicts: int, steps: int) -> str:
    """What so many conflicts are a sign of; "" where there are fewer.

    Args:
        conflicts: steps (or cases) whose data contradict the bounds.
        steps: all that have data.
    """
    if not conflicts or conflicts < NEARLY_ALL * steps:
        return ""
    return (
        "nearly all of them contradict the stated bounds: no fault of the plant, but of the model or its bounds. "
        "Units? (degrees and radians, km/h and m/s, percent; order of columns; sample time; noise bounds too small)"
    )


def summary(est: Estimate, observer: Any = None, u: Any = None) -> str:
    """The lines of `Estimate.summary`."""
    status = np.asarray(est.status)
    steps, missing = status.size, _count(status, Status.MISSING)
    conflicts = _count(status, Status.CONFLICT)
    facts = [
        ("steps", f"{steps}"),
        ("conflicts", ": ".join(filter(None, (f"{conflicts}", units_hint(conflicts, steps))))),
        ("missing", f"{missing} steps with missing entries{', or such as are not believed' if conflicts else ''}"),
        ("unbounded", f"{_count(status, Status.UNBOUNDED)} steps with a state that is not bounded"),
        ("no promise", str(where(est, observer, u))),
    ]
    if est.kept is not None:
        facts.insert(-1, ("outvoted", f"{_count(status, Status.OUTVOTED)} steps with an output that is not kept"))
    if (
        observer is not None
        and observer.certificate.rates is not None
        and observer.certificate.rate_width.min() < np.inf
    ):
        rates = observer.certificate.rates.rates
        facts[-1] = ("promise", f"by rows over several steps, while outputs come every {rates} rows: `rate_width`")
    elif observer is not None and not observer.certificate.self_consistent:
        kind = "empty" if observer.certificate.certified else "none"
        facts[-1] = ("no promise", f"at all: the certificate is {kind}; print(observer.certificate) says why")
    return "\n".join(f"{name:<12}{text}" for name, text in facts)


def where(est: Estimate, observer: Any = None, u: Any = None) -> Outside:
    """Where the promise of the observer does not apply; counts by reason as far as `observer` and `u` tell."""
    status = np.asarray(est.status)
    boxes = inputs = None
    if observer is not None:
        region = observer.certificate.region
        boxes = int(np.count_nonzero(beyond(est.state.lower, est.state.upper, region)))
        inputs = None if u is None else int(np.count_nonzero(beyond(u, u, observer.u_region)))
    lacking = unread(status)
    return Outside(status.size, unpromised(status, lacking), boxes, inputs, int(lacking.sum()))


def unpromised(status: np.ndarray, lacking: np.ndarray) -> int:
    """How many steps have no promised width: those outside of the region, and those that are `unread`."""
    return int((lacking | (status & int(Status.OUTSIDE_REGION) != 0)).sum())


def unread(status: np.ndarray, before: bool = False) -> np.ndarray:
    """Steps (..., T) whose outputs, or those of the step before, say less than the certificate counts on.

    Args:
        status: of the steps.
        before: is that so of the step before the first one?
    """
    here = status & int(Status.MISSING | Status.AMBIGUOUS | Status.CONFLICT) != 0
    last = np.concatenate([np.full((*here.shape[:-1], 1), before), here[..., :-1]], axis=-1)
    return here | last


def beyond(lower: Any, upper: Any, box: Any) -> np.ndarray:
    """Rows (..., T) of boxes that do not lie inside another one, (n,)."""
    lower, upper = np.asarray(lower), np.asarray(upper)
    return ~((lower >= np.asarray(box.lower)) & (upper <= np.asarray(box.upper))).all(-1)


def percent(share: float) -> str:
    """Rounding does not turn some into none, nor nearly all into all."""
    return f"{100 * share:.3g} %" if share in (0.0, 1.0) or 0.001 < share < 0.999 else f"{100 * share:.6g} %"


def _count(status: np.ndarray, bit: Status) -> int:
    return int(np.count_nonzero(status & int(bit)))
