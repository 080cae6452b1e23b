"""Threads that run one compiled program on different chunks of a tile.

XLA's CPU backend runs the program of a step on one core. Small chunks stay in its caches, and other cores take others.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import jax


def usable() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # there is none on macOS and Windows
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextlib.contextmanager
def configured(x64: bool, threefry_partitionable: bool, matmul_precision: str | None) -> Iterator[None]:
    """What numbers depend on in the configuration of JAX, set for this thread."""
    with (
        jax.enable_x64(x64),
        jax.threefry_partitionable(threefry_partitionable),
        jax.default_matmul_precision(matmul_precision),
    ):
        yield


def configuration() -> tuple[bool, bool, str | None]:
    """The arguments of `configured`, as they are in this thread."""
    x64, *rest = (getattr(jax.config, f"jax_{name}") for name in ("enable_x64", *_OTHERS))
    return (bool(x64), *rest)


_OTHERS = "threefry_partitionable", "default_matmul_precision"


class Crew:
    """Threads for one study; leaving the context takes back what has not begun, and waits for the rest.

    What a thread does must not depend on which one it is, so that results do not depend on their number.
    """

    def __init__(self, threads: int | None = None):
        self._pool = ThreadPoolExecutor(usable() if threads is None else threads, "study")
        self._ready = False

    def __enter__(self) -> Crew:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def start(self, work: Callable[[int], None], parts: Sequence[int]) -> list[Future[None]]:
        """Do ``work(part)`` for all parts, and do not wait for it.

        The very first one is done here and now: it compiles the program, which the threads then find.

        Raises:
            Exception: whatever the first one raises.
        """
        if not self._ready:
            work(parts[0])
            self._ready, parts = True, parts[1:]
        here, device = configuration(), getattr(jax.config, "jax_default_device")  # noqa: B009 (pyright knows no such name)

        def configured_work(part: int) -> None:  # contexts of JAX belong to a thread
            with configured(*here), jax.default_device(device):
                work(part)

        return [self._pool.submit(configured_work, part) for part in parts]
