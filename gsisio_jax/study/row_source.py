"""Where the rows of a run come from: what the observer is given at every step, and the truth to compare it with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.observer import scan
from gsisio_jax.plant.system import Noise
from gsisio_jax.study.reduction_base import Variable


class Row(NamedTuple):
    """One step.

    Attributes:
        y: (l,) measurement.
        u: (m,) known input.
        noise: bounds of the step.
        x: (n,) true state x[k], or None.
        d: (p,) true input d[k-1], or None; zeros at k = 0.
        exact: the truth is one of the plant as stated, up to here and without any rounding.
    """

    y: Any
    u: Any
    noise: Noise
    x: Any = None
    d: Any = None
    exact: Any = False


class Rows:
    """A source of rows; hashable, because the program is compiled for it. All methods see one case."""

    def steps(self, case: Any) -> int:
        """T."""
        raise NotImplementedError

    def first(self, observer: Any, case: Any) -> tuple[Row, Any]:
        """Row 0, and what the source carries along."""
        raise NotImplementedError

    def given(self, case: Any) -> Any:
        """What rows 1..T-1 have at hand: a pytree with a leading axis T-1."""
        raise NotImplementedError

    def following(self, observer: Any, case: Any, carried: Any, k: Any, given: Any) -> tuple[Row, Any]:
        """Row k >= 1."""
        raise NotImplementedError

    def results(self, carried: Any) -> dict[str, Any]:
        """Results of the source itself after the last row."""
        return {}

    def identity(self, observer: Any) -> tuple[str, list[Any]]:
        """What the numbers of the source depend on, the same in every process: text, and arrays."""
        return type(self).__name__, []

    def describe(self) -> dict[str, Variable]:
        """Labels of the results."""
        return {}

    def check(self, job: Any, cases: np.ndarray, results: dict[str, np.ndarray]) -> None:
        """Refuse the results of some cases of a `Job` that cannot be.

        Raises:
            ValueError: and why.
        """


@dataclass(frozen=True)
class Recorded(Rows):
    """Records at hand."""

    def steps(self, case: Any) -> int:
        return case["y"].shape[0]

    def first(self, observer: Any, case: Any) -> tuple[Row, Any]:
        x, d = case["truth"] if case["truth"] is not None else (None, None)
        noise = scan.noise_at(case["noise"], 0)
        # There is no d[-1]; zeros stand in for it if there is any truth of d at all.
        before = None if d is None else jnp.zeros(d.shape[1:], d.dtype)
        y = case["y"] if case["length"] is None else scan.cut(case["y"], case["length"])
        return Row(y[0], case["u"][0], noise, None if x is None else x[0], before), None

    def given(self, case: Any) -> Any:
        x, d = case["truth"] if case["truth"] is not None else (None, None)
        y = case["y"] if case["length"] is None else scan.cut(case["y"], case["length"])
        noise = jax.tree.map(lambda a: a[1:], scan.noise_rows(case["noise"]))
        steps = y.shape[0]
        return y[1:], case["u"][1:], noise, None if x is None else x[1:steps], None if d is None else d[: steps - 1]

    def following(self, observer: Any, case: Any, carried: Any, k: Any, given: Any) -> tuple[Row, Any]:
        y, u, now, x, d = given
        return Row(y, u, scan.noise_of_row(case["noise"], now), x, d), None
