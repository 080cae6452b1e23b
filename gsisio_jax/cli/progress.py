"""A progress bar that appears only where a run turns out to be long, and only where a person is watching."""

from __future__ import annotations

import sys
import threading
from types import TracebackType
from typing import Literal

from .._extras import need

When = Literal["auto", "always", "never"]


class DelayedProgress:
    """A bar on standard error that appears after a delay, also while the main thread is inside a compilation.

    Args:
        when: ``"auto"`` shows it where standard error is a terminal, ``"always"`` and ``"never"`` say so.
        delay: seconds before it appears.
    """

    def __init__(self, when: When = "auto", delay: float = 2.0):
        need("rich", extra="cli", purpose="the command line")
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        forced = when == "always"
        self._wanted = forced or (when == "auto" and sys.stderr.isatty())
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            console=Console(stderr=True, force_terminal=True if forced else None),
            transient=True,
        )
        self._task = self._progress.add_task("starting", total=None)
        self._lock = threading.Lock()
        self._closed = False
        self._timer = threading.Timer(delay, self._show)
        self._timer.daemon = True

    def __enter__(self) -> DelayedProgress:
        if self._wanted:
            self._timer.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._timer.cancel()
        with self._lock:
            self._closed = True
        # A display that never started stops without printing anything.
        if self._progress.live.is_started:
            self._progress.stop()

    def _show(self) -> None:
        with self._lock:
            if not self._closed:
                self._progress.start()

    def stage(self, description: str, total: int | None = None) -> None:
        """Name what is being done; `total` counts its steps where they can be counted."""
        # A new task, because one that had a total cannot go back to having none.
        self._progress.remove_task(self._task)
        self._task = self._progress.add_task(description, total=total)

    def advance(self, steps: int) -> None:
        """Count steps that are done."""
        self._progress.advance(self._task, steps)
