"""The plant that a file was saved for, and whether it is the one that is given."""

from __future__ import annotations

from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax._memo import once_per_observer
from gsisio_jax.files.program import first_difference, points, program, values
from gsisio_jax.plant.system import System

Compare = Literal["program", "values"]
_TOLERANCE = {"float64": 1e-11, "float32": 1e-4}
"""How far values of one and the same function may be apart, relative to the largest at all points: other versions of
JAX, other machines, constants in another precision."""


@once_per_observer  # a carry may be saved at every step
def described(observer: Any) -> dict[str, Any]:
    """What a file says of f and g: the programs, and values at some points of the region; JSON."""
    system, region, bounds = observer.system, observer.certificate.region, observer.system.state_bounds
    x = points(*(np.clip(side, bounds.lower, bounds.upper) for side in (region.lower, region.upper)))
    u = points(observer.u_region.lower, observer.u_region.upper)
    maps = (system.dynamics, system.measurement)
    return {
        "jax": jax.__version__,
        "dtype": str(jnp.result_type(float)),
        "f": program(system.dynamics, system.n, system.m),
        "g": program(system.measurement, system.n, system.m),
        "x": x.tolist(),
        "u": u.tolist(),
        "values": [_text(values(function, x, u)) for function in maps],
    }


def check_system(
    call: str, path: Any, stored: System, about: dict[str, Any], system: System, compare: Compare = "program"
) -> None:
    """Refuse a system that is another one than that of the file.

    Args:
        call, path: what the message names.
        stored: the system of the file, apart from f and g.
        about: what `described` said of its f and g.
        system: the one that is given.
        compare: "values": f and g may be written in another way, if they give the same values.

    Raises:
        ValueError: says what differs, entry by entry.
    """
    found = _sizes(stored, system) or [*_numbers(stored, system), *differing_maps(about, system, compare)]
    if found:
        more = f" (and {len(found) - 4} more)" if len(found) > 4 else ""
        raise ValueError(
            f"{call}: `system` must be the one that {path} was saved for; {'; '.join(found[:4])}{more}; give that "
            "system, or design for this one and save again"
        )


def _sizes(stored: System, system: System) -> list[str]:
    names = {"n": "states", "l": "outputs", "p": "unknown inputs", "m": "known inputs"}
    return [
        f"the file has {getattr(stored, size)} {what}, `system` has {getattr(system, size)}"
        for size, what in names.items()
        if getattr(stored, size) != getattr(system, size)
    ]


def _numbers(stored: System, system: System) -> list[str]:
    """Matrices and bounds, in the lower one of both precisions; periods and arguments of f and g as they are."""
    found = []
    for name in ("G", "H", "B", "D"):
        found += _entries(name, *_in_one_type(getattr(stored, name), getattr(system, name)))
    for name in ("state_bounds", "input_bounds", "input_rate"):
        file, here = getattr(stored, name), getattr(system, name)
        if file is None or here is None:
            found += [] if file is here else [f"{name} is {file} in the file and {here} here"]
            continue
        dtype = min(file.dtype, here.dtype, key=lambda dtype: np.dtype(dtype).itemsize)
        file, here = file.astype(dtype), here.astype(dtype)
        for side in ("lower", "upper"):
            found += _entries(f"{name}.{side}", *_in_one_type(getattr(file, side), getattr(here, side)))
    for name in ("periodic", "periodic_states", "f_takes_u", "g_takes_u", "input_constant"):
        file, here = getattr(stored, name), getattr(system, name)
        if file != here:
            found.append(f"{name} is {file} in the file and {here} here")
    return found


def _in_one_type(file: Any, here: Any) -> tuple[np.ndarray, np.ndarray]:
    file, here = np.asarray(file), np.asarray(here)
    dtype = min(file.dtype, here.dtype, key=lambda dtype: dtype.itemsize)
    return file.astype(dtype), here.astype(dtype)


def _entries(name: str, file: np.ndarray, here: np.ndarray) -> list[str]:
    return [
        f"{name}{list(map(int, index))} is {file[tuple(index)]} in the file and {here[tuple(index)]} here"
        for index in np.argwhere(file != here)[:1]
    ]


def differing_maps(about: dict[str, Any], system: System, compare: Compare = "program") -> list[str]:
    """In what f and g are other functions: by their programs where both were traced alike, else by their values."""
    dtype, x, u = str(jnp.result_type(float)), np.array(about["x"]), np.array(about["u"])
    x, u = x.reshape(len(x), system.n), u.reshape(len(x), system.m)
    alike = about["jax"] == jax.__version__ and about["dtype"] == dtype
    tolerance = max(_TOLERANCE[about["dtype"]], _TOLERANCE[dtype])
    found = []
    for name, function, saved in zip("fg", (system.dynamics, system.measurement), about["values"], strict=True):
        ours = program(function, system.n, system.m)
        if ours == about[name]:
            continue
        file, here = np.array([[float(v) for v in row] for row in saved]), values(function, x, u)
        file = file.reshape(here.shape)
        scale = np.nanmax(np.where(np.isfinite(file), np.abs(file), 0.0), axis=0, initial=1e-300)
        with np.errstate(invalid="ignore"):
            apart = np.abs(file - here) > tolerance * scale
        if wrong := np.argwhere(apart | (np.isnan(file) != np.isnan(here))).tolist():
            row, entry = wrong[0]
            found.append(
                f"{name} gives {file[row, entry]!s} in the file and {here[row, entry]!s} here, as its entry {entry} "
                f"at x = {x[row].tolist()}" + (f", u = {u[row].tolist()}" if system.m else "")
            )
        elif alike and compare == "program":
            found.append(
                f"{name} is written in another way ({first_difference(ours, about[name])}), though its values at "
                f'{len(x)} points are the same: compare="values" takes these as proof enough'
            )
    return found


def _text(rows: np.ndarray) -> list[list[str]]:
    """Numbers that read back exactly; JSON has no infinity."""
    return [[repr(float(value)) for value in row] for row in rows]
