"""Ctrl-C while the command line is still importing its packages ends it at once, without a traceback.

Extension modules turn an interrupt into errors of their own, or crash, so until `hear_interrupts` the system's own
handling is in place: the process ends, as shells expect it to. Nothing has been written then. Where the package is used
as a library nothing is changed.
"""

from __future__ import annotations

import signal
import sys
import threading
from pathlib import PurePath


def _is_command() -> bool:
    """Is this process the command ``gsisio``, or ``python -m gsisio_jax`` (or ``gsisio_jax.cli``)?"""
    words = getattr(sys, "orig_argv", [])
    module = len(words) > 2 and words[1] == "-m" and words[2] in ("gsisio_jax", "gsisio_jax.cli")
    return module or (bool(sys.argv) and PurePath(sys.argv[0]).stem in ("gsisio", "gsisio-script"))


def _silent() -> bool:
    """Put the system's handling in the place of Python's; False where somebody else's is there already."""
    if threading.current_thread() is not threading.main_thread():
        return False
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return False
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    return True


_SILENCED = [_is_command() and _silent()]


def hear_interrupts() -> None:
    """From now on Ctrl-C is a `KeyboardInterrupt` again: there is something to say, or to clean up."""
    if _SILENCED[0]:
        _SILENCED[0] = False
        signal.signal(signal.SIGINT, signal.default_int_handler)
