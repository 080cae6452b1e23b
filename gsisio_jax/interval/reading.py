"""How arrays that a user gives are read, for every public call: NumPy, JAX, lists, masked arrays, pandas.

Nothing is lost on the way: what is marked as missing counts as missing or is refused, never as the number that happens
to stand there, and what is no real number (complex, dates, text), or none that float64 can hold, is refused.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Set
from decimal import Decimal
from numbers import Integral, Real
from typing import Any, NoReturn, TypeGuard

import jax
import jax.numpy as jnp
import numpy as np


class _Refused(Exception):
    """What came, and the remedy."""


def read_array(call: str, name: str, value: Any, missing: bool = False) -> Any:
    """The numbers that a user gives.

    Args:
        call: what the message names.
        name: of the argument.
        value: an array of NumPy or JAX, a number, nested lists, a masked array, a Series or DataFrame, or whatever else
            NumPy makes an array of.
        missing: entries may be missing: masked ones, NA, None and NaT become NaN. Otherwise they are refused. (NaN
            itself is handed on, for the caller to judge.)

    Returns:
        Floating arrays of JAX and NumPy as they are (subclasses of NumPy's as plain arrays), all else in float64.

    Raises:
        ValueError: it is no array of real numbers, an entry is missing, or float64 would round an integer.
    """
    if type(value) is np.ndarray and value.dtype.kind == "f" and value.dtype.itemsize <= 8:
        return value
    try:
        return _numbers(value, missing)
    except _Refused as error:
        raise ValueError(f"{call}: `{name}` must be an array of real numbers, got {error}") from None


def is_whole(value: Any) -> TypeGuard[int]:
    """A whole number, of Python or of NumPy; True and False are none."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def check_type(call: str, name: str, value: Any, kinds: type | tuple[type, ...], remedy: str = "") -> None:
    """Refuse an argument that is no object of this library where one is needed.

    Raises:
        ValueError: says what was needed, what came, and that arguments may have been swapped where it is ours.
    """
    if isinstance(value, kinds):
        return
    names = [kind.__name__ for kind in (kinds if isinstance(kinds, tuple) else (kinds,))]
    ours = type(value).__module__.startswith("gsisio_jax")
    hint = " (arguments in the wrong order?)" if ours else ""
    raise ValueError(
        f"{call}: `{name}` must be a gsisio_jax.{' or '.join(names)}, got {type(value).__name__}{hint}"
        + (f"; {remedy}" if remedy else "")
    )


def _refuse(got: str, remedy: str = "") -> NoReturn:
    raise _Refused(f"{got}; {remedy}" if remedy else got)


def _numbers(value: Any, missing: bool) -> Any:
    if isinstance(value, jax.Array):
        return _of_jax(value)
    if isinstance(value, np.ma.MaskedArray):
        return _of_masked(value, missing)
    _check_kind(value)
    # A single date of pandas (`Timestamp`) has no columns.
    columns = {1: "dtype", 2: "dtypes"}.get(getattr(value, "ndim", 0))
    if type(value).__module__.split(".")[0] == "pandas" and columns and hasattr(value, columns):
        return _of_pandas(value, missing)
    if hasattr(value, "to_numpy"):  # xarray, polars
        return _numbers(value.to_numpy(), missing)
    if isinstance(value, list | tuple) and any(map(_is_array_like, value)):
        return _stacked([_numbers(part, missing) for part in value])
    try:
        array = np.asarray(value)
    except Exception as error:  # whatever another library's conversion raises
        if "inhomogeneous" in str(error):
            _refuse("rows of different lengths", "give all of them the same length")
        _refuse(f"an object of type {type(value).__name__} ({str(error).splitlines()[0]})")
    return _of_numpy(array, missing, type(value).__name__)


def _check_kind(value: Any) -> None:
    """Refuse what NumPy would take apart in its own way."""
    kind = type(value).__name__
    if isinstance(value, Mapping):
        _refuse(
            f"columns by name ({', '.join(map(str, list(value)[:4]))})",
            "their order is not that of the system: give np.column_stack([data[name] for name in (...)])",
        )
    if hasattr(value, "to_numpy"):  # whose columns may have any names
        return
    if type(value).__module__.startswith("gsisio_jax"):
        _refuse(f"an object of type {kind}", "are the arguments in the right order?")
    if isinstance(value, Set) or callable(value) or hasattr(value, "__next__"):
        _refuse(f"an object of type {kind}")
    if hasattr(value, "toarray"):
        _refuse(f"a sparse matrix ({kind})", "give .toarray()")
    if (isinstance(value, np.ndarray) and hasattr(value, "unit")) or hasattr(value, "magnitude"):
        _refuse(f"a quantity with a unit ({kind})", "convert it to the unit of the system, and give its plain numbers")


def _of_jax(value: jax.Array) -> Any:
    if jnp.issubdtype(value.dtype, jnp.floating):
        return value
    if jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
        _refuse("a random key", "are the arguments in the right order?")
    if jnp.issubdtype(value.dtype, jnp.complexfloating):
        _refuse_complex()
    return value.astype(jnp.result_type(float))


def _of_masked(value: np.ma.MaskedArray, missing: bool) -> np.ndarray:
    mask = np.ma.getmaskarray(value)
    data = np.asarray(value.data)
    if data.dtype.names is not None:
        return _of_numpy(data, missing, "masked array")
    if mask.any():
        _check_missing(mask, missing, "masked")
        data = np.where(mask, np.zeros((), data.dtype), data)  # what stands there is no number of anybody's
    return np.where(mask, np.nan, _of_numpy(data, missing, "masked array"))


def _of_pandas(value: Any, missing: bool) -> np.ndarray:
    if value.ndim == 1:
        return _of_column(value, missing)
    if all(isinstance(dtype, np.dtype) and dtype.kind == "f" for dtype in value.dtypes):
        return value.to_numpy()
    columns = []
    for place, name in enumerate(value.columns):
        try:
            columns.append(_of_column(value.iloc[:, place], missing))
        except _Refused as error:
            raise _Refused(f"in its column {name!r} {error}") from None
    return np.column_stack(columns) if columns else np.zeros(value.shape)


def _of_column(column: Any, missing: bool) -> np.ndarray:
    if isinstance(column.dtype, np.dtype):
        return _of_numpy(column.to_numpy(), missing, "pandas object")
    absent = np.asarray(column.isna())
    if absent.any():
        _check_missing(absent, missing, "missing (NA)")
    found = np.full(column.shape, np.nan)
    present = column[~absent]
    kind = getattr(column.dtype, "kind", "O")
    # Nullable numbers without their missing entries have a plain type; everything else is looked at one by one.
    plain = present.to_numpy(dtype=getattr(column.dtype, "numpy_dtype", object) if kind in "fiub" else object)
    found[~absent] = _of_numpy(plain, missing, str(column.dtype))
    return found


def _is_array_like(value: Any) -> bool:
    """Something in a list that NumPy would read wrongly, or not at all."""
    if isinstance(value, list | tuple):
        return any(map(_is_array_like, value))
    return isinstance(value, jax.Array | np.ma.MaskedArray | Mapping) or hasattr(value, "to_numpy")


def _stacked(parts: list[Any]) -> Any:
    shapes = list(dict.fromkeys(np.shape(part) for part in parts))
    if len(shapes) > 1:
        _refuse(f"rows of different shapes ({', '.join(map(str, shapes[:3]))})", "give all of them the same length")
    return (jnp if any(isinstance(part, jax.Array) for part in parts) else np).stack(parts)


def _of_numpy(value: np.ndarray, missing: bool, kind: str) -> np.ndarray:
    if value.dtype.kind == "c":
        _refuse_complex()
    if value.dtype.kind in "mM":
        _refuse(f"dates or times ({value.dtype})", "give seconds, as numbers: (t - t[0]) / np.timedelta64(1, 's')")
    if value.dtype.kind in "USTa":
        _refuse("text", "convert it to numbers (float, pandas.to_numeric)")
    if value.dtype.names is not None:
        _refuse("a structured array", "give numpy.lib.recfunctions.structured_to_unstructured(...)")
    if value.dtype.kind == "O":
        return _of_objects(value, missing, kind)
    if value.dtype.kind in "iu":
        return _exact(value, lambda number: int(number) != int(float(number)))
    if value.dtype.kind == "f" and value.dtype.itemsize > 8:
        return _exact(value, lambda number: number == number and np.longdouble(float(number)) != number)
    if jnp.issubdtype(value.dtype, jnp.floating):
        return value
    return value.astype(np.float64)


def _exact(value: np.ndarray, wrong: Callable[[Any], bool]) -> np.ndarray:
    """In float64, where that holds every number: rounding to nearest would move bounds inward, and measurements."""
    found = value.astype(np.float64)
    suspects = value if value.dtype.kind == "f" else value[np.abs(found) >= 2.0**53]
    for number in np.ravel(suspects):
        if wrong(number):
            _refuse(f"{number!s}, which float64 cannot hold", "subtract an offset, or round it with .astype(float)")
    return found


def _of_objects(value: np.ndarray, missing: bool, kind: str) -> np.ndarray:
    found = np.empty(value.shape)
    for index, entry in np.ndenumerate(value):
        if entry is None or entry is np.ma.masked or type(entry).__name__ in ("NAType", "NaTType"):
            if value.ndim == 0:
                _refuse("nothing (None)")
            if not missing:
                _refuse_missing(index, "missing")
            found[index] = np.nan
        elif isinstance(entry, Integral):
            found[index] = _exact_integer(int(entry))
        elif isinstance(entry, Real | Decimal):
            found[index] = float(entry)
        elif isinstance(entry, complex | np.complexfloating):
            _refuse_complex()
        elif value.ndim == 0:
            _refuse(f"an object of type {kind}")
        else:
            _refuse(f"an entry of type {type(entry).__name__} at index {list(index)}")
    return found


def _exact_integer(number: int) -> float:
    if abs(number) > 2**1023 or int(float(number)) != number:
        _refuse(f"the integer {number:.6e}" if abs(number) < 2**1023 else "an integer beyond float64",
                "float64 cannot hold it: subtract an offset, or round it")  # fmt: skip
    return float(number)


def _check_missing(absent: np.ndarray, missing: bool, what: str) -> None:
    if not missing:
        _refuse_missing(np.argwhere(absent)[0], what)


def _refuse_missing(index: Iterable[int], what: str) -> NoReturn:
    where = [int(i) for i in index]
    _refuse(f"an entry that is {what} at index {where}", "every entry must be known here (inf for unknown bounds)")


def _refuse_complex() -> NoReturn:
    _refuse(
        "complex numbers", "give .real if the imaginary part is only rounding; else write real and imaginary parts as "
        "two signals"
    )  # fmt: skip
