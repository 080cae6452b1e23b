"""What a study varies: named axes, and the flat list of cases that their product is.

Cases are numbered 0..N-1 in C order of the axes. The product is never stored: `Layout.take` picks the rows of any set
of cases from the arguments as the user gave them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np

from gsisio_jax._calls import named_arguments

RUN = "run"  # the axis of arguments that have a leading batch axis and no name
TAKEN = ("state", "input", "time", "quantile")  # dimensions of the results themselves

# Number of dimensions of every argument without a batch axis. Noise has two: with and without time.
RANKS: dict[str, tuple[int, ...]] = {
    "initial": (1,), "y": (2,), "noise": (1, 2), "u": (2,), "length": (0,), "truth": (2,), "steady": (1,),
}  # fmt: skip


class Truth(NamedTuple):
    """What really happened, to be compared with the boxes: x (T, n) or (T+1, n), and d (T-1, p) or (T, p), or None."""

    x: Any
    d: Any = None


@dataclass(frozen=True, eq=False)
class Axis:
    """An argument of `sweep` that varies along a named axis; made by `grid`."""

    name: str
    value: Any
    coordinate: np.ndarray | None
    unit: str


@named_arguments
def grid(name: str, value: Any, coordinate: Any = None, unit: str = "") -> Axis:
    """Let an argument of `sweep` vary along a named axis.

    Arguments under different names are combined in all ways, arguments under the same name are paired.

    Args:
        name: of the axis; a dimension of the result.
        value: the argument with a leading axis of size S: an `Interval` (S, n), a record (S, T, l), a `Noise`, ...
        coordinate: (S,) values that label the axis, for example noise levels; 0..S-1 where left out.
        unit: of the coordinate.

    Returns:
        `Axis`, to be given to `sweep` in the place of the argument.

    Raises:
        ValueError: the name is empty or belongs to the result, or the coordinate is not one-dimensional.

    >>> grid("level", np.zeros((3, 2)), coordinate=[0.1, 0.2, 0.4], unit="m").name
    'level'

    Source: theory 11.
    """
    if not isinstance(name, str) or not name or name in TAKEN:
        raise ValueError(f"grid: `name` must be a word other than {', '.join(TAKEN)}; got {name!r}")
    if isinstance(value, Axis):
        raise ValueError(f"grid: the value of {name!r} lies on the axis {value.name!r} already; wrap it once")
    if value is None or (isinstance(value, list | tuple) and not value):
        got = "nothing (None)" if value is None else "an empty list"
        raise ValueError(f"grid: the value of {name!r} must have a leading axis, one entry per element, got {got}")
    if coordinate is not None:
        if isinstance(coordinate, np.ma.MaskedArray) and np.ma.is_masked(coordinate):
            raise ValueError(f"grid: `coordinate` of {name!r} has masked entries; every element needs its label")
        coordinate = np.asarray(coordinate)
        if coordinate.ndim != 1:
            raise ValueError(
                f"grid: `coordinate` of {name!r} must have shape (S,), one entry per element of the axis, got shape "
                f"{coordinate.shape}"
            )
    return Axis(name, value, coordinate, unit)


class Coordinate(NamedTuple):
    """Labels of an axis (S,) and their unit."""

    values: np.ndarray
    unit: str


class Placed(NamedTuple):
    """Where an argument lies: the index of its axis (None: shared), which leaves vary, most dimensions of one case."""

    axis: int | None
    varying: tuple[bool, ...]
    rank: int


@dataclass(frozen=True, eq=False)
class Layout:
    """The axes of a study and where its arguments lie on them.

    Attributes:
        names: of the axes, in the order in which the arguments bring them up.
        sizes: of the axes.
        coordinates: by name of the axis.
        placed: by name of the argument.
    """

    names: tuple[str, ...]
    sizes: tuple[int, ...]
    coordinates: dict[str, Coordinate]
    placed: dict[str, Placed]

    @classmethod
    def build(
        cls, call: str, arguments: Mapping[str, Any], ranks: Mapping[str, tuple[int, ...]] | None = None
    ) -> Layout:
        """Find the axes of a study.

        Args:
            call: what messages name.
            arguments: by name; arrays, `Interval`, `Noise` or `Truth`, bare or wrapped by `grid`; None is left out.
            ranks: number of dimensions of each argument without a batch axis; those of `sweep` where left out.

        Raises:
            ValueError: an argument has too few or too many dimensions, an axis is empty, or the arguments (or
                coordinates) of one axis do not agree.
        """
        ranks = RANKS if ranks is None else ranks
        sizes: dict[str, int] = {}
        first: dict[str, str] = {}
        labels: dict[str, Coordinate] = {}
        where: dict[str, tuple[str | None, tuple[bool, ...]]] = {}
        for name, argument in arguments.items():
            axis = argument.name if isinstance(argument, Axis) else RUN
            size, varying = _batch(call, name, argument, ranks[name])
            where[name] = (None if size is None else axis, varying)
            if size is None:
                continue
            if size == 0:
                raise ValueError(f"{call}: the axis {axis!r} of `{name}` is empty; give at least one element")
            if sizes.setdefault(axis, size) != size:
                raise ValueError(
                    f"{call}: the axis {axis!r} has {sizes[axis]} elements in `{first[axis]}` and {size} in `{name}`; "
                    "arguments of one axis are paired, so give equal sizes, or wrap them with gx.grid under different "
                    "names for all combinations" + _time_hint(name, argument)
                )
            first.setdefault(axis, name)
            if isinstance(argument, Axis):
                _label(call, labels, argument, size)
        names = tuple(sizes)
        for axis, size in sizes.items():
            labels.setdefault(axis, Coordinate(np.arange(size), ""))
        placed = {
            name: Placed(None if axis is None else names.index(axis), varying, ranks[name][-1])
            for name, (axis, varying) in where.items()
        }
        return cls(names, tuple(sizes.values()), labels, placed)

    @property
    def cases(self) -> int:
        """N, the number of cases."""
        return math.prod(self.sizes)

    def take(self, arguments: Mapping[str, Any], cases: np.ndarray) -> dict[str, Any]:
        """The varying parts of some cases, on the host.

        Args:
            arguments: as given to `build` (or cast to another type since).
            cases: (B,) numbers of cases.

        Returns:
            Arguments by name, every leaf with a leading axis B, None for leaves that all cases share; and the numbers
            themselves as ``case``.
        """
        index = np.unravel_index(cases, self.sizes) if self.sizes else ()
        taken: dict[str, Any] = {"case": np.asarray(cases)}
        for name, argument in arguments.items():
            axis, varying, _ = self.placed[name]
            rows = None if axis is None else index[axis]
            taken[name] = _pick(argument, varying, lambda leaf, rows=rows: np.asarray(leaf)[rows])
        return taken

    def shared(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """What all cases share: the complement of `take`, without a leading axis."""
        rest: dict[str, Any] = {"case": None}
        for name, argument in arguments.items():
            _, varying, rank = self.placed[name]
            rest[name] = _pick(
                argument,
                [not leaf_varies for leaf_varies in varying],
                # Noise (1, T, n) that changes with time but not with the case sheds its first axis.
                lambda leaf, rank=rank: leaf[0] if np.ndim(leaf) > rank else leaf,
            )
        return rest


def bare(argument: Any) -> Any:
    """An argument without its axis."""
    return argument.value if isinstance(argument, Axis) else argument


def _pick(argument: Any, chosen: Iterable[bool], change: Callable[[Any], Any]) -> Any:
    """The chosen leaves, changed, and None in the place of the others."""
    leaves, structure = jax.tree.flatten(bare(argument))
    kept = [change(leaf) if wanted else None for leaf, wanted in zip(leaves, chosen, strict=True)]
    return jax.tree.unflatten(structure, kept)


def _batch(call: str, name: str, argument: Any, ranks: tuple[int, ...]) -> tuple[int | None, tuple[bool, ...]]:
    """Size of the batch axis of an argument (None: it has none), and which leaves have it."""
    leaves = jax.tree.leaves(bare(argument))
    wrapped = isinstance(argument, Axis)
    sizes: list[int | None] = []
    for leaf in leaves:
        shape = np.shape(leaf)
        if not ranks[0] <= len(shape) <= ranks[-1] + 1:
            raise ValueError(
                f"{call}: `{name}` must have {ranks[0]} dimensions, or one more in front for a batch, got an array of "
                f"shape {shape}"
            )
        sizes.append(shape[0] if len(shape) > ranks[0] else None)
    varying = {size for size in sizes if size is not None}
    if len(ranks) > 1 and (varying != {1} or not wrapped):
        # Bounds that change with time need a leading axis to be told from a batch; of size 1 they are shared.
        sizes = [None if s == 1 and np.ndim(x) > ranks[-1] else s for s, x in zip(sizes, leaves, strict=True)]
        varying = {size for size in sizes if size is not None}
    if len(varying) > 1:
        raise ValueError(
            f"{call}: the parts of `{name}` have leading axes of {' and '.join(map(str, sorted(varying)))}; give "
            "all of them the same batch axis, or none"
        )
    if wrapped and not varying:
        shapes = ", ".join(str(np.shape(leaf)) for leaf in leaves)
        raise ValueError(
            f"{call}: gx.grid({argument.name!r}) wraps `{name}`, which has no leading batch axis (shape {shapes}); "
            "stack its values along a first axis, or give it without gx.grid to share it"
        )
    return (varying.pop() if varying else None), tuple(size is not None for size in sizes)


def _label(call: str, labels: dict[str, Coordinate], axis: Axis, size: int) -> None:
    if axis.coordinate is None:
        return
    if len(axis.coordinate) != size:
        raise ValueError(
            f"{call}: the coordinate of the axis {axis.name!r} has {len(axis.coordinate)} entries, the axis has {size}"
        )
    known = labels.setdefault(axis.name, Coordinate(axis.coordinate, axis.unit))
    if known.unit != axis.unit or not np.array_equal(known.values, axis.coordinate):
        raise ValueError(
            f"{call}: two arguments of the axis {axis.name!r} give different coordinates or units; give them once"
        )


def _time_hint(name: str, argument: Any) -> str:
    if name != "noise" or all(np.ndim(leaf) > 2 for leaf in jax.tree.leaves(bare(argument))):
        return ""
    return "; noise bounds that change with time take shape (1, T, n), or (S, T, n) for a batch"
