"""Write all files of a run, or none of them."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .errors import UserError, reason


def check_writable(out: Path, names: list[str]) -> None:
    """Find out before the work whether the files can be written; leave nothing behind.

    Raises:
        UserError: `out` is no folder, cannot be made or written to, or one of the files is a folder.
    """
    existing = out
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    if not existing.is_dir():
        raise UserError(f"cannot write to {out}: {existing} is not a folder")
    try:
        with tempfile.TemporaryDirectory(prefix=".gsisio-", dir=existing):
            pass
    except OSError as error:
        raise UserError(f"cannot write to {out}: {reason(error)}") from error
    for name in names:
        if (out / name).is_dir():
            raise UserError(f"cannot write {out / name}: it is a folder")


def write_all(out: Path, writers: dict[str, Callable[[Path], None]]) -> list[Path]:
    """Write every file under a temporary name, then rename all of them into place.

    Args:
        out: the folder; made where it is not there, and removed again if the writing fails.
        writers: for every file name a function that writes the file whose path it is given.

    Returns:
        The paths written, in order.

    Raises:
        UserError: a file cannot be written; the folder is then as it was.
    """
    made = _make_folder(out)
    try:
        staging = Path(tempfile.mkdtemp(prefix=".gsisio-", dir=out))
        try:
            for name, write in writers.items():
                try:
                    write(staging / name)
                except (OSError, RuntimeError) as error:
                    raise UserError(f"cannot write {out / name}: {reason(error)}") from error
                if not (staging / name).is_file():
                    raise UserError(f"cannot write {out / name}: the function that draws it made no such file")
            with _uninterrupted():
                for name in writers:
                    os.replace(staging / name, out / name)
        finally:
            shutil.rmtree(staging, ignore_errors=True)
    except BaseException as error:
        for folder in reversed(made):
            with contextlib.suppress(OSError):
                folder.rmdir()
        if isinstance(error, OSError):
            raise UserError(f"cannot write to {out}: {reason(error)}") from error
        raise
    return [out / name for name in writers]


def write_netcdf(dataset: Any, path: Path) -> None:
    """Write a Dataset as NetCDF 4."""
    dataset.to_netcdf(path, engine="netcdf4")


def write_csv(dataset: Any, path: Path) -> None:
    """Write the boxes as CSV: ``time,<signal>_lower,<signal>_upper,...,status``; numbers read back exactly.

    A box that does not exist (the input at the last step) is two empty cells, an unbounded side ``inf`` or ``-inf``.
    """
    columns = {"time": dataset["time"].values}
    bounds = [name for name, variable in dataset.data_vars.items() if "signal" in variable.attrs]
    columns |= {name: dataset[name].values for name in [*bounds, "status"]}
    with open(path, "w", encoding="utf-8", newline="") as stream:
        stream.write(",".join(columns) + "\n")
        for row in zip(*(values.tolist() for values in columns.values()), strict=True):
            stream.write(",".join(map(_cell, row)) + "\n")


def _cell(value: float | int) -> str:
    return "" if isinstance(value, float) and np.isnan(value) else repr(value)


def _make_folder(out: Path) -> list[Path]:
    missing = [folder for folder in (out, *out.parents) if not folder.exists()]
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"cannot write to {out}: {reason(error)}") from error
    return missing[::-1]


@contextlib.contextmanager
def _uninterrupted() -> Iterator[None]:
    """Hold Ctrl-C back for the few renames, so that all files change or none does."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.SIG_DFL if before is None else before)
