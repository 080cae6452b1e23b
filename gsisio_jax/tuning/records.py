"""Logged records for fitting: batched, of unequal length, with or without the true state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.reading import read_array
from gsisio_jax.plant.system import System


@dataclass(frozen=True)
class Records:
    """R logged records, held as NumPy arrays; shorter ones are filled up with NaN.

    Args:
        initial: box of x[0] before y[0], (n,) for all records or (R, n).
        y: measurements: (R, T, l), or a sequence of R arrays (T_r, l); one array (T, l) is one record. NaN is missing.
        u: known inputs, as `y`, or one (T, m) that all records share; None where the system has none.
        x: logged true states, as `y`, T_r rows or one more (as `simulate` returns them); NaN where not logged.
        d: logged unknown inputs, as `y`, T_r rows or one less.

    Raises:
        ValueError: shapes do not agree, or a number is infinite.

    >>> Records(Interval([0.0], [1.0]), [np.zeros((3, 1)), np.zeros((5, 1))]).length.tolist()
    [3, 5]
    """

    initial: Interval
    y: Any
    u: Any = None
    x: Any = None
    d: Any = None
    length: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        y = _pieces("y", self.y) if len(self.y) else []
        if not y:
            raise ValueError("Records: `y` holds no record; give at least one array (T, l)")
        length = np.array([len(piece) for piece in y])
        if not length.all():
            raise ValueError(f"Records: record {int(np.argmin(length))} of `y` has no row; every record needs T >= 1")
        steps = int(length.max())
        initial = self.initial
        if not isinstance(initial, Interval) or len(initial.shape) not in (1, 2):
            raise ValueError(
                "Records: `initial` must be an Interval of shape (n,) or (R, n), got "
                f"{getattr(initial, 'shape', initial)}"
            )
        if len(initial.shape) == 2 and initial.shape[0] != len(y):
            raise ValueError(f"Records: `initial` has {initial.shape[0]} boxes for {len(y)} records of `y`")
        shape = (len(y), initial.shape[-1])
        sides = (np.array(np.broadcast_to(np.asarray(s, float), shape)) for s in (initial.lower, initial.upper))
        values: dict[str, Any] = {"initial": Interval(*sides), "length": length, "y": _stack("y", y, steps, np.nan)}
        for name, rest, shared in (("u", 0.0, True), ("x", np.nan, False), ("d", np.nan, False)):
            given = getattr(self, name)
            if given is None:
                continue
            if shared and np.ndim(given) == 2 and len(y) > 1:
                given = [read_array("Records", name, given)[:rows] for rows in length]
            pieces = _pieces(name, given)
            legal = {"u": (0,), "x": (0, 1), "d": (-1, 0)}[name]
            if len(pieces) != len(y):
                raise ValueError(f"Records: `{name}` has {len(pieces)} records, `y` has {len(y)}")
            for r, (piece, rows) in enumerate(zip(pieces, length, strict=True)):
                if len(piece) - rows not in legal:
                    raise ValueError(
                        f"Records: record {r} of `{name}` has {len(piece)} rows, `y` has {rows}; expected "
                        + " or ".join(str(rows + extra) for extra in legal)
                    )
            pieces = [piece[:rows] for piece, rows in zip(pieces, length, strict=True)]
            values[name] = _stack(name, pieces, steps, rest)
        for name, value in values.items():
            object.__setattr__(self, name, value)
        if self.u is not None and np.isnan(self.u).any():
            raise ValueError("Records: `u` must be finite in every row; a known input cannot be missing")

    def __len__(self) -> int:
        return len(self.length)

    @property
    def truth(self) -> bool:
        """Some true state or input is logged."""
        return any(value is not None and bool(np.isfinite(value).any()) for value in (self.x, self.d))

    def check(self, call: str, system: System) -> None:
        """Do the records belong to this system?

        Raises:
            ValueError: a number of columns is wrong, or known inputs are missing.
        """
        sizes = {"y": system.l, "u": system.m, "x": system.n, "d": system.p}
        for name, size in sizes.items():
            value = getattr(self, name)
            if value is not None and value.shape[-1] != size:
                raise ValueError(
                    f"{call}: `{name}` of the records has {value.shape[-1]} columns, the system needs {size}"
                )
        if self.initial.shape[-1] != system.n:
            raise ValueError(
                f"{call}: the initial boxes of the records have {self.initial.shape[-1]} entries, the system has "
                f"{system.n} states"
            )
        if self.u is None and system.m:
            raise ValueError(f"{call}: the system has {system.m} known inputs; give `u` in the records")

    def arrays(self, system: System) -> dict[str, Any]:
        """Everything a compiled program takes, complete: what was not logged is NaN."""
        count, steps = self.y.shape[:2]
        absent = {
            "u": np.zeros((count, steps, system.m)),
            "x": np.full((count, steps, system.n), np.nan),
            "d": np.full((count, steps, system.p), np.nan),
        }
        given = {name: getattr(self, name) for name in absent}
        return {
            "initial": self.initial,
            "y": self.y,
            "length": self.length.astype(np.int32),
            **{name: absent[name] if value is None else value for name, value in given.items()},
        }

    def select(self, chosen: Any) -> Records:
        """Some of the records, by a mask or by indices."""
        index = np.arange(len(self))[chosen]

        def some(value: Any) -> Any:
            return None if value is None else [value[r, : self.length[r]] for r in index]

        return Records(self.initial[index], some(self.y), some(self.u), some(self.x), some(self.d))

    def join(self, other: Records) -> Records:
        """These records and those of another set behind them."""

        def both(name: str) -> Any:
            parts = [getattr(part, name) for part in (self, other)]
            if parts[0] is None and parts[1] is None:
                return None
            size = next(part.shape[-1] for part in parts if part is not None)
            pieces: list[Any] = []
            for records, part in zip((self, other), parts, strict=True):
                for r, rows in enumerate(records.length):
                    pieces.append(np.full((rows, size), np.nan) if part is None else part[r, :rows])
            return pieces

        sides = (np.concatenate([getattr(part.initial, side) for part in (self, other)]) for side in ("lower", "upper"))
        return Records(Interval(*sides), both("y"), both("u"), both("x"), both("d"))


def _pieces(name: str, value: Any) -> list[np.ndarray]:
    """One float64 array (T_r, columns) per record; what is missing is NaN."""
    missing = name != "u"
    several = isinstance(value, Sequence) and not np.isscalar(value[0] if len(value) else 0)
    if several and np.ndim(value[0]) == 2:
        pieces = [np.asarray(read_array("Records", name, piece, missing), float) for piece in value]
    else:
        array = np.asarray(read_array("Records", name, value, missing), float)
        pieces = list(array if array.ndim == 3 else array[None])
    for r, piece in enumerate(pieces):
        if piece.ndim != 2 or piece.shape[1] != pieces[0].shape[1]:
            raise ValueError(
                f"Records: record {r} of `{name}` must have shape (T, {pieces[0].shape[-1]}), got {piece.shape}"
            )
        if np.isinf(piece).any():
            raise ValueError(f"Records: record {r} of `{name}` holds an infinite number; mark missing ones with NaN")
    return pieces


def _stack(name: str, pieces: list[np.ndarray], steps: int, rest: float) -> np.ndarray:
    stacked = np.full((len(pieces), steps, pieces[0].shape[1]), rest)
    for r, piece in enumerate(pieces):
        stacked[r, : len(piece)] = piece
    return stacked
