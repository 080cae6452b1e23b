"""The container of every file: a NumPy ``.npz`` archive of plain arrays, one of which is a header in JSON.

The header says what the file is (`kind`), in which version of its layout, and by which version of the library it was
written. Nothing in it is ever executed. ``numpy.load`` opens it, so the numbers are readable without this library.
"""

from __future__ import annotations

import io
import json
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from gsisio_jax._version import __version__
from gsisio_jax._whole import put
from gsisio_jax.files.tree import Node, Unknown, decode, encode

VERSION = 6
"""Of the layout; to be raised with every change of what a field of an observer or a carry means."""
_HEADER = "header.json"


def write(call: str, path: str | os.PathLike[str], kind: str, about: dict[str, Any], tree: Any) -> None:
    """Write one pytree of this library.

    Args:
        call: what messages name.
        path: of the file; one that is there is replaced.
        kind: what is in it, for example ``"observer"``.
        about: what else the header says; JSON.
        tree: the pytree, its arrays concrete.

    Raises:
        OSError: it cannot be written there; an older file is untouched.
    """
    target = _file(call, path)
    stream = io.BytesIO()
    arrays: dict[str, np.ndarray] = {}
    header = {"kind": f"gsisio_jax.{kind}", "version": VERSION, "library": __version__, "about": about}
    header["tree"] = encode(tree, kind, arrays)
    arrays[_HEADER] = np.frombuffer(json.dumps(header, ensure_ascii=False).encode(), np.uint8)
    np.savez_compressed(stream, allow_pickle=False, **arrays)
    try:
        put(target, stream.getvalue())
    except OSError as error:  # which names the temporary file
        raise OSError(error.errno, f"{call}: {error.strerror or error}", str(target)) from error


def _file(call: str, path: Any) -> Path:
    if not isinstance(path, str | os.PathLike):
        raise ValueError(f"{call}: `path` must be the name of a file, got {type(path).__name__}")
    target = Path(path)
    if not target.name or target.is_dir():
        raise ValueError(f"{call}: `path` must be the name of a file, {str(path)!r} is a folder; add a name to it")
    return target


def read(call: str, path: str | os.PathLike[str], kind: str) -> tuple[dict[str, Any], Node, dict[str, np.ndarray]]:
    """What a file says: the header's `about`, the structure and the arrays of the pytree (see `restore`).

    Raises:
        OSError: it is not there, or may not be read.
        ValueError: it is no such file, is damaged, or was written by a version of the library that this one is not.
    """
    target = _file(call, path)
    try:
        data = target.read_bytes()
    except OSError as error:
        raise OSError(error.errno, f"{call}: {error.strerror or error}", str(target)) from error
    try:
        members = _members(data)
        header = json.loads(members.pop(_HEADER).tobytes())
        found, version, library = header["kind"], header["version"], header["library"]
        about, tree = (header["about"], header["tree"]) if version == VERSION else ({}, None)
    except Exception as error:  # whatever a damaged archive makes of its readers
        why = (str(error).splitlines() or ["no reason given"])[0]
        raise ValueError(
            f"{call}: {target} must be a file that gsisio_jax has saved; it is another file, or damaged "
            f"({type(error).__name__}: {why}); save it again"
        ) from error
    if found != f"gsisio_jax.{kind}":
        held = str(found).removeprefix("gsisio_jax.")
        raise ValueError(
            f"{call}: {target} must be the file of one {kind}, it is that of one {held}; give the right one"
        )
    if version != VERSION:
        raise ValueError(
            f"{call}: {target} must be of version {VERSION}, the one that gsisio_jax {__version__} reads; it is of "
            f"version {version}, written by gsisio_jax {library}; use that one, or make and save the {kind} again"
        )
    return about, tree, members


def restore(
    call: str, path: str | os.PathLike[str], kind: str, tree: Node, arrays: dict[str, np.ndarray], system: Any = None
) -> Any:
    """The pytree of a file that `read` has taken apart.

    Raises:
        ValueError: it has parts or fields that this version of the library does not know, or lacks some.
    """
    left = dict(arrays)
    try:
        found = decode(tree, left, system)
        if left:
            raise Unknown(f"arrays that belong to nothing: {', '.join(sorted(left)[:4])}")
    except Unknown as error:
        raise ValueError(
            f"{call}: {Path(path)} must hold what gsisio_jax {__version__} knows of one {kind}; it has {error}; make "
            "and save it again"
        ) from None
    return found


def _members(data: bytes) -> dict[str, np.ndarray]:
    """Every array of the archive. Members are read whole first: that is what compares their checksums."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        raw = {name.removesuffix(".npy"): archive.read(name) for name in archive.namelist()}
    return {name: np.lib.format.read_array(io.BytesIO(one), allow_pickle=False) for name, one in raw.items()}
