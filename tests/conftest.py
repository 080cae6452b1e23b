"""The reference results are double precision; float32 is tested by float32 inputs."""

import gc
import time
from collections import Counter
from collections.abc import Iterator
from typing import Any

import jax
import pytest
from oracles.uncompiled import is_about_xla
from oracles.uncompiled import uncompiled as without_xla

from gsisio_jax._room import with_room

jax.config.update("jax_enable_x64", True)
# Tracing makes millions of small objects that live on: looking for garbage among them, even as rarely as designs do,
# is a twelfth of the time. It is looked for below.
gc.disable()


# A file stays on one worker. These take longest; begun last (they have few tests), they would leave a core idle.
LONGEST = ("test_gallery.py", "test_recovery.py", "test_documents.py", "test_uncompiled.py", "test_tune_linear.py",
           "test_containment.py", "test_model_code.py", "test_abstraction.py", "test_simulated_examples.py",
           "test_past_cells.py")  # fmt: skip


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop(session: pytest.Session) -> Any:
    """All tests once more from here, where deep calls find room: an eighth of the suite's time (`gsisio_jax._room`)."""
    if session.stash.get(_HAS_ROOM, False):
        return None
    session.stash[_HAS_ROOM] = True
    return with_room(session.config.hook.pytest_runtestloop)(session=session)


_HAS_ROOM = pytest.StashKey[bool]()


def pytest_collection_finish() -> None:
    """What is imported lives on: no collection need look at it."""
    gc.collect()
    gc.freeze()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: item.path.name not in LONGEST)


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Where the time went: `LONGEST` and the aim of the gate's time need it."""
    seconds: Counter[str] = Counter()
    for report in (report for reports in terminalreporter.stats.values() for report in reports):
        if hasattr(report, "duration"):
            seconds[report.nodeid.partition("::")[0]] += report.duration
    if sum(seconds.values()) > 60:
        terminalreporter.section(f"modules of {sum(seconds.values()):.0f} s in all")
        for name, spent in seconds.most_common(30):
            terminalreporter.line(f"{spent:7.1f} s  {name}")


_MOST_SECONDS = 90.0  # of tests between two clearings, which take two seconds
_cleared = [time.process_time()]


@pytest.fixture(scope="module", autouse=True)
def little_memory() -> Iterator[None]:
    """No module needs the programs of another one; kept, with what else is garbage, they take gigabytes."""
    yield
    if time.process_time() - _cleared[0] > _MOST_SECONDS:
        jax.clear_caches()
        gc.collect()
        _cleared[0] = time.process_time()


@pytest.fixture(scope="module", autouse=True)
def uncompiled(request: pytest.FixtureRequest) -> Iterator[None]:
    """What the observer says is asked without XLA, but in modules that are about what XLA makes of it (`COMPILED`)."""
    if is_about_xla(request):
        yield
    else:
        with without_xla():
            yield
