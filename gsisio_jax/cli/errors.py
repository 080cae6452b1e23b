"""The one kind of error that a user of the command line can cause: it becomes one line and exit code 2."""

from __future__ import annotations


class UserError(ValueError):
    """Something in the command, the configuration, the table or the folder is wrong; the message is one line."""


class Interrupted(KeyboardInterrupt):
    """Ctrl-C where there is more to say than that no file was written."""


def reason(error: BaseException) -> str:
    """The text of an error on one line, for use inside another message."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return " ".join(str(error).split()) or type(error).__name__
