"""Zarr arrays as a study stores them, and one line for whatever a disk refuses."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gsisio_jax._extras import need


class StoreError(OSError, ValueError):
    """The disk is full, or the store cannot be read or written there. Finished tiles stay as they are."""


def create_array(create: Any, shape: Any, chunks: Any, dtype: Any, plain: bool = False, **more: Any) -> Any:
    """Create a Zarr array the one way this file does: flat chunk names, checksums, no chunk left out as empty."""
    codecs = need("zarr.codecs", extra="study", purpose="storing a study")
    return create(
        shape=shape,
        chunks=tuple(max(size, 1) for size in chunks),
        dtype=np.dtype(dtype),
        fill_value=fill_value(dtype),
        compressors=None if plain else [codecs.ZstdCodec(level=1, checksum=True)],
        chunk_key_encoding={"name": "default", "separator": "."},
        config={"write_empty_chunks": True},
        **more,
    )


def encoded(chunk: np.ndarray) -> bytes:
    """The bytes of a chunk, by Zarr's own encoder on a store in memory."""
    zarr = need("zarr", extra="study", purpose="storing a study")
    memory: dict[str, Any] = {}
    create_array(partial(zarr.create_array, memory, zarr_format=3), chunk.shape, chunk.shape, chunk.dtype)[...] = chunk
    return memory[".".join(["c", *["0"] * chunk.ndim])].to_bytes()


def flush_folder(path: Path) -> None:
    """Make the names in a folder durable; Windows has no such call and needs none."""
    if os.name == "nt":
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def is_empty(path: Path) -> bool:
    return path.is_dir() and not any(path.iterdir())


def fill_value(dtype: Any) -> Any:
    kind = np.dtype(dtype).kind
    return np.nan if kind == "f" else False if kind == "b" else 0


def failure(error: OSError, what: str, kept: str) -> StoreError:
    full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    remedy = "free some space" if full else "check the path and who may write there"
    message = StoreError(f"{what}: {error.strerror or error}; {kept}; {remedy}, then make the same call again")
    message.errno = error.errno
    return message


@contextlib.contextmanager
def one_line_os_error(what: str, kept: str) -> Iterator[None]:
    """Turn an error of the operating system into one line that names the path and the remedy."""
    try:
        yield
    except StoreError:
        raise
    except OSError as error:
        raise failure(error, what, kept) from error
