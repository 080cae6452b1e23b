"""One line on standard error that says what a design is at, once it has taken a while."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator

PATIENCE = 2.0  # seconds
_PERIOD = 0.5  # seconds between two looks at the clock

Say = Callable[[str], None]


@contextlib.contextmanager
def told(call: str, progress: bool | None, patience: float | None = None) -> Iterator[Say]:
    """What is to be called with the name of every stage.

    The line is written by a thread of its own, as most stages are one long call, and is wiped out at the end.

    Args:
        call: what the line begins with.
        progress: True writes it; None where standard error is a terminal or the output of a notebook's cell; False
            never.
        patience: seconds before it appears.
    """
    if progress is False or (progress is None and not (_terminal() or _notebook())):
        yield lambda stage: None
        return
    stream, wait = sys.stderr, PATIENCE if patience is None else patience
    stage, done, began = ["starting"], threading.Event(), time.monotonic()
    shown = [0]

    def watch() -> None:
        if done.wait(wait):
            return
        while True:
            text = f"{call}: {stage[0]}, {time.monotonic() - began:.0f} s"
            stream.write(f"\r{text.ljust(shown[0])}")
            stream.flush()
            shown[0] = len(text)
            if done.wait(_PERIOD):
                return

    def say(name: str) -> None:
        stage[0] = name

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield say
    finally:
        done.set()
        thread.join()
        if shown[0]:
            stream.write(f"\r{' ' * shown[0]}\r")
            stream.flush()


def _terminal() -> bool:
    return bool(getattr(sys.stderr, "isatty", lambda: False)())


def _notebook() -> bool:
    """Standard error of a Jupyter kernel is no terminal, but what a carriage return overwrites is overwritten there."""
    return type(sys.stderr).__module__.partition(".")[0] == "ipykernel"
