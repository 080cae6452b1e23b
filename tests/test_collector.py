"""While programs are traced garbage is looked for rarely, and as before afterwards, whatever the threads."""

import gc
import threading
from collections.abc import Iterator

import pytest

from gsisio_jax._collector import rare_collection


@pytest.fixture
def usual() -> Iterator[None]:
    before = gc.get_threshold()
    gc.set_threshold(700, 10, 10)
    yield
    gc.set_threshold(*before)


def test_it_is_rare_inside_and_as_before_afterwards(usual):
    with pytest.raises(KeyError), rare_collection():
        with rare_collection():
            assert gc.get_threshold()[0] > 700
        assert gc.get_threshold()[0] > 700
        raise KeyError
    assert gc.get_threshold() == (700, 10, 10)


def test_the_last_thread_puts_it_back(usual):
    inside, leave = threading.Event(), threading.Event()

    def other() -> None:
        with rare_collection():
            inside.set()
            leave.wait()

    with rare_collection():
        thread = threading.Thread(target=other)
        thread.start()
        inside.wait()
    assert gc.get_threshold()[0] > 700
    leave.set()
    thread.join()
    assert gc.get_threshold() == (700, 10, 10)


@pytest.mark.parametrize("own", [(0, 10, 10), (10**6, 5, 5)], ids=["off", "rarer"])
def test_what_a_user_has_set_stays(usual, own):
    gc.set_threshold(*own)
    with rare_collection():
        assert gc.get_threshold() == own
    assert gc.get_threshold() == own
    gc.set_threshold(700, 10, 10)


def test_what_is_set_inside_stays(usual):
    with rare_collection():
        gc.set_threshold(5000, 1, 1)
    assert gc.get_threshold() == (5000, 1, 1)
