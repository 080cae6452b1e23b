"""What a study varies: named axes, and the flat list of cases that their product is.

Cases are numbered 0..N-1 in C order of the axes. The product is never stored: `Layout.take` picks the rows of any set
of cases from the arguments as the user gave them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.interval.box import Interval
from gsisio_jax.plant.system import Noise, System

RUN = "run"  # the axis of arguments that have a leading batch axis and no name
BLOCK = 1 << 16  # rows looked at together, so that checking a large record does not double it
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
    if coordinate is not None:
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


def prepare(call: str, system: System, arguments: Mapping[str, Any]) -> tuple[dict[str, Any], Any]:
    """Check the arguments of a study, bare or wrapped, and bring them to NumPy arrays of one floating type.

    Args:
        call: what messages name.
        system: the plant.
        arguments: initial, y, noise, u, length and truth, as in `sweep`.

    Returns:
        The arguments, bounds rounded outward where the type is narrower, and the type.

    Raises:
        ValueError: a shape or a number is not legal.
    """
    system.check_unchanged(call)
    initial, y, noise = (bare(arguments[name]) for name in ("initial", "y", "noise"))
    if not isinstance(initial, Interval) or not isinstance(noise, Noise):
        name, kind = ("noise", "Noise") if isinstance(initial, Interval) else ("initial", "Interval")
        got = type(bare(arguments[name])).__name__
        raise ValueError(f"{call}: `{name}` must be a gsisio_jax.{kind}, bare or wrapped by gx.grid; got {got}")
    y = _floating(y)
    _expect(call, "y", y, [(None, system.l)])
    steps = y.shape[-2]
    if steps == 0:
        raise ValueError(f"{call}: `y` has no rows (shape {y.shape}); give at least one measurement per record")
    _expect(call, "initial", initial.lower, [(system.n,)])
    for name, box, size in (("noise.w", noise.w, system.n), ("noise.v", noise.v, system.l)):
        if np.ndim(box.lower) == 3:
            _expect(call, name, box.lower, [(steps, size)])
        else:
            _expect(call, name, box.lower, [(size,)], ", (S, T, .) or (1, T, .) for bounds that change with time")
    _refuse(call, "y", y, np.isinf, "infinite; mark missing entries with NaN")
    try:
        Interval(initial.lower, initial.upper)
        Noise(Interval(noise.w.lower, noise.w.upper), Interval(noise.v.lower, noise.v.upper))
    except ValueError as error:
        raise ValueError(f"{call}: a bound of `initial` or `noise` is not legal. {error}") from error

    dtype = jnp.result_type(initial.dtype, y.dtype)
    dtype = jax.dtypes.canonicalize_dtype(dtype if jnp.issubdtype(dtype, jnp.floating) else float)
    cast: dict[str, Any] = {
        "initial": jax.tree.map(np.asarray, initial.astype(dtype)),
        "y": np.asarray(y, dtype),
        "noise": jax.tree.map(np.asarray, noise.astype(dtype)),
        "u": _known_input(call, system, bare(arguments["u"]), steps, dtype),
        "length": _lengths(call, bare(arguments["length"]), steps),
        "truth": _truth(call, system, bare(arguments["truth"]), steps, dtype),
    }
    for name, argument in arguments.items():
        if isinstance(argument, Axis):
            cast[name] = replace(argument, value=cast[name])
    return cast, dtype


def _known_input(call: str, system: System, u: Any, steps: int, dtype: Any) -> np.ndarray:
    if u is None:
        if system.m > 0:
            raise ValueError(f"{call}: the system has {system.m} known inputs; give `u` of shape ({steps}, {system.m})")
        return np.zeros((steps, 0), dtype)
    u = np.asarray(u, dtype)
    _expect(call, "u", u, [(steps, system.m)])
    _refuse(call, "u", u, lambda a: ~np.isfinite(a), "not finite; a known input cannot be missing")
    return u


def _lengths(call: str, length: Any, steps: int) -> np.ndarray | None:
    if length is None:
        return None
    length = np.asarray(length)
    _expect(call, "length", length, [()])
    if not np.issubdtype(length.dtype, np.integer):
        raise ValueError(f"{call}: `length` must hold integers, got {length.dtype}")
    bad = (length < 1) | (length > steps)
    if bad.any():
        raise ValueError(
            f"{call}: `length` must lie between 1 and the {steps} rows of `y`, got {int(length[bad][0])}; leave "
            "records without rows out"
        )
    return length.astype(np.int32)


def _truth(call: str, system: System, truth: Any, steps: int, dtype: Any) -> Truth | None:
    if truth is None:
        return None
    if not isinstance(truth, tuple) or len(truth) != 2:
        raise ValueError(f"{call}: `truth` must be a pair (x, d), d may be None; got {type(truth).__name__}")
    x, d = (None if part is None else np.asarray(part, dtype) for part in truth)
    if x is None:
        raise ValueError(f"{call}: `truth` must hold the true states: truth=(x, d) or (x, None)")
    _expect(call, "truth", x, [(steps, system.n), (steps + 1, system.n)])
    if d is not None:
        _expect(call, "truth", d, [(steps - 1, system.p), (steps, system.p)])
    for part in (x, d):
        if part is not None:
            _refuse(call, "truth", part, lambda a: ~np.isfinite(a), "not finite; shorten the record with `length`")
    return Truth(x, d)


def _floating(value: Any) -> Any:
    value = np.asarray(value)
    return value if jnp.issubdtype(value.dtype, jnp.floating) else value.astype(np.float64)


def _expect(call: str, name: str, value: Any, legal: list[tuple[int | None, ...]], besides: str = "") -> None:
    """The shape of one case, or that with one axis in front; None stands for any number of rows."""
    shape = np.shape(value)
    for core in legal:
        tail = shape[len(shape) - len(core) :]
        if len(shape) - len(core) in (0, 1) and all(b in (None, a) for a, b in zip(tail, core, strict=True)):
            return
    one = [tuple("T" if size is None else size for size in core) for core in legal]
    said = [str(core).replace("'", "") for core in (*one, ("S", *one[0]))]
    raise ValueError(
        f"{call}: `{name}` must have shape {' or '.join(said[:-1])}, or {said[-1]} for a batch{besides}; got {shape}"
    )


def _refuse(call: str, name: str, value: np.ndarray, bad: Callable[[Any], Any], why: str) -> None:
    if value.size == 0:
        return
    rows = value.reshape(-1, value.shape[-1])
    for start in range(0, len(rows), BLOCK):
        wrong = bad(rows[start : start + BLOCK])
        if wrong.any():
            place = np.argwhere(wrong)[0]
            index = np.unravel_index((start + place[0]) * rows.shape[1] + place[1], value.shape)
            raise ValueError(f"{call}: `{name}` is {why} (at index {[int(i) for i in index]})")
