"""A misspelled argument of a public call: which one was meant, and which ones there are."""

from __future__ import annotations

import difflib
import functools
import inspect
from collections.abc import Callable
from typing import Any, TypeVar

import jax

config: Any = jax.config  # pyright does not know its names
Call = TypeVar("Call", bound=Callable[..., Any])


def named_arguments(function: Call) -> Call:
    """The same function, whose error about an argument that it does not have says what to write instead.

    Only an error of this very call is changed: its traceback ends here. It costs a fifth of a microsecond.

    Where a user has JAX refuse shapes or types that NumPy's rules bring together, that is for the user's own code: here
    it is allowed.
    """
    parameters = inspect.signature(function).parameters
    name = function.__qualname__.removesuffix(".__init__")
    label = "plot." + name if function.__module__.startswith("gsisio_jax.plot.") else name

    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        __tracebackhide__ = True
        try:
            if config.jax_numpy_rank_promotion != "raise" and config.jax_numpy_dtype_promotion != "strict":
                return function(*arguments, **named)
            with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
                return function(*arguments, **named)
        except TypeError as error:
            within = error.__traceback__ is not None and error.__traceback__.tb_next is not None
            unknown = [name for name in named if name not in parameters]
            if within or not unknown:
                raise
        raise TypeError(_message(label, unknown[0], [*parameters], named))

    return call  # type: ignore[return-value]


def _message(call: str, unknown: str, parameters: list[str], named: dict[str, Any]) -> str:
    taken = [name for name in parameters if name != "self"]
    # Case is no difference (`Region`); an argument that was given as well is not the one that was meant.
    left = {name.lower(): name for name in taken if name not in named}
    close = difflib.get_close_matches(unknown.lower(), left, n=1) or [
        name for name in left if len(unknown) > 2 and name.startswith(unknown.lower())
    ]
    hint = f"; did you mean `{left[close[0]]}`?" if close else "."
    return f"{call}: there is no argument `{unknown}`{hint} It takes {', '.join(taken)}"
