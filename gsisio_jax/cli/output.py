"""Write all files of a run, or none of them."""

from __future__ import annotations

import contextlib
import itertools
import os
import shutil
import signal
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .._extras import need
from .errors import UserError, reason

CHUNK = 1 << 16  # rows of a chunk of a NetCDF file that is written part by part
LINES = 1 << 14  # of a CSV file that are text in memory


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


def write_all(out: Path, writers: dict[str, Callable[[Path], None]], staging_in: Path | None = None) -> list[Path]:
    """Write every file under a temporary name, then rename all of them into place.

    Args:
        out: the folder; made where it is not there, and removed again if the writing fails.
        writers: for every file name a function that writes the file whose path it is given.
        staging_in: folder on the same disk for what is not finished; `out` where left out.

    Returns:
        The paths written, in order.

    Raises:
        UserError: a file cannot be written; the folder is then as it was.
    """
    made = _make_folder(out)
    try:
        staging = Path(tempfile.mkdtemp(prefix=".gsisio-", dir=staging_in or out))
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


def write_netcdf(datasets: Iterable[Any], path: Path) -> None:
    """Write NetCDF 4: one Dataset as it is, several behind each other along an unlimited time."""
    netcdf4 = need("netCDF4", extra="cli", purpose="the command line")
    several = iter(datasets)
    first, second = next(several), next(several, None)
    if second is None:
        first.to_netcdf(path, engine="netcdf4")
        return
    chunks = {name: {"chunksizes": (CHUNK,)} for name in first.variables}
    first.to_netcdf(path, engine="netcdf4", unlimited_dims=["time"], encoding=chunks)
    with netcdf4.Dataset(path, "a") as file:
        for variable in file.variables.values():
            # By default up to 64 MiB of each variable stay in memory.
            variable.set_var_chunk_cache(size=2 * 8 * CHUNK)
        for dataset in itertools.chain([second], several):
            begin = len(file.dimensions["time"])
            rows = slice(begin, begin + dataset.sizes["time"])
            for name, variable in dataset.variables.items():
                file.variables[name][rows] = variable.values


def write_csv(datasets: Iterable[Any], path: Path) -> None:
    """Write the boxes as CSV: ``time,<signal>_lower,<signal>_upper,...,status``; numbers read back exactly.

    A box that does not exist (the input at the last step) is two empty cells, an unbounded side ``inf`` or ``-inf``.
    """
    with open(path, "w", encoding="utf-8", newline="") as stream:
        for dataset in datasets:
            bounds = [name for name, variable in dataset.data_vars.items() if "signal" in variable.attrs]
            names = ["time", *bounds, "status"]
            if stream.tell() == 0:
                stream.write(",".join(names) + "\n")
            for begin in range(0, dataset.sizes["time"], LINES):
                columns = [_cells(dataset[name].values[begin : begin + LINES]) for name in names]
                stream.writelines(f"{line}\n" for line in map(",".join, zip(*columns, strict=True)))


def _cells(values: np.ndarray) -> list[str]:
    """Numbers as they read back exactly; nothing where there is none."""
    cells = list(map(repr, values.tolist()))
    for index in np.flatnonzero(np.isnan(values)):
        cells[index] = ""
    return cells


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
