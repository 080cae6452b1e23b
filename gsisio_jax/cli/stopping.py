"""Ctrl-C and SIGTERM while a study runs: the end comes soon, also where the main thread is inside of compiled code."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

GRACE = 2.0  # seconds that the main thread has to hear of a signal


class Terminated(KeyboardInterrupt):
    """SIGTERM, to be handled as Ctrl-C is."""


def exit_code(error: KeyboardInterrupt) -> int:
    """As shells know it: 130 after Ctrl-C, 143 after SIGTERM."""
    return 128 + (signal.SIGTERM if isinstance(error, Terminated) else signal.SIGINT)


@contextlib.contextmanager
def stoppable(last_words: Callable[[], str], grace: float = GRACE) -> Iterator[None]:
    """Turn SIGTERM into an exception as Ctrl-C is one, and end the process where neither is heard in time.

    Python raises them between two of its own instructions; a large tile may keep it waiting for a minute. A stored
    study survives any end of its process, so nothing is lost if this one does not wait.

    Args:
        last_words: what is said on standard error at an end that is not heard.
        grace: seconds to wait for it.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    heard = threading.Event()
    read, write = os.pipe()
    os.set_blocking(write, False)

    def watch() -> None:
        while data := os.read(read, 64):
            number = next((n for n in data if n in (signal.SIGINT, signal.SIGTERM)), None)
            if number is not None and not heard.wait(grace):
                clear = "\r\033[K" if sys.stderr.isatty() else ""
                print(f"{clear}{last_words()}", file=sys.stderr, flush=True)
                os._exit(128 + number)

    def terminated(*_: Any) -> None:
        raise Terminated

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    term = signal.signal(signal.SIGTERM, terminated)
    wakeup = signal.set_wakeup_fd(write, warn_on_full_buffer=False)
    try:
        yield
    finally:
        heard.set()
        signal.set_wakeup_fd(wakeup)
        signal.signal(signal.SIGTERM, signal.SIG_DFL if term is None else term)
        os.close(write)
        thread.join()
        os.close(read)
