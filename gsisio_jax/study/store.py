"""A study on disk that no kill can spoil: a Zarr group in which every tile of cases is one chunk of every variable.

A tile counts once its marker is there. The marker is renamed into place after all chunks of the tile were written under
other names, flushed to the disk and renamed. So whatever a killed run leaves behind is either a finished tile or
nothing, and a resumed run ends in the dataset of an undisturbed one. No file is shared between two tiles: any number
of processes may write at the same time. Zarr encodes the chunks and reads them (any Zarr reader can open the group); it
does not write them, because its local store does not flush. Source: theory 11.2.
"""

from __future__ import annotations

import contextlib
import errno
import glob
import os
import re
import shutil
import time
import uuid
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsisio_jax._extras import need
from gsisio_jax._whole import PART, put
from gsisio_jax.study.disk import (
    create_array,
    encoded,
    failure,
    fill_value,
    flush_folder,
    is_empty,
    one_line_os_error,
)
from gsisio_jax.study.header import DONE, Header, checked, difference
from gsisio_jax.study.reader import backend, for_netcdf

KEY = "gsisio_jax_study"  # the attribute of the group that makes it ours
_STALE = 3600.0  # seconds after which an unfinished file can have no writer any more


@dataclass(frozen=True)
class TileStore:
    """A stored study; holds no open file, so it can be sent to other processes. Make it with `open` or `load`."""

    path: Path
    header: Header

    @classmethod
    def open(cls, path: str | os.PathLike[str], header: Header, resume: bool = True) -> TileStore:
        """Create the store of a study, or go on with it.

        Args:
            path: folder of the store; its parents are made.
            header: what the study is.
            resume: go on with a store that is there; False refuses it.

        Raises:
            ValueError: there is a store and `resume` is False, or it belongs to another study, or the folder holds
                something else; or the header contradicts itself.
            StoreError: the store cannot be created or read.
            MissingExtra: zarr is not installed.
        """
        need("zarr", extra="study", purpose="storing a study")
        if not isinstance(path, str | os.PathLike):
            raise ValueError(f"store: `store` must be the path of a folder, got {type(path).__name__}")
        path, header = Path(path).absolute(), checked(header)
        store = cls(path, header)
        with one_line_os_error(f"store: cannot create {path}", "nothing was written"):
            if (os.path.lexists(path) and not is_empty(path)) or not store._create():
                if not resume:
                    raise ValueError(
                        f"store: {path} is there already and `resume` is False; nothing is overwritten: give another "
                        "path, delete it, or pass resume=True"
                    )
                differs = difference(cls.load(path).header, header)
                if differs:
                    raise ValueError(
                        f"store: {path} belongs to another study (differs in {differs}); give another path or delete it"
                    )
                store._tidy(_STALE)
        return store

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> TileStore:
        """Open the store of any study, for its dataset.

        Raises:
            ValueError: there is no stored study.
            StoreError: it cannot be read.
        """
        zarr = need("zarr", extra="study", purpose="reading a stored study")
        path = Path(path).absolute()
        with one_line_os_error(f"store: cannot read {path}", "nothing was changed"):
            try:
                group = zarr.open_group(path, mode="r", zarr_format=3)
                kept = dict(group.attrs)[KEY]
            except (FileNotFoundError, NotADirectoryError, KeyError, ValueError) as error:
                raise ValueError(f"store: {path} holds no stored study; give another path") from error
            if kept["format"] != 1:
                raise ValueError(f"store: {path} was written by a later version of gsisio_jax; update it to read this")
            coords = {}
            for name, (dims, attrs) in kept["coords"].items():
                text = kept["text"].get(name)
                coords[name] = (tuple(dims), group[name][...] if text is None else np.asarray(text, dtype=str), attrs)
        variables = {n: (tuple(s), d, tuple(dims), attrs) for n, (s, d, dims, attrs) in kept["variables"].items()}
        axes = {name: size for name, size in kept["axes"]}
        return cls(
            path, Header(kept["cases"], kept["tile"], variables, coords, kept["attrs"], kept["fingerprint"], axes)
        )

    @property
    def tiles(self) -> int:
        """Number of tiles."""
        return -(-self.header.cases // self.header.tile)

    def cases(self, tile: int) -> slice:
        """The cases of a tile."""
        if not 0 <= tile < self.tiles:
            raise ValueError(f"store: tile {tile} does not exist, {self.path} has tiles 0 to {self.tiles - 1}")
        return slice(tile * self.header.tile, min((tile + 1) * self.header.tile, self.header.cases))

    def missing(self) -> list[int]:
        """The tiles that are still to be written, in order."""
        return np.flatnonzero(~self._finished()).tolist()

    def write(self, tile: int, values: dict[str, np.ndarray]) -> None:
        """Write a tile: all of it, or nothing. A finished tile is left as it is.

        Args:
            tile: its number; it holds the cases `cases(tile)`.
            values: every variable of the header, shape (cases of the tile, ...), of its dtype or one that casts to it
                without loss.

        Raises:
            ValueError: a tile or a variable that the header does not have, or a wrong shape or dtype.
            StoreError: the disk is full, or the path cannot be written; the tile is then still missing.
        """
        wanted = self.cases(tile)
        chunks = {name: self._chunk(name, values, wanted.stop - wanted.start) for name in self._names(values)}
        if self._marker(tile).exists():
            return
        try:
            for name, chunk in chunks.items():
                if chunk.size:
                    key = ".".join(["c", str(tile), *["0"] * (chunk.ndim - 1)])
                    put(self.path / name / key, encoded(chunk))
                    flush_folder(self.path / name)
            put(self._marker(tile), b"\x01")
            flush_folder(self.path / DONE)
        except OSError as error:
            if self._marker(tile).exists():  # another process finished it and tidied up
                return
            count = self.tiles - len(self.missing()) if self.path.is_dir() else 0
            kept = f"{count} of {self.tiles} tiles are finished and kept"
            raise failure(error, f"store: cannot write tile {tile} to {self.path}", kept) from error

    def dataset(self, cache: bool = True) -> Any:
        """The study as an ``xarray.Dataset``: named axes first, then each variable's own dimensions.

        Values are read from the store when they are used, and kept where `cache` is True. Cases of unfinished tiles
        are NaN (integers and booleans are then float64); attribute ``complete`` says whether there are none. Which
        tiles are finished is looked up once, here.

        Raises:
            MissingExtra: xarray is not installed.
        """
        xarray = need("xarray", extra="study", purpose="the dataset of a study")
        with one_line_os_error(f"store: cannot read {self.path}", "nothing was changed"):
            finished = self._finished()
            if finished.all():
                self._tidy(0.0)
            return xarray.open_dataset(str(self.path), engine=backend()[0], cache=cache, store=self, finished=finished)

    def export_netcdf(self, path: str | os.PathLike[str]) -> Path:
        """Write the dataset as NetCDF 4 under a temporary name, then rename it; one variable in memory at a time.

        Raises:
            StoreError: the file cannot be written; a file that was there is left as it was.
            MissingExtra: netCDF4 or xarray is not installed.
        """
        need("netCDF4", extra="study", purpose="NetCDF export")
        path = Path(path).absolute()
        dataset = self.dataset(cache=False)
        for holder in (dataset, *dataset.variables.values()):
            holder.attrs = {name: for_netcdf(value) for name, value in holder.attrs.items() if value is not None}
        part = path.with_name(f".{path.name}.{uuid.uuid4().hex}{PART}")
        with one_line_os_error(f"store: cannot write {path}", "the store is as it was"):
            try:
                dataset.to_netcdf(part, engine="netcdf4")
                with open(part, "rb+") as stream:
                    os.fsync(stream.fileno())
                os.replace(part, path)
            except RuntimeError as error:  # how the NetCDF library reports a full disk
                raise OSError(errno.EIO, str(error)) from error
            finally:
                part.unlink(missing_ok=True)
            flush_folder(path.parent)
        return path

    def _marker(self, tile: int) -> Path:
        return self.path / DONE / f"c.{tile}"

    def _finished(self) -> np.ndarray:
        finished = np.zeros(self.tiles, dtype=bool)
        with one_line_os_error(f"store: cannot read {self.path}", "nothing was changed"):
            found = [
                int(match[1]) for name in os.listdir(self.path / DONE) if (match := re.fullmatch(r"c\.(\d+)", name))
            ]
        finished[found] = True
        return finished

    def _names(self, values: dict[str, np.ndarray]) -> list[str]:
        if set(values) != set(self.header.variables):
            raise ValueError(
                f"store: {self.path} keeps the variables {sorted(self.header.variables)}, a tile came with "
                f"{sorted(values)}"
            )
        return list(self.header.variables)

    def _chunk(self, name: str, values: dict[str, np.ndarray], count: int) -> np.ndarray:
        """One variable of a tile, checked and filled up to the full chunk."""
        rest, dtype, _, _ = self.header.variables[name]
        value = np.asarray(values[name])
        if value.shape != (count, *rest) or not np.can_cast(value.dtype, dtype, "safe"):
            raise ValueError(
                f"store: `{name}` of tile must be {np.dtype(dtype)} of shape {(count, *rest)}, got {value.dtype} of "
                f"shape {value.shape}"
            )
        chunk = np.full((self.header.tile, *rest), fill_value(dtype), dtype=dtype)
        chunk[:count] = value
        return chunk

    def _create(self) -> bool:
        """Lay the store out under another name and rename it; False where another process was first."""
        zarr = need("zarr", extra="study", purpose="storing a study")
        cases, tile, variables, coords, attrs, fingerprint, axes = self.header
        self.path.parent.mkdir(parents=True, exist_ok=True)
        staging = self.path.with_name(f".{self.path.name}.{uuid.uuid4().hex}{PART}")
        try:
            text = {name: values.tolist() for name, (_, values, _) in coords.items() if values.dtype.kind == "U"}
            kept = {
                "format": 1,
                "fingerprint": fingerprint,
                "cases": cases,
                "tile": tile,
                "axes": [[name, size] for name, size in (axes or {}).items()],
                "variables": variables,
                "coords": {name: (dims, attributes) for name, (dims, _, attributes) in coords.items()},
                "text": text,
                "attrs": attrs,
            }
            group = zarr.create_group(staging, zarr_format=3, attributes={**attrs, KEY: kept})
            for name, (rest, dtype, dims, attributes) in variables.items():
                layout = {"dimension_names": ("case", *dims), "attributes": attributes}
                create_array(group.create_array, (cases, *rest), (tile, *rest), dtype, name=name, **layout)
            for name, (dims, values, attributes) in coords.items():
                if name not in text:
                    layout = {"dimension_names": dims, "attributes": attributes}
                    shape = values.shape
                    array = create_array(group.create_array, shape, shape, values.dtype, name=name, **layout)
                    array[...] = values
            create_array(
                group.create_array, (self.tiles,), (1,), "uint8", name=DONE, plain=True, dimension_names=("tile",)
            )
            for folder, _, files in os.walk(staging):
                for name in files:
                    with open(Path(folder, name), "rb+") as stream:
                        os.fsync(stream.fileno())
                flush_folder(Path(folder))
            try:
                os.rename(staging, self.path)
            except OSError as error:
                if error.errno in (errno.ENOTEMPTY, errno.EEXIST):
                    return False
                raise
            flush_folder(self.path.parent)
            return True
        finally:
            shutil.rmtree(staging, ignore_errors=True)

    def _tidy(self, age: float) -> None:
        """Remove what killed runs left unfinished; only what is older than `age` seconds may have lost its writer."""
        folders = [self.path / name for name in (*self.header.variables, DONE)]
        found = [part for folder in folders for part in folder.glob(f".*{PART}")]
        found += self.path.parent.glob(f".{glob.escape(self.path.name)}.*{PART}") if age else []
        for part in found:
            with contextlib.suppress(OSError):
                if time.time() - part.stat().st_mtime >= age:
                    shutil.rmtree(part) if part.is_dir() else part.unlink()
