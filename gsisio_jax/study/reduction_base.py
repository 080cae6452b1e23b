"""What a study keeps of every run: reductions that go along with the recursion, one step at a time.

All functions here see one case; the kernel maps them over a tile.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

import numpy as np

from gsisio_jax.observer.types import StepOutput


class Context(NamedTuple):
    """What a reduction may know besides the boxes of step k.

    Attributes:
        steady: (n,) state width that the certificate promises for the noise of the case.
        x: (n,) true state x[k], or None.
        d: (p,) true input d[k-1] (meaningless at k = 0), or None.
        exact: that truth is known to be one of the plant as stated; else it may be off by rounding.
    """

    steady: Any
    x: Any = None
    d: Any = None
    exact: Any = False


class Variable(NamedTuple):
    """How a result is labelled: dimensions after those of the study, a line of text, and whose unit it has.

    `unit` is "state" or "input" (that of the signal), or the unit itself.
    """

    dims: tuple[str, ...]
    text: str
    unit: str = ""


class Reduction:
    """A running reduction; subclass it for your own. Instances must be hashable: frozen dataclasses are.

    Attributes:
        name: unique among the reductions of a study; with the fields of a dataclass it identifies a stored study.
        needs_truth: `sweep` must be given the truth.
    """

    name: ClassVar[str]
    needs_truth: ClassVar[bool] = False

    def init(self, first: StepOutput, context: Context) -> Any:
        """State (a pytree of arrays of fixed shapes and types) after step 0."""
        raise NotImplementedError

    def update(self, state: Any, out: StepOutput, k: Any, context: Context) -> Any:
        """State after step k >= 1."""
        raise NotImplementedError

    def finish(self, state: Any, steps: Any, context: Context) -> dict[str, Any]:
        """Results by name after `steps` steps; the context has no truth any more."""
        raise NotImplementedError

    def describe(self) -> dict[str, Variable]:
        """Labels of the results; one that is missing here gets dimensions of its own."""
        return {}

    def coordinates(self) -> dict[str, np.ndarray]:
        """Labels of dimensions that only this reduction has."""
        return {}


class Kept(Reduction):
    """A reduction that must see all rows at once. It costs memory: the rows of all cases of a tile are held.

    The state that `finish` gets is what `row` returned, stacked along a first axis (T, ...).
    """

    def row(self, out: StepOutput, k: Any, context: Context) -> Any:
        """What to keep of step k (a pytree of arrays)."""
        raise NotImplementedError
