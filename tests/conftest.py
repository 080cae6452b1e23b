"""The reference results are double precision; float32 is tested by float32 inputs."""

import gc
from collections.abc import Iterator

import jax
import pytest

jax.config.update("jax_enable_x64", True)
# Tracing makes millions of small objects that live on: looking for garbage as often as usual is a tenth of the time.
gc.set_threshold(100_000, 20, 50)


# A file stays on one worker. These take longest; begun last (they have few tests), they would leave a core idle.
LONGEST = ("test_containment.py", "test_tune_linear.py", "test_gradients.py", "test_documents.py", "test_missing.py",
           "test_methods.py", "test_conflicts.py", "test_tune_scale.py")  # fmt: skip


def pytest_collection_finish() -> None:
    """What is imported lives on: no collection need look at it."""
    gc.collect()
    gc.freeze()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: item.path.name not in LONGEST)


@pytest.fixture(scope="module", autouse=True)
def little_memory() -> Iterator[None]:
    """No module needs the programs of another one; kept, they take gigabytes, and ever longer collections."""
    yield
    jax.clear_caches()
    gc.collect()
