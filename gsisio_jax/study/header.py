"""What a stored study is, and how two of them differ."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

DONE = "tile_done"  # the array of markers of a store: chunk i is there once tile i is finished
CHUNK_LIMIT = 0x7E000000  # bytes, the largest buffer that the compressor of a store takes


class Header(NamedTuple):
    """What a stored study is: enough to lay out the store and to refuse the tiles of another study.

    Attributes:
        cases: number of cases N, in C order of the axes.
        tile: cases per tile; the last tile may hold fewer.
        variables: for every variable the shape per case, dtype (bool, integer or float), names of these dimensions, and
            attributes (``units``, ``long_name``, ...).
        coords: for every coordinate its dimensions, values (numbers or text) and, optionally, attributes.
        attrs: attributes of the dataset.
        fingerprint: sha256 of all that decides the numbers: observer, arguments, reductions.
        axes: names and sizes of the axes; where None, the dimensions of `coords` that no variable has, in their order.
    """

    cases: int
    tile: int
    variables: dict[str, tuple[tuple[int, ...], str, tuple[str, ...], dict[str, Any]]]
    coords: dict[str, tuple[Any, ...]]
    attrs: dict[str, Any]
    fingerprint: str
    axes: dict[str, int] | None = None


def checked(header: Header) -> Header:
    """The header in one normal form, so that a stored and a given one compare."""
    variables = {
        name: (tuple(map(int, rest)), str(np.dtype(dtype)), tuple(dims), plain_value(attrs))
        for name, (rest, dtype, dims, attrs) in header.variables.items()
    }
    coords = {}
    for name, (dims, values, *attrs) in header.coords.items():
        dims, values = ((dims,) if isinstance(dims, str) else tuple(dims)), np.asarray(values)
        values = values.astype(str) if values.dtype.kind == "O" else values
        if values.ndim != len(dims) or values.dtype.kind not in "biufU":
            raise ValueError(
                f"store: coordinate `{name}` must be numbers or text with dimensions {dims}, got {values.dtype} of "
                f"shape {values.shape}"
            )
        coords[name] = (dims, values, plain_value(attrs[0] if attrs else {}))
    axes = header.axes
    if axes is None:
        own = {dim for _, _, dims, _ in variables.values() for dim in dims}
        sizes = {d: size for dims, values, _ in coords.values() for d, size in zip(dims, values.shape, strict=True)}
        axes = {dim: size for dim, size in sizes.items() if dim not in own}
    axes = {name: int(size) for name, size in axes.items()}
    if min(header.cases, header.tile) < 1 or math.prod(axes.values()) != header.cases:
        raise ValueError(
            f"store: {header.cases} cases in tiles of {header.tile} need axes of that many cases, got {axes}; name "
            "them in Header.axes"
        )
    for name, (rest, dtype, dims, _) in variables.items():
        if np.dtype(dtype).kind not in "biuf" or len(rest) != len(dims) or name in coords or set(dims) & set(axes):
            raise ValueError(
                f"store: variable `{name}` does not fit: {dtype}, shape {rest}, dimensions {dims}, axes {axes}"
            )
        size = header.tile * math.prod(rest) * np.dtype(dtype).itemsize
        if size > CHUNK_LIMIT:
            raise ValueError(
                f"store: `{name}` of one tile takes {size / 2**30:.1f} GiB, at most 1.9 fit; give a smaller batch"
            )
    for name in (*variables, *coords):
        if name == DONE or name.startswith((".", "__")) or "/" in name or name in ("", "c", "zarr.json"):
            raise ValueError(f"store: `{name}` cannot be the name of a variable or coordinate of a store; rename it")
    return Header(
        int(header.cases), int(header.tile), variables, coords, plain_value(header.attrs), header.fingerprint, axes
    )


def plain_value(value: Any) -> Any:
    """Attributes as JSON keeps them."""
    if isinstance(value, dict):
        return {str(key): plain_value(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [plain_value(item) for item in value]
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def difference(stored: Header, given: Header) -> str:
    """What tells two studies apart, in words; empty where they are the same."""
    found = [
        f"{what} {old}, now {new}"
        for what, old, new in (
            ("cases", stored.cases, given.cases),
            ("tile size", stored.tile, given.tile),
            ("axes", stored.axes, given.axes),
            ("variables", sorted(stored.variables), sorted(given.variables)),
        )
        if old != new
    ]
    for name in sorted({*stored.variables} & {*given.variables}):
        if stored.variables[name][:3] != given.variables[name][:3]:
            found.append(f"shape or dtype of `{name}`")
    if not found and stored.fingerprint == given.fingerprint:
        return ""
    for name in sorted({*stored.coords} & {*given.coords}):
        if not np.array_equal(stored.coords[name][1], given.coords[name][1]):
            found.append(f"coordinate `{name}`")
    found += [f"`{name}`" for name in sorted(stored.attrs) if stored.attrs[name] != given.attrs.get(name)]
    return "; ".join(found) or "the observer, the arguments or the reductions, by their fingerprint"
