"""Where a long run stands, on the disk: a run that was killed goes on there and ends in the same boxes, bit for bit."""

from __future__ import annotations

import contextlib
import hashlib
import shutil
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from .._version import __version__
from ..files.carries import carried, digests
from ..files.container import read, write
from ..files.program import program
from .boxes import Boxes
from .errors import UserError, reason
from .problem import Problem

EVERY = 5.0  # seconds from one to the next
_KIND = "checkpoint"


class Digest:
    """What identifies the rows that were read, however they were cut into blocks."""

    def __init__(self) -> None:
        self._parts = [hashlib.blake2b(digest_size=16) for _ in range(3)]

    def add(self, time: np.ndarray, y: np.ndarray, u: np.ndarray | None) -> None:
        for part, values in zip(self._parts, (time, y, u), strict=True):
            if values is not None:
                part.update(np.ascontiguousarray(values, dtype=np.float64).data)

    def __str__(self) -> str:
        return "".join(part.hexdigest() for part in self._parts)


def identity(observer: Any, problem: Problem, on_conflict: str, chunk: int) -> str:
    """What two runs must share for one to go on where the other stopped.

    All numbers of the observer and of the initial box, the programs of f and g, how the rows are cut, and the version
    of the library.
    """
    found = hashlib.blake2b(digest_size=16)
    for leaf in jax.tree.leaves(problem.initial):
        values = np.asarray(leaf)
        found.update(f"{values.dtype}{values.shape}".encode())
        found.update(values.tobytes())
    system = observer.system
    maps = [program(function, system.n, system.m) for function in (system.dynamics, system.measurement)]
    found.update(repr((digests(observer), maps, on_conflict, chunk, __version__)).encode())
    return found.hexdigest()


class Checkpoint:
    """A folder with the rows so far and the observer's carry after the last of them.

    Args:
        folder: not there before and after a run, and while a run is short.
        every: seconds from one to the next.

    Attributes:
        rows: how many of this run's rows it has.
        begun: this run has written to the folder.
    """

    def __init__(self, folder: Path, every: float | None = None):
        self.folder, self.rows, self.begun = folder, 0, False
        self._every, self._last = EVERY if every is None else every, time.monotonic()
        self._missing = [parent for parent in folder.parents if not parent.exists()]
        self._lock: Any = None

    @property
    def boxes(self) -> Path:
        """The file of the rows."""
        return self.folder / "rows.bin"

    @property
    def file(self) -> Path:
        return self.folder / "checkpoint.npz"

    def begin(self) -> Path:
        """Make the folder, forget an older run, and say where the rows go."""
        self.folder.mkdir(parents=True, exist_ok=True)
        self._hold()
        self.file.unlink(missing_ok=True)
        self.begun = True
        return self.boxes

    def due(self, boxes: Boxes) -> bool:
        return boxes.on_disk and time.monotonic() - self._last >= self._every

    def save(self, boxes: Boxes, carry: Any, identity: str, digest: Digest) -> None:
        """Rows first, then what refers to them; each whole or not at all."""
        boxes.sync()
        about = {"rows": len(boxes), "identity": identity, "digest": str(digest)}
        write("--resume", self.file, _KIND, about, jax.device_get(carry))
        self.rows, self._last = len(boxes), time.monotonic()

    def load(self, identity: str, observer: Any) -> tuple[Any, int, str] | None:
        """The carry, the number of rows and their digest; None where there is nothing to go on from.

        Args:
            identity: of this run.
            observer: which takes the carry.

        Raises:
            UserError: what is there belongs to another run, or cannot be read.
        """
        if not self.file.is_file():
            return None
        try:
            about, tree, arrays = read("--resume", self.file, _KIND)
        except (OSError, ValueError) as error:
            raise UserError(f"--resume: cannot read {self.file}: {reason(error)}; begin anew without it") from error
        if about["identity"] != identity:
            raise UserError(
                f"--resume: the interrupted run in {self.folder} had another plant, noise, initial box, design or "
                "version of this library; begin anew without --resume"
            )
        self._hold()
        carry = carried("--resume", self.file, tree, arrays, observer, _KIND)
        self.rows = about["rows"]
        return carry, self.rows, about["digest"]

    def leave(self) -> None:
        """The run has failed or was stopped: what helps no other run goes."""
        if self.begun and self.rows == 0:
            self.remove()
        elif self._lock is not None:
            self._lock.close()

    def remove(self) -> None:
        """Remove the folder, and those around it that were made for it and are empty."""
        if self._lock is not None:
            self._lock.close()
        shutil.rmtree(self.folder, ignore_errors=True)
        for folder in self._missing:
            with contextlib.suppress(OSError):
                folder.rmdir()

    def _hold(self) -> None:
        """Keep a second run out of the folder; where files cannot be locked (Windows), there is no such guard."""
        with contextlib.suppress(ImportError):
            import fcntl

            lock = open(self.folder / "lock", "w")  # noqa: SIM115
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                lock.close()
                raise UserError(f"cannot write to {self.folder}: another run is at work there") from error
            self._lock = lock


def refused(rows: int) -> UserError:
    """The rows that are read again are not those of the interrupted run."""
    return UserError(
        f"--resume: the first {rows:,} steps of the table are not those of the interrupted run; begin anew without "
        "--resume"
    )
